"""Layers of tiles: their bytes, their bound, and tiles beyond the range of the settings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec import EncodeConfig
from fhash_codec.appending.figures import Figures
from fhash_codec.appending.layers import LayerCoder
from fhash_codec.appending.planning import plan_layers
from fhash_formats.transform.tile.decoding import decode_tile

BOUND = 0.01


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 5, 9, 12)), indexing="ij")
    return (np.sin(5 * x + t) * np.cos(4 * y) + z).astype(np.float32)


@pytest.fixture(scope="module")
def coder(frames) -> LayerCoder:
    config = EncodeConfig(max_error=BOUND, effort=1, tile="4x5x6x6")
    return plan_layers(list(frames), config, BOUND, None).coder


def coded(coder: LayerCoder, frames: np.ndarray):
    figures = Figures(1.0)
    with ThreadPoolExecutor(2) as workers:
        return coder.code(list(frames), figures, workers)


def decoded(coder: LayerCoder, streams: list[bytes], shape: tuple[int, ...]) -> np.ndarray:
    t, z, y, x = coder.tile
    result = np.empty((t, z, 2 * y, 2 * x), np.float32)
    for number, stream in enumerate(streams):
        j, i = divmod(number, 2)
        part = decode_tile(stream, coder.tile, np.float32, coder.settings)
        result[:, :, j * y : (j + 1) * y, i * x : (i + 1) * x] = part
    return result[tuple(slice(0, n) for n in shape)]


@pytest.mark.parametrize("steps", [1, 4])
def test_the_streams_decode_within_the_bound_that_is_told(frames, coder, steps) -> None:
    layer = coded(coder, frames[:steps])
    errors = np.abs(decoded(coder, layer.streams, (steps, *frames.shape[1:])) - frames[:steps])
    assert errors.max() <= BOUND
    assert len(layer.errors) == steps
    for error, told in zip(errors.astype(float), layer.errors, strict=True):
        assert told.largest == pytest.approx(error.max(), rel=1e-4)
        assert told.squares == pytest.approx((error**2).sum(), rel=1e-3)
    assert (layer.value_range.low, layer.value_range.high) == (
        frames[:steps].min(),
        frames[:steps].max(),
    )


def test_values_beyond_the_range_take_settings_of_their_own_where_that_is_smaller(
    frames, coder
) -> None:
    far = 3 * frames + 10
    layer = coded(coder, far)
    assert np.abs(decoded(coder, layer.streams, far.shape) - far).max() <= BOUND
    shared = coded(replace(coder, settings=replace(coder.settings, low=-50.0, high=50.0)), far)
    assert sum(map(len, layer.streams)) < 2 * sum(map(len, shared.streams))


def test_a_tile_that_decodes_otherwise_is_told(frames, coder, monkeypatch) -> None:
    monkeypatch.setattr("fhash_codec.appending.layers.decode_tile", lambda *_: frames[0])
    with pytest.raises(RuntimeError, match="decodes to other values"):
        coded(coder, frames)
