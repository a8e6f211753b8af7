"""The integers that an encoder chooses for the coefficients of a tile, and their bytes.

The quantiser is plain, and an integer may give way to a cheaper one beside it; or there are two
quantisers, and the cheapest path through their trellis is searched.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.entropy.coder import encode_integers
from fhash_formats.transform.entropy.trellis import choose_levels
from fhash_formats.transform.tile.settings import TileSettings
from fhash_formats.transform.values.quantise import LARGEST, quantise

__all__ = [
    "MAX_CHOSEN",
    "OFFSETS",
    "SHARE",
    "TRELLIS_OFFSETS",
    "TRELLIS_WEIGHT",
    "WEIGHT",
    "choose_integers",
    "code_coefficients",
    "with_trellis",
]

WEIGHT = 0.09
"""Squared steps of the plain quantiser that a bit is worth (best between 0.07 and 0.11 in
experiments)."""
OFFSETS = (-5, -1, 0, 0, 0, 0)
"""Shift, in 1/128 step, of the decoded magnitudes after the optimisation, see `dequantise`."""
SHARE = 0.65
"""Step on the trellis as a share of the plain quantiser's of about the same error and bytes."""
TRELLIS_WEIGHT = 0.27
"""Squared steps on the trellis that a bit is worth (0.25 to 0.3 are alike in experiments)."""
TRELLIS_OFFSETS = (17, -10, -5, -3, -2, -1)
"""The same with two quantisers.

It is the mean over coefficients of many series, which differ by 3 or less.
"""

MAX_CHOSEN = 1 << 22
"""Magnitude from which on an integer is the nearest one, and is not chosen by its cost.

The choice compares coefficients in float32, which no longer holds their fractions. The search on
the trellis compares them in the type of the arithmetic.
"""

Values = npt.NDArray[Any]
Integers = npt.NDArray[np.int32]


def with_trellis(settings: TileSettings) -> TileSettings:
    """The settings with two quantisers in place of the plain one, at about the same error."""
    return replace(settings, trellis=True, step=settings.step * SHARE, offsets=TRELLIS_OFFSETS)


def choose_integers(
    coefficients: Values, settings: TileSettings, weight: float, passes: int = 1
) -> Integers | None:
    """The integers of coefficients (t, z, y, x), int32; None where the trellis has none so large.

    Args:
        coefficients: in the working type of the settings.
        settings: settings of the tile.
        weight: squared steps that a bit is worth; 0 for the integers of least error.
        passes: how often the path through the trellis is searched.
    """
    table = band_table(settings.transform, coefficients.shape)
    if settings.trellis:
        scaled = coefficients * settings.dtype.type(1.0 / settings.step)
        # Written so that it holds for NaN as well.
        if not max(-float(scaled.min()), float(scaled.max())) < LARGEST:
            return None
        return choose_levels(scaled, table, weight, passes)
    integers, scaled = quantise(coefficients, settings.step)
    if weight <= 0:
        return integers
    return encode_integers(integers, table, scaled=scaled, weight=weight).integers


def code_coefficients(
    coefficients: Values, settings: TileSettings, weight: float, passes: int
) -> tuple[bytes, Integers] | None:
    """The coded coefficients, and the integers that they decode to; None where one is too large.

    The arguments are those of `choose_integers`. Without a trellis, 2 passes code the integers that
    were chosen once more.
    """
    table = band_table(settings.transform, coefficients.shape)
    if settings.trellis:
        path = choose_integers(coefficients, settings, weight, passes)
        if path is None:
            return None
        return encode_integers(path, table, trellis=True).data, path
    integers, scaled = quantise(coefficients, settings.step)
    largest = max(-int(integers.min()), int(integers.max()))
    if largest >= LARGEST:
        return None
    coded = encode_integers(integers, table, scaled=scaled if weight > 0 else None, weight=weight)
    chosen = coded.integers
    if largest >= MAX_CHOSEN and weight > 0 and settings.double:
        large = np.abs(integers) >= MAX_CHOSEN
        nearest = np.rint(coefficients / settings.step).astype(np.int32)
        chosen = np.where(large, nearest, chosen)
    if (passes > 1 and weight > 0) or chosen is not coded.integers:
        coded = encode_integers(chosen, table)
    return coded.data, coded.integers
