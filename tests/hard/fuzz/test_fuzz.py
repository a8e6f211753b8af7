"""Native code under the sanitizers, and readers under limits, hold for a few seconds of fuzzing.

`run.py` and `readers.py` are for long runs. The quick set starts from every seventh seed of the
native code, the long set from all.
"""

from __future__ import annotations

import re
import shutil
import struct
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import readers
import run
from reporting import LONG

SECONDS = 5.0
"""Seconds for which the fuzzer mutates inputs, after it has run all seeds."""
EVERY = 1 if LONG else 7
"""Every so many of the seeds of each target are run. 7 has no factor in common with the numbers of
seeds of one setup (2 and 15), so that all kinds of seeds take turns."""
NOT_FUZZED = {
    **dict.fromkeys(("fhash_abi_version", "fhash_codec_abi_version"), "takes nothing"),
    "fhash_network_abi_version": "takes nothing",
    "fhash_between": "takes frames that Python or a file has decoded; files are fuzzed",
    **dict.fromkeys(
        (
            *(
                f"fhash_file_{name}"
                for name in ("open", "with", "node", "place", "cache", "digest")
            ),
            *(f"fhash_array_{name}" for name in ("read", "chunk", "stored", "announce", "check")),
            "fhash_chunk_free",
        ),
        "reads files as fhash_open and fhash_read do, which are fuzzed; hostile files try it",
    ),
    "fhash_price": "takes coefficients of the planner, any floats",
    "fhash_plan": "takes the caller's own values, by arrays that Python alone makes",
    **dict.fromkeys(("fhash_network_fma", "fhash_network_copy"), "for benchmarks alone"),
    **dict.fromkeys(
        ("fhash_bricks_work", "fhash_bricks_gaps", "fhash_bricks_touch", "fhash_bricks_run"),
        "trains a network of the caller's own values, by arrays that Python alone makes",
    ),
}
"""Exported functions that no target calls, and why."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.hard
def test_the_native_code_under_sanitizers(folder: Path) -> None:
    try:
        figures = run.fuzz(
            folder,
            folder / "crashes",
            seconds=SECONDS,
            processes=1,
            every=EVERY,
            optimise="-O0",
        )
    except run.CannotBuild as error:
        pytest.skip(str(error))
    assert not figures.crashes, (
        figures.crashes[0].with_suffix(".txt").read_text(encoding="utf-8")[:4000]
    )
    # All seeds were run, which reach most of the code, and more inputs.
    assert figures.executions > len(list((folder / "corpus").iterdir()))
    assert figures.edges > 3000


@pytest.mark.hard
def test_every_target_has_a_name_and_seeds(folder: Path) -> None:
    if not (folder / "corpus").exists():
        run.prepare(folder, EVERY)
    import seeds

    source = (run.HERE / "targets.cpp").read_text(encoding="utf-8")
    assert re.findall(r"targets = (\d+);", source) == [str(len(seeds.NAMES) - n) for n in (0, 1)]
    first = {path.read_bytes()[0] for path in (folder / "corpus").iterdir()}
    assert first == set(range(len(seeds.NAMES)))


def test_every_exported_function_has_a_target_and_no_target_declares_one() -> None:
    called = set()
    for path in (*run.TARGETS, run.HERE / "target_march.cpp", run.HERE / "overrun.cpp"):
        text = path.read_text(encoding="utf-8")
        assert '#include "exports.hpp"' in text, path.name
        assert not re.search(r"int64_t fhash_", text), f"{path.name} declares a function itself"
        called |= set(re.findall(r"\bfhash_\w+", text))
    declared = {name for names in run.declared().values() for name in names}
    assert called & declared == declared - NOT_FUZZED.keys()
    assert set(NOT_FUZZED) <= declared


def test_every_file_that_is_called_is_built() -> None:
    """A file of a library that no list names has no function that a target calls."""
    built = {*run.SOURCES, *run.CODEC_SOURCES, *run.NETWORK_SOURCES, *run.MARCH}
    others = [name for file, names in run.declared().items() if file not in built for name in names]
    assert set(others) <= NOT_FUZZED.keys()


@pytest.mark.hard
def test_an_overrun_is_seen(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fuzzer that sees nothing would pass all other tests."""
    source = (run.NATIVE / "quantise.cpp").read_text(encoding="utf-8")
    loop = "for (std::int64_t i = 0; i < count; i++) {\n        const std::int32_t q"
    assert source.count(loop) == 1
    (tmp_path / "quantise.cpp").write_text(
        source.replace(loop, loop.replace("i < count", "i <= count")), encoding="utf-8"
    )
    for header in (*run.NATIVE.glob("*.hpp"), *run.NATIVE.glob("*.h")):
        shutil.copy(header, tmp_path)
    monkeypatch.setattr(run, "NATIVE", tmp_path)
    monkeypatch.setattr(run, "SOURCES", ("quantise",))
    monkeypatch.setattr(run, "CODEC_SOURCES", ())
    monkeypatch.setattr(run, "NETWORK_SOURCES", ())
    monkeypatch.setattr(run, "TARGETS", (run.HERE / "overrun.cpp",))
    try:
        figures = run.fuzz(
            folder / "overrun", tmp_path / "crashes", seconds=2.0, processes=1, optimise="-O0"
        )
    except run.CannotBuild as error:
        pytest.skip(str(error))
    assert figures.crashes
    assert "heap-buffer-overflow" in figures.crashes[0].with_suffix(".txt").read_text(
        encoding="utf-8"
    )


@pytest.mark.hard
def test_code_that_does_not_compile_is_no_reason_to_skip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a compiler without sanitizers is one: else a defect would stop the fuzzer for good."""
    broken = tmp_path / "broken.cpp"
    broken.write_text("int missing();\nint used = missing() +;\n", encoding="utf-8")
    monkeypatch.setattr(run, "SOURCES", ())
    monkeypatch.setattr(run, "CODEC_SOURCES", ())
    monkeypatch.setattr(run, "NETWORK_SOURCES", ())
    monkeypatch.setattr(run, "TARGETS", (broken,))
    try:
        with pytest.raises(RuntimeError, match=r"(?s)does not compile: .*broken\.cpp"):
            run.build(tmp_path / "built", optimise="-O0")
    except run.CannotBuild as error:
        pytest.skip(str(error))
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(run.CannotBuild, match="no compiler"):
        run.build(tmp_path / "built")


LINUX = pytest.mark.skipif(
    sys.platform != "linux", reason="limits on memory and time are those of Linux"
)

PLAIN = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 1 1 1\nencoding: raw\n"
GRID = b"object 1 class gridpositions counts 1 1 1\nobject 3 class array type double "
NAMED = struct.pack(">I4sI", 1, b"x\0\0\0", 1)
LARGE = {
    "quotes.nrrd": PLAIN + b'labels: "' + b'\\"' * 60_000 + b"\n\n1",
    "brackets.nrrd": PLAIN + b"space directions: " + b"( " * 60_000 + b"\n\n1",
    "items.dx": GRID + b"items 1 " * 30_000 + b"\n",
    # a variable of 20,000 dimensions
    "many.nc": b"CDF\1"
    + struct.pack(">3I", 0, 10, 1)
    + NAMED
    + struct.pack(">4I", 0, 0, 11, 1)
    + NAMED[:8]
    + struct.pack(">I", 20_000)
    + bytes(80_000)
    + struct.pack(">5I", 0, 0, 1, 4, 200)
    + bytes(400),
}
"""Files whose work once grew with the square of their length."""


@LINUX
def test_hostile_files_are_refused_within_limits() -> None:
    """Each of them once hung, or took gigabytes."""
    batch = [(path.name, path.read_bytes()) for path in sorted(readers.HOSTILE.iterdir())]
    batch += LARGE.items()
    assert len(batch) > 15
    wrong = readers.run_batch(batch)
    assert not wrong, "\n".join(f"{batch[number][0]}: {why}" for number, why in wrong)


@LINUX
def test_the_fuzzer_sees_a_hang_a_crash_and_other_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without this, the fuzzer could find nothing at all."""

    def harmful(path: Path) -> str:
        if path.name == "hang":
            monkeypatch.undo()
            while True:
                pass
        if path.name == "memory":
            bytearray(2 * readers.MEMORY)
        return "several lines\nof a message" if path.name == "text" else ""

    monkeypatch.setattr(readers, "problem", harmful)
    monkeypatch.setattr(readers, "SECONDS", 1)
    batch = [(name, b"") for name in ("fine", "hang", "text", "memory", "fine")]
    wrong = readers.run_batch(batch)
    assert [number for number, _ in wrong] == [1, 2, 3]
    assert "SIGXCPU" in wrong[0][1]
    assert wrong[1][1] == "several lines\nof a message"
    assert "exit code" in wrong[2][1]


def test_the_same_seed_makes_the_same_files() -> None:
    first, second = readers.inputs(3), readers.inputs(3)
    assert [next(first) for _ in range(20)] == [next(second) for _ in range(20)]


@LINUX
@pytest.mark.hard
def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    done, wrong = readers.fuzz(tmp_path, seconds=60 if LONG else 2, seed=1)
    assert done > 100
    assert not wrong, wrong[0].with_name(f"{wrong[0].name}.txt").read_text(encoding="utf-8")
