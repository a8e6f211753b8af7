"""Stages of planning: what each leaves as it is, and what the gains of a file say of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planned import plan_task

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact import stages as planning
from fhash_codec.compact.attempt import Attempt, PlanTask
from fhash_codec.compact.choices.head_prospects import EFFORTS, Budget, Effort
from fhash_codec.compact.stages import (
    choose_step,
    choose_tiles,
    fill_tiles,
    first_guess,
    first_settings,
    try_head,
    try_predictor,
)
from fhash_codec.compact.tiles.access import Tiling
from fhash_formats.transform.tile.settings import TileSettings

Field = Callable[..., npt.NDArray[Any]]


def test_the_stages_follow_each_other_and_leave_out_what_does_not_apply(field: Field) -> None:
    with ThreadPoolExecutor(2) as workers:
        task = plan_task(field((4, 8, 12, 16)), workers, fixed_tile=(4, 8, 6, 8), psnr=45.0)
        tiled = task.blocks.retile((4, 8, 6, 8))
        guess = first_guess(task, tiled, first_settings(task, tiled))
        attempt = choose_tiles(task, guess)
        assert attempt.sample.blocks.tile == (4, 8, 6, 8)
        filled = fill_tiles(task, attempt)
        assert filled.sample is attempt.sample  # all vertices count
        attempt = choose_step(task, filled)
        assert attempt.outcome.psnr(task.goal.data_range) == pytest.approx(45.0, abs=0.3)
        assert attempt.outcome in attempt.tried
        # Effort 2 trains no head, and a PSNR has no predictor.
        assert try_head(task, attempt) is attempt
        assert try_predictor(task, attempt) is attempt
    assert [entry["what"] for entry in task.gains.entries] == ["start", "transform by trial"]
    assert task.gains.entries[1]["bytes"] == attempt.outcome.size + 100


def test_transforms_of_a_large_tile_are_tried_at_a_step_of_its_own(
    field: Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first guess has a step that is much too coarse for the tiles."""
    monkeypatch.setattr(planning, "TRIAL_VERTICES", 1)
    monkeypatch.setattr(planning, "SAMPLE_VERTICES", 1)
    monkeypatch.setattr(planning, "MAX_SEARCHED_VERTICES", 1)
    steps = []
    tried = planning._transform_of_large_tile

    def noted(task: PlanTask, attempt: Attempt) -> TileSettings:
        steps.append(attempt.settings.step)
        return tried(task, attempt)

    monkeypatch.setattr(planning, "_transform_of_large_tile", noted)
    with ThreadPoolExecutor(2) as workers:
        for factor in (1, 100):
            task = plan_task(field((8, 8, 24, 32)), workers, max_error_rel=1e-3)
            tiled = task.blocks.retile((2, 4, 6, 8))
            guess = first_guess(task, tiled, first_settings(task, tiled))
            guess = replace(guess, settings=replace(guess.settings, step=factor * 1e-3))
            monkeypatch.setattr(
                planning, "_tiling", lambda *_: Tiling(tile=(8, 8, 12, 16), price=1.0)
            )
            assert choose_tiles(task, guess).sample.is_single
    assert steps[0] == pytest.approx(steps[1], rel=0.3)


def test_under_a_bound_a_predictor_is_tried(tmp_path: Path, field: Field) -> None:
    figures = fhash_codec.encode(
        field((4, 8, 12, 16)), tmp_path / "a.fhz", EncodeConfig(effort=2, max_error_rel=1e-3)
    )
    whats = [gain["what"] for gain in figures["gains"]]
    noted = [what for what in whats if not what.startswith("coarser bases")]
    assert noted[:2] == ["start", "transform by trial"]
    assert noted[2] in ("prediction", "prediction (left out)")
    assert noted[3:] == ["all tiles"]


def test_more_effort_is_no_larger_and_keeps_the_promise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: Field
) -> None:
    budget = Budget(updates=200, samples=40_000)
    monkeypatch.setitem(EFFORTS, 5, Effort(candidates=4, budget=budget, perceptron=budget))
    source = field((4, 12, 16, 16))
    reports = [
        fhash_codec.encode(source, tmp_path / f"{n}.fhz", EncodeConfig(effort=n, psnr=45.0))
        for n in (1, 3, 5)
    ]
    assert all(figures["psnr"] >= 45 for figures in reports)
    sizes = [figures["bytes"] for figures in reports]
    # The header says more where more was done.
    assert sizes[1] < sizes[0]
    assert sizes[2] < 1.15 * sizes[1]
    assert [gain["what"] for gain in reports[0]["gains"]] == ["all tiles"]
    assert any(gain["what"].startswith("head") for gain in reports[2]["gains"])


def test_a_coreset_of_integers_is_filled_anew_for_all_tiles(tmp_path: Path, field: Field) -> None:
    """Rounded fill values would cost more than those that they were rounded from."""
    source = np.rint(field((3, 6, 10, 12))).astype(np.int16)
    config = EncodeConfig(effort=2, psnr=45.0, features=("interval:0:400",))
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume[...].dtype.kind == "f"  # NaN outside the coreset
        assert volume.verify() == len(volume.info["arrays"])


def _stages(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {entry["stage"]: entry for entry in report["stages"]}


def test_a_stage_that_is_switched_off_is_never_entered(field: Field, tmp_path: Path) -> None:
    values = field((4, 8, 12, 16))
    path = tmp_path / "a.fhz"
    mask = np.zeros(values.shape, bool)
    mask[:, 1:3, 2:4, 3:6] = mask[:, 4:7, 7:10, 8:14] = True

    def encode(without: tuple[str, ...]) -> dict[str, dict[str, Any]]:
        config = EncodeConfig(effort=5, max_error=0.5, without=without)
        return _stages(fhash_codec.encode(values, path, config, mask=mask, force=True))

    every = ("tiles", "transform", "filling", "head", "predictor", "ssim")
    without = encode(every)
    for name in every:
        assert without[name]["times"] == 0
        assert without[name]["seconds"] == 0
        assert without[name]["why"] == f"--without {name}"
    with_all = encode(())
    assert {with_all[name]["times"] for name in ("transform", "filling", "predictor", "ssim")} == {
        1
    }


def test_the_seconds_of_the_stages_are_those_of_the_whole(field: Field, tmp_path: Path) -> None:
    report = fhash_codec.encode(field((4, 8, 12, 16)), tmp_path / "a.fhz", EncodeConfig(effort=2))
    assert sum(entry["seconds"] for entry in report["stages"]) == pytest.approx(
        report["seconds"], rel=0.05, abs=0.02
    )
    stages = _stages(report)
    assert {"scan", "features", "bulk", "first guess", "transform", "step", "coding"} <= set(stages)
    assert stages["head"]["why"] == "effort 2 trains none; from 5 on"
    assert stages["measuring"]["times"] == stages["ssim"]["times"] == 1
