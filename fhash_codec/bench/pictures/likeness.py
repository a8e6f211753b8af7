"""Likeness of two pictures: PSNR and SSIM."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from fhash_codec.measure.ssim import ssim

__all__ = ["black", "picture_psnr", "picture_ssim"]

Pixels = npt.NDArray[np.uint8]
Single = npt.NDArray[np.float32]


def black(rgba: Single) -> Pixels:
    """Bytes (H, W, 3) over black of a picture (H, W, 4) that is multiplied by its opacity."""
    return np.asarray(np.rint(np.clip(rgba[..., :3], 0.0, 1.0) * 255), dtype=np.uint8)


def picture_psnr(
    picture: npt.NDArray[np.generic], other: npt.NDArray[np.generic], peak: float
) -> float | None:
    """PSNR in dB over all pixels and channels, `peak` being white; None where nothing differs."""
    error = float(np.mean((picture.astype(np.float64) - other.astype(np.float64)) ** 2))
    return 10 * math.log10(peak * peak / error) if error else None


def picture_ssim(picture: Pixels, other: Pixels) -> float:
    """Mean structural similarity of bytes (H, W, 3) over the channels; see
    `fhash_codec.measure.ssim`."""
    total = count = 0.0
    for channel in range(3):
        similarity, number = ssim(picture[None, ..., channel], other[None, ..., channel], 255.0)
        total, count = total + similarity, count + number
    return total / count if count else 1.0
