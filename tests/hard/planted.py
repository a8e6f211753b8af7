"""Faults planted in the product, one at a time: does a test of `make test` see each?

    python tests/hard/planted.py [--tree DIR] [--all] [NAME ...]

A copy of the working tree is changed in one place, its library compiled again where that is C++,
and the tests of the room run until one fails. `--all` runs all tests where those of the room miss
a fault; names choose faults. The exit code is 1 if one is missed. Half an hour of one processor.

The faults were chosen by a rule, before any test was looked at: of each room the functions that
every value, byte or pixel goes through, and in turns an index off by one, a swapped sign or axis, a
missing check, a wrong comparison, a dropped clip, a lost flush.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TIMEOUT = 1200
"""Seconds after which tests are ended; a fault that lets them wait for ever is seen."""
NATIVE = "formats/fhash_formats/native/"
FORMAT_TESTS = "tests/golden tests/reference tests/formats/transform tests/formats/native"
TESTS = {
    "formats/fhash_formats/container/": "tests/formats/container tests/golden",
    "formats/fhash_formats/transform/": FORMAT_TESTS,
    f"{NATIVE}files/": "tests/formats/container tests/formats/test_libfhash_files.py tests/golden",
    NATIVE: FORMAT_TESTS,
    "fhash_codec/native/": "tests/codec/native tests/codec/measure tests/codec/rendering",
    "fhash_codec/compact/": "tests/codec/compact tests/codec/test_volume.py",
    "fhash_codec/boxes.py": "tests/codec/test_boxes.py tests/cli/commands/test_decode.py",
    "cli/fhash_cli/": "tests/cli",
}
"""Tests of the files below a folder; of others, those of the room of the same name."""
BUILD = """
import runpy, setuptools, sys
whole, library = setuptools.setup, sys.argv.pop()
def one(**words):
    chosen = [each for each in words["ext_modules"] if each.name.endswith("." + library)]
    whole(**(words | {"ext_modules": chosen}))
setuptools.setup = one
sys.path.insert(0, ".")
runpy.run_path("setup.py")
"""
"""Runs setup.py for one library."""
FAULTS = """
zip-gap formats/fhash_formats/native/files/zip.cpp
if (member.offset != position || member.end() > end.offset) => if (member.end() > end.offset)
zip-crc formats/fhash_formats/native/files/zip.cpp
member.full_size < 0 && crc_32(data, size_t(member.size)) != member.crc => false
tile-present formats/fhash_formats/native/files/chunks.cpp
(next && !present(number, i)) => false
tile-sum formats/fhash_formats/native/files/chunks.cpp
return position == size || => return true ||
tiles-together formats/fhash_formats/container/array.py
range(i * count, min((i + 1) * count, n)) => range(i * count, (i + 1) * count)
layer-rounding formats/fhash_formats/container/growing.py
tuple(-(-n // length) for n => tuple(max(n // length, 1) for n
lost-sync formats/fhash_formats/support/files.py
_sync(output.temporary) => pass
band-axis formats/fhash_formats/native/plan.cpp
return refer(coarser, {0, 0, along_y > 1, 0}); => return refer(coarser, {0, along_y > 1, 0, 0});
final-clip formats/fhash_formats/native/numbers.hpp
const O raised = values[i] < low ? low : values[i]; => const O raised = values[i];
axes-back formats/fhash_formats/transform/stream.py
ordered.transpose(np.argsort(self._order)) => ordered.transpose(self._order)
coder-sign formats/fhash_formats/native/coder.cpp
plane[x] + 2 * left + left2; => plane[x] + 2 * left - left2;
tile-clip formats/fhash_formats/native/lifting_tile.hpp
const T raised = value < low ? low : value; => const T raised = value;
predict-tie formats/fhash_formats/native/predict.cpp
sign = fraction < 0 ? -1 : 1; => sign = fraction <= 0 ? -1 : 1;
mask-reach formats/fhash_formats/native/mask_levels.cpp
if (k > reach) { => if (k > reach + 1) {
last-step fhash_codec/native/march_sample.hpp
if (!on[l] || k[l] != last[l] || !(alpha[l] > 0)) continue; => continue;
bulk-end fhash_codec/native/quality.cpp
((double)one <= high) => ((double)one < high)
morton-axis fhash_codec/features/occupancy.py
for axis in (2, 1, 0) if bit => for axis in (0, 1, 2) if bit
dilate-sign fhash_codec/features/features.py
out[:-shift] |= lines[shift:] => out[shift:] |= lines[:-shift]
integer-bound fhash_codec/compact/goal.py
error=math.floor(error) + 0.5 => error=math.floor(error) + 1.5
promise-order fhash_codec/compact/encode.py
min(psnr, other_psnr) < self => max(psnr, other_psnr) < self
step-weight fhash_codec/compact/model.py
shares = [p - i for p, i => shares = [i - p for p, i
level-of-two fhash_codec/paper/network.py
if previous > fold else 2 => if previous >= fold else 2
needed-corner fhash_codec/paper/storage.py
result[last] |= layer => pass
pixel-middle fhash_codec/rendering/cameras.py
(np.arange(height) + 0.5) / height => (np.arange(height) + 1) / height
part-in-view fhash_codec/rendering/view.py
int(np.ceil(high)) + 1 + margin => int(np.ceil(high)) + margin
unpacked-sign formats/fhash_formats/readers/cf.py
values += self.offset => values -= self.offset
picked-index formats/fhash_formats/readers/layout.py
one = {place: slice(index, index + 1) for => one = {place: slice(0, 1) for
spacing-count formats/fhash_formats/writers/common.py
extent / (len(values) - 1) => extent / len(values)
merge-end fhash_codec/appending/parts.py
if end != first.steps: => if end > first.steps:
coarse-start fhash_codec/boxes.py
-(-max(low - first, 0) // every) * every => max(low - first, 0) // every * every
box-end cli/fhash_cli/selection.py
& (positions <= end) => & (positions < end)
"""
"""Name and file of each fault, the text that stands there once, and what takes its place."""


def copied(tree: Path, folder: Path) -> None:
    """Copy a working tree: files that git knows or does not ignore, and the libraries."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=tree, check=True, capture_output=True, text=True).stdout
    paths = [tree / name for name in filter(None, listed.split("\0"))]
    paths += [path for path in tree.rglob("*.so") if ".venv" not in path.parts]
    for path in filter(Path.is_file, paths):
        target = folder / path.relative_to(tree)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, target)


def tests_of(path: str) -> list[str]:
    """Return the folders and files of the tests of a file's room."""
    for room, tests in TESTS.items():
        if path.startswith(room):
            return tests.split()
    return [re.sub(r"(fhash_|formats/fhash_)(\w+/\w+)/.*", r"tests/\2", path)]


def run(python: Path, folder: Path, words: list[str]) -> subprocess.CompletedProcess[str]:
    """Run Python with the packages of a folder."""
    roots = os.pathsep.join(str(folder / root) for root in ("", "formats", "cli", "benchmarks"))
    environment = {**os.environ, "PYTHONPATH": roots, "PYTHONDONTWRITEBYTECODE": "1"}
    command, plain = [str(python), *words], {"capture_output": True, "text": True}
    try:
        return subprocess.run(command, cwd=folder, env=environment, timeout=TIMEOUT, **plain)  # type: ignore[call-overload]
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "FAILED without an end", "")


def seen_by(python: Path, folder: Path, path: str, everything: bool) -> str:
    """Return the test that sees a fault in a file, or an empty text."""
    file = folder / path
    if file.suffix in (".cpp", ".hpp"):
        library = "libfhash" if path.startswith(NATIVE) else "_codec"
        words = ["-c", BUILD, "-q", "build_ext", "--inplace", "--force", library]
        built = run(python, folder, words)
        if built.returncode:
            sys.exit(f"{path} does not compile: {built.stderr[-500:]}")
    for tests in [tests_of(path), *([["tests"]] if everything else [])]:
        done = run(python, folder, ["-m", "pytest", "-x", "-q", "-n", "0", *tests])
        if done.returncode > 2:  # no tests, or no such folder
            sys.exit(f"pytest of {tests} ends with {done.returncode}: {done.stdout[-500:]}")
        if done.returncode:
            failed = re.findall(r"^(?:FAILED|ERROR) .*", done.stdout, re.MULTILINE)
            return failed[-1] if failed else "a crash"
    return ""


def main() -> int:
    """Plant the faults that are asked for, and print which were seen."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--tree", type=Path, default=Path(__file__).parents[2])
    parser.add_argument("--all", action="store_true")
    parser.add_argument("names", nargs="*")
    options = parser.parse_args()
    tree, missed = options.tree.resolve(), []
    faults = re.findall(r"^([a-z-]+) (\S+)\n(.*) => (.*)$", FAULTS, re.MULTILINE)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        copied(tree, folder)
        for name, path, old, new in faults:
            if options.names and name not in options.names:
                continue
            file, start = folder / path, time.monotonic()
            text = file.read_text()
            if text.count(old) != 1:
                sys.exit(f"{name}: {path} has {old!r} {text.count(old)} times, not once")
            libraries = {each: each.read_bytes() for each in file.parent.glob("*.so")}
            file.write_text(text.replace(old, new))
            seen = seen_by(tree / ".venv/bin/python", folder, path, options.all)
            file.write_text(text)
            for each, data in libraries.items():
                each.write_bytes(data)
            missed += [] if seen else [name]
            took = f"{time.monotonic() - start:5.0f} s"
            print(f"{name:16s} {'seen  ' if seen else 'MISSED'} {took}  {seen[:150]}", flush=True)
    print(f"{len(missed)} missed: {', '.join(missed)}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
