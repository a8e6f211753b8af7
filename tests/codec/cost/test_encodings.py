"""Encodings of this package: figures of the report, predictions where there is no time."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost import encodings as own
from fhash_codec.cost.encodings import OwnEncodings
from fhash_codec.cost.plan import Allowance, Wish
from fhash_codec.cost.prediction import Prediction
from fhash_codec.progress import silent
from fhash_formats.errors import InterruptedEncodingError, MissingDependencyError
from fhash_formats.series import ArraySeries

FAST = Wish(codec="compact", group="compact, effort 1", config=EncodeConfig(effort=1, psnr=40.0))


def foretold(config: EncodeConfig) -> Prediction:
    """A prediction of 2 s."""
    return Prediction(seconds=2.0, bytes=99, psnr=40.0, basis="none")


def test_an_encoding_has_its_figures_and_its_prediction(
    series: ArraySeries, tmp_path: Path
) -> None:
    encodings = OwnEncodings(series, tmp_path, Allowance(1000.0), foretold, silent)
    encodings.measure(FAST)
    (point,), (file,) = encodings.points, encodings.files
    assert point.measured
    assert point.bytes == file.path.stat().st_size
    assert point.psnr is not None
    assert point.psnr >= 40
    assert (point.predicted_seconds, point.predicted_bytes) == (2.0, 99)


def test_where_time_is_wanting_the_prediction_stays(series: ArraySeries, tmp_path: Path) -> None:
    allowance = Allowance(1.0)
    encodings = OwnEncodings(series, tmp_path, allowance, foretold, silent)
    encodings.measure(FAST)
    (point,) = encodings.points
    assert not point.measured
    assert point.predicted_seconds == 2.0
    assert [entry.what for entry in allowance.left_out] == [FAST.name]
    assert list(tmp_path.iterdir()) == []


def test_an_encoding_that_overruns_is_no_point(series: ArraySeries, tmp_path: Path) -> None:
    now = 0.0
    allowance = Allowance(1000.0, lambda: now)

    def advance(stage: str, done: int, total: int, note: str) -> None:
        nonlocal now
        now += 0.0 if stage == "predicting" else 500.0

    encodings = OwnEncodings(series, tmp_path, allowance, foretold, advance)
    encodings.measure(FAST)
    assert not any(point.measured for point in encodings.points)
    assert "took longer" in allowance.left_out[0].why
    assert list(tmp_path.iterdir()) == []


def test_paper_needs_torch(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(what: str) -> None:
        raise MissingDependencyError(f"{what} needs torch")

    monkeypatch.setattr(own, "need_torch", missing)
    allowance = Allowance(1000.0)
    encodings = OwnEncodings(series, tmp_path, allowance, foretold, silent)
    encodings.measure(Wish(codec="paper", group="paper"))
    assert encodings.points == []
    assert allowance.left_out[0].why == "profile paper needs torch"


def test_paper_trains_one_epoch_and_then_as_many_as_fit(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own, "EPOCHS", (2, 10**6))
    encodings = OwnEncodings(series, tmp_path, Allowance(1000.0), foretold, silent)
    encodings.measure(Wish(codec="paper", group="paper"))
    assert [point.name for point in encodings.points] == ["paper, 1 epoch", "paper, 2 epochs"]
    assert [len(curve.points) for curve in encodings.curves] == [1, 2]
    assert list(tmp_path.glob("*.checkpoint")) == []


def test_ctrl_c_in_a_training_ends_the_measurements(
    series: ArraySeries, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise InterruptedEncodingError("interrupted, a checkpoint is saved")

    monkeypatch.setattr(own, "encode", interrupted)
    allowance = Allowance(1000.0)
    OwnEncodings(series, tmp_path, allowance, foretold, silent).measure(FAST)
    assert allowance.interrupted
