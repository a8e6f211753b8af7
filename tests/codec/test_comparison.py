"""Comparison of a container with its series."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError, comparison
from fhash_codec.comparison import DecodedFrames, bytes_on_disk
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


def test_the_figures_are_those_of_the_file(field, tmp_path) -> None:
    source = field()
    config = EncodeConfig(profile="paper", features=("interval:50:200",), epochs=8, width=16)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        back = volume[...].astype(np.float64)
    inside = np.isfinite(back)
    error = (back - source)[inside]
    span = float(source.max()) - float(source.min())
    assert figures["rmse"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-6)
    assert figures["psnr"] == pytest.approx(
        20 * np.log10(span / np.sqrt((error**2).mean())), abs=1e-4
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        everywhere = np.where(inside, back, volume.background) - source
        assert volume.background == pytest.approx(source[~inside].mean(), rel=1e-5)
        assert figures["psnr"] * (1 - 1e-5) <= volume.info["quality"]["psnr"] <= figures["psnr"]
    assert figures["psnr_domain"] == pytest.approx(
        20 * np.log10(span / np.sqrt((everywhere**2).mean())), abs=1e-4
    )
    assert figures["bytes"] == (tmp_path / "a.fhz").stat().st_size
    assert figures["ratio"] == source.nbytes / figures["bytes"]
    assert figures["coreset_fraction"] == pytest.approx(inside.mean())
    assert [point["epoch"] for point in figures["curve"]] == list(range(1, 9))
    json.dumps(figures, allow_nan=False)
    again = fhash_codec.diff(source, tmp_path / "a.fhz")
    for name in ("psnr", "rmse", "max_abs_error", "psnr_domain", "ssim", "bytes", "key_frames"):
        assert again[name] == figures[name], name


def test_the_source_is_counted_as_it_lies_on_disk(tmp_path: Path) -> None:
    folder = tmp_path / "a.zarr" / "c"
    folder.mkdir(parents=True)
    (folder / "0").write_bytes(b"12345")
    (folder.parent / "zarr.json").write_bytes(b"{}")
    (tmp_path / "b.raw").write_bytes(b"123")
    assert bytes_on_disk([folder.parent]) == 7
    assert bytes_on_disk([folder.parent, tmp_path / "b.raw"]) == 10
    assert bytes_on_disk([]) is None
    assert bytes_on_disk([tmp_path / "gone"]) is None
