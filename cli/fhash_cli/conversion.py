"""Decoded frames in the number type of an output."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def check_fill(kind: np.dtype[Any], fill: float | None) -> None:
    """Raise InputError for a fill value that a number type cannot hold; None is always held."""
    from fhash_codec.value_type import holds

    if fill is not None and not holds(kind, fill):
        raise InputError(f"the fill value {fill:g} does not fit {kind}; give another, or --dtype")


def convert(
    frame: npt.NDArray[Any],
    kind: np.dtype[Any],
    *,
    fill: float | None = None,
    background: bool = False,
    integers: npt.NDArray[Any] | None = None,
) -> npt.NDArray[Any]:
    """Convert a decoded frame to another number type; for integers it is rounded and clipped.

    fill: value in place of NaN; None for NaN itself. background: vertices outside the coreset hold
    the background's value; NaN means a missing value. integers: the values as integers, where
    floats have not all of them. Raises InputError where the type cannot hold a value.
    """
    import numpy as np

    gaps = np.isnan(frame)
    frame = frame if integers is None else integers
    if not gaps.any():
        return _converted(frame, kind)
    if fill is None:
        if kind.kind != "f":
            what = (
                "the data have no value (NaN) at some vertices of the region"
                if background
                else "the region holds vertices without a value (NaN)"
            )
            other = "" if background else "add --outside background, "
            raise InputError(
                f"{what}, which {kind} cannot hold; {other}give --fill V, or take a float type"
            )
        return _converted(frame, kind)
    result = _converted(np.where(gaps, 0, frame), kind)
    result[gaps] = fill
    return result


def _converted(frame: npt.NDArray[Any], kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """A frame without NaN in another number type; `kind` may be a float type for any frame."""
    import numpy as np

    if kind == frame.dtype:
        return frame
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            narrow = frame.astype(kind)
        if np.isinf(narrow).any():
            raise InputError(
                f"a value of {float(np.nanmax(np.abs(frame))):.6g} does not fit {kind};"
                " choose a wider type"
            )
        return narrow
    limits = np.iinfo(kind)
    if frame.dtype.kind != "f":
        own = np.iinfo(frame.dtype)
        low, high = max(int(limits.min), int(own.min)), min(int(limits.max), int(own.max))
        return np.asarray(np.clip(frame, low, high).astype(kind))
    rounded = np.rint(frame.astype(np.float64))
    # No float64 equals the largest 64-bit integer: the float of the limit lies one above it.
    clipped = rounded >= float(limits.max)
    integers = np.where(clipped, 0.0, np.maximum(rounded, float(limits.min))).astype(kind)
    integers[clipped] = limits.max
    return np.asarray(integers)
