"""One hostile file and the commands of `fhash` on it, in a process with bounded memory and time.

    PYTHONPATH=tests python tests/hard/hostile_trial.py FOLDER

The script reads numbers of mutations from stdin and answers each with one line of JSON; its files
lie in FOLDER. With --write NUMBER FILE.fhz it writes the file of a number.
"""

from __future__ import annotations

import contextlib
import faulthandler
import io
import json
import os
import resource
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable
from functools import cache
from math import prod
from pathlib import Path
from typing import Any

import mutations
import numpy as np
from containers import unpack
from documents import Documents, header_of
from further_trials import Further
from mutated_tiles import Tiles, settings_of, type_of
from PIL import Image

import fhash_cli.main
import fhash_codec
from fhash_cli.output import describe_error, say
from fhash_formats.container import Container
from fhash_formats.errors import FhashError, FhashWarning
from fhash_formats.transform.tile_format import PREDICTED, TRANSFORMED, TileSettings, parse_stream

MEMORY = 512 << 20
"""Bytes that the process may allocate beyond what it has before; larger allocations fail."""
WARM_UPS = 2.0
"""Longest processor time of one command, as a multiple of that of all commands on all goldens,
which a worker runs first (12 s on an EPYC): a limit in seconds would be that of one machine."""
LARGE = 1 << 22
"""Most vertices of a series that is decoded as a whole; of larger ones, a region is decoded."""
OWN_WARNING = "fhash: warning: "
EMPTY_PICTURE = "of the picture's pixels differ from the background"
"""Part of the remark of `fhash render` on a picture with hardly anything in it."""


class Trial:
    """One mutated file and the commands on it.

    Attributes:
        limit: longest processor time of one command in seconds.
    """

    limit = 60.0

    def __init__(self, mutation: mutations.Mutation, folder: Path) -> None:
        self.mutation = mutation
        self.path, self.folder = folder / "run.fhz", folder
        self.path.write_bytes(self.mutation.data)
        self.ends: list[dict[str, Any]] = []
        self.variable: str | None = None
        self.shape = self._declared()

    def _declared(self) -> tuple[int, ...]:
        """Return the shape of the volume that the file declares; the golden's if it cannot be
        opened. Of several variables, the number of the mutation chooses one."""
        self.variable = variable_of(self.mutation.golden, self.mutation.number)
        try:
            with Container.open(self.path) as container:
                names = list(container.variables)
                self.variable = names[self.mutation.number % len(names)] if names else None
                header = container.variables[self.variable].header if self.variable else {}
                return tuple((header or container.header)["domain"]["shape"])
        except FhashError:
            return tuple(header_of(mutations.goldens()[self.mutation.golden][1])["domain"]["shape"])
        except Exception:  # the first command reports it
            return (5, 6, 7, 9)

    def run(self) -> dict[str, Any]:
        """Run all commands and return the answer of the worker."""
        run, region = str(self.path), self._region()
        roi = ",".join(f"{low}:{high}" for low, high in region[1:])
        steps = f"{region[0][0]}:{region[0][1]}"
        all_values, values, picture = (
            str(self.folder / name) for name in ("whole.npy", "part.npy", "picture.png")
        )
        chosen = [] if self.variable is None else ["--var", self.variable]
        self._command("info", ["info", run])
        self._command("info --json", ["info", run, "--json", *chosen])
        self._command("verify", ["verify", run, "-q"])
        if self._small():
            self._command(
                "decode",
                ["decode", run, "-o", all_values, "--force", "-q", *chosen],
                lambda: self._values(all_values, self.shape, "whole"),
            )
        sizes = [high - low for low, high in region]
        check = lambda: self._values(values, sizes, "part", region)  # noqa: E731
        self._command(
            "decode region",
            ["decode", run, "--roi", roi, "--t", steps, "-o", values, "--force", "-q", *chosen],
            check,
        )
        self._end("sample", lambda: said(self._sample))
        self._command(
            "render",
            ["render", run, "-o", picture, "--size", "32x32", "--force", "-q", *chosen],
            lambda: self._picture(picture),
        )
        further = Further(self.path, self.folder, self.mutation, self.variable, region)
        self._end("C", lambda: said(further.by_c))
        self._end("xarray", lambda: said(further.by_xarray))
        self._end("zarr", lambda: said(further.by_zarr))
        if further.grows:
            self._end("append", lambda: said(further.append))
        if further.is_part:
            self._end("merge", lambda: said(further.merge))
        return {
            "number": self.mutation.number,
            "kind": self.mutation.kind,
            "golden": self.mutation.golden,
            "ends": self.ends,
        }

    def _small(self) -> bool:
        return prod(self.shape) <= LARGE

    def _region(self) -> list[tuple[int, int]]:
        """Return a small region in the middle, (low, high) for t, z, y, x."""
        return [(length // 3, min(length, length // 3 + 3)) for length in self.shape]

    def _command(
        self, name: str, arguments: list[str], check: Callable[[], str | None] | None = None
    ) -> None:
        def work() -> str | None:
            try:
                fhash_cli.main.program.main(args=arguments, prog_name="fhash")
            except SystemExit as left:
                if left.code:
                    raise
            return check() if check is not None else None

        self._end(name, work)

    def _end(self, name: str, work: Callable[[], str | None]) -> None:
        """Do the work and note how it ended; `work` returns what is wrong with its result, or
        None."""
        out, err, wrong = io.StringIO(), io.StringIO(), None
        _reset_peak()
        before, start = _resident("VmRSS"), time.process_time()
        _bound_time()
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.showwarning = _warned
            try:
                wrong = work()
                code = 0
            except SystemExit as left:
                code = int(left.code or 0)
            except Exception as error:
                code, wrong = -1, f"{type(error).__name__}: {error}"[:300]
        seconds, peak = time.process_time() - start, max(0, _resident("VmHWM") - before)
        said = err.getvalue()
        if wrong is None:
            wrong = self._judged(name, code, said)
        if wrong is None and seconds > self.limit:
            wrong = f"{seconds:.1f} s of processor time, of at most {self.limit:.1f}"
        end = {0: "decoded", 4: "refused", 1: "too large", 2: "nothing to show"}.get(
            code, f"exit {code}"
        )
        self.ends.append(
            {"command": name, "end": end, "seconds": seconds, "bytes": peak, "wrong": wrong}
        )

    def _judged(self, name: str, code: int, said: str) -> str | None:
        """Return what is wrong with an exit code and the text that was printed with it, or None."""
        lines = [
            line
            for line in said.splitlines()
            if not line.startswith(OWN_WARNING) and EMPTY_PICTURE not in line
        ]
        if code == 0:
            if lines:
                return f"success, but it says {said[:200]!r}"
            if name == "verify" and not self.mutation.sealed and not self._is_golden():
                return "a damaged file is called sound"
            return None
        if len(lines) != 1 or not lines[0].startswith("fhash: error: "):
            return f"exit code {code} and {len(lines)} lines: {said[:300]!r}"
        # A sound file may need more memory than there is.
        if (
            code == 1
            and self.mutation.sealed
            and lines[0].startswith("fhash: error: out of memory")
        ):
            return None
        # The usual scene may show nothing of a sound file with strange values; other sound files
        # do not grow, or do not belong together.
        if code == 2 and self.mutation.sealed and name in ("render", "append", "merge"):
            return None
        # A flipped byte that decodes is of a golden of integers that pictures cannot show.
        if code == 2 and name == "render" and "pictures are of float64" in lines[0]:
            return None
        return None if code == 4 else f"exit code {code}: {lines[0][:300]}"

    def _is_golden(self) -> bool:
        """Whether a file that was not refused has the members of its golden, and no other byte.

        Deflated documents may have other bytes that inflate to the same text (FORMAT.md, ZIP).
        """
        data, parts = mutations.goldens()[self.mutation.golden]
        return len(self.mutation.data) == len(data) and unpack(self.mutation.data) == parts

    def _values(
        self,
        path: str,
        shape: Iterable[int],
        what: str,
        region: list[tuple[int, int]] | None = None,
    ) -> str | None:
        """Return what is wrong with decoded values, or None.

        They must be finite and have the declared shape; if nothing was sealed, or all that is told
        is the same, they must be the golden's.
        """
        values = np.load(path)
        os.unlink(path)
        if values.shape != tuple(shape):
            return f"{what}: shape {values.shape} instead of {tuple(shape)}"
        if np.isinf(values).any():
            return f"{what}: infinities"
        if self.mutation.kind == "clip" and self.beyond(values, region):
            return f"{what}: values beyond the range to which they are clipped"
        if not self.mutation.sealed or self.mutation.kind in mutations.SAME:
            expected = expected_values(self.mutation.golden, self.variable)
            if region is not None:
                expected = expected[tuple(slice(low, high) for low, high in region)]
            if not np.array_equal(values, expected, equal_nan=True):
                return f"{what}: values that differ from the golden's"
        return None

    def beyond(self, values: Any, region: list[tuple[int, int]] | None) -> bool:
        """Whether values lie beyond the range to which their tile clips them."""
        fill = header_of(unpack(self.mutation.data))["variable"].get("fill")
        ends = clip_ends(self.mutation)
        if region is not None:
            ends = ends[:, *(slice(low, high) for low, high in region)]
        known = ~np.isnan(values) & (values != fill)
        return bool((known & ((values < ends[0]) | (values > ends[1]))).any())

    def _sample(self) -> str | None:
        """Sample points between vertices with the API."""
        chance = np.random.default_rng(self.mutation.number)
        # Points lie within a few vertices, since a sample decodes the vertices between its points,
        # too.
        points = [chance.uniform(low, high - 1, 9) for low, high in self._region()]
        with fhash_codec.open(self.path, variable=self.variable) as volume:
            t, z, y, x = points
            values, slopes = volume.sample(t=t, z=z, y=y, x=x, gradient=True)
        # A derivative may overflow its type.
        return (
            "infinities" if np.isinf(values).any() or slopes.shape != (*values.shape, 4) else None
        )

    def _picture(self, path: str) -> str | None:
        with Image.open(path) as image:
            size = image.size
            image.load()
        os.unlink(path)
        return None if size == (32, 32) else f"a picture of {size}"


def _warned(message: Warning | str, category: type[Warning], *_: Any) -> None:
    """Print a warning as the command line does; warnings of libraries with their own category."""
    kind = "warning" if issubclass(category, FhashWarning) else category.__name__
    say(f"{kind}: {' '.join(str(message).split())}")


def clip_ends(mutation: mutations.Mutation) -> Any:
    """Return the ends of the range to which each vertex of a table is clipped, (2, t, z, y, x).

    They are of the type of the table, and its extreme values in tiles that are not clipped: those
    without `clip`, and those that are neither transformed nor predicted (FORMAT.md, Decoding).
    The table has every vertex and step of the domain. With an origin the range is that of the
    differences.
    """
    file = Documents(unpack(mutation.data))
    tiles, shared = Tiles(file, file.table), settings_of(file.arrays[file.table])
    dtype = type_of(file.arrays[file.table])
    ends = np.empty((2, *tiles.metadata.shape), dtype)
    ends[0], ends[1] = (-np.inf, np.inf) if dtype.kind == "f" else most_of(dtype)
    for member in tiles.members:
        for place, data in tiles.streams(member).items():
            stream = parse_stream(data)
            own = stream.settings
            settings = shared if own is None else TileSettings.from_bytes(own)
            if settings is not None and settings.clip and stream.kind in (TRANSFORMED, PREDICTED):
                for end, limit in zip(ends, (settings.low, settings.high), strict=True):
                    end[tiles.metadata.region(place)] = rounded(limit, settings.origin, dtype)
    return ends


def most_of(dtype: np.dtype[Any]) -> tuple[int, int]:
    """Return the smallest and the largest integer of a type."""
    return int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)


def rounded(limit: float, origin: int, dtype: np.dtype[Any]) -> Any:
    """Return an end of a range, about the origin, in the type of an array."""
    if dtype.kind == "f":
        return dtype.type(limit)
    low, high = most_of(dtype)
    if origin:  # the differences are of int64
        limit = min(max(round(limit), -(1 << 63)), (1 << 63) - 1)
    return min(max(round(limit) + origin, low), high)


def said(work: Callable[[], str | None]) -> str | None:
    """Do work with the API; an error ends as on the command line."""
    try:
        return work()
    except Exception as error:
        line, code = describe_error(error)
        say(f"error: {line}")
        raise SystemExit(code) from error


@cache
def expected_values(golden: str, variable: str | None) -> Any:
    """Return all values of a golden."""
    with fhash_codec.open(mutations.GOLDENS / f"{golden}.fhz", variable=variable) as volume:
        return volume[...]


@cache
def variable_of(golden: str, number: int) -> str | None:
    """Return one of the variables of a golden of several; None for other goldens."""
    with Container.open(mutations.GOLDENS / f"{golden}.fhz") as container:
        names = list(container.variables)
        return names[number % len(names)] if names else None


def _resident(key: str) -> int:
    """Return a figure of this process's memory in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) * 1024
    return 0


def _reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _bound_time() -> None:
    """End the process if the next command takes several times its longest time.

    A timer counts from now on. A limit of the whole process would not do: the kernel's clock of
    limits counts ticks, and in an hour it runs away from the clock that `getrusage` tells, so that
    commands of a second were ended.
    """
    signal.setitimer(signal.ITIMER_PROF, 3 * Trial.limit)


def _bound_memory(limit: int) -> None:
    """Let allocations fail that would take the process beyond so many bytes."""
    resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))


def worker(folder: Path) -> None:
    """Warm up, bound the memory, then answer each number on stdin with a line of JSON."""
    fhash_cli.main.warn = _warned  # type: ignore[assignment]
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for golden, (data, _) in mutations.goldens().items():
        same = mutations.Mutation(number=0, golden=golden, kind="none", sealed=True, data=data)
        wrong = [end for end in Trial(same, folder).run()["ends"] if end["wrong"]]
        assert not wrong, wrong
    Trial.limit = WARM_UPS * time.process_time()
    limit = _resident("VmData") + MEMORY
    # Where a command does not end, the log tells where it was.
    faulthandler.register(signal.SIGPROF, all_threads=True, chain=True)
    for line in sys.stdin:
        if os.environ.get("FHASH_HOSTILE_CRASH") == line.strip():  # for a test of the crash
            os.kill(os.getpid(), signal.SIGSEGV)
        # Making a file of giant arrays may take more than reading it may.
        _bound_memory(resource.RLIM_INFINITY)
        mutation = mutations.mutation(int(line))
        _bound_memory(limit)
        answers.write(json.dumps(Trial(mutation, folder).run()) + "\n")


if __name__ == "__main__":
    if sys.argv[1] == "--write":
        Path(sys.argv[3]).write_bytes(mutations.mutation(int(sys.argv[2])).data)
    else:
        worker(Path(sys.argv[1]))
