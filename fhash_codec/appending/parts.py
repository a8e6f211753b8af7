"""`encode_part`: some steps of a series on one machine of several; `merge` joins the parts.

Every part makes the same plan from the whole series, and codes whole layers of its tiles. So parts
have the bytes that one encoding of everything has. A part is a container of its steps; the key
`part` of its header and the array `steps/errors` say what `merge` needs beside that.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.coded_table import CodedTable
from fhash_codec.compact.encode import table_header
from fhash_codec.compact.tiles.blocks import fits_memory
from fhash_codec.compact.tiles_to_promise import all_tiles, code_layers, plan_series
from fhash_codec.comparison import measure, ssim_budget
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.features import Everything
from fhash_codec.coreset.scan import Scan
from fhash_codec.coreset.selection import FeatureSelection, Source, open_source, select_features
from fhash_codec.encoding import check_name, mask_files
from fhash_codec.header import OUTSIDE, brief_quality, describe_source, write_series
from fhash_codec.lean_header import lean
from fhash_codec.measure.metrics import Comparison
from fhash_codec.measure.ssim import ssim_steps
from fhash_codec.measure.sums import ErrorSums
from fhash_codec.progress import Progress, silent
from fhash_codec.provenance import source_parts
from fhash_codec.report import report
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import SOURCE, ContainerWriter, coordinate_features
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
    config: EncodeConfig,
    part: Part,
    *,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Encode one part of a series; `merge` makes one file of all of them.

    The arguments are those of `encode`; the promise is a bound of the error, and times are not
    kept, so that the parts make the file of `encode` with `timings=False`, byte for byte.

    Returns the figures of the written file (`report`). Raises what `encode` raises, and InputError
    for a promise that no part alone can keep.
    """
    path, config = Path(path), replace(config, timings=False)
    if config.profile != "compact" or (config.max_error is None and config.max_error_rel is None):
        raise InputError(
            "a part keeps a promise by itself, which is a bound of the error in the profile "
            "compact: give max_error or max_error_rel"
        )
    check_name(path)
    check_output(path, force)
    begun = time.perf_counter()
    with open_source(source) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        selection = select_features(series, config, progress, ranked=not fits_memory(series))
        with thread_pool() as workers:
            plan, _, bulk = plan_series(series, selection, config, workers, progress)
            layers = part.layers(plan.blocks.grid[0])
            table = replace(code_layers(plan, layers, workers, progress), bulk=bulk)
        length = plan.blocks.tile[0]
        steps = range(layers.start * length, min(layers.stop * length, series.shape[0]))
        with ContainerWriter(path, force=force) as writer:
            job = _Job(series, selection, config, part, steps, table)
            quality = job.write(writer, progress)
        series.check()
        with open_volume(path) as volume:
            return report(volume, quality, seconds=time.perf_counter() - begun, files=series.files)


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


@dataclass(frozen=True)
class _Job:
    """A part that is coded and has to be written."""

    series: Series
    selection: FeatureSelection
    config: EncodeConfig
    part: Part
    steps: range
    table: CodedTable

    def write(self, writer: ContainerWriter, progress: Progress) -> dict[str, Any]:
        """Write the part and measure it; its quality."""
        steps = StepsSeries(self.series, self.steps)
        everything = any(isinstance(one, Everything) for one in self.selection.features)
        source = self._write_source(writer)
        described = write_series(
            writer, steps, self._scan(), range(len(self.steps)), brief=True, everything=everything
        )
        if everything and self.selection.scanned.missing:
            described["missing"] = OUTSIDE
        blocks = self.table.plan.blocks
        parts = TableParts(
            shape=(len(self.steps), *blocks.shape[1:]),
            dtype=blocks.dtype,
            tile=blocks.tile,
            settings=self.table.plan.settings,
            streams=self.table.streams,
        )
        parts.write(writer)
        header = self._header(steps, described, parts)
        rows: list[list[float]] = []
        budget = ssim_budget(self.config)
        whole = ssim_steps(self.series.shape[0], _vertices(self.series), budget) if budget else []
        with Volume(writer.preview(header)) as volume:
            quality = measure(
                steps,
                volume,
                progress,
                ssim_measured=[step - self.steps.start for step in whole if step in self.steps],
                observe=lambda comparison: rows.append(_row(comparison)),
            )
        writer.add_whole(ERRORS, np.array(rows, dtype=np.float64))
        low, high = header["value_range"]
        header["quality"] = brief_quality(quality, high - low, len(self.steps))
        header = lean(header)
        header[PART] = {
            "number": self.part.number,
            "of": self.part.of,
            "first": self.steps.start,
            "steps": self.series.shape[0],
            "size": self.table.outcome.size,
            "nonzero": self.table.outcome.nonzero,
            "ssim_steps": whole,
            **source,
        }
        writer.commit(header)
        return quality

    def _write_source(self, writer: ContainerWriter) -> dict[str, Any]:
        """Write what belongs to the whole series in its source, in the first part alone."""
        if self.part.number != 1:
            return {}
        whole = describe_source(self.series, self.selection.scanned.value_range, self.config)
        for name, array in source_parts(self.series, self.series.coords, {})[1].items():
            writer.add_whole(f"{WHOLE}{name}", array)
        return {SOURCE: whole[SOURCE]} if SOURCE in whole else {}

    def _scan(self) -> Scan:
        """The scan of the whole series, with the missing values of the part's steps."""
        scanned = self.selection.scanned
        missing: Mapping[int, npt.NDArray[np.uint8]] = {
            step - self.steps.start: bits
            for step, bits in scanned.missing.items()
            if step in self.steps
        }
        return replace(scanned, missing=missing)

    def _header(
        self, steps: Series, described: Mapping[str, Any], parts: TableParts
    ) -> dict[str, Any]:
        """The header of the part, without its quality."""
        gains = [*self.table.plan.gains, all_tiles(self.table.outcome.size)]
        table = replace(self.table, plan=replace(self.table.plan, gains=gains))
        own = table_header(self.selection, table, self.config, None)
        own["required_features"] = parts.features + coordinate_features(described["coordinates"])
        own["model"]["levels"] = [list(parts.shape)]
        source = describe_source(steps, self.selection.scanned.value_range, self.config)
        return {**source, **described, **own}


def _vertices(series: Series) -> int:
    """Vertices of a step."""
    z, y, x = series.shape[1:]
    return z * y * x
