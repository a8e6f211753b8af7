"""`FhashMarch` of march.hpp as a ctypes structure, and constants that both sides must agree on."""

from __future__ import annotations

import ctypes
from ctypes import POINTER, c_double, c_float, c_int32, c_int64, c_uint32
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = [
    "ATTENUATED",
    "AVERAGE",
    "GRADED",
    "LIT",
    "MAXIMUM",
    "MAX_PLANES",
    "MAX_SURFACES",
    "MINIMUM",
    "POWERS",
    "SHADED",
    "TILE",
    "March",
    "box",
    "numbers",
    "plane",
    "surface",
]

MAX_SURFACES = 64
"""Surfaces of a picture, at most: FHASH_SURFACES."""
MAX_PLANES = 6
"""Planes that clip a picture, at most: FHASH_PLANES."""
POWERS = 1024
"""Intervals of the table of highlights: FHASH_POWERS."""
TILE = 16
"""Pixels along a tile's side: TILE of march_packet.hpp."""
SHADED = 1
"""Flag of `fhash_march`: the volume is lit by its gradients."""
LIT = 2
"""Flag of `fhash_march`: the volume has a light grid."""
MAXIMUM = 4
"""Flag of `fhash_march`: the largest value along each ray is drawn."""

MINIMUM = 32
"""Flag of `fhash_march`, with MAXIMUM: the smallest value along each ray is drawn."""
AVERAGE = 64
"""Flag of `fhash_march`: the mean along each ray is drawn."""
ATTENUATED = 128
"""Flag of `fhash_march`: the attenuated maximum along each ray is drawn."""
GRADED = 256
"""Flag of `fhash_march`, with SHADED: the gradients decide on the opacity, too."""

_Three = c_double * 3
_Pair = c_double * 2
_Box = _Pair * 3
_Surface = c_double * 5
_Plane = c_double * 4


class March(ctypes.Structure):
    """`FhashMarch` of march.hpp, field by field.

    Pointers are given as contiguous arrays, or None for null. The structure keeps them alive.
    """

    _fields_ = (
        ("values", POINTER(c_float)),
        ("shape", c_int64 * 3),
        ("distance", POINTER(c_int32)),
        ("cells", POINTER(c_uint32)),
        ("highest", POINTER(c_float)),
        ("bricks", c_int64 * 3),
        ("table", POINTER(c_float)),
        ("extinction", POINTER(c_double)),
        ("entries", c_int64),
        ("low", c_double),
        ("scale", c_double),
        ("light", POINTER(c_float)),
        ("light_shape", c_int64 * 3),
        ("light_offset", _Three),
        ("light_scale", c_double),
        ("eye", _Three),
        ("right", _Three),
        ("up", _Three),
        ("forward", _Three),
        ("box", _Box),
        ("seen", _Box),
        ("spacing", _Three),
        ("width", c_int64),
        ("height", c_int64),
        ("parallel", c_int64),
        ("rays", c_int64),
        ("step", c_double),
        ("threshold", c_double),
        ("jitter", c_int64),
        ("lamp", _Three),
        ("ambient", c_double),
        ("diffuse", c_double),
        ("specular", c_double),
        ("steep", c_double),
        ("gradient", _Three),
        ("floor", c_double),
        ("powers", POINTER(c_float)),
        ("surfaces", c_int64),
        ("surface", _Surface * MAX_SURFACES),
        ("out", POINTER(c_float)),
        ("depth", POINTER(c_float)),
        ("normal", POINTER(c_float)),
        ("central", c_int64),
        ("path", c_int64),
        ("planes", c_int64),
        ("plane", _Plane * MAX_PLANES),
        ("grading", POINTER(c_float)),
        ("grade_scale", c_double),
        ("unlit", c_int64),
        ("smooth", POINTER(c_float)),
    )

    def __init__(self, **fields: Any) -> None:
        arrays = {name: field for name, field in fields.items() if isinstance(field, np.ndarray)}
        kinds: dict[str, Any] = dict(self._fields_)
        for name, array in arrays.items():
            assert array.flags.c_contiguous, f"{name} is not contiguous"
            assert np.ctypeslib.as_ctypes_type(array.dtype) is kinds[name]._type_, (
                f"{name} is {array.dtype}"
            )
            fields[name] = array.ctypes.data_as(kinds[name])
        # A pointer in a structure does not refer to its array.
        self._arrays = tuple(arrays.values())
        super().__init__(**fields)


def numbers(values: npt.ArrayLike) -> ctypes.Array[c_double]:
    """Three numbers, x, y, z."""
    return _Three(*np.asarray(values))


def box(ends: npt.NDArray[np.float64]) -> ctypes.Array[Any]:
    """A box (3, 2), x, y, z."""
    return _Box(*(_Pair(*pair) for pair in ends))


def surface(level: float, colour: npt.ArrayLike, opacity: float) -> ctypes.Array[c_double]:
    """An isosurface: its value, red, green, blue and opacity."""
    return _Surface(level, *np.asarray(colour), opacity)


def plane(normal_and_distance: npt.ArrayLike) -> ctypes.Array[c_double]:
    """A plane: its normal x, y, z, and the product with it from which on places are kept."""
    return _Plane(*np.asarray(normal_and_distance))
