"""Table of fhash and its peers on many series, one core, cell by cell: `fhash bench table`."""

from __future__ import annotations

import csv
import io
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from fhash_bench.kept import file_name, load, of_fields, save
from fhash_bench.rate.measuring import OWN, Bench, shown_psnr
from fhash_bench.rate.peers import AnyVariant, spent
from fhash_bench.rate.rate import all_variants, bench_of, check, goals_of
from fhash_codec.devices import machine
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Series
from fhash_formats.support.files import replacing
from fhash_formats.support.threads import at_most

CELL_VERSION = 2
"""Number of the way in which cells are measured; cells of another number are not taken."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """A cell that is wanted.

    Attributes:
        series: name of the series.
        codec: as the user names it.
        goal, asked: the quality.
        settings: everything else that the figures depend on.
    """

    series: str
    codec: str
    goal: str
    asked: float
    settings: Mapping[str, Any]

    @property
    def filename(self) -> str:
        """Name of the cell's file; another setting has another name."""
        words = (self.series, self.codec, f"{self.goal}{self.asked:g}")
        return file_name(words, self.settings, CELL_VERSION)


@dataclass(frozen=True, kw_only=True)
class RateCell:
    """Figures of a codec on a series at a quality."""

    series: Annotated[str, "as it was named"]
    shape: Annotated[tuple[int, ...], "(t, z, y, x)"]
    dtype: Annotated[str, "number type"]
    raw_bytes: Annotated[int, "size of the array"]
    codec: Annotated[str, "name of a peer, or of fhash with its effort and its preset"]
    goal: Annotated[str, "`psnr` in dB, or `bound`"]
    asked: Annotated[float, "dB, or share of the range"]
    reached: Annotated[bool, "whether the codec reached it; if not, figures of its closest trial"]
    bytes: Annotated[int | None, "of the file; null where nothing was measured"] = None
    encode_mb_s: Annotated[float | None, "10^6 bytes for each second of the processor"] = None
    decode_mb_s: Annotated[float | None, "likewise"] = None
    region_ms: Annotated[float | None, "of the processor, for a region"] = None
    region_bytes: Annotated[int | None, "that one region takes"] = None
    psnr: Annotated[float | None, "dB; null where exact"] = None
    max_error: Annotated[float | None, "share of the range"] = None
    setting: Annotated[str, "in words"] = ""
    why: Annotated[str, "why nothing was measured"] = ""

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return {**asdict(self), "shape": list(self.shape)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> RateCell:
        """The cell of JSON values; raises InputError or TypeError for others."""
        cell = of_fields(cls, values)
        return replace(cell, shape=tuple(cell.shape))


TARGETS = (45.0, 60.0)
"""PSNR in dB."""
BOUNDS = (0.01, 0.001)
"""Largest errors as shares of the range."""
EFFORTS = (1, 5, 7)
"""Efforts of fhash: the fastest, the default, and a thorough one."""
FILTERS = ("SPERR", "SZ3", "ZFP")
"""Peers."""
DEFAULT = "default"
"""The preset of settings that name none."""
CSV = "table.csv"
"""Name of the table beside the cells, which grows with them."""
NOTES = (
    "one thread, the series in memory; seconds are those of the processor, and the best of some"
    " runs counts; MB are 10^6 bytes of the array",
    "bytes and files of a peer are of the smallest of its layouts and modes that reached the"
    " quality, whose chunks alone count; bytes of fhash are the whole file",
    "encoding ends with the written file, decoding with the whole array in memory; a region has up"
    " to 16 x 16 x 16 vertices of one step, and is read from a file that was just opened",
    "PSNR and largest error, a share of the range, are measured on decoded values; ! marks a"
    " quality that was not reached",
)

Opening = Callable[[], AbstractContextManager[Series]]
"""A function that opens a series."""
Search = Callable[[Bench], object]
"""A function that lets a bench find the best setting of a codec."""


@dataclass(frozen=True, kw_only=True)
class RateTable:
    """Cells of every series, quality and codec."""

    cells: Annotated[tuple[RateCell, ...], "in the order in which they were asked for"]
    measured: Annotated[int, "those measured in this run"]
    startup_seconds: Annotated[float, "of the processor, for `fhash encode` of 16 values"]
    machine: Annotated[dict[str, Any], "this machine"]
    notes: Annotated[tuple[str, ...], "how the figures were taken"] = NOTES

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**asdict(self), "cells": [cell.to_dict() for cell in self.cells]}


def own_coders(
    efforts: Sequence[int], presets: Sequence[str], settings: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Settings of fhash by name, such as "fhash 5 fast": each effort with each preset."""
    return {
        f"{OWN}{effort} {preset}".removesuffix(f" {DEFAULT}"): {
            **settings,
            "effort": effort,
            "preset": preset,
        }
        for effort in efforts
        for preset in presets or (DEFAULT,)
    }


def bench_table(
    sources: Mapping[str, Opening],
    folder: Path,
    coders: Mapping[str, Mapping[str, Any]],
    *,
    targets: Sequence[float] = TARGETS,
    bounds: Sequence[float] = BOUNDS,
    names: Sequence[str] = FILTERS,
    named: Mapping[str, str] | None = None,
    speed: bool = True,
    progress: Progress = silent,
) -> RateTable:
    """Measure fhash and its peers on several series; every cell is kept at once.

    Args:
        sources: functions that open series, by name.
        folder: place of the cells, and of all of them as a CSV file. Cells that are there already,
            of the same numbers and settings, are taken as they are.
        coders: settings of fhash by name, as `own_coders` gives them.
        targets, bounds, names, named: as of `bench_rate`.
        speed: also measure encoding, decoding and access, of each codec at each quality.

    Raises errors as `bench_rate` does, and OutputError where a cell cannot be written.
    """
    for settings in coders.values():
        check(
            settings, targets, bounds, [*names, *(named or {})], [settings.get("preset", DEFAULT)]
        )
    variants, refused = all_variants(names, named or {})
    searches: dict[str, tuple[Any, Search]] = {
        name: (
            settings,
            partial(Bench.search_preset, settings=settings, preset=settings.get("preset", DEFAULT)),
        )
        for name, settings in coders.items()
    }
    for codec, several in variants.items():
        searches[codec] = ([each.name for each in several], partial(_search_all, several))
    goals, measured = goals_of(targets, bounds), 0
    cells: list[RateCell] = []
    total = len(sources) * len(goals) * len(searches)
    with at_most(1):
        for name, opened in sources.items():
            with opened() as series:
                run = _Run(name, series, speed)
            for goal in goals:
                for codec, (told, search) in searches.items():
                    progress("table", len(cells), total, f"{name}, {codec}, {goal[0]} {goal[1]:g}")
                    path, cell = run.kept(folder, codec, goal, told)
                    if cell is None:
                        cell = run.measure(codec, goal, search)
                        save(path, cell.to_dict())
                        measured += 1
                    cells.append(cell)
                    _write(folder / CSV, cells)
                cells += [run.refused(codec, goal, why) for codec, why in refused.items()]
        startup = startup_seconds()
    return RateTable(
        cells=tuple(cells), measured=measured, startup_seconds=startup, machine=machine()
    )


def _search_all(variants: Sequence[AnyVariant], bench: Bench) -> None:
    for variant in variants:
        bench.search(variant)


def startup_seconds() -> float:
    """Seconds of the processor for a whole `fhash encode` of 16 values."""
    with tempfile.TemporaryDirectory(prefix="fhash-bench-") as folder:
        np.save(f"{folder}/a.npy", np.arange(16.0).reshape(2, 2, 2, 2))
        words = ["encode", f"{folder}/a.npy", "-o", f"{folder}/a.fhz", "--effort", "1", "-q"]
        program = [sys.executable, "-m", "fhash_cli.main", *words]
        return spent(lambda: subprocess.run(program, check=True, stdout=subprocess.DEVNULL)).core


def _write(path: Path, cells: Sequence[RateCell]) -> None:
    """Write cells as a CSV file, complete or not at all."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(RateCell.__dataclass_fields__))
    writer.writeheader()
    writer.writerows({**cell.to_dict(), "shape": "x".join(map(str, cell.shape))} for cell in cells)
    with replacing(path, force=True) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8", newline="")


class _Run:
    """Cells of one series, which is held in memory."""

    def __init__(self, name: str, series: Series, speed: bool) -> None:
        values = np.stack(list(series.frames()))
        self._name, self._speed = name, speed
        self._series = ArraySeries(
            values, name=series.name, units=series.units, coords=series.coords
        )
        self._series.source = series.source
        self._identity = {
            "checksum": zlib.crc32(values.tobytes()),
            "shape": list(values.shape),
            "speed": speed,
        }

    def kept(
        self, folder: Path, codec: str, goal: tuple[str, float], told: Any
    ) -> tuple[Path, RateCell | None]:
        """Place of a cell, and the cell where it is there."""
        request = Request(
            series=self._name,
            codec=codec,
            goal=goal[0],
            asked=goal[1],
            settings={**self._identity, "told": told},
        )
        path = folder / request.filename
        return path, load(path, RateCell.from_dict)

    def measure(self, codec: str, goal: tuple[str, float], search: Search) -> RateCell:
        """Search and time a codec for a quality; what cannot be encoded says why."""
        figures: dict[str, Any] = {}
        with tempfile.TemporaryDirectory(prefix="fhash-bench-") as scratch:
            try:
                bench = bench_of(self._series, Path(scratch), [goal], silent)
                bench.price_tiles = False
                search(bench)
                best = next(iter(bench.best[goal].values()), None)
                if best is None:
                    why = next(iter(bench.refused.values()), "it has no such goal")
                    return self.refused(codec, goal, why)
                if self._speed:
                    bench.time(best)
                    (speed,), (access,) = bench.speeds, bench.access
                    figures = {
                        "encode_mb_s": speed.encode_core_mb_s,
                        "decode_mb_s": speed.decode_core_mb_s,
                        "region_ms": access.core_milliseconds,
                        "region_bytes": access.bytes_read,
                    }
            except InputError as error:
                return self.refused(codec, goal, str(error))
        return replace(
            self.refused(codec, goal, ""),
            reached=best.reached,
            bytes=best.trial.bytes,
            psnr=shown_psnr(best.trial),
            max_error=best.trial.max_error,
            setting="" if codec.startswith(OWN) else best.setting,
            **figures,
        )

    def refused(self, codec: str, goal: tuple[str, float], why: str) -> RateCell:
        """The cell of a codec of which nothing is measured."""
        return RateCell(
            series=self._name,
            shape=tuple(self._series.shape),
            dtype=self._series.dtype.name,
            raw_bytes=self._series.values.nbytes,
            codec=codec,
            goal=goal[0],
            asked=goal[1],
            reached=False,
            why=why,
        )
