"""TTHRESH by a stand-in: sizes from the fastest axis, and a PSNR over the whole range."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.rate.programs.tthresh import variants


@pytest.mark.parametrize("shape", [(4, 6, 20, 24), (1, 6, 20, 24), (3, 1, 1, 9)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
def test_the_psnr_is_that_of_the_level(
    tthresh: str,
    field: Callable[..., np.ndarray],
    tmp_path: Path,
    shape: tuple[int, ...],
    dtype: type,
) -> None:
    values = (100 * field(shape)).astype(dtype)
    data_range = float(np.ptp(values))
    for variant in variants(tthresh):
        coded = variant.encode(values, data_range, 40.0, tmp_path)
        difference = variant.decode(coded).astype(float) - values
        # A uniform error of that tolerance has a PSNR 4.8 dB above the level.
        reached = 20 * np.log10(data_range / np.sqrt(np.mean(difference**2)))
        assert 43 < reached < 48
        assert 0 < coded.bytes < 8 * values.size + 600
    assert {variant.goals for variant in variants(tthresh)} == {("psnr", "bound")}
