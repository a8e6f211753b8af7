"""Figures of a container: those of the file as it decodes, the same from `encode` and `diff`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.report import bytes_on_disk


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


def test_figures_count_the_steps_between_key_frames(field, tmp_path) -> None:
    source = field((5, 6, 8, 10))
    figures = fhash_codec.encode(
        source,
        tmp_path / "a.fhz",
        EncodeConfig(profile="paper", key_frames="every:2", epochs=30, width=16),
    )
    steps = {point["step"]: point["psnr"] for point in figures["quality"]["per_step"]}
    assert sorted(steps) == [0, 1, 2, 3, 4]
    assert figures["key_frames"] == [0, 2, 4]
    assert min(steps[0], steps[2], steps[4]) > max(steps[1], steps[3])


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


def test_an_array_has_no_source_on_disk(field, tmp_path) -> None:
    figures = fhash_codec.encode(field((2, 4, 5, 6)), tmp_path / "a.fhz", EncodeConfig(effort=1))
    assert (figures["source_bytes"], figures["source_ratio"]) == (None, None)
