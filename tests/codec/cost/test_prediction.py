"""Predictions of encodings."""

from __future__ import annotations

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.prediction import predict
from fhash_formats.series import ArraySeries


def test_each_setting_has_a_prediction() -> None:
    t, z, y, x = np.ogrid[:6, :8, :24, :24]
    values = np.sin(0.3 * x + 0.2 * y + 0.1 * t) * np.cos(0.2 * z)
    series = ArraySeries(values.astype(np.float32))
    configs = [EncodeConfig(psnr=psnr, effort=1) for psnr in (40.0, 60.0)]
    coarse, fine = predict(series, configs)
    assert coarse.bytes is not None
    assert fine.bytes is not None
    assert 0 < coarse.bytes < fine.bytes
    assert coarse.seconds > 0
    assert fine.psnr is not None
    assert fine.psnr >= 60
