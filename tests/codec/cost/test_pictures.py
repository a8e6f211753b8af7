"""Pictures: each group, effects that are not named count zero, likeness to the best."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import pictures
from fhash_codec.cost.allowance import Allowance
from fhash_codec.cost.own import KeptFile
from fhash_codec.cost.pictures import NOTHING, PictureCosts
from fhash_codec.cost.results import Picture
from fhash_codec.encoding import encode
from fhash_codec.progress import silent
from fhash_codec.volume import open as open_volume
from fhash_formats.series import ArraySeries


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
