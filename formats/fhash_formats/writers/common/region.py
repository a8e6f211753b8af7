"""Description of the values that a writer gets, known before the first of them comes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.series import Coordinate, Series, check_coords, check_values
from fhash_formats.source_metadata import SourceMetadata


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """A decoded part of a time-varying volume, without its values.

    Attributes:
        name: name of the variable, such as "density".
        units: units of the values, "" where unknown.
        dtype: type of the frames, an integer or float of at most 64 bits; kept in the native byte
            order.
        shape: (t, z, y, x), every length at least 1.
        coords: a Coordinate for each of "t", "z", "y", "x", cut to the region and as long as the
            axis.
        attributes: attributes of the variable, JSON values.
        fill: number of `dtype` that stands where there is no value; None where every vertex has one
            or NaN stands there.
        metadata: what belongs to the variable in its source, cut to the region; None where that is
            unknown. NetCDF and Zarr give it back.

    Raises:
        InputError: one of these does not hold.
    """

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, int, int, int]
    coords: Mapping[str, Coordinate]
    units: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    fill: int | float | None = None
    metadata: SourceMetadata | None = None

    @classmethod
    def of(cls, series: Series) -> Self:
        """The region that is all of a series."""
        return cls(
            name=series.name,
            units=series.units,
            dtype=series.dtype,
            shape=series.shape,
            coords=series.coords,
            attributes=series.attributes,
            metadata=series.metadata,
        )

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("region: the variable has no name; give one, such as 'values'")
        dtype = np.dtype(self.dtype).newbyteorder("=")
        shape = check_values(f"region {self.name!r}", self.shape, dtype)
        object.__setattr__(self, "dtype", dtype)
        object.__setattr__(self, "shape", shape)
        check_coords(f"region {self.name!r}", self.coords, shape)
