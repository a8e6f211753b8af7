"""The centre of a series: its plateau, or the mean without one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
from fhash_codec.compact.attempt import Attempt, PlanTask, Tiling
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.head import EFFORTS, Budget, Effort
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.stages import (
    choose_tiles,
    coarser_bases,
    first_guess,
    first_settings,
    mask_levels,
)
from fhash_codec.compact.step import find_step
from fhash_codec.compact.tiles import Coding, Index, Tile
from fhash_codec.compact.transform import Bases, basis_bytes, usual_transform
from fhash_codec.features.features import dilate, parse_feature
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TileSettings


@pytest.mark.parametrize("effort", [1, 2])
def test_a_file_has_the_plateau_as_its_centre(tmp_path, effort: int) -> None:
    t, z, y, x = np.indices((6, 12, 24, 24))
    pulse = 9 * np.exp(-((z - 6) ** 2 + (y - 12) ** 2 + (x - 4 - 3 * t) ** 2) / 6)
    values = (0.777 + np.where(pulse > 0.01, pulse, 0)).astype(np.float32)
    path = tmp_path / "a.fhz"
    fhash_codec.encode(values, path, EncodeConfig(psnr=45.0, effort=effort, timings=False))
    with fhash_codec.open(path) as volume:
        settings = volume.container.arrays["tables/level_1"].settings
    assert settings.center == float(np.float32(0.777))


GOAL = Goal(psnr=40.0, data_range=8.0)


class Patterns:
    """One tile in which each line along x is a sum of a few patterns, with a little noise."""

    shape = tile = (1, 8, 24, 48)
    in_memory = True

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, 0, 0)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        rng = np.random.default_rng(0)
        patterns = rng.normal(size=(12, 48)) * 0.7 ** np.arange(12)[:, None]
        values = rng.normal(size=(1, 8, 24, 12)) @ patterns
        values += rng.normal(0, 0.02, values.shape)
        return Tile(values.clip(-4, 4).astype(np.float32), None)


@pytest.fixture
def workers() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool


def begun(sample: Sample, fineness: float) -> TileSettings:
    """Settings with a basis along x that is so many times finer than the step asks for."""
    usual = usual_transform(Patterns.tile).axes
    settings = TileSettings(
        transform=TransformSpec(axes=(*usual[:3], AxisTransform(kind="haar", depth=1))),
        step=0.3,
        center=0.0,
        low=-4.0,
        high=4.0,
    )
    basis = Bases(sample, replace(settings, step=settings.step / fineness)).along(3)
    spec = TransformSpec(axes=(*usual[:3], basis))
    return find_step(sample, replace(settings, transform=spec), Coding(), GOAL, tries=6)[0]


def test_bases_that_are_too_fine_become_coarser(workers: ThreadPoolExecutor) -> None:
    sample = Sample(Patterns(), 1 << 20, workers)
    settings = begun(sample, 20.0)
    settings, outcome = find_step(sample, settings, Coding(), GOAL, tries=6)
    found = coarser_bases(sample, settings, outcome, Coding(), GOAL)
    assert found is not None
    other, new = found
    saved = basis_bytes(settings.transform) - basis_bytes(other.transform)
    assert saved > 100
    assert new.size + basis_bytes(other.transform) < outcome.size + basis_bytes(settings.transform)
    assert new.psnr(GOAL.data_range) == pytest.approx(40.0, abs=0.2)


Field = Callable[..., npt.NDArray[Any]]


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint8"])
@pytest.mark.parametrize("promise", [{"psnr": 45.0}, {"max_error": 2.0}], ids=str)
@pytest.mark.parametrize(
    "text", ["interval:105:1000", "interval:90:110", "isosurface:100", "segmentation:120"]
)
def test_the_occupancy_is_exact_at_every_step(
    tmp_path: Path, field: Field, dtype: str, promise: dict[str, float], text: str
) -> None:
    source = (field((3, 7, 10, 13)) / 3 + 100).astype(dtype)
    config = EncodeConfig(effort=1, features=(text,), dilation=1, tile="2x4x5x8", **promise)
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    selected = [parse_feature(text).select(frame, step) for step, frame in enumerate(source)]
    requested = np.stack([dilate(frame, 1) for frame in selected])
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["required_features"] == ["transform"]
        assert volume.container.arrays["tables/level_1"].masked
        occupied = np.stack([volume.occupancy(t) for t in range(3)])
        values = volume[...]
        assert volume.verify() == len(volume.info["arrays"])
    np.testing.assert_array_equal(occupied, requested)
    np.testing.assert_array_equal(np.isfinite(values), requested)


def test_scores_of_a_mask_are_learned_from_tiles() -> None:
    values = np.linspace(0, 1, 4000, dtype=np.float32).reshape(1, 10, 20, 20)
    levels = mask_levels([], 1, 0.01, [Tile(values, values > 0.5), Tile(values, None)])
    # Small values count in one tile of two, large ones in both.
    assert levels.scores[0] < levels.scores[-1]
    nothing = Tile(np.full((1, 1, 1, 1), np.nan), None)
    assert mask_levels([], 1, 0.01, [nothing]).edges == ()


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
