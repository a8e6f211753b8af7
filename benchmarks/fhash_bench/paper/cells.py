"""Cells of the bench: one encoding trained once on one feature, kept as JSON, joined by seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from fhash_bench.kept import file_name, of_fields
from fhash_bench.paper.data import PROTOCOLS
from fhash_bench.paper.printed import ENCODINGS, FEATURES, SETS, Spread

CELL_VERSION = 2
"""Version of the cells and of what they measure; a cell of another version is run again."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """A point of a curve, after whole epochs. Figures are None where they were not measured.

    Attributes:
        step: Adam steps of each model.
        epoch: passes over all samples.
        seconds: training alone, of all models together: those of the processor, of all threads; on
            a GPU those of the clock.
        coreset_psnr: dB of normalised values over the coreset at the key frames (peak 1).
        picture_psnr: dB of pictures, mean over the key frames.
        picture_ssim: SSIM of pictures, mean over the key frames.
    """

    step: int
    epoch: int
    seconds: float
    coreset_psnr: float | None = None
    picture_psnr: float | None = None
    picture_ssim: float | None = None


@dataclass(frozen=True, kw_only=True)
class Cell:
    """The result of one training, as a file keeps it.

    Attributes:
        encoding: name of the encoding.
        protocol: published, released, equal or best.
        data_set: flame, bubble, shell, or the name of the user's data.
        shape: (t, z, y, x) of the series.
        feature: kind of the feature: interval, isosurface, segmentation, or as the user wrote it.
        key_frames: steps of the series.
        coreset_share: vertices of the coreset / vertices of the key frames.
        box: spans (first, end) along z, y and x of the feature bounding box.
        seed: seed of the initial numbers and of the batches.
        parameters: {"tables", "mlp"}, trained numbers of all models.
        buckets_used: share of the embeddings that a gradient moved.
        bytes: the trained numbers as float32, compressed by zstd, as the product stores them;
            embeddings that no gradient moved are 0.
        raw_bytes: the source's values of all steps.
        samples_an_epoch: samples that all models together see in an epoch.
        steps_an_epoch: Adam steps of each model in an epoch.
        samples_per_second: of training.
        training_seconds: of all epochs.
        curve: points, the first before training.
        settings: all other settings of the training by name; together with the fields above they
            identify the cell.
        latency: of pictures through the encoding, as `latency.measure_latency` has it, or None.
        between: figures of all steps over the coreset of the key frames around each, or None.
            "psnr" in dB of all steps by interpolation in time; "psnr_key_frames" and
            "psnr_between" of those that are key frames and of the others; "psnr_linear" of the
            others where the source's key frames are interpolated. "psnr_fringe" and
            "psnr_fringe_linear" at vertices in the coreset of one of the two key frames, whose
            share is "fringe_share", "psnr_inner" and "psnr_inner_linear" at the others;
            "missed_share" of the steps' own features is in neither.
        collisions: share of the corners of hashed levels that share their bucket; 0 for others.
        trial: {steps, seconds, psnr, reached} of each number of steps that the protocol best
            tried; `reached` has the seconds to 20, 30 and 40 dB, or None.
        machine: processor, threads, versions, date.
    """

    encoding: str
    protocol: str
    data_set: str
    shape: tuple[int, int, int, int]
    feature: str
    key_frames: tuple[int, ...]
    coreset_share: float
    box: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
    seed: int
    parameters: dict[str, int]
    buckets_used: float
    bytes: int
    raw_bytes: int
    samples_an_epoch: int
    steps_an_epoch: int
    samples_per_second: float
    training_seconds: float
    curve: tuple[Point, ...]
    settings: dict[str, Any] = field(default_factory=dict)
    latency: dict[str, Any] | None = None
    between: dict[str, Any] | None = None
    machine: dict[str, Any] = field(default_factory=dict)
    collisions: float = 0.0
    trial: tuple[dict[str, Any], ...] = ()
    engine: str = "gather"
    version: int = CELL_VERSION

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """The cell of what `to_dict` gave; raises InputError for missing or unknown fields."""
        made = of_fields(cls, values)
        tuples: dict[str, Any] = {
            "shape": tuple(made.shape),
            "key_frames": tuple(made.key_frames),
            "box": tuple(map(tuple, made.box)),
            "curve": tuple(of_fields(Point, point) for point in values["curve"]),
            "trial": tuple(made.trial),
        }
        return dataclasses.replace(made, **tuples)

    def reached(self, decibels: float, figure: str = "coreset_psnr") -> Point | None:
        """The first point whose figure is at least `decibels`; None where none is (NR)."""
        for point in self.curve:
            value = getattr(point, figure)
            if value is not None and value >= decibels:
                return point
        return None


@dataclass(frozen=True, kw_only=True)
class Request:
    """A cell that is wanted.

    Attributes:
        encoding, protocol, data_set, feature, seed: as of `Cell`.
        settings: everything else that the figures depend on.
    """

    encoding: str
    protocol: str
    data_set: str
    feature: str
    seed: int
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def filename(self) -> str:
        """Name of the cell's file; another setting has another name."""
        words = (self.data_set, self.feature, self.protocol, self.encoding, f"seed{self.seed}")
        return file_name(words, self.settings, CELL_VERSION)

    def __str__(self) -> str:
        return f"{self.data_set} {self.feature} {self.protocol} {self.encoding} {self.seed}"


@dataclass(frozen=True)
class Group:
    """Cells that differ in their seed alone.

    Attributes:
        protocol, data_set, feature, encoding: as of a cell.
        cells: at least one.
    """

    protocol: str
    data_set: str
    feature: str
    encoding: str
    cells: tuple[Cell, ...]

    def spread(self, figure: Callable[[Cell], float | None], digits: int = 3) -> Spread | None:
        """A figure over the seeds that have it."""
        found = [figure(cell) for cell in self.cells]
        return Spread.of([one for one in found if one is not None], digits)

    def reached(self, decibels: float, quality: str, clock: str) -> Spread:
        """Time to a quality, by a field of a point; NR counts as infinitely long."""
        points = (cell.reached(decibels, quality) for cell in self.cells)
        found = Spread.of([None if point is None else getattr(point, clock) for point in points])
        assert found is not None
        return found

    def after(self, epochs: int, figure: str, digits: int = 3) -> Spread | None:
        """A field of the last point within some epochs."""
        return self.spread(lambda cell: getattr(within(cell, epochs), figure), digits)

    @property
    def first(self) -> Cell:
        """The cell of the smallest seed."""
        return self.cells[0]


def groups(cells: Iterable[Cell]) -> list[Group]:
    """Join cells by protocol, data set, feature and encoding, in the paper's order."""
    found: dict[tuple[str, str, str, str], list[Cell]] = {}
    for cell in cells:
        key = cell.protocol, cell.data_set, cell.feature, cell.encoding
        found.setdefault(key, []).append(cell)
    orders: list[Sequence[str]] = [
        PROTOCOLS, tuple(SETS), FEATURES, tuple(ENCODINGS),
    ]  # fmt: skip

    def rank(key: tuple[str, ...]) -> list[tuple[int, str]]:
        """Place of each name in its order; unknown names come last, by the alphabet."""
        return [
            (order.index(name) if name in order else len(order), name)
            for name, order in zip(key, orders, strict=True)
        ]

    return [
        Group(*key, tuple(sorted(found[key], key=lambda cell: cell.seed)))
        for key in sorted(found, key=rank)
    ]


def by_protocol(grouped: Iterable[Group]) -> dict[str, list[Group]]:
    """Groups by protocol, in their order."""
    found: dict[str, list[Group]] = {}
    for group in grouped:
        found.setdefault(group.protocol, []).append(group)
    return found


def of_protocol(grouped: Sequence[Group], protocol: str) -> list[Group]:
    """Groups of a protocol; beside released F-Hash stand the other encodings as published."""
    return [
        group
        for group in grouped
        if group.protocol == protocol
        or ((protocol, group.protocol) == ("released", "published") and group.encoding != "fhash")
    ]


def by_data(grouped: Sequence[Group]) -> list[tuple[tuple[str, str], dict[str, Group]]]:
    """Groups of one protocol by (data set, feature), then by encoding."""
    found: dict[tuple[str, str], dict[str, Group]] = {}
    for group in grouped:
        found.setdefault((group.data_set, group.feature), {})[group.encoding] = group
    return list(found.items())


def within(cell: Cell, epochs: int) -> Point:
    """The last point of a curve within some epochs."""
    return max(
        (point for point in cell.curve if point.epoch <= epochs), key=lambda point: point.epoch
    )
