"""Table of fhash beside its best peer on many series, cell by cell: `fhash bench table`."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

from fhash_bench.kept import file_name, load, of_fields, save
from fhash_bench.rate.measuring import OWN, PEERS, Access, Bench, Best, Speed, TilePrice, shown_psnr
from fhash_bench.rate.peers import AnyVariant
from fhash_bench.rate.rate import NOTES, all_variants, bench_of, check, goals_of
from fhash_codec.cost.plan import machine
from fhash_codec.progress import Progress, silent
from fhash_formats.series import Series

CELL_VERSION = 1
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
    """Figures of a codec on a series at a quality.

    Attributes:
        series, shape, dtype, raw_bytes: the series.
        codec: as the user names it.
        goal, asked: the quality: `psnr` in dB, or `bound` as a share of the range.
        reached: whether the codec reached it; where it did not, the other figures are of its
            closest trial.
        bytes, psnr, max_error, setting: as of `Point`; None where nothing was measured.
        encode_mb_s, decode_mb_s, encode_core_mb_s, decode_core_mb_s: as of `Speed`.
        region_ms, region_bytes: as of `Access`.
        one_tile_bytes, tile_price, tile_steps: as of `TilePrice`, of the profile compact alone.
        why: why nothing was measured.
    """

    series: str
    shape: tuple[int, ...]
    dtype: str
    raw_bytes: int
    codec: str
    goal: str
    asked: float
    reached: bool
    bytes: int | None = None
    psnr: float | None = None
    max_error: float | None = None
    setting: str = ""
    encode_mb_s: float | None = None
    encode_core_mb_s: float | None = None
    decode_mb_s: float | None = None
    decode_core_mb_s: float | None = None
    region_ms: float | None = None
    region_bytes: int | None = None
    one_tile_bytes: int | None = None
    tile_price: float | None = None
    tile_steps: int | None = None
    why: str = ""

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return {**asdict(self), "shape": list(self.shape)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> RateCell:
        """The cell of JSON values; raises InputError or TypeError for others."""
        cell = of_fields(cls, values)
        return replace(cell, shape=tuple(cell.shape))


def cell_of(
    about: Mapping[str, Any],
    best: Best,
    speed: Speed | None,
    access: Access | None,
    tiles: TilePrice | None,
) -> RateCell:
    """A cell of what was measured. about: series, codec and quality."""
    figures: dict[str, Any] = {
        "reached": best.reached,
        "bytes": best.trial.bytes,
        "psnr": shown_psnr(best.trial),
        "max_error": best.trial.max_error,
        "setting": best.setting,
    }
    if speed is not None:
        for name in ("encode_mb_s", "encode_core_mb_s", "decode_mb_s", "decode_core_mb_s"):
            figures[name] = getattr(speed, name)
    if access is not None:
        figures |= {"region_ms": access.milliseconds, "region_bytes": access.bytes_read}
    if tiles is not None:
        figures |= {
            "one_tile_bytes": tiles.one_tile_bytes,
            "tile_price": tiles.price,
            "tile_steps": tiles.steps,
        }
    return RateCell(**about, **figures)


TARGETS = (35.0, 45.0, 60.0)
"""PSNR in dB."""
BOUNDS = (0.05, 0.01, 0.001)
"""Largest errors as shares of the range."""
COMPACT = "compact"
"""The profile that is measured."""

Opening = Callable[[], AbstractContextManager[Series]]
"""A function that opens a series."""


@dataclass(frozen=True, kw_only=True)
class RateTable:
    """Cells of every series, codec and quality.

    Attributes:
        cells: in the order in which they were asked for.
        measured: how many of them were measured in this run; the others were there.
        machine: this machine. notes: how the figures were taken.
    """

    cells: tuple[RateCell, ...]
    measured: int
    machine: dict[str, Any]
    notes: tuple[str, ...]

    def rows(self) -> list[tuple[RateCell, RateCell | None]]:
        """fhash's cell and that of its best peer, for each series and quality.

        The best peer is the smallest that reached the quality; None where none did.
        """
        rows = []
        for cell in self.cells:
            if not cell.codec.startswith(OWN):
                continue
            peers = [
                other
                for other in self.cells
                if (other.series, other.goal, other.asked) == (cell.series, cell.goal, cell.asked)
                and other.reached
                and not other.codec.startswith(OWN)
            ]
            best = min(peers, key=lambda other: other.bytes or 0, default=None)
            rows.append((cell, best))
        return rows

    def markdown(self) -> str:
        """A table with a row for each series and quality, and what was not measured."""
        lines = [[name for name, _ in COLUMNS], ["---" for _ in COLUMNS]]
        lines += [[column(own, peer) for _, column in COLUMNS] for own, peer in self.rows()]
        text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        missing = [
            f"- not measured: {cell.series}, {cell.codec}, {_quality(cell)}: {cell.why}"
            for cell in self.cells
            if cell.why
        ]
        return "\n".join([text, *([""] if missing else []), *missing])

    def to_dict(self) -> dict[str, Any]:
        """JSON values, the table in Markdown included."""
        return {
            "cells": [cell.to_dict() for cell in self.cells],
            "measured": self.measured,
            "table": self.markdown(),
            "machine": self.machine,
            "notes": list(self.notes),
        }


def bench_table(
    sources: Mapping[str, Opening],
    folder: Path,
    settings: Mapping[str, Any] | None = None,
    *,
    targets: Sequence[float] = TARGETS,
    bounds: Sequence[float] = BOUNDS,
    names: Sequence[str] = PEERS,
    named: Mapping[str, str] | None = None,
    speed: bool = True,
    progress: Progress = silent,
) -> RateTable:
    """Measure the profile compact and its peers on several series; every cell is kept at once.

    Args:
        sources: functions that open series, by name.
        folder: place of the cells. Those that are there already, of the same numbers and settings,
            are taken as they are.
        settings, targets, bounds, names, named: as of `bench_rate`.
        speed: also measure encoding, decoding and access, of each codec at each quality.

    Raises errors as `bench_rate` does, and OutputError where a cell cannot be written.
    """
    settings = settings or {}
    check(settings, targets, bounds, [*names, *(named or {})], [COMPACT])
    variants, refused = all_variants(names, named or {})
    goals = goals_of(targets, bounds)
    cells: list[RateCell] = []
    measured = 0
    for number, (name, opened) in enumerate(sources.items()):
        progress("series", number, len(sources), name)
        with opened() as series:
            run = _Run(name, series, folder, settings, goals, speed=speed, progress=progress)
            cells += run.of_fhash()
            for codec, several in variants.items():
                cells += run.peer(codec, several)
            cells += [
                run.refused(codec, goal, why) for codec, why in refused.items() for goal in goals
            ]
            measured += run.measured
    return RateTable(cells=tuple(cells), measured=measured, machine=machine(), notes=NOTES)


class _Run:
    """Cells of one series.

    Attributes:
        measured: cells that were not there.
    """

    def __init__(
        self,
        name: str,
        series: Series,
        folder: Path,
        settings: Mapping[str, Any],
        goals: Sequence[tuple[str, float]],
        *,
        speed: bool,
        progress: Progress,
    ) -> None:
        self._name, self._series, self._folder = name, series, folder
        self._settings, self._goals, self._progress = settings, goals, progress
        self._speed, self.measured = speed, 0
        checksum = 0
        for frame in series.frames():
            checksum = zlib.crc32(frame.tobytes(), checksum)
        self._identity = {"checksum": checksum, "shape": list(series.shape), "speed": speed}

    def of_fhash(self) -> list[RateCell]:
        """fhash at each quality; a cell is kept before the next one begins."""
        return [
            cell
            for goal in self._goals
            for cell in self._cells(
                f"{OWN}{COMPACT}",
                [goal],
                lambda bench: bench.search_profile(self._settings, COMPACT),
                self._settings,
            )
        ]

    def peer(self, codec: str, variants: Sequence[AnyVariant]) -> list[RateCell]:
        """A peer at all qualities, whose searches help each other."""

        def search(bench: Bench) -> None:
            for variant in variants:
                bench.search(variant)

        told = {"variants": [variant.name for variant in variants]}
        return self._cells(codec, self._goals, search, told)

    def refused(self, codec: str, goal: tuple[str, float], why: str) -> RateCell:
        """The cell of a peer that cannot be measured, which is not kept."""
        return RateCell(**self._about(codec, goal), reached=False, why=why)

    def _cells(
        self,
        codec: str,
        goals: Sequence[tuple[str, float]],
        search: Callable[[Bench], None],
        told: Mapping[str, Any],
    ) -> list[RateCell]:
        """Cells of a codec: those that are kept, and the others measured together."""
        requests = {
            goal: Request(
                series=self._name,
                codec=codec,
                goal=goal[0],
                asked=goal[1],
                settings={**self._identity, **told},
            )
            for goal in goals
        }
        paths = {goal: self._folder / request.filename for goal, request in requests.items()}
        kept = {goal: load(path, RateCell.from_dict) for goal, path in paths.items()}
        missing = [goal for goal, cell in kept.items() if cell is None]
        if missing:
            for goal, cell in self._measure(codec, missing, search).items():
                save(paths[goal], cell.to_dict())
                kept[goal] = cell
                self.measured += 1
        return [cell for cell in kept.values() if cell is not None]

    def _measure(
        self,
        codec: str,
        goals: list[tuple[str, float]],
        search: Callable[[Bench], None],
    ) -> dict[tuple[str, float], RateCell]:
        """Search and time a codec for some qualities."""
        with tempfile.TemporaryDirectory(prefix="fhash-bench-") as scratch:
            bench = bench_of(self._series, Path(scratch), goals, self._progress)
            bench.total = len(goals)
            search(bench)
            tiles = {(price.goal, price.asked): price for price in bench.tiles}
            cells = {}
            for goal in goals:
                best = next(iter(bench.best[goal].values()), None)
                if best is None:
                    why = next(iter(bench.refused.values()), "it has no such goal")
                    cells[goal] = self.refused(codec, goal, why)
                    continue
                if self._speed:
                    bench.time(best)
                cells[goal] = cell_of(
                    self._about(codec, goal),
                    best,
                    bench.speeds[-1] if self._speed else None,
                    bench.access[-1] if self._speed else None,
                    tiles.get(goal),
                )
        return cells

    def _about(self, codec: str, goal: tuple[str, float]) -> dict[str, Any]:
        """The series, a codec and a quality."""
        series = self._series
        return {
            "series": self._name,
            "shape": tuple(series.shape),
            "dtype": series.dtype.name,
            "raw_bytes": prod(series.shape) * series.dtype.itemsize,
            "codec": codec,
            "goal": goal[0],
            "asked": goal[1],
        }


def _quality(cell: RateCell) -> str:
    """The quality in words."""
    return f"{cell.asked:g} dB" if cell.goal == "psnr" else f"{100 * cell.asked:g} %"


def _bytes(cell: RateCell | None) -> str:
    """Bytes with commas; marked where the quality was not reached."""
    if cell is None or cell.bytes is None:
        return "-"
    return f"{cell.bytes:,}{'' if cell.reached else ' (missed)'}"


def _share(top: int | None, bottom: int | None) -> str:
    return "-" if not top or not bottom else f"{top / bottom:.3f}"


def _each(values: Iterable[float | None]) -> str:
    """Figures of three digits, with strokes between them."""
    return " / ".join("-" if value is None else f"{value:.3g}" for value in values)


Column = Callable[[RateCell, RateCell | None], str]
"""A function of the cells of fhash and its best peer, that gives a field."""

COLUMNS: tuple[tuple[str, Column], ...] = (
    ("series", lambda own, peer: own.series),
    ("quality", lambda own, peer: _quality(own)),
    ("fhash, bytes", lambda own, peer: _bytes(own)),
    ("one tile", lambda own, peer: f"{own.one_tile_bytes or 0:,}"),
    ("tiles cost", lambda own, peer: _each([own.tile_price])),
    ("best peer", lambda own, peer: "-" if peer is None else peer.setting),
    ("its bytes", lambda own, peer: _bytes(peer)),
    ("its / ours", lambda own, peer: _share(None if peer is None else peer.bytes, own.bytes)),
    (
        "encode MB/s, core / wall",
        lambda own, peer: _each([own.encode_core_mb_s, own.encode_mb_s]),
    ),
    (
        "decode MB/s, core / wall",
        lambda own, peer: _each([own.decode_core_mb_s, own.decode_mb_s]),
    ),
    ("region ms", lambda own, peer: _each([own.region_ms])),
    (
        "peer: encode / decode MB/s of a core, region ms",
        lambda own, peer: (
            "-"
            if peer is None
            else _each([peer.encode_core_mb_s, peer.decode_core_mb_s, peer.region_ms])
        ),
    ),
)
"""Columns of the table: name, and what stands there."""
