"""Comparison of a container with its series."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError, comparison
from fhash_codec.comparison import DecodedFrames
from fhash_formats.container.stored import StoredArray
from fhash_formats.series import ArraySeries


def test_diff_refuses_another_shape(field, encoded) -> None:
    with pytest.raises(InputError, match=r"shape \(4, 8, 10, 18\)"):
        fhash_codec.diff(ArraySeries(field()), encoded[1])


def test_a_volume_is_equal_to_its_own_decoded_values(encoded) -> None:
    """The coreset has no error; the background stands outside, where the decoded values are NaN."""
    with fhash_codec.open(encoded[1]) as volume:
        figures = fhash_codec.diff(volume[...], encoded[1])
    assert (figures["rmse"], figures["max_abs_error"], figures["psnr"]) == (0, 0, None)
    assert figures["quality"]["rmse_domain"] == 0
    assert len(figures["quality"]["per_step"]) == 5


@pytest.mark.parametrize("steps_held", [1, 2, 3, 100])
@pytest.mark.parametrize("dtype", ["f4", "i8"])
def test_layers_beyond_the_cache_are_decoded_together(
    field, tmp_path, monkeypatch, dtype, steps_held
) -> None:
    path, source = tmp_path / "a.fhz", (100 * field()).astype(dtype)
    config = EncodeConfig(max_error=2, effort=1, tile="3x8x10x9")
    fhash_codec.encode(source, path, config)
    decoded: Counter[tuple[int, ...]] = Counter()
    usual = StoredArray._decode

    def watched(self, index, lod=0, **options):
        decoded[index] += 1
        return usual(self, index, lod, **options)

    with fhash_codec.open(path) as volume:
        frames = [volume.values(step) if dtype == "i8" else volume.read(step) for step in range(4)]
    frame = frames[0].size * volume.float_dtype.itemsize
    monkeypatch.setattr(comparison, "LAYER_BYTES", steps_held * frame)
    monkeypatch.setattr(StoredArray, "_decode", watched)
    with fhash_codec.open(path) as volume:
        volume.container._cache.limit = 1
        read = DecodedFrames(volume, exact=dtype == "i8").read
        for step in range(4):
            np.testing.assert_array_equal(read(step), frames[step])
        np.testing.assert_array_equal(read(1), frames[1])
    assert len(decoded) == 4
    if steps_held >= 3:
        assert max(decoded.values()) == 2  # the first layer comes again
