"""Steps estimated from the coefficients of all tiles."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fhash_codec.compact.choices.estimate import estimated_step, magnitudes
from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries
from fhash_formats.transform.tile.integers import OFFSETS
from fhash_formats.transform.tile.settings import TileSettings


def test_the_error_is_that_of_a_dead_zone_and_uniform_rounding() -> None:
    coefficients = np.random.default_rng(0).laplace(size=200_000).astype(np.float32)
    histogram = magnitudes(coefficients)
    for step in (0.01, 0.5, 4.0):
        dead = np.abs(coefficients) < 0.8 * step
        expected = np.square(
            coefficients[dead], dtype=np.float64
        ).sum() + 0.1 * step**2 * np.count_nonzero(~dead)
        assert histogram.error(step) == pytest.approx(expected, rel=0.02)
        assert histogram.step(histogram.error(step), 1e-6) == pytest.approx(step, rel=1e-3)


def test_zeros_have_no_error() -> None:
    histogram = magnitudes(np.zeros(100, np.float32))
    assert histogram.error(1.0) == 0.0
    assert math.isfinite(histogram.step(1.0, 1e-3))


@pytest.mark.parametrize("tile", [(6, 10, 20, 20), (6, 20, 40, 40)], ids=str)
def test_the_estimated_step_reaches_the_psnr(tile: tuple[int, int, int, int]) -> None:
    rng = np.random.default_rng(0)
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (6, 20, 40, 40)), indexing="ij")
    source = np.tanh(
        9 * (x + 0.4 * np.sin(5 * y + 2 * t) - 0.5 - 0.2 * z)
    ) + 0.02 * rng.standard_normal(t.shape)
    source = source.astype(np.float32)
    series = ArraySeries(source)
    selection = select_features(series, EncodeConfig(), silent)
    blocks = Blocks(series, selection.extent, tile)
    low, high = float(source.min()), float(source.max())
    settings = TileSettings(
        transform=usual_transform(tile), step=1.0, center=0.0, low=low, high=high, offsets=OFFSETS
    )
    coding = Coding(filled=True)
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(blocks, source.size, workers)
        for psnr in (40.0, 55.0):
            step = estimated_step(
                blocks, settings, coding, psnr=psnr, data_range=high - low, workers=workers
            )
            reached = sample.run(TileSettings(**{**vars(settings), "step": step}), coding).psnr(
                high - low
            )
            assert reached == pytest.approx(psnr, abs=0.6)
