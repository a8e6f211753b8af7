"""Conversions of colours (..., 3) between sRGB, HSV, CIE Lab (D65) and Moreland's Msh, as VTK computes them.

Sources: vtkMath.cxx and vtkColorTransferFunction.cxx of VTK 9; Moreland, Diverging Color Maps for Scientific Visualization, 2009.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["hsv_to_rgb", "lab_to_rgb", "mix_diverging", "rgb_to_hsv", "rgb_to_lab"]

Floats = npt.NDArray[np.float64]

WHITE = (0.9505, 1.0, 1.089)
"""D65 as VTK rounds it."""
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)


def rgb_to_hsv(rgb: Floats) -> Floats:
    """Hue, saturation and value, each 0..1."""
    value = rgb.max(axis=-1)
    spread = value - rgb.min(axis=-1)
    safe = np.where(spread > 0, spread, 1.0)
    red, green, blue = np.moveaxis(rgb, -1, 0)
    hue = np.where(
        value == red,
        ((green - blue) / safe) % 6,
        np.where(value == green, 2 + (blue - red) / safe, 4 + (red - green) / safe),
    )
    return np.stack(
        [np.where(spread > 0, hue / 6, 0.0), spread / np.where(value > 0, value, 1.0), value],
        axis=-1,
    )


def hsv_to_rgb(hsv: Floats) -> Floats:
    """The inverse of `rgb_to_hsv`."""
    hue, saturation, value = (part[..., None] for part in np.moveaxis(hsv, -1, 0))
    pure = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0.0, 1.0)
    return np.asarray(value * (1 + saturation * (pure - 1)), dtype=np.float64)


def rgb_to_lab(rgb: Floats) -> Floats:
    """CIE Lab: lightness 0..100, a and b."""
    light = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    part = light @ TO_XYZ.T / WHITE
    part = np.where(part > 0.008856, np.cbrt(part), 7.787 * part + 16 / 116)
    x, y, z = np.moveaxis(part, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def lab_to_rgb(lab: Floats) -> Floats:
    """The inverse of `rgb_to_lab`; a colour that no screen has is dimmed until its brightest channel fits, and cut at 0."""
    lightness, a, b = np.moveaxis(lab, -1, 0)
    y = (lightness + 16) / 116
    part = np.stack([y + a / 500, y, y - b / 200], axis=-1)
    part = np.where(part**3 > 0.008856, part**3, (part - 16 / 116) / 7.787) * WHITE
    light = part @ FROM_XYZ.T
    rgb = np.where(
        light > 0.0031308, 1.055 * np.maximum(light, 0.0) ** (1 / 2.4) - 0.055, 12.92 * light
    )
    return np.asarray(
        np.maximum(rgb / np.maximum(rgb.max(axis=-1, keepdims=True), 1.0), 0.0), dtype=np.float64
    )


def mix_diverging(first: Floats, second: Floats, share: Floats) -> Floats:
    """Colours between two by Moreland's diverging scale: through white where both are saturated and of different hues.

    first, second: (..., 3) sRGB. share: (..., 1), 0 at the first.
    """
    one, two = _lab_to_msh(rgb_to_lab(first)), _lab_to_msh(rgb_to_lab(second))
    share = np.array(np.broadcast_to(share, (*one.shape[:-1], 1)))[..., 0]
    turn = np.abs(one[..., 2] - two[..., 2])
    turn = np.where(turn > np.pi, 2 * np.pi - turn, turn)
    apart = (one[..., 1] > 0.05) & (two[..., 1] > 0.05) & (turn > 0.33 * np.pi)
    white = np.stack(
        [np.maximum(np.maximum(one[..., 0], two[..., 0]), 88.0), *[np.zeros_like(share)] * 2],
        axis=-1,
    )
    lower = share < 0.5
    two = np.where((apart & lower)[..., None], white, two)
    one = np.where((apart & ~lower)[..., None], white, one)
    share = np.where(apart, np.where(lower, 2 * share, 2 * share - 1), share)
    grey_one = (one[..., 1] < 0.05) & (two[..., 1] > 0.05)
    grey_two = (two[..., 1] < 0.05) & (one[..., 1] > 0.05)
    one[..., 2], two[..., 2] = (
        np.where(grey_one, _hue(two, one[..., 0]), one[..., 2]),
        np.where(grey_two, _hue(one, two[..., 0]), two[..., 2]),
    )
    mixed = one + share[..., None] * (two - one)
    m, s, h = np.moveaxis(mixed, -1, 0)
    return lab_to_rgb(
        np.stack([m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)], axis=-1)
    )


def _lab_to_msh(lab: Floats) -> Floats:
    m = np.sqrt((lab**2).sum(axis=-1))
    s = np.where(
        m > 0.001, np.arccos(np.clip(lab[..., 0] / np.where(m > 0.001, m, 1.0), -1.0, 1.0)), 0.0
    )
    h = np.where(s > 0.001, np.arctan2(lab[..., 2], lab[..., 1]), 0.0)
    return np.stack([m, s, h], axis=-1)


def _hue(msh: Floats, unsaturated: Floats) -> Floats:
    """The hue that a colour without saturation takes, so that the way to the saturated colour `msh` is even."""
    m, s, h = np.moveaxis(msh, -1, 0)
    spin = s * np.sqrt(np.maximum(unsaturated**2 - m**2, 0.0)) / np.maximum(m * np.sin(s), 1e-30)
    return np.asarray(
        np.where(m >= unsaturated - 0.1, h, np.where(h > -0.3 * np.pi, h + spin, h - spin)),
        dtype=np.float64,
    )
