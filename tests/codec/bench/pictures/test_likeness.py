"""Likeness of pictures: PSNR and SSIM."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.bench.pictures.likeness import picture_psnr, picture_ssim


def test_likeness_of_pictures() -> None:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 200, (40, 50, 3)).astype(np.uint8)
    assert picture_psnr(one, one, 255.0) is None
    assert picture_psnr(one, one + np.uint8(10), 255.0) == pytest.approx(20 * np.log10(25.5))
    assert picture_ssim(one, one) == pytest.approx(1.0)
    assert picture_ssim(one, rng.integers(0, 200, (40, 50, 3)).astype(np.uint8)) < 0.2
