"""The centre of a series: its plateau, or the mean without one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
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
    PLATEAU,
    choose_filling,
    choose_step,
    choose_tiles,
    coarser_bases,
    fill_tiles,
    first_guess,
    first_settings,
    mask_levels,
    mean_center,
    plateau_center,
    try_head,
    try_predictor,
)
from fhash_codec.compact.step import find_step
from fhash_codec.compact.tiles import Coding, Index, Tile
from fhash_codec.compact.transform import Bases, basis_bytes, refit, usual_transform
from fhash_codec.features.features import dilate, parse_feature
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.transform.encoding import OFFSETS
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TileSettings

RANGE = ValueRange(low=0.0, high=8.0)


def sample_of(*tiles: tuple[Any, Any, int]) -> Any:
    """A sample of tiles: values, which count, and the number of tiles that each stands for."""
    return SimpleNamespace(
        tiles=[Tile(np.asarray(values, np.float32), counted) for values, counted, _ in tiles],
        weights=[weight for _, _, weight in tiles],
    )


def with_plateau(share: float) -> np.ndarray:
    """Values that are spread over the range, but a share of them, which is 1.5."""
    values = np.linspace(0, 8, 10_000, dtype=np.float32)
    values[: round(share * values.size)] = 1.5
    return values.reshape(1, 1, 100, 100)


def test_a_plateau_is_the_centre_from_its_share_on() -> None:
    assert plateau_center(sample_of((with_plateau(PLATEAU + 0.01), None, 1)), RANGE) == 1.5
    assert plateau_center(sample_of((with_plateau(PLATEAU - 0.01), None, 1)), RANGE) is None


def test_tiles_count_by_what_they_stand_for_and_by_their_vertices() -> None:
    none, half = with_plateau(0.0), with_plateau(0.5)
    assert plateau_center(sample_of((none, None, 99), (half, None, 1)), RANGE) is None
    assert plateau_center(sample_of((none, None, 1), (half, None, 1)), RANGE) == 1.5
    assert plateau_center(sample_of((half, half != 1.5, 1)), RANGE) is None
    assert mean_center(sample_of((half, half == 1.5, 1)), RANGE) == 1.5


@pytest.mark.filterwarnings("ignore:Mean of empty slice:RuntimeWarning")
def test_missing_values_and_constants_have_no_plateau() -> None:
    missing = np.full((1, 1, 2, 2), np.nan)
    assert plateau_center(sample_of((missing, None, 1)), RANGE) is None
    assert mean_center(sample_of((missing, None, 1)), RANGE) == 4.0
    same = ValueRange(low=3.0, high=3.0)
    assert plateau_center(sample_of((np.full((1, 1, 2, 2), 3.0), None, 1)), same) is None
    with_gap = with_plateau(0.5)
    with_gap[..., -1] = np.nan
    assert plateau_center(sample_of((with_gap, None, 1)), RANGE) == 1.5


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


def test_bases_that_do_not_pay_are_left_alone(workers: ThreadPoolExecutor) -> None:
    sample = Sample(Patterns(), 1 << 20, workers)
    settings = begun(sample, 1.0)
    coarse = refit(sample, settings, 40.0)
    coarse, outcome = find_step(sample, coarse, Coding(), GOAL, tries=6)
    found = coarser_bases(sample, coarse, outcome, Coding(), GOAL)
    if found is None:
        return
    chosen, new = found
    total = new.size + basis_bytes(chosen.transform)
    # They are coarser already than any that is tried. Finer ones of more bytes come out only where
    # with these no step keeps the promise.
    missed = outcome.psnr(GOAL.data_range) < 39.8
    assert missed or total <= 1.02 * (outcome.size + basis_bytes(coarse.transform))
    assert new.psnr(GOAL.data_range) >= min(outcome.psnr(GOAL.data_range), 39.8)


def test_without_bases_nothing_is_tried(workers: ThreadPoolExecutor) -> None:
    sample = Sample(Patterns(), 1 << 20, workers)
    settings = TileSettings(
        transform=usual_transform(Patterns.tile), step=0.3, center=0.0, low=-4.0, high=4.0
    )
    settings, outcome = find_step(sample, settings, Coding(), GOAL, tries=3)
    assert coarser_bases(sample, settings, outcome, Coding(), GOAL) is None


def test_a_file_with_coarser_bases_keeps_its_promise(tmp_path: Path) -> None:
    values = Patterns().read((0, 0, 0, 0)).values
    report = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(psnr=40.0, effort=2))
    assert report["psnr"] >= 40.0
    whats = [gain["what"] for gain in report["gains"]]
    assert {"coarser bases", "coarser bases (left out)"} & {*whats} or "klt" not in str(
        fhash_codec.open(tmp_path / "a.fhz").container.arrays["tables/level_1"].settings
    )


SHAPE = (3, 12, 16, 20)
SETTINGS = TileSettings(
    transform=usual_transform(SHAPE), step=0.05, center=0.5, low=0.0, high=1.0, offsets=OFFSETS
)


class Grid:
    """Two tiles of noise in which a smooth half along z counts."""

    complete, in_memory, shape, tile = False, True, (3, 12, 32, 20), SHAPE
    dtype = np.dtype(np.float32)

    def indices(self) -> Iterator[Index]:
        return iter([(0, 0, number, 0) for number in range(2)])

    def weight(self, index: Index) -> int:
        return 1

    def read(self, index: Index) -> Tile:
        t, z, y, x = np.indices(SHAPE)
        noise = np.random.default_rng(index[2]).normal(size=SHAPE)
        smooth = 0.5 + 0.3 * np.sin(0.3 * x + 0.2 * t) * np.cos(0.2 * y)
        values = (smooth + 0.15 * noise * (z > 6)).clip(0, 1).astype(np.float32)
        return Tile(values, z <= 6)


def test_a_filling_takes_fewer_bytes_than_noise() -> None:
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(Grid(), 10**7, workers)
        coding = Coding(filled=True, weight=0.09)
        plain = sample.run(SETTINGS, coding)
        filled = sample.filled(SETTINGS, 2).run(SETTINGS, coding)
        assert filled.size < 0.8 * plain.size
        assert filled.count == plain.count


def test_the_chosen_filling_is_no_larger_than_the_existing_values() -> None:
    with ThreadPoolExecutor(2) as workers:
        sample = Sample(Grid(), 10**7, workers)
        goal, coding = Goal(psnr=35.0, data_range=1.0), Coding(filled=True)
        chosen = choose_filling(sample, SETTINGS, coding, goal, 4)
        settings = replace(SETTINGS, step=0.06)
        assert chosen.run(settings, coding).size <= sample.run(settings, coding).size


Field = Callable[..., npt.NDArray[Any]]


def decoded(path: Path) -> npt.NDArray[Any]:
    with fhash_codec.open(path) as volume:
        return volume[...]


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


@pytest.mark.parametrize(
    "options",
    [{}, {"dilation": 0}, {"features": ("interval:150:400", "isosurface:0")}],
    ids=str,
)
def test_features_that_do_not_follow_from_values_are_exact_as_well(
    tmp_path: Path, field: Field, options: dict[str, Any]
) -> None:
    source = field()
    mask = np.random.default_rng(5).random(source.shape) < 0.02
    config = EncodeConfig(effort=1, **options)
    fhash_codec.encode(source, tmp_path / "a.fhz", config, mask=mask)
    selected = mask.copy()
    for text in options.get("features", ()):
        selected |= np.stack(
            [parse_feature(text).select(frame, step) for step, frame in enumerate(source)]
        )
    requested = np.stack([dilate(frame, config.dilation) for frame in selected])
    np.testing.assert_array_equal(np.isfinite(decoded(tmp_path / "a.fhz")), requested)


def test_huge_values_have_an_exact_occupancy_too(tmp_path: Path, field: Field) -> None:
    source = field(dtype=np.float64) * 1e200
    config = EncodeConfig(effort=1, features=("interval:1e202:1e300",), dilation=0)
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isfinite(back), source >= 1e202)
    np.testing.assert_array_equal(back[source >= 1e202], source[source >= 1e202])


def test_scores_of_an_interval_rise_inside_it() -> None:
    levels = mask_levels([parse_feature("interval:0:10")], 1, 0.5, [])
    edges, scores = np.array(levels.edges), np.array(levels.scores)
    assert len(scores) == len(edges) + 1
    inside = scores[np.searchsorted(edges, 5.0, side="right")]
    at_border = scores[np.searchsorted(edges, 0.01, side="right")]
    outside = scores[np.searchsorted(edges, -5.0, side="right")]
    assert outside < at_border < inside


def test_scores_of_a_mask_are_learned_from_tiles() -> None:
    values = np.linspace(0, 1, 4000, dtype=np.float32).reshape(1, 10, 20, 20)
    levels = mask_levels([], 1, 0.01, [Tile(values, values > 0.5), Tile(values, None)])
    # Small values count in one tile of two, large ones in both.
    assert levels.scores[0] < levels.scores[-1]
    nothing = Tile(np.full((1, 1, 1, 1), np.nan), None)
    assert mask_levels([], 1, 0.01, [nothing]).edges == ()


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
