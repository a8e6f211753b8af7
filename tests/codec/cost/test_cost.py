"""The whole of `fhash cost`, on a small series in little time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import cost
from fhash_codec.cost import encodings as own
from fhash_codec.cost import uses as pictures
from fhash_codec.cost.cost import measure_cost, report_on_encode
from fhash_codec.cost.plan import Wish
from fhash_codec.cost.prediction import Prediction
from fhash_codec.encoding import encode
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


def few() -> Iterator[Wish]:
    """Two encodings and a peer."""
    for effort in (1, 2):
        config = EncodeConfig(effort=effort, psnr=40.0)
        yield Wish(codec="compact", group=f"compact, effort {effort}", config=config)
    yield Wish(codec="SZ3", group="SZ3", target=40.0)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few encodings, no predictions to wait for, and small pictures."""

    class Foretold:
        """A predictor of times as long as the series."""

        def __init__(self, series: ArraySeries) -> None:
            self.seconds = 1e-9 * float(np.prod(series.shape))

        def predict(self, config: EncodeConfig) -> Prediction:
            return Prediction(seconds=self.seconds, bytes=9, psnr=40.0, basis="")

    monkeypatch.setattr(cost, "predictor", lambda series: nullcontext(Foretold(series)))
    monkeypatch.setattr(cost, "wishes", few)
    monkeypatch.setattr(pictures.PictureCosts, "measure", lambda self, series, files: None)


def test_encodings_reads_and_advice(series: ArraySeries) -> None:
    report = measure_cost(series, budget=500.0)
    assert [point.codec for point in report.encodings] == ["compact", "compact", "SZ3"]
    assert all(point.measured for point in report.encodings)
    assert {read.what for read in report.reads} >= {"open", "frame", "line in time"}
    assert report.measured == "the whole series"
    assert report.raw_bytes == series.values.nbytes
    assert {entry.aim for entry in report.advice} >= {"smallest"}
    assert not report.interrupted
    assert report.left_out == ()


def test_a_series_that_is_too_large_is_cropped(
    series: ArraySeries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost, "FAST_SHARE", 0.5e-9 * series.values.size / 500.0)
    report = measure_cost(series, budget=500.0)
    assert report.measured.startswith("a crop, ")
    assert report.shape == series.shape
    assert np.prod(report.measured_shape) < 0.7 * np.prod(report.shape)
    assert report.raw_bytes == 4 * np.prod(report.measured_shape)


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


def test_stages_steps_reads_and_the_file_itself(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures.PictureCosts, "measure", lambda self, series, files: None)
    config = EncodeConfig(effort=2, psnr=45.0)
    path = tmp_path / "run.fhz"
    figures = encode(series, path, config)
    report = report_on_encode(series, figures, config, budget=100.0)
    (point,) = report.encodings
    assert (point.name, point.options) == ("run.fhz", "--psnr 45 --effort 2")
    assert point.bytes == path.stat().st_size
    assert [step["step"] for step in report.per_step] == [0, 1, 2, 3]
    assert sum(stage.seconds for stage in report.stages) <= report.seconds
    assert report.gains[-1].bytes > 0
    assert {read.file for read in report.reads} == {"run.fhz"}
    assert report.seconds >= figures["seconds"]
