"""Ablations: every variation is measured once, and kept runs are read again."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fhash_bench import ablate
from fhash_bench.ablate import (
    AXES,
    POINTS,
    AblateBench,
    Axis,
    Run,
    axes_named,
    bench_ablate,
    plot,
    points_per_second,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

FEW = (
    Axis(
        name="schedule",
        preset="published",
        varied=({"schedule": "cosine"}, {"schedule": "constant"}),
        why="rates",
        common=(("hidden_layers", 1), ("width", 8)),
    ),
    Axis(name="effort", preset="default", varied=({"effort": 1}, {"effort": 2}), why="trials"),
)


@pytest.fixture
def few_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablate, "AXES", FEW)


@pytest.fixture
def waves(few_axes: None) -> np.ndarray:
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
        preset="published",
        varied=({"key_frames": "0,1"}, {"key_frames": "0,7"}),
        why="steps",
    )
    monkeypatch.setattr(ablate, "AXES", (frames,))
    result = measured(waves)
    assert len(result.runs) == 1
    assert len(result.left_out) == 1
    assert "0,7" in result.left_out[0]


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_the_reference_is_the_default(axis: Axis) -> None:
    common = {"preset": axis.preset, **dict(axis.common)}
    if axis.preset == "published":  # without the default promise, as the bench has it
        common["tables"] = "float16"
    usual = EncodeConfig.from_dict(common)
    reference = EncodeConfig.from_dict({**common, **axis.varied[axis.reference]})
    assert reference.model_fold == usual.model_fold
    assert reference.model_embedding_size == usual.model_embedding_size
    assert reference.model_width == usual.model_width
    for name in set(axis.varied[axis.reference]) - {"fold", "embedding_size", "width"}:
        assert getattr(reference, name) == getattr(usual, name), name


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_all_settings_are_allowed_and_differ(axis: Axis) -> None:
    configs = [
        EncodeConfig.from_dict({"preset": axis.preset, **dict(axis.common), **varied})
        for varied in axis.varied
    ]
    assert len(set(configs)) == len(configs)


def test_axes_are_chosen_by_name_in_their_own_order() -> None:
    assert axes_named([]) == AXES
    assert [axis.name for axis in axes_named(["tile", "batch"])] == ["batch", "tile"]
    with pytest.raises(InputError, match="unknown axis 'bricks'; did you mean 'brick'"):
        axes_named(["bricks"])


def run(axis: str, number: int, curve: bool) -> Run:
    points = tuple({"epoch": n, "seconds": n, "psnr": 10.0 * n} for n in (1, 2)) if curve else ()
    return Run(
        axis=axis,
        settings={"effort": number},
        reference=number == 0,
        seed=0,
        seconds=1.0 + number,
        training_seconds=None,
        epochs=2,
        bytes=1000 + number,
        parameters=10,
        points_per_second=3e6,
        psnr=None if number == 1 else 40.0,
        psnr_domain=None,
        max_abs_error=None,
        curve=points,
    )


def test_every_axis_has_a_panel(tmp_path: Path) -> None:
    widths = []
    for names in (["a"], ["a", "b", "c", "d"]):
        runs = tuple(run(axis, number, axis == "a") for axis in names for number in range(10))
        result = AblateBench(
            series="s", shape=(1, 2, 3, 4), features=("all",), common={}, runs=runs, left_out=()
        )
        plot(result, tmp_path / "p.png")
        with Image.open(tmp_path / "p.png") as image:
            widths.append(image.size)
    assert widths[1][0] > 2 * widths[0][0]
    assert widths[1][1] > widths[0][1]


def blob(steps: int) -> np.ndarray:
    """Values of which only a block of the first step is above 0.5."""
    values = np.zeros((steps, 6, 8, 10), np.float32)
    values[0, 2:5, 3:7, 4:9] = np.linspace(0.6, 1, 60, dtype=np.float32).reshape(3, 4, 5)
    return values


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("preset", ["default", "published"])
def test_points_lie_beside_the_coreset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str, steps: int
) -> None:
    path = tmp_path / "run.fhz"
    config = EncodeConfig(preset=preset, features=("interval:0.5:2",), dilation=0)
    if preset == "published":
        config = replace(config, epochs=1, width=8, tables="float16")
    encode(blob(steps), path, config)
    asked: list[dict[str, Any]] = []
    sample = Volume.sample

    def noted(volume: Volume, **places: Any) -> Any:
        asked.append(places)
        return sample(volume, **places)

    monkeypatch.setattr(Volume, "sample", noted)
    assert points_per_second(path) > 0
    (places, *_), last = asked, (5, 7, 9)
    assert 0 <= places["t"] <= steps - 1
    for axis, (first, end), most in zip("zyx", ((2, 5), (3, 7), (4, 9)), last, strict=True):
        assert len(places[axis]) == POINTS
        assert places[axis].min() >= first
        assert places[axis].max() <= min(end, most)


RUN: dict[str, Any] = {
    "axis": "effort",
    "settings": {"effort": 5},
    "reference": True,
    "seed": 0,
    "seconds": 2.0,
    "training_seconds": None,
    "epochs": 0,
    "bytes": 100,
    "parameters": 7,
    "points_per_second": 3e6,
    "psnr": 40.0,
    "psnr_domain": 41.0,
    "max_abs_error": 0.5,
}


def bench(*changes: dict[str, Any]) -> AblateBench:
    runs = tuple(Run(**{**RUN, **change}) for change in changes)
    return AblateBench(
        series="s", shape=(1, 2, 3, 4), features=("all",), common={}, runs=runs, left_out=()
    )


def test_rows_have_medians_and_the_spread() -> None:
    other = {"settings": {"effort": 1}, "reference": False}
    reference, row = bench(
        {},
        {"seed": 1, "psnr": 42.0},
        {**other, "psnr": 30.0, "bytes": 50, "seconds": 1.0},
        {**other, "psnr": 33.0, "bytes": 70, "seconds": 3.0, "seed": 1},
    ).rows
    assert (reference.psnr, reference.psnr_spread) == (41.0, 2.0)
    assert (row.psnr, row.psnr_gain, row.psnr_spread) == (31.5, -9.5, 3.0)
    assert (row.bytes, row.bytes_ratio, row.seconds_ratio) == (60, 0.6, 1.0)


def test_without_its_reference_a_row_has_no_ratios() -> None:
    (row,) = bench({"reference": False, "psnr": None}).rows
    assert (row.psnr, row.psnr_gain, row.bytes_ratio, row.seconds_ratio) == (None, None, None, None)


def test_records_come_back_from_their_dict() -> None:
    run = Run(**{**RUN, "settings": {"without": ("head",)}}, curve=({"epoch": 1, "psnr": 3.0},))
    assert Run.from_dict(json.loads(json.dumps(asdict(run)))) == run
    with pytest.raises(InputError, match="not a run of bench ablate"):
        Run.from_dict({**asdict(run), "more": 1})
