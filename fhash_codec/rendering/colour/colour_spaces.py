"""Conversions of colours (..., 3) between sRGB, HSV, CIE Lab (D65) and Moreland's Msh.

They are computed as in VTK. Sources: vtkMath.cxx and vtkColorTransferFunction.cxx of VTK 9;
Moreland, Diverging Color Maps for Scientific Visualization, 2009.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["hsv_to_rgb", "lab_to_rgb", "mix_diverging", "rgb_to_hsv", "rgb_to_lab"]

Floats = npt.NDArray[np.float64]

WHITE = (0.9505, 1.0, 1.089)
"""The white point D65 in XYZ, rounded as in VTK."""
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Matrix from linear RGB to XYZ."""
FROM_XYZ = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
"""Matrix from XYZ to linear RGB."""


def rgb_to_hsv(rgb: Floats) -> Floats:
    """Convert to hue, saturation and value, each 0..1."""
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
    """Invert `rgb_to_hsv`."""
    hue, saturation, value = (channel[..., None] for channel in np.moveaxis(hsv, -1, 0))
    pure = np.clip(np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1, 0.0, 1.0)
    return np.asarray(value * (1 + saturation * (pure - 1)), dtype=np.float64)


def rgb_to_lab(rgb: Floats) -> Floats:
    """Convert to CIE Lab: lightness 0..100, a and b."""
    linear = np.where(rgb > 0.04045, ((rgb + 0.055) / 1.055) ** 2.4, rgb / 12.92)
    xyz = linear @ TO_XYZ.T / WHITE
    x, y, z = np.moveaxis(np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116), -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def lab_to_rgb(lab: Floats) -> Floats:
    """Invert `rgb_to_lab`.

    A colour that no screen has is dimmed until its brightest channel is 1, and channels below 0
    become 0.
    """
    lightness, a, b = np.moveaxis(lab, -1, 0)
    y = (lightness + 16) / 116
    roots = np.stack([y + a / 500, y, y - b / 200], axis=-1)
    xyz = np.where(roots**3 > 0.008856, roots**3, (roots - 16 / 116) / 7.787) * WHITE
    linear = xyz @ FROM_XYZ.T
    rgb = np.where(
        linear > 0.0031308, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055, 12.92 * linear
    )
    return np.asarray(
        np.maximum(rgb / np.maximum(rgb.max(axis=-1, keepdims=True), 1.0), 0.0), dtype=np.float64
    )


def mix_diverging(first: Floats, second: Floats, share: Floats) -> Floats:
    """Mix two colours on Moreland's diverging scale.

    The scale passes through white where both colours are saturated and their hues are far apart.

    Args:
        first: sRGB (..., 3), at share 0.
        second: sRGB (..., 3), at share 1.
        share: (..., 1), 0..1.
    """
    start, end = _lab_to_msh(rgb_to_lab(first)), _lab_to_msh(rgb_to_lab(second))
    share = np.array(np.broadcast_to(share, (*start.shape[:-1], 1)))[..., 0]
    turn = np.abs(start[..., 2] - end[..., 2])
    turn = np.where(turn > np.pi, 2 * np.pi - turn, turn)
    apart = (start[..., 1] > 0.05) & (end[..., 1] > 0.05) & (turn > 0.33 * np.pi)
    white = np.stack(
        [np.maximum(np.maximum(start[..., 0], end[..., 0]), 88.0), *[np.zeros_like(share)] * 2],
        axis=-1,
    )
    lower = share < 0.5
    end = np.where((apart & lower)[..., None], white, end)
    start = np.where((apart & ~lower)[..., None], white, start)
    share = np.where(apart, np.where(lower, 2 * share, 2 * share - 1), share)
    grey_start = (start[..., 1] < 0.05) & (end[..., 1] > 0.05)
    grey_end = (end[..., 1] < 0.05) & (start[..., 1] > 0.05)
    start[..., 2], end[..., 2] = (
        np.where(grey_start, _hue(end, start[..., 0]), start[..., 2]),
        np.where(grey_end, _hue(start, end[..., 0]), end[..., 2]),
    )
    mixed = start + share[..., None] * (end - start)
    m, s, h = np.moveaxis(mixed, -1, 0)
    return lab_to_rgb(
        np.stack([m * np.cos(s), m * np.sin(s) * np.cos(h), m * np.sin(s) * np.sin(h)], axis=-1)
    )


def _lab_to_msh(lab: Floats) -> Floats:
    """Convert to Moreland's polar Lab: magnitude, saturation angle and hue angle."""
    m = np.sqrt((lab**2).sum(axis=-1))
    s = np.where(
        m > 0.001, np.arccos(np.clip(lab[..., 0] / np.where(m > 0.001, m, 1.0), -1.0, 1.0)), 0.0
    )
    h = np.where(s > 0.001, np.arctan2(lab[..., 2], lab[..., 1]), 0.0)
    return np.stack([m, s, h], axis=-1)


def _hue(msh: Floats, unsaturated: Floats) -> Floats:
    """Choose the hue of an unsaturated colour so that the scale to a saturated one is even.

    Args:
        msh: the saturated colour (..., 3).
        unsaturated: magnitude (...) of the other colour.
    """
    m, s, h = np.moveaxis(msh, -1, 0)
    spin = s * np.sqrt(np.maximum(unsaturated**2 - m**2, 0.0)) / np.maximum(m * np.sin(s), 1e-30)
    return np.asarray(
        np.where(m >= unsaturated - 0.1, h, np.where(h > -0.3 * np.pi, h + spin, h - spin)),
        dtype=np.float64,
    )
