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


def test_a_constant_part_is_kept_without_the_program(tmp_path: Path) -> None:
    """The program takes minutes on it, and megabytes."""
    values = np.linspace(0, 1, 2 * 3 * 4 * 5).reshape(2, 3, 4, 5)
    values[0] = 0.3
    frames = next(variant for variant in variants("/nowhere") if variant.layout == "frame")
    file = tmp_path / "part"
    frames.program.encode(values[0], file, (0.0, 1.0), 45.0)
    assert file.stat().st_size == 8
    np.testing.assert_array_equal(frames.program.decode(file, (3, 4, 5), (0.0, 1.0)), values[0])
