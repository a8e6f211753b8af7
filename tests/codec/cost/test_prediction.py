"""Predictions of encodings: each part of the work is counted where it is done, and only there."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.prediction import LOOKED_AT, Prediction, Predictor, predict
from fhash_formats.series import ArraySeries, Series
from fhash_formats.support.threads import thread_pool


def waves(shape: tuple[int, int, int, int] = (6, 8, 24, 24)) -> npt.NDArray[np.float32]:
    t, z, y, x = np.ogrid[tuple(slice(n) for n in shape)]
    return (np.sin(0.3 * x + 0.2 * y + 0.1 * t) * np.cos(0.2 * z)).astype(np.float32)


def only(values: npt.NDArray[np.generic], **settings: object) -> Prediction:
    (prediction,) = predict(ArraySeries(values), [EncodeConfig.from_dict(settings)])
    return prediction


def test_each_setting_has_a_prediction() -> None:
    configs = [EncodeConfig(psnr=psnr, effort=effort) for psnr in (40.0, 60.0) for effort in (1, 2)]
    told: list[tuple[int, int]] = []
    predictions = predict(
        ArraySeries(waves()),
        configs,
        progress=lambda _, done, total, __: told.append((done, total)),
    )
    coarse, _, fine, _ = predictions
    assert coarse.bytes is not None
    assert fine.bytes is not None
    assert 0 < coarse.bytes < fine.bytes
    assert fine.psnr is not None
    assert fine.psnr >= 60
    assert told == [(n, 4) for n in range(5)]
    for prediction in predictions:
        assert prediction.seconds == pytest.approx(sum(prediction.stages.values()))
        assert prediction.basis


def test_only_what_an_effort_does_is_counted() -> None:
    values = waves() + np.random.default_rng(0).normal(0, 0.05, (6, 8, 24, 24)).astype(np.float32)
    stages = {effort: only(values, effort=effort, psnr=50.0).stages for effort in (1, 2, 5)}
    assert {"estimate", "coding", "measuring"} <= set(stages[1])
    assert "transform" not in stages[1]
    assert stages[2]["transform"] > 0
    assert "head trial" not in stages[2]
    assert stages[5]["head trial"] > 0
    without = only(values, effort=5, psnr=50.0, without=["transform", "head"]).stages
    assert without["bases"] == 0 < stages[5]["bases"]
    assert "head trial" not in without


def test_a_bound_counts_the_predictor_and_exact_labels_themselves() -> None:
    bound = only(waves(), effort=2, max_error=1e-3)
    assert bound.stages["predictor"] > 0
    assert bound.psnr is not None
    labels = np.repeat(np.arange(24 * 24).reshape(24, 24) // 96, 48).reshape(6, 8, 24, 24)
    exact = only(labels.astype(np.uint8), max_error=0.0)
    assert exact.psnr is None
    assert exact.stages["labels"] > 0


def test_a_coreset_with_a_mask_counts_its_filling() -> None:
    filled = only(waves(), effort=2, psnr=45.0, features=["interval:0.2:2"])
    assert filled.stages["filling"] > 0
    assert "filling" not in only(waves(), effort=2, psnr=45.0).stages


class _Long(Series):
    """A series of many large frames, which counts those that are read."""

    def __init__(self) -> None:
        like = ArraySeries(np.zeros((4096, 1, 1, 1), np.float32))
        self.source, self.name, self.units, self.attributes = "long", "v", "", {}
        self.dtype, self.shape = np.dtype(np.float32), (4096, 4, 64, 64)
        self.coords = {
            **ArraySeries(np.zeros((1, 4, 64, 64), np.float32)).coords,
            "t": like.coords["t"],
        }
        self.seen: set[int] = set()

    def read(self, step: int) -> npt.NDArray[np.float32]:
        self.seen.add(step)
        z, y, x = np.ogrid[:4, :64, :64]
        return np.asarray(np.sin(0.1 * (x + y + z) + 0.01 * step), dtype=np.float32)


def test_of_a_long_series_a_part_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fhash_codec.cost.prediction.LOOKED_AT", 1 << 18)
    assert LOOKED_AT < 4096 * 4 * 64 * 64
    series = _Long()
    with thread_pool() as workers:
        prediction = Predictor(series, workers).predict(EncodeConfig(effort=1, psnr=40.0))
    assert series.seen == {step for first in (1022, 3066) for step in range(first, first + 8)}
    assert prediction.bytes is not None
    assert "0% of the steps" in prediction.basis
