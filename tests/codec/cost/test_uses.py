"""Likeness of pictures: PSNR and SSIM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import uses as pictures
from fhash_codec.cost.encodings import KeptFile
from fhash_codec.cost.plan import Allowance, facts_of
from fhash_codec.cost.results import Picture
from fhash_codec.cost.uses import (
    NOTHING,
    PictureCosts,
    interpolated,
    measure_reads,
    picture_psnr,
    picture_ssim,
)
from fhash_codec.encoding import encode
from fhash_codec.progress import silent
from fhash_codec.volume import open as open_volume
from fhash_formats.series import ArraySeries


def test_likeness_of_pictures() -> None:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 200, (40, 50, 3)).astype(np.uint8)
    assert picture_psnr(one, one, 255.0) is None
    assert picture_psnr(one, one + np.uint8(10), 255.0) == pytest.approx(20 * np.log10(25.5))
    assert picture_ssim(one, one) == pytest.approx(1.0)
    assert picture_ssim(one, rng.integers(0, 200, (40, 50, 3)).astype(np.uint8)) < 0.2


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small pictures, each drawn once after its warm-up."""
    for name in ("SIZE", "MARCH_SIZE", "NETWORK_SIZE"):
        monkeypatch.setattr(pictures, name, 16)
    monkeypatch.setattr(pictures, "TURNS", 1)
    monkeypatch.setattr(pictures, "STEPS", (4.0, 1.0))
    monkeypatch.setattr(pictures, "THRESHOLDS", (0.3,))


@pytest.mark.usefixtures("small")
def test_every_group_is_measured(series: ArraySeries, tmp_path: Path) -> None:
    files = []
    for name, psnr in (("good", 60.0), ("poor", 20.0)):
        path = tmp_path / f"{name}.fhz"
        encode(series, path, EncodeConfig(effort=1, psnr=psnr))
        files.append(KeptFile(name=name, path=path, psnr=psnr))
    network = tmp_path / "paper.fhz"
    encode(series, network, EncodeConfig(profile="paper", epochs=1, width=4))
    files.append(KeptFile(name="paper", path=network, psnr=20.0))
    made: list[Picture] = []
    allowance = Allowance(1000.0)
    with open_volume(files[0].path) as volume:
        PictureCosts(volume, allowance, silent, made).measure(series, files)
    assert allowance.left_out == []
    rows = {(each.group, each.setting): each for each in made}
    nothing, shaded = rows["effect", NOTHING], rows["effect", "shading"]
    assert nothing.counters["gradients"] == nothing.counters["secondary_rays"] == 0
    assert shaded.counters["gradients"] > 0
    assert rows["effect", "shadows"].counters["secondary_rays"] > 0
    assert nothing.counters["evaluations"] == 0
    coarse, fine = rows["step length", "4"], rows["step length", "1"]
    assert coarse.psnr is not None
    assert fine.psnr is not None
    assert coarse.psnr < fine.psnr
    assert rows["step length", "0.03125"].best
    good, poor = rows["encoding", "good"], rows["encoding", "poor"]
    assert good.psnr is not None
    assert poor.psnr is not None
    assert good.psnr > poor.psnr
    (arm,) = [
        each
        for each in made
        if each.group.startswith("march, paper, ") and each.setting == "ARM on"
    ]
    assert arm.counters["evaluations"] > 0
    assert {"level of detail", "threshold", "level of detail, first picture"} <= {
        each.group for each in made
    }


@pytest.fixture
def file(series: ArraySeries, tmp_path: Path) -> KeptFile:
    """A file that holds the series exactly."""
    path = tmp_path / "a.fhz"
    encode(series, path, EncodeConfig(effort=1, max_error=0.0))
    return KeptFile(name="exact", path=path, psnr=None)


def test_every_kind_is_read_and_compared(series: ArraySeries, file: KeptFile) -> None:
    facts = facts_of(series, silent)
    reads = {
        read.what: read for read in measure_reads(series, [file], facts, Allowance(1000.0), silent)
    }
    sizes = {"open": 0, "frame": 720, "region of 16^3": 720, "line in time": 4}
    assert {name: reads[name].values for name in sizes} == sizes
    for name in ("frame", "region of 16^3", "line in time"):
        assert (reads[name].psnr, reads[name].max_abs_error) == (None, 0.0)
    assert reads["level of detail 1"].values == 3 * 5 * 6
    coarse = [reads[f"level of detail {lod}"].psnr for lod in (1, 2, 3)]
    assert None not in coarse
    assert coarse == sorted(coarse, reverse=True)  # type: ignore[type-var]
    assert reads["open"].bytes_read < reads["frame"].bytes_read


def test_without_time_reads_are_left_out(series: ArraySeries, file: KeptFile) -> None:
    allowance = Allowance(1e-9)
    reads = list(measure_reads(series, [file], facts_of(series, silent), allowance, silent))
    assert len(reads) <= 1
    assert allowance.left_out


def test_interpolation_is_exact_for_linear_values_and_keeps_gaps_small() -> None:
    z, y, x = np.meshgrid(np.arange(5.0), np.arange(7.0), np.arange(9.0), indexing="ij")
    fine = z + 2 * y - x
    places = (range(0, 5, 2), range(0, 7, 2), range(0, 9, 4))
    coarse = fine[::2, ::2, ::4].copy()
    np.testing.assert_allclose(interpolated(coarse, places, fine.shape), fine)
    coarse[0, 0, 0] = np.nan
    gaps = np.isnan(interpolated(coarse, places, fine.shape))
    assert gaps.sum() == 2 * 2 * 4
    assert not gaps[2:].any()
