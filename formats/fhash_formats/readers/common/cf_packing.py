"""Packed values by the CF conventions, as NetCDF, zarr and HDF5 files declare them.

CF 1.11, sections 2.5.1 and 8.1: value = stored * scale_factor + add_offset, and NaN where stored
equals `_FillValue` or `missing_value`. xarray is not needed for it. The type of the result follows
xarray: that of scale and offset where a file stores them as float32, float64 otherwise (JSON
numbers have no narrower type). With fill values alone it is float32 if that holds every stored
integer (up to 16 bits), float64 otherwise; floats keep their type.
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.series import Series
from fhash_formats.support.attributes import text_of

SCALING = frozenset(("scale_factor", "add_offset"))
"""Attributes that make stored numbers counts of another unit."""

AS_STORED = "; --raw-values reads the numbers as they are stored"
"""Advice where attributes make no sense."""


@dataclass(frozen=True, kw_only=True)
class Packing:
    """The packing of an array.

    It has the stored type, the type of the values, the fill values, the scale and the offset (None:
    none).
    """

    stored: np.dtype[Any]
    dtype: np.dtype[Any]
    fills: tuple[Any, ...] = ()
    scale: float | None = None
    offset: float | None = None

    @property
    def scaled(self) -> bool:
        """Whether stored numbers are counts of another unit than the values."""
        return self.scale is not None or self.offset is not None

    @property
    def integers(self) -> bool:
        """Whether the values are integers, and only the missing ones made floats of them."""
        return self.stored.kind in "iu" and not self.scaled and self.dtype != self.stored

    def unpack(self, stored: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Physical values of stored ones; the same array where nothing is packed."""
        numbers = stored.astype(stored.dtype.newbyteorder("="), copy=False).view(
            self.stored
        )  # the view is for _Unsigned
        if self.dtype == self.stored:
            # floats without scaling; the array is fresh and may be changed in place
            for fill in self.fills:
                numbers[numbers == fill] = np.nan
            return numbers
        values = numbers.astype(self.dtype)
        if self.scale is not None:
            values *= self.scale
        if self.offset is not None:
            values += self.offset
        for fill in self.fills:
            values[numbers == fill] = np.nan
        return values


def packing(
    source: str, dtype: np.dtype[Any], attributes: Mapping[str, Any], fill_value: Any = None
) -> Packing:
    """The packing that an array's attributes describe.

    attributes: JSON values, or as h5py gives them. fill_value: a further fill value, from zarr's
    own metadata. Raises InputError for an attribute that is not a number.
    """
    stored = dtype.newbyteorder("=")
    signs = {"true": ("i", "u"), "false": ("u", "i")}.get(
        text_of(_single(attributes.get("_Unsigned", ""))).lower()
    )
    other = signs is not None and stored.kind == signs[0]
    if signs is not None and other:
        stored = np.dtype(f"{signs[1]}{stored.itemsize}")
    fills = []
    for value in (fill_value, *(attributes.get(name) for name in ("_FillValue", "missing_value"))):
        for each in value if isinstance(value, list | tuple | np.ndarray) else [value]:
            if each is not None:
                fills.append(_fill(source, each, stored, unsigned=other and stored.kind == "i"))
    scale, offset = (_single(attributes.get(name)) for name in ("scale_factor", "add_offset"))
    return _packing(
        stored,
        [fill for fill in fills if fill is not None and fill == fill],  # NaN marks itself
        _number(source, "scale_factor", scale),
        _number(source, "add_offset", offset),
        _scaled_type(stored, scale, offset),
    )


def note_packing(series: Series, packed: Packing) -> None:
    """Tell a series what stood for missing values in its source, and its integer type there."""
    if packed.fills and not packed.scaled and series.fill is None:
        series.fill = packed.fills[0].item()
    if packed.scaled and packed.stored.kind == "i" and packed.stored.itemsize > 1:
        lowest = np.iinfo(packed.stored).min + np.arange(3, dtype=packed.stored)
        series.unlikely = frozenset(packed.unpack(lowest).tolist())
    if packed.integers:
        series.source_dtype = packed.stored


def missing_values(source: str, dtype: np.dtype[Any], values: Sequence[float]) -> Packing:
    """The packing of an array in which some numbers stand for missing values, and nothing else.

    values: they occur nowhere if the type cannot hold them.
    """
    stored = dtype.newbyteorder("=")
    fills = [_fill(source, value, stored) for value in values]
    return _packing(
        stored, [fill for fill in fills if fill is not None and fill == fill], None, None, stored
    )


def _packing(
    stored: np.dtype[Any],
    fills: Sequence[Any],
    scale: float | None,
    offset: float | None,
    scaled: np.dtype[Any],
) -> Packing:
    dtype = stored
    if scale is not None or offset is not None:
        dtype = scaled
    elif fills and stored.kind in "iu":
        dtype = np.dtype(np.float32 if stored.itemsize <= 2 else np.float64)
    return Packing(stored=stored, dtype=dtype, fills=tuple(fills), scale=scale, offset=offset)


def _scaled_type(stored: np.dtype[Any], scale: Any, offset: Any) -> np.dtype[Any]:
    """The type of scaled values, chosen as xarray does.

    An offset alone, or of another type than the scale, is not CF and needs float64; so do integers
    of 32 bits with both.
    """
    double = np.dtype(np.float64)
    if not isinstance(scale, np.floating) or (
        offset is not None and type(offset) is not type(scale)
    ):
        return double
    wide = offset is not None and stored.kind in "iu" and stored.itemsize == 4
    return double if wide or scale.dtype.itemsize > 8 else scale.dtype


def _single(value: Any) -> Any:
    """The only element of an attribute that is an array or list of one; else the attribute."""
    if isinstance(value, np.ndarray):
        return value.reshape(-1)[0] if value.size == 1 else value
    return value[0] if isinstance(value, list | tuple) and len(value) == 1 else value


def _fill(source: str, value: Any, stored: np.dtype[Any], *, unsigned: bool = False) -> Any:
    """A fill value in the stored type; None if that type cannot hold it, so that it never occurs.

    unsigned: whether the value was written for unsigned numbers that are read as signed.

    xarray writes the fill value of a float array of zarr format 3 as base64 of a little-endian
    float64; others write a number or "NaN".
    """
    if isinstance(value, str | bytes):
        value = text_of(value)
        try:
            value = float(value)
        except ValueError:
            try:
                (value,) = struct.unpack("<d", base64.standard_b64decode(value))
            except (ValueError, struct.error) as error:
                raise InputError(
                    f"{source}: the fill value {value!r} is not a number{AS_STORED}"
                ) from error
    if not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"{source}: the fill value {value!r} is not a number{AS_STORED}")
    if stored.kind == "f":
        with np.errstate(over="ignore"):
            return stored.type(value)
    if not math.isfinite(value) or value != int(value):
        return None
    integer = int(value)
    limits = np.iinfo(stored)
    if integer < 0 and stored.kind == "u":
        integer += 2 ** (
            8 * stored.itemsize
        )  # the fill value of an _Unsigned array is written signed
    if unsigned and integer > limits.max:
        integer -= 2 ** (8 * stored.itemsize)
    return stored.type(integer) if limits.min <= integer <= limits.max else None


def _number(source: str, name: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"{source}: {name} is {value!r}, not a number{AS_STORED}")
    return float(value)
