"""Steps estimated from the coefficients of all tiles."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from fhash_codec import native
from fhash_codec.compact.choices.estimate import estimated_step, magnitudes
from fhash_codec.compact.choices.transform import usual_transform
from fhash_codec.compact.tiles.blocks import Blocks
from fhash_codec.compact.tiles.coding import Coding
from fhash_codec.compact.tiles.sample import Sample
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import select_features
from fhash_codec.encoding import encode
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning
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


ENCODE_IN_NUMPY = """
import sys, warnings
sys.modules["numba"] = None  # compiling takes longer than this small series
warnings.simplefilter("ignore")
import numpy, fhash_codec
from fhash_codec import native
assert native.library() is None
config = fhash_codec.EncodeConfig(psnr=40.0, effort=1, timings=False, tile="3x6x5x12")
fhash_codec.encode(numpy.load(sys.argv[1]), sys.argv[2], config)
"""


@pytest.mark.skipif(native.library() is None, reason="the native library was not built here")
def test_effort_1_gives_the_same_bytes_native_and_in_numpy(tmp_path: Path) -> None:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 6, 10, 12)), indexing="ij")
    source = (np.sin(9 * x + 3 * y * t) + z).astype(np.float32)
    config = EncodeConfig(psnr=40.0, effort=1, timings=False, tile="3x6x5x12")
    encode(source, tmp_path / "a.fhz", config)
    np.save(tmp_path / "a.npy", source)
    subprocess.run(
        [sys.executable, "-c", ENCODE_IN_NUMPY, tmp_path / "a.npy", tmp_path / "b.fhz"],
        env={**os.environ, "FHASH_NATIVE": "0"},
        check=True,
    )
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


def test_without_the_native_core_the_user_is_warned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_codec.compact.encode.native.library", lambda: None)
    with pytest.warns(FhashWarning, match="native core"):
        encode(np.zeros((1, 2, 2, 2), np.float32), tmp_path / "a.fhz", EncodeConfig(effort=1))
