"""Packed values, as xarray writes them to zarr arrays, by the CF conventions.

CF 1.11, sections 2.5.1 and 8.1: value = stored * scale_factor + add_offset, and NaN where stored
equals `_FillValue` or `missing_value`. xarray is not needed for it. The type of the result follows
xarray: float64 with a scale or an offset (JSON numbers have no narrower type). With fill values
alone it is float32 if that holds every stored integer (up to 16 bits), float64 otherwise; floats
keep their type.
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError


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

    fill_value: a further fill value, from zarr's own metadata. Raises InputError for an attribute
    that is not a number.
    """
    stored = dtype.newbyteorder("=")
    if stored.kind == "i" and str(attributes.get("_Unsigned", "")).lower() == "true":
        stored = np.dtype(f"u{stored.itemsize}")
    fills = []
    for value in (fill_value, *(attributes.get(name) for name in ("_FillValue", "missing_value"))):
        for each in value if isinstance(value, list) else [value]:
            if each is not None:
                fills.append(_fill(source, each, stored))
    scale, offset = (
        _number(source, name, attributes.get(name)) for name in ("scale_factor", "add_offset")
    )
    fills = [fill for fill in fills if fill is not None and fill == fill]  # NaN marks itself
    if scale is not None or offset is not None:
        return Packing(
            stored=stored,
            dtype=np.dtype(np.float64),
            fills=tuple(fills),
            scale=scale,
            offset=offset,
        )
    if fills and stored.kind in "iu":
        return Packing(
            stored=stored,
            dtype=np.dtype(np.float32 if stored.itemsize <= 2 else np.float64),
            fills=tuple(fills),
        )
    return Packing(stored=stored, dtype=stored, fills=tuple(fills))


def _fill(source: str, value: Any, stored: np.dtype[Any]) -> Any:
    """A fill value in the stored type; None if that type cannot hold it, so that it never occurs.

    xarray writes the fill value of a float array of zarr format 3 as base64 of a little-endian
    float64; others write a number or "NaN".
    """
    if isinstance(value, str):
        try:
            value = float(value)
        except ValueError:
            try:
                (value,) = struct.unpack("<d", base64.standard_b64decode(value))
            except (ValueError, struct.error) as error:
                raise InputError(f"{source}: the fill value {value!r} is not a number") from error
    if not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"{source}: the fill value {value!r} is not a number")
    if stored.kind == "f":
        return stored.type(value)
    if not math.isfinite(value) or value != int(value):
        return None
    integer = int(value)
    limits = np.iinfo(stored)
    if integer < 0 and stored.kind == "u":
        integer += 2 ** (
            8 * stored.itemsize
        )  # the fill value of an _Unsigned array is written signed
    return stored.type(integer) if limits.min <= integer <= limits.max else None


def _number(source: str, name: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(f"{source}: {name} is {value!r}, not a number")
    return float(value)
