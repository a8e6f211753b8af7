"""The whole of `fhash cost`, on a small series in little time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import cost
from fhash_codec.cost import encodings as own
from fhash_codec.cost import uses as pictures
from fhash_codec.cost.cost import measure_cost, report_on_encode
from fhash_codec.cost.encodings import KeptFile
from fhash_codec.cost.plan import Allowance, Wish, facts_of
from fhash_codec.cost.results import NETWORK, Picture, advice_rows, feature_options
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
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


def few(features: tuple[str, ...]) -> Iterator[Wish]:
    """Two encodings and a peer."""
    for effort in (1, 2):
        config = EncodeConfig(effort=effort, psnr=40.0, features=features)
        yield Wish(codec="default", group=f"effort {effort}", config=config)
    yield Wish(codec="SZ3", group="SZ3", target=40.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few encodings, and no pictures."""

    monkeypatch.setattr(cost, "wishes", few)
    drawn = SimpleNamespace(measure=lambda series, files: None)
    monkeypatch.setattr(cost, "PictureCosts", lambda *_: drawn)


def test_encodings_reads_and_advice(series: ArraySeries) -> None:
    report = measure_cost(series, budget=500.0)
    assert [point.codec for point in report.encodings] == ["default", "default", "SZ3"]
    assert all(point.bytes_range is None for point in report.encodings)
    assert report.series == "array wave"
    assert {read.what for read in report.reads} >= {"open", "frame", "line in time"}
    assert report.measured == "the whole series"
    assert report.raw_bytes == series.values.nbytes
    assert {entry.goal for entry in report.advice} >= {"40 dB"}
    assert not report.interrupted
    assert report.left_out == ()


def test_figures_of_a_sample_are_scaled_up(
    series: ArraySeries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost, "WHOLE_ENCODINGS", 1e9)
    monkeypatch.setattr(cost, "SAMPLE_ENCODINGS", 1e9)
    monkeypatch.setattr(cost, "MIN_VERTICES", 700)
    report = measure_cost(series, budget=500.0)
    assert report.measured.startswith("a sample, ")
    assert report.shape == series.shape
    scale = np.prod(report.shape) / np.prod(report.measured_shape)
    assert scale > 2
    assert report.raw_bytes == series.values.nbytes
    low, high = series.values.min(), series.values.max()
    assert report.value_range == pytest.approx((low, high))
    for point in report.encodings:
        assert point.bytes_range is not None
        assert point.bytes_range[0] <= point.bytes <= point.bytes_range[1]
        assert point.ratio == pytest.approx(report.raw_bytes / point.bytes, rel=0.01)
        assert (point.psnr or 0) >= 40


def test_features_are_those_of_every_encoding(series: ArraySeries) -> None:
    report = measure_cost(series, features=("interval:1:9",), budget=500.0)
    assert report.features == ("interval:1:9",)
    own = [point for point in report.encodings if point.codec == "default"]
    assert all("--feature interval:1:9" in point.options for point in own)
    assert feature_options(report) == ["--feature interval:1:9"]
    assert {row[-1] for row in advice_rows(report) if row[1] != "SZ3"} <= {
        "--psnr 40 --effort 1",
        "--psnr 40 --effort 2",
    }
    with pytest.raises(InputError, match="interval:99:100"):
        measure_cost(series, features=("interval:99:100",), budget=500.0)


def test_ctrl_c_keeps_what_was_measured(
    series: ArraySeries, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> Iterator[object]:
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(cost, "measure_reads", interrupted)
    report = measure_cost(series, budget=500.0)
    assert report.interrupted
    assert len(report.encodings) == 3
    assert report.reads == ()


def test_ctrl_c_before_anything_was_measured_is_passed_on(
    series: ArraySeries, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(own, "encode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure_cost(series, budget=500.0)


def test_unsuitable_budgets_and_series_are_refused(series: ArraySeries) -> None:
    with pytest.raises(InputError, match="budget is 0 s"):
        measure_cost(series, budget=0.0)
    with pytest.raises(InputError, match="is constant"):
        measure_cost(np.ones((2, 3, 4, 5)), budget=10.0)


def test_stages_steps_reads_and_the_file_itself(series: ArraySeries, tmp_path: Path) -> None:
    config = EncodeConfig(effort=2, psnr=45.0)
    path = tmp_path / "run.fhz"
    figures = encode(series, path, replace(config, timings=True))
    report = report_on_encode(series, figures, config, budget=100.0)
    (point,) = report.encodings
    assert (point.name, point.options) == ("run.fhz", "--psnr 45 --effort 2")
    assert point.bytes == path.stat().st_size
    assert [step["step"] for step in report.per_step] == [0, 1, 2, 3]
    assert sum(stage.seconds for stage in report.stages) <= report.seconds
    assert report.gains[-1].bytes > 0
    assert {read.file for read in report.reads} == {"run.fhz"}
    assert report.seconds >= figures["seconds"]


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
    network = tmp_path / "network.fhz"
    encode(series, network, EncodeConfig(preset="published", tables="float16", epochs=1, width=4))
    files.append(KeptFile(name=NETWORK, path=network, psnr=20.0))
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
        if each.group.startswith(f"march, {NETWORK}, ") and each.setting == "ARM on"
    ]
    assert arm.counters["evaluations"] > 0
    assert {"level of detail", "threshold", "level of detail, first picture"} <= {
        each.group for each in made
    }


@pytest.mark.usefixtures("small")
def test_a_picture_of_a_feature_is_compared_with_that_feature(
    series: ArraySeries, tmp_path: Path
) -> None:
    path = tmp_path / "a.fhz"
    encode(series, path, EncodeConfig(effort=1, max_error=0.0, features=("onset:0.5",)))
    made: list[Picture] = []
    with open_volume(path) as volume:
        assert not volume.occupancy(2).all()
        files = [KeptFile(name="exact", path=path, psnr=None)]
        PictureCosts(volume, Allowance(1000.0), silent, made).measure(series, files)
    (picture,) = [each for each in made if (each.group, each.setting) == ("encoding", "exact")]
    assert (picture.psnr, picture.ssim) == (None, pytest.approx(1.0))


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
    assert reads["open"].bytes_read <= reads["frame"].bytes_read


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
