"""Residual of a network: what its decoded values lack, coded as a lattice within a bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.encode import code_series
from fhash_codec.compact.tiles import fits_memory
from fhash_codec.config import EncodeConfig
from fhash_codec.features.selection import select_features
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.paper.encode import coded_bound
from fhash_codec.progress import Progress, stage
from fhash_codec.volume import Volume
from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import RESIDUAL, TRANSFORM_FEATURE
from fhash_formats.series import AXES, ArraySeries, Series, index_coordinate

EFFORT = 3
"""Effort of the lattice: what a network lacks is noise, of which a head learns nothing."""


def with_residual(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    header: dict[str, Any],
    progress: Progress,
) -> dict[str, Any]:
    """Code and write what a written network lacks of a series, where a bound is promised.

    header: of what is written.

    Returns the header with what it says of the residual.
    """
    bound = coded_bound(config, series, ValueRange(*header["value_range"]))
    if bound is None:
        return header
    told = "what the network lacks, coded as a lattice within the bound"
    with stage("residual", told), Volume(writer.preview(header)) as volume:
        lacking: Series = _Lacking(series, volume)
        if fits_memory(lacking):
            lacking = ArraySeries(lacking.read_steps(range(lacking.shape[0])))
        coding = EncodeConfig(max_error=bound, effort=EFFORT, seed=config.seed)
        selection = select_features(lacking, coding, progress, ranked=not fits_memory(lacking))
        table = code_series(lacking, selection, coding, progress)
    table.parts.write(writer, RESIDUAL)
    needed = [*header.get("required_features", ()), TRANSFORM_FEATURE, RESIDUAL]
    return header | {"required_features": list(dict.fromkeys(needed))}


class _Lacking(Series):
    """Errors of a volume, in its box (z, y, x) at each step; 0 where no value counts."""

    def __init__(self, series: Series, volume: Volume) -> None:
        self._series, self._volume = series, volume
        self.source, self.name, self.units, self.attributes = series.source, RESIDUAL, "", {}
        z, y, x = volume.box.shape
        self.shape = (series.shape[0], z, y, x)
        self.dtype = volume.float_dtype
        lengths = zip(AXES, self.shape, strict=True)
        self.coords = {axis: index_coordinate(axis, length) for axis, length in lengths}

    def read(self, step: int) -> npt.NDArray[Any]:
        box = self._volume.box
        frame = self._series.read(step)[box.slices()].astype(np.float64)
        lacking = frame - self._volume.read(step, box)
        return np.where(self._volume.occupancy(step, box), lacking, 0.0).astype(self.dtype)
