"""Ablations: every variation is measured once, and kept runs are read again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.ablate import ablate, axes
from fhash_codec.bench.ablate.ablate import bench_ablate
from fhash_codec.bench.ablate.axes import Axis
from fhash_codec.bench.ablate.results import AblateBench
from fhash_formats.errors import InputError

FEW = (
    Axis(
        name="schedule",
        profile="paper",
        varied=({"schedule": "cosine"}, {"schedule": "constant"}),
        why="rates",
        common=(("hidden_layers", 1), ("width", 8)),
    ),
    Axis(name="effort", profile="compact", varied=({"effort": 1}, {"effort": 2}), why="trials"),
)


@pytest.fixture(autouse=True)
def few_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(axes, "AXES", FEW)


@pytest.fixture
def waves() -> np.ndarray:
    t, z, y, x = np.indices((3, 6, 8, 10))
    return np.sin(0.4 * x + 0.2 * t).astype("f4") * np.cos(0.3 * y - 0.1 * z).astype("f4")


def measured(waves: np.ndarray, **arguments: object) -> AblateBench:
    return bench_ablate(waves, {"psnr": 45.0, "max_error": None}, epochs=2, **arguments)  # type: ignore[arg-type]


def test_each_variation_stands_beside_the_reference_of_its_axis(waves: np.ndarray) -> None:
    result = measured(waves)
    assert [(row.axis, row.settings) for row in result.rows] == [
        (axis.name, varied) for axis in FEW for varied in axis.varied
    ]
    cosine, constant, first, second = result.rows
    assert (cosine.psnr_gain, cosine.bytes_ratio, cosine.seconds_ratio) == (0.0, 1.0, 1.0)
    assert constant.psnr is not None
    assert cosine.psnr is not None
    assert constant.psnr_gain == pytest.approx(constant.psnr - cosine.psnr)
    assert second.bytes_ratio == pytest.approx(second.bytes / first.bytes)
    assert first.psnr is not None
    assert first.psnr >= 45
    assert cosine.training_seconds is not None
    assert first.training_seconds is None
    assert [len(run.curve) for run in result.runs] == [2, 2, 0, 0]
    assert json.loads(json.dumps(result.to_dict()))["rows"][0]["axis"] == "schedule"


def test_seeds_give_a_spread(waves: np.ndarray) -> None:
    result = measured(waves, names=["schedule"], seeds=2)
    assert [run.seed for run in result.runs] == [0, 1, 0, 1]
    for row in result.rows:
        psnrs = [run.psnr for run in result.runs if run.settings == row.settings]
        assert row.psnr_spread == pytest.approx(abs(psnrs[0] - psnrs[1]))  # type: ignore[operator]


def test_kept_runs_are_not_made_again(
    waves: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = measured(waves, names=["effort"], folder=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2

    def never(*_: object, **__: object) -> None:
        raise AssertionError("encoded again")

    monkeypatch.setattr(ablate, "encode", never)
    assert measured(waves, names=["effort"], folder=tmp_path).runs == first.runs
    with pytest.raises(AssertionError, match="encoded again"):  # other data are another run
        measured(waves + 1, names=["effort"], folder=tmp_path)


def test_a_damaged_run_is_refused(waves: np.ndarray, tmp_path: Path) -> None:
    measured(waves, names=["effort"], folder=tmp_path)
    next(tmp_path.iterdir()).write_text("{}")
    with pytest.raises(InputError, match="delete it to measure again"):
        measured(waves, names=["effort"], folder=tmp_path)


def test_a_variation_that_cannot_be_encoded_is_told(
    waves: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = Axis(
        name="key-frames",
        profile="paper",
        varied=({"key_frames": "0,1"}, {"key_frames": "0,7"}),
        why="steps",
    )
    monkeypatch.setattr(axes, "AXES", (frames,))
    result = measured(waves)
    assert len(result.runs) == 1
    assert len(result.left_out) == 1
    assert "0,7" in result.left_out[0]
