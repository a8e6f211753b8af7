"""`encode_part`: some steps of a series on one machine of several; `merge` joins the parts.

All parts have one plan of the whole series, and each codes whole layers of its tiles. So parts have
the bytes that one encoding of everything has. A part is a container of its steps; the key
`part` of its header and the array `steps/errors` say what `merge` needs beside that.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.series_plan import SeriesPlan, bounded
from fhash_codec.compact.recipe import CodedLayers, code_layers
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles_to_promise import all_tiles
from fhash_codec.comparison import measure, ssim_budget
from fhash_codec.config import EncodeConfig
from fhash_codec.container_name import check_name
from fhash_codec.coreset.extent import Extent, packed_masks
from fhash_codec.coreset.features import resolve_features
from fhash_codec.coreset.scan import Scan, scan_steps
from fhash_codec.coreset.selection import Source, mask_files, open_source
from fhash_codec.header import (
    brief_quality,
    describe_source,
    write_series,
)
from fhash_codec.measure.metrics import Comparison
from fhash_codec.measure.ssim import ssim_steps
from fhash_codec.measure.sums import ErrorSums
from fhash_codec.progress import Progress, silent
from fhash_codec.provenance import source_parts
from fhash_codec.report import report
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import SOURCE, ContainerWriter
from fhash_formats.container.header import EVERYTHING, NOT_STORED
from fhash_formats.container.table_parts import TableParts
from fhash_formats.errors import InputError
from fhash_formats.series import Series, StepsSeries
from fhash_formats.support.atomic import check_output
from fhash_formats.support.threads import thread_pool

__all__ = ["ERRORS", "PART", "Part", "comparisons_of", "encode_part"]

PART = "part"
"""Key of a part's header: which part it is, of how many steps of what."""
ERRORS = "steps/errors"
"""Array of a part: sums of the errors of each step, of which the figures of the whole follow."""
WHOLE = "whole/"
"""Prefix of arrays of the first part that belong to the whole series."""
COLUMNS = 10
"""Numbers that it has for each step, see `_row`."""
COUNTS = (0, 3, 5, 9)
"""Those of them that count vertices."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One of several parts of a series, counted from 1.

    Raises InputError for a part that is none of them.
    """

    number: int
    of: int

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise InputError(
                f"part {self.number}/{self.of}; allowed: 1/{self.of} to {self.of}/{self.of}"
            )

    @classmethod
    def parse(cls, text: str) -> Part:
        """The part that a text such as "3/16" names; raises InputError for another text."""
        match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
        if match is None:
            raise InputError(f"part '{text}'; allowed: I/N, such as 3/16 for the third of 16")
        return cls(number=int(match[1]), of=int(match[2]))

    def layers(self, count: int) -> range:
        """The layers of tiles that the part has of `count`; raises InputError for too few."""
        if count < self.of:
            raise InputError(
                f"{self.of} parts of {count} layers of tiles: each part needs one; ask for "
                f"{count} parts at most, or for tiles of fewer steps (--tile)"
            )
        return range(count * (self.number - 1) // self.of, count * self.number // self.of)


def encode_part(
    source: Source,
    path: str | Path,
    config: EncodeConfig | None,
    part: Part,
    *,
    plan: SeriesPlan | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Encode one part of a series; `merge` makes one file of all of them.

    The arguments are those of `encode`; the promise is a bound of the error, and times are not
    kept, so that the parts make the file of `encode` with `timings=False`, byte for byte.

    plan: of the whole series, as `plan_parts` makes it once for all parts; then only the steps of
        the part are read. It has the settings; those of `config` must be the same, if given. The
        part plans the whole series by itself if None.

    Returns the figures of the written file (`report`). Raises what `encode` raises, and InputError
    for a promise that no part alone can keep and for a plan of other data or settings.
    """
    path = Path(path)
    config = _settings(config, plan)
    check_name(path)
    check_output(path, force)
    begun = time.perf_counter()
    with open_source(source) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        if plan is None:
            plan = SeriesPlan.make(series, config, progress)
        plan.require(series)
        quality = _Job(series, plan, part).write(path, force, progress)
        series.check()
        with open_volume(path) as volume:
            return report(volume, quality, seconds=time.perf_counter() - begun, files=series.files)


def _settings(config: EncodeConfig | None, plan: SeriesPlan | None) -> EncodeConfig:
    """The settings of a part; raises InputError where they are not those of its plan."""
    if plan is None:
        return bounded(config or EncodeConfig())
    if config is not None:
        plan.require_settings(vars(config))
    return plan.config


def comparisons_of(errors: npt.NDArray[np.float64], first: int) -> list[Comparison]:
    """The comparisons of the steps of a part, which begin at step `first` of the whole.

    errors: (steps, COLUMNS), as a part has them.
    """
    result = []
    for step, row in enumerate(errors.tolist(), start=first):
        number, squares, largest, bulk_count, bulk_squares, *rest = row
        result.append(
            Comparison(
                step=step,
                coreset=ErrorSums(int(number), squares, largest, int(bulk_count), bulk_squares),
                domain=ErrorSums(int(rest[0]), rest[1], rest[2]),
                similarity=(rest[3], int(rest[4])),
                between=None,
                seconds=0.0,
                ssim_seconds=0.0,
            )
        )
    return result


def _row(comparison: Comparison) -> list[float]:
    """The numbers of a step: sums over the coreset, the domain, and the similarity."""
    coreset, domain = comparison.coreset, comparison.domain
    numbers = (
        *(coreset.number, coreset.squares, coreset.largest),
        *(coreset.bulk_count, coreset.bulk_squares),
        *(domain.number, domain.squares, domain.largest),
        *comparison.similarity,
    )
    return [float(number) for number in numbers]


class _Job:
    """A part that is to be coded, measured and written."""

    def __init__(self, series: Series, plan: SeriesPlan, part: Part) -> None:
        self.series, self.plan, self.part = series, plan, part
        self.layers = part.layers(plan.layers)
        self.steps = plan.steps(self.layers)

    def write(self, path: Path, force: bool, progress: Progress) -> dict[str, Any]:
        """Write the part and measure it; its quality."""
        plan = self.plan
        missing = scan_steps(
            self.series,
            self.steps,
            plan.value_range,
            may_miss=plan.has_missing,
            progress=progress,
        )
        blocks = self._blocks(missing, progress)
        with thread_pool() as workers:
            coded = code_layers(blocks, plan.recipe, self.layers, workers, progress)
        blocks.forget()  # measuring needs the memory
        with ContainerWriter(path, force=force) as writer:
            header = self._write_arrays(writer, blocks, coded, missing)
            quality, errors, whole = self._measured(writer, header, progress)
            writer.add_whole(ERRORS, errors)
            low, high = header["value_range"]
            header["quality"] = brief_quality(writer, quality, high - low, len(self.steps))
            header[PART] |= {
                "number": self.part.number,
                "of": self.part.of,
                "first": self.steps.start,
                "steps": self.series.shape[0],
                "size": coded.outcome.size,
                "nonzero": coded.outcome.nonzero,
                "ssim_steps": whole,
            }
            writer.commit(header)
        return quality

    def _blocks(self, missing: Mapping[int, npt.NDArray[np.uint8]], progress: Progress) -> Blocks:
        """The series in tiles, of which those of the part can be read."""
        plan, shape = self.plan, self.series.shape
        packed = [np.empty(0, np.uint8)] * shape[0]  # those of other steps are not looked at
        if plan.samples < shape[0] * prod(plan.box.shape):
            features = resolve_features(
                plan.features, self.series, range(shape[0]), plan.value_range, progress
            )
            dilation = plan.config.dilation
            masks = packed_masks(self.series, missing, self.steps, features, dilation)
            for step, mask in masks.items():
                packed[step] = mask
        extent = Extent(
            box=plan.box,
            key_frames=tuple(range(shape[0])),
            packed=packed,
            domain=shape[1:],
            samples=plan.samples,
            background=plan.header["background"],
        )
        dtype = self.series.source_dtype or self.series.dtype
        origin = plan.value_range.origin(dtype)
        return Blocks(self.series, extent, plan.recipe.tile, origin).by_layers()

    def _write_arrays(
        self,
        writer: ContainerWriter,
        blocks: Blocks,
        coded: CodedLayers,
        missing: Mapping[int, npt.NDArray[np.uint8]],
    ) -> dict[str, Any]:
        """Write coordinates, masks and tiles; the header without its quality."""
        plan, steps = self.plan, StepsSeries(self.series, self.steps)
        value_range = plan.value_range
        scanned = Scan(
            value_range=value_range,
            mean=value_range.low,
            finite_count=0,
            missing={step - self.steps.start: bits for step, bits in missing.items()},
        )
        described = write_series(
            writer,
            steps,
            scanned,
            range(len(self.steps)),
            everything=EVERYTHING in plan.features,
        )
        source = self._write_source(writer)
        parts = TableParts(
            shape=(len(self.steps), *blocks.shape[1:]),
            dtype=blocks.source_dtype,
            tile=blocks.tile,
            settings=replace(plan.recipe.settings, origin=blocks.origin),
            streams=coded.streams,
        )
        parts.write(writer)
        own = deepcopy(dict(plan.header))
        own["required_features"] = ["transform"]
        own["model"]["levels"] = [list(parts.shape)]
        own["model"]["parameters"] += coded.outcome.nonzero
        own["model"]["gains"].append(all_tiles(coded.outcome.size))
        gaps = plan.samples < prod(self.series.shape)
        told = describe_source(steps, value_range, plan.config, gaps=gaps)
        return {**told, **described, **own, PART: source}

    def _measured(
        self, writer: ContainerWriter, header: Mapping[str, Any], progress: Progress
    ) -> tuple[dict[str, Any], npt.NDArray[np.float64], list[int]]:
        """The quality of what is written, the errors of each step, and the steps of the SSIM."""
        rows: list[list[float]] = []
        z, y, x = self.series.shape[1:]
        budget = ssim_budget(self.plan.config)
        whole = ssim_steps(self.series.shape[0], z * y * x, budget) if budget else []
        with Volume(writer.preview(header)) as volume:
            quality = measure(
                StepsSeries(self.series, self.steps),
                volume,
                progress,
                ssim_measured=[step - self.steps.start for step in whole if step in self.steps],
                observe=lambda comparison: rows.append(_row(comparison)),
            )
        return quality, np.array(rows, dtype=np.float64), whole

    def _write_source(self, writer: ContainerWriter) -> dict[str, Any]:
        """Write what belongs to the whole series in its source, in the first part alone."""
        if self.part.number != 1:
            return {}
        whole = describe_source(self.series, self.plan.value_range, self.plan.config)
        for name, array in source_parts(self.series, self.series.coords, {})[1].items():
            writer.add_whole(f"{WHOLE}{name}", array)
        kept = {SOURCE: whole.get(SOURCE), NOT_STORED: whole["variable"].get(NOT_STORED)}
        return {key: value for key, value in kept.items() if value is not None}
