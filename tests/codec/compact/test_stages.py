"""Stages of planning: each choice pays, stays out where it does not, and keeps the promise."""

from __future__ import annotations

import lzma
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planned import plan_task
from rarely import rarely
from reference.kernels import encode_predicted

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact import encode as encode_module
from fhash_codec.compact.attempt import Attempt
from fhash_codec.compact.goal import (
    DECIDED,
    FAR_BELOW,
    SLOPE,
    Bracket,
    Goal,
    PsnrSearch,
    cheapest,
    decided_by_bulk,
    goal_of,
    held_psnr,
    missed_promise,
    promise,
    remarks,
    search,
    with_step,
)
from fhash_codec.compact.labels import holds_beside, rank_share
from fhash_codec.compact.plan import CodingPlan, first_settings, plan
from fhash_codec.compact.predictor import IntegerTile, fit_weights
from fhash_codec.compact.sample import FEW_TILES, Sample, mask_levels
from fhash_codec.compact.tiles import Blocks, Coding, Outcome, Tile, off_trellis, on_trellis
from fhash_codec.compact.transform import usual_transform
from fhash_codec.features.features import dilate, parse_feature
from fhash_codec.features.selection import select_features
from fhash_codec.measure.errors import MIN_SHARE
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import silent
from fhash_formats.errors import InputError, QualityError
from fhash_formats.series import ArraySeries
from fhash_formats.transform.predict import Predictor, passes_of
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile import OFFSETS, encode_tile, plain_step
from fhash_formats.transform.tile import Coding as Coding_step
from fhash_formats.transform.tile_format import TileSettings

Field = Callable[..., npt.NDArray[Any]]


def plan_of(source: npt.NDArray[Any], config: EncodeConfig) -> tuple[CodingPlan, list[int]]:
    """Return the plan of a series, and the progress on the way."""
    series, done = ArraySeries(source), []
    selection = select_features(series, config, silent)
    value_range = selection.scanned.value_range
    integers = source.dtype.kind in "iu"
    goal = goal_of(config, value_range, source.nbytes, 3000, integers=integers)
    blocks = Blocks(series, selection.extent, series.shape)

    def progress(_what: str, part: int, of: int, _detail: str) -> None:
        assert of == 7
        if not done or part != done[-1]:
            done.append(part)

    with ThreadPoolExecutor(2) as workers:
        features = selection.features
        return plan(blocks, value_range, config, goal, workers, progress, features), done


@pytest.mark.parametrize("factor", [1e200, 1e-200])
def test_values_whose_squares_overflow_are_stored_without_loss(field: Field, factor: float) -> None:
    exact, done = plan_of(field(dtype=np.float64) * factor, EncodeConfig(effort=2))
    assert exact.coding.exact
    assert exact.settings.double
    assert done == []


def counts() -> npt.NDArray[np.int16]:
    """Counted events (6, 8, 24, 24) on a background of 50: smooth means, random numbers."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (6, 8, 24, 24)), indexing="ij")
    means = 4000 * np.exp(-8 * ((x - 0.3 - 0.3 * t) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2))
    return (50 + np.random.default_rng(0).poisson(means)).astype(np.int16)


@pytest.mark.parametrize(("psnr", "exact"), [(90.0, True), (60.0, False)])
def test_integers_are_exact_where_a_psnr_leaves_hardly_any_error(psnr: float, exact: bool) -> None:
    """A transform with a step that is finer than the integers takes more bytes than all of them."""
    found, _ = plan_of(counts(), EncodeConfig(psnr=psnr, effort=2))
    assert found.goal.lossless is exact
    if exact:
        asked, _ = plan_of(counts(), EncodeConfig(max_error=0.0, effort=2))
        assert found.settings == asked.settings
        assert found.size == asked.size


def moving_regions() -> np.ndarray:
    """Regions (6, 12, 48, 48) of sixty labels that move and do not follow an order."""
    z, y, x = np.meshgrid(*(np.arange(n) for n in (12, 48, 48)), indexing="ij")
    chance = np.random.default_rng(0)
    points, speeds = chance.uniform(0, 48, (60, 3)), chance.normal(0, 0.7, (60, 3))
    frames = []
    for t in range(6):
        u, v, w = (points + t * speeds).T[:, :, None, None, None]
        frames.append(np.argmin((x - u) ** 2 + (y - v) ** 2 + (z - w / 4) ** 2, axis=0))
    return (np.stack(frames) * 37 % 101).astype("i2")


def encoded(tmp_path, values: np.ndarray, **changes) -> tuple[int, set[str], np.ndarray]:
    path = tmp_path / "a.fhz"
    promise = {} if "psnr" in changes or "max_error" in changes else {"max_error": 0.0}
    config = EncodeConfig(timings=False, **{"effort": 2, **promise, **changes})
    figures = fhash_codec.encode(values, path, config, force=True)
    with fhash_codec.open(path) as volume:
        settings = volume.container.arrays["table_1"].settings
        used = {name for name in ("labels", "mask") if getattr(settings, name)}
        return figures["bytes"], used, volume[...]


def test_labels_take_fewer_bytes_than_xz(tmp_path) -> None:
    values = moving_regions()
    size, features, decoded = encoded(tmp_path, values)
    assert "labels" in features
    np.testing.assert_array_equal(decoded, values)
    assert size < len(lzma.compress(values.tobytes(), preset=9 | lzma.PRESET_EXTREME))


def test_labels_in_floats_and_with_a_feature(tmp_path) -> None:
    values = moving_regions().astype("f4")
    values[values == values[0, 0, 0, 0]] = np.nan
    _, features, decoded = encoded(tmp_path, values, features=("interval:10:60",), dilation=0)
    assert {"labels", "mask"} <= features
    inside = (values >= 10) & (values <= 60)
    np.testing.assert_array_equal(decoded, np.where(inside, values, np.nan))


@pytest.mark.parametrize("promise", [{"psnr": 45.0}, {"max_error": 1.0}])
@pytest.mark.parametrize("effort", [1, 2])
def test_labels_keep_other_promises_in_fewer_bytes(
    tmp_path, promise: dict[str, float], effort: int
) -> None:
    values = moving_regions()
    size, features, decoded = encoded(tmp_path, values, effort=effort, **promise)
    assert "labels" in features
    np.testing.assert_array_equal(decoded, values)
    exact_size, _, _ = encoded(tmp_path, values, effort=effort)
    assert size < 1.02 * exact_size


def test_labels_under_a_promise_with_tiles_that_have_none(tmp_path) -> None:
    """Tiles of too many different values keep the promise by a transform."""
    values = np.tile(moving_regions(), (1, 1, 2, 2)).astype("f4")
    noise = np.random.default_rng(0).normal(0, 20, (6, 12, 8, 8))
    values[:, :, -8:, -8:] = noise
    size, features, decoded = encoded(tmp_path, values, max_error=2.0, tile="6x12x16x16")
    assert "labels" in features
    assert np.abs(decoded - values).max() <= 2.0
    np.testing.assert_array_equal(decoded[:, :, :48, :48], values[:, :, :48, :48])
    assert size < encoded(tmp_path, values, tile="6x12x16x16")[0]


def test_labels_whose_sum_overflows_are_labels_all_the_same(tmp_path) -> None:
    values = (moving_regions() % 5 + 1).astype(np.float32) * np.float32(4e37)
    values[1, 2:5, 3:9, 2:7] = np.nan
    _, used, decoded = encoded(tmp_path, values)
    assert "labels" in used
    np.testing.assert_array_equal(decoded, values)


def test_labels_on_a_plateau_are_not_believed_of_another_sample() -> None:
    """The first tile is of two values, the one with the highest cost is smooth beside them."""
    values = np.zeros((2, 8, 16, 64), "f4")
    values[..., 5:11] = 1.0
    values[..., 16:] = np.sin(np.tensordot((0.1, 0.11, 0.13, 0.17), np.indices((2, 8, 16, 48)), 1))
    with ThreadPoolExecutor(2) as workers:
        task = plan_task(values, workers, psnr=30.0)
        tiled = task.blocks.retile((2, 8, 16, 16))
        settings, coding = first_settings(task, tiled), Coding(filled=True)

        def attempt(costs: list[float] | None, *, labels: bool) -> Attempt:
            sample = Sample(tiled, 1, workers, costs)
            found = replace(settings, labels=labels)
            outcome = sample.run(found, coding)
            return Attempt(sample=sample, settings=found, outcome=outcome, coding=coding)

        plateau = attempt(None, labels=True)
        smooth = attempt([0.0, 0.0, 1.0, 3.0], labels=False)
        # Its tile is no label: by these settings it takes what a first guess takes, not less.
        smooth = replace(smooth, outcome=replace(smooth.outcome, size=smooth.outcome.size - 1))
        assert plateau.outcome.size < smooth.outcome.size
        assert not holds_beside(task, plateau, smooth)
        assert holds_beside(task, plateau, attempt(None, labels=False))


def pieces(lengths: list[int]) -> np.ndarray:
    """Random numbers (2, 6, 24, x) that are the same along each of some pieces of x."""
    noise = np.random.default_rng(0).integers(0, 12, (2, 6, 24, len(lengths)))
    return np.repeat(noise, lengths, axis=3).astype("u1")


def test_the_rank_is_that_of_the_axis_with_the_fewest_vectors() -> None:
    noise = np.random.default_rng(0).integers(0, 12, (2, 6, 24, 28)).astype("u1")
    assert rank_share([noise]) > 0.7
    assert rank_share([pieces([5, 9, 14])]) == 3 / 28
    assert rank_share([pieces([5, 9, 14]), pieces([9, 5, 14])]) == 4 / 28
    assert rank_share([np.zeros((1, 2, 3, 4), "i4")]) == 1.0


def sharp(dtype: str) -> npt.NDArray[Any]:
    """Return steps at moving planes, with a little noise: transforms ring there."""
    random = np.random.default_rng(0)
    places = np.stack(np.meshgrid(*(np.arange(n) for n in (4, 12, 32, 32)), indexing="ij"), -1)
    normals = random.normal(size=(4, 8)) * np.array([[2.0], [1.0], [1.0], [1.0]])
    steps = (places @ normals > random.uniform(-20, 40, 8)).sum(axis=-1)
    return (1000.0 * steps + random.uniform(0, 20, steps.shape)).astype(dtype)


@pytest.mark.parametrize("dtype", ["float32", "float64", "uint16"])
def test_a_file_by_prediction_keeps_the_bound(tmp_path: Path, dtype: str) -> None:
    values = sharp(dtype)
    path = tmp_path / "a.fhz"
    report = fhash_codec.encode(
        values, path, fhash_codec.EncodeConfig(max_error=30.5, effort=3, timings=True)
    )
    assert "prediction" in [gain["what"] for gain in report["gains"]]
    with fhash_codec.open(path) as volume:
        decoded = volume[...]
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= 30.5


def test_trained_weights_beat_none() -> None:
    y, x = np.meshgrid(np.arange(48), np.arange(48), indexing="ij")
    frame = 3000 * np.sin(x / 7 + y / 11) + 2000 * np.cos(x / 5 - y / 6)
    steps = np.stack([frame * (1 + 0.1 * t) for t in range(4)])
    integers = np.rint(steps).astype(np.int32)[:, None]
    levels, order = (0, 0, 3, 3), (0, 1, 2, 3)
    trained = fit_weights([IntegerTile(integers, None)], levels, order, 1)
    zeros = (0,) * sum(len(refinement.taps) for refinement in passes_of(levels, order, 1))
    sizes = []
    for weights in (trained, zeros):
        predictor = Predictor(
            step=1.0, origin=0.0, levels=levels, order=order, reach=1, weights=weights
        )
        sizes.append(len(encode_predicted(integers, None, predictor)[0]))
    assert sizes[0] < 0.8 * sizes[1]


@pytest.mark.parametrize("effort", [1, 2])
def test_a_file_has_the_plateau_as_its_centre(tmp_path, effort: int) -> None:
    t, z, y, x = np.indices((6, 12, 24, 24))
    pulse = 9 * np.exp(-((z - 6) ** 2 + (y - 12) ** 2 + (x - 4 - 3 * t) ** 2) / 6)
    values = (0.777 + np.where(pulse > 0.01, pulse, 0)).astype(np.float32)
    path = tmp_path / "a.fhz"
    fhash_codec.encode(values, path, EncodeConfig(psnr=45.0, effort=effort, timings=False))
    with fhash_codec.open(path) as volume:
        settings = volume.container.arrays["table_1"].settings
    assert settings.center == float(np.float32(0.777))


@pytest.mark.parametrize("dtype", ["float32", "int16", *rarely("float64", "uint8")])
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
        assert volume.container.arrays["table_1"].masked
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


def test_more_effort_is_no_larger_and_keeps_the_promise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: Field
) -> None:
    source = field((8, 16, 32, 32))
    reports = [
        fhash_codec.encode(
            source, tmp_path / f"{n}.fhz", EncodeConfig(effort=n, psnr=45.0, timings=True)
        )
        for n in (1, 3, 5)
    ]
    assert all(figures["psnr"] >= 45 for figures in reports)
    sizes = [figures["bytes"] for figures in reports]
    # The header says more where more was done.
    assert sizes[1] < 1.02 * sizes[0]
    assert sizes[2] < 1.15 * sizes[1]
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

    every = ("tiles", "transform", "filling", "predictor", "ssim")
    without = encode(every)
    for name in every:
        assert without[name]["times"] == 0
        assert without[name]["seconds"] == 0
        assert without[name]["why"] == f"--without {name}"
    with_all = encode(())
    assert {with_all[name]["times"] for name in ("predictor", "ssim")} == {1}
    assert (without["plan"]["times"], with_all["plan"]["times"]) == (1, 1)


def found_by(points: Sequence[tuple[float, float]], target: float) -> float:
    """The log step that a search finds after pairs of a log step and a PSNR."""
    steps = PsnrSearch(1e-9, 1e9)
    for log_step, psnr in points:
        found = steps.after(math.exp(log_step), psnr, target)
    return math.log(found)


def test_two_points_take_their_own_slope_within_reason() -> None:
    assert found_by([(0.0, 50.0), (1.0, 44.0)], 41.0) == pytest.approx(1.5)
    assert found_by([(0.0, 44.1), (1.0, 44.0)], 42.0) == pytest.approx(1.0 + 2.0 / 2.0)
    assert found_by([(0.0, 90.0), (1.0, 44.0)], 32.0) == pytest.approx(2.0)
    assert found_by([(1.0, 44.0), (1.0, 44.0)], 42.0) == pytest.approx(1.0 + 2.0 / SLOPE)


def test_a_psnr_of_uniform_rounding_is_found_in_a_few_steps() -> None:
    """The PSNR of step^2 / 12 falls by 20 / ln 10 dB for each factor of e."""
    steps, step = PsnrSearch(1e-9, 1e9), 1.0
    for _ in range(3):
        step = steps.after(step, -10 * math.log10(step**2 / 12), 60.0)
    assert -10 * math.log10(step**2 / 12) == pytest.approx(60.0, abs=1e-6)
    assert steps.after(step, -1e9, 60.0) == pytest.approx(1e-9)


def test_a_search_ends_where_nothing_follows_and_gives_the_best() -> None:
    tried: list[int] = []

    def run(number: int) -> int:
        tried.append(number)
        return number

    def following(number: int, before: int) -> int | None:
        return None if number == 5 else number + 2

    assert search(1, following, run, 9) == 5
    assert search(0, following, run, 3) == 6
    assert search(4, following, run, 3, lambda new, best: new < best) == 4
    assert tried == [3, 5, 2, 4, 6, 6, 8, 10]


@pytest.mark.parametrize("target", [1.5, 40.0, 99.0])
def test_bisection_in_a_bracket_converges(target: float) -> None:
    bracket = Bracket(1.0, 100.0)
    for _ in range(60):
        number = bracket.inside(math.inf)
        bracket = bracket.narrowed(number, too_low=number < target)
    assert bracket.low == pytest.approx(target, rel=1e-9)
    assert bracket.high == pytest.approx(target, rel=1e-9)


@pytest.mark.parametrize("start", [0, 3, 9, 12])
@pytest.mark.parametrize("lowest", [0, 5, 7, 12])
def test_the_cheapest_is_found_from_everywhere(start: int, lowest: int) -> None:
    asked: list[int] = []

    def run(numbers: Sequence[int]) -> list[tuple[float, str]]:
        asked.extend(numbers)
        return [(float((number - lowest) ** 2), f"at {number}") for number in numbers]

    assert cheapest(run, start, 12, strides=(2, 1)) == f"at {lowest}"
    assert len(asked) == len(set(asked))
    assert all(0 <= number <= 12 for number in asked)


RANGE = ValueRange(low=0.0, high=100.0)


def test_the_default_promises_a_wide_bulk_too() -> None:
    wide = ValueRange(0.0, 100.0 * MIN_SHARE)
    assert promise(EncodeConfig(), RANGE, wide) == {"psnr": 50.0, "psnr_bulk": 40.0}
    narrow = ValueRange(0.0, 99.9 * MIN_SHARE)
    assert promise(EncodeConfig(), RANGE, narrow) == {"psnr": 50.0}
    assert promise(EncodeConfig(), RANGE, None) == {"psnr": 50.0}
    assert promise(EncodeConfig(psnr_bulk=30.0), RANGE, narrow) == {"psnr_bulk": 30.0}
    # What is promised explicitly is all that is promised.
    for options in ({"psnr": 50.0}, {"max_error": 1.0}, {"ratio": 3.0}):
        assert promise(EncodeConfig(**options), RANGE, wide) == options


def test_a_promised_bulk_that_is_not_there_is_refused_unless_all_is_constant() -> None:
    config = EncodeConfig(psnr_bulk=40.0)
    with pytest.raises(InputError, match="psnr-bulk has nothing to measure"):
        goal_of(config, RANGE, 1000, 0, None)
    assert goal_of(config, ValueRange(1.0, 1.0), 1000, 0, None).data_range == 0


@pytest.mark.parametrize("bulk_rmse", [0.09, 0.11])
@pytest.mark.parametrize("rmse", [0.3, 0.33])
def test_both_promises_are_kept_where_the_psnr_of_an_outcome_is(
    rmse: float, bulk_rmse: float
) -> None:
    """Allowed are 100 / 10^2.5 = 0.316 of all values and 10 / 10^2 = 0.1 of the bulk."""
    goal = goal_of(EncodeConfig(), RANGE, 1000, 0, ValueRange(20.0, 30.0))
    assert goal.bulk is not None
    outcome = Outcome(
        size=1,
        squares=100 * rmse**2,
        count=100,
        max_error=1.0,
        bulk_squares=50 * bulk_rmse**2 * goal.bulk.weight,
        bulk_count=50,
    )
    assert goal.psnr == 50.0
    assert (outcome.psnr(100.0) >= 50.0) == (rmse < 0.316 and bulk_rmse < 0.1)
    assert goal.expected_error == pytest.approx(0.1)


def figures(**others):
    """Figures of a file; by default its promise is kept."""
    psnr_bulk = others.pop("psnr_bulk", 42.0)
    bulk = None if psnr_bulk is None else {"psnr": psnr_bulk, "rmse": 0.1, "range": [1.0, 2.0]}
    usual = {"psnr": 50.0, "rmse": 0.1, "max_abs_error": 0.5, "ratio": 30.0, "data_range": 10.0}
    return {**usual, "promised": {}, "quality": {"bulk": bulk}, "psnr_bulk": psnr_bulk, **others}


def test_a_promise_of_a_network_holds_with_the_rounding_of_other_readers() -> None:
    settings, promised = EncodeConfig(psnr=50.0, psnr_bulk=42.0), {"psnr": 50.0, "psnr_bulk": 42.0}

    def told(psnr: float, psnr_bulk: float, rounding: float) -> str | None:
        found = figures(promised=promised, psnr=psnr, psnr_bulk=psnr_bulk)
        return missed_promise(settings, found, rounding)

    assert told(50.1, 42.4, 3e-5) is None
    assert "49.99 dB over the coreset in every reader" in (told(50.1, 42.4, 4e-5) or "")
    # the bulk has a tenth of the range
    assert "41.98 dB over the bulk in every reader" in (told(60.0, 42.2, 2e-5) or "")
    assert held_psnr(None, 0.0) == np.inf


@pytest.mark.parametrize(
    ("config", "kept", "missed", "text"),
    [
        ({"max_error": 0.5}, {}, {"max_abs_error": 0.51}, "a largest error of 0.51"),
        ({"max_error_rel": 0.05}, {}, {"max_abs_error": 0.51}, "a largest error of 0.51"),
        ({"psnr": 50.0}, {}, {"psnr": 49.99}, "49.99 dB over the coreset, 50 dB were asked for"),
        ({"psnr": 50.0}, {"psnr": None, "rmse": 0.0}, {"psnr": None}, "an unknown PSNR"),
        ({"psnr_bulk": 42.0}, {}, {"psnr_bulk": 41.99}, "41.99 dB over the bulk"),
        (
            {"psnr_bulk": 42.0},
            {"psnr_bulk": None, "rmse": 0.0},
            {"psnr_bulk": None},
            "all the same",
        ),
        ({"ratio": 30.0}, {}, {"ratio": 29.99}, "29.99 times smaller than the data"),
    ],
    ids=str,
)
def test_a_promise_is_missed_on_one_side_of_its_number(config, kept, missed, text) -> None:
    promised, settings = dict(config), EncodeConfig(**config)
    assert missed_promise(settings, figures(promised=promised, **kept)) is None
    assert text in (missed_promise(settings, figures(promised=promised, **missed)) or "")


@pytest.mark.parametrize(
    ("config", "psnr", "psnr_bulk", "remarked"),
    [
        ({"psnr": 50.0}, 50.0, 50.0 - FAR_BELOW, False),
        ({"psnr": 50.0}, 50.0, 49.9 - FAR_BELOW, True),
        ({"psnr": 80.0}, 80.0, 40.0, False),
        ({"psnr": 80.0}, 80.0, 39.9, True),
        ({"max_error": 1.0}, 50.0, 20.0, True),
        ({"psnr": 50.0, "psnr_bulk": 20.0}, 50.0, 20.0, False),
        ({}, 50.0, 20.0, True),
        ({}, 50.0, None, False),
        ({"psnr": 50.0}, None, 20.0, False),
    ],
)
def test_a_bulk_far_below_the_whole_is_remarked(config, psnr, psnr_bulk, remarked) -> None:
    lines = list(remarks(EncodeConfig(**config), figures(psnr=psnr, psnr_bulk=psnr_bulk)))
    assert bool(lines) == remarked
    assert all("--psnr-bulk 40" in line and "from 1 to 2" in line for line in lines)


def test_the_remark_names_the_promise_that_the_option_stands_beside_or_replaces() -> None:
    def line(config):
        return "".join(remarks(EncodeConfig(**config), figures(psnr_bulk=10.0)))

    assert line({"psnr": 50.0}).endswith("--psnr-bulk 40 beside --psnr keeps them")
    assert line({"max_error_rel": 0.1}).endswith(
        "--psnr-bulk 40 instead of --max-error-rel keeps them"
    )
    assert line({}).endswith("whole; --psnr-bulk 40 keeps them")


@pytest.mark.parametrize(("ratio", "count"), [(31.5, 0), (31.6, 1)])
@pytest.mark.parametrize(("rmse", "why"), [(0.0, "exact already"), (0.1, "no step")])
def test_a_file_much_smaller_than_asked_for_is_remarked(ratio, count, rmse, why) -> None:
    lines = list(remarks(EncodeConfig(ratio=30.0), figures(ratio=ratio, rmse=rmse)))
    assert len(lines) == count
    assert all(why in line and "30 times were asked for" in line for line in lines)


@pytest.mark.parametrize(
    ("config", "psnr", "psnr_bulk", "decided"),
    [
        ({}, 54.5, 40.0, True),
        ({}, 50.1, 40.0, False),
        ({}, 54.5, 40.1 + DECIDED, False),
        ({"psnr": 45.0, "psnr_bulk": 41.0}, 49.5, 41.0, True),
        ({"psnr": 45.0}, 49.5, 40.0, False),
        ({"psnr_bulk": 41.0}, 49.5, 41.0, False),
        ({"max_error": 1.0}, 54.5, 40.0, False),
        ({}, 54.5, None, False),
    ],
)
def test_a_bulk_that_decided_says_what_it_took(config, psnr, psnr_bulk, decided) -> None:
    line = decided_by_bulk(EncodeConfig(**config), figures(psnr=psnr, psnr_bulk=psnr_bulk))
    assert (line is not None) == decided
    if line is not None:
        asked = config.get("psnr", 50)
        assert f"--psnr {asked:g} alone leaves it out" in line
        assert "about 50 % of the file" in line.replace("50%", "50 %")
        assert "from 1 to 2" in line


def outcome(size: int, psnr: float) -> Outcome:
    return Outcome(size=size, squares=10 ** (-psnr / 10) * 100, count=100, max_error=1.0)


NONE = AxisTransform(kind="none")
SETTINGS = TileSettings(
    transform=TransformSpec(axes=(NONE,) * 4),
    step=0.1,
    center=0.0,
    low=0.0,
    high=1.0,
    offsets=OFFSETS,
)


def test_the_way_to_the_trellis_and_back() -> None:
    settings, coding = on_trellis(SETTINGS, Coding())
    assert settings.trellis
    assert settings.step < SETTINGS.step
    assert plain_step(settings) == pytest.approx(plain_step(SETTINGS))
    back, plain = off_trellis(settings, coding)
    assert replace(back, step=0.1) == SETTINGS
    assert plain == Coding()


SHAPE = (2, 16, 32, 32)


@pytest.mark.parametrize(("rounding", "exact"), [(2.0**-24, False), (0.0, True)])
def test_rounding_to_the_type_of_the_source_stores_no_tile_exactly(
    rounding: float, exact: bool
) -> None:
    """A float32 near 1000 is 3e-5 off at most: a residual must leave room for that."""
    source = (1000 + np.random.default_rng(0).normal(size=SHAPE).cumsum(axis=3)).astype(np.float32)
    low, high, error = float(source.min()), float(source.max()), 0.002
    begun = TileSettings(
        transform=usual_transform(SHAPE), step=1.0, center=1000.0, low=low, high=high
    )
    coded = encode_tile(
        source,
        with_step(begun, 4 * error, Goal(error=error, data_range=high - low), rounding),
        Coding_step(error=error),
    )
    assert np.abs(coded.decoded.astype(np.float64) - source).max() <= error
    assert np.array_equal(coded.decoded, source) == exact


@pytest.mark.parametrize(("step", "double"), [(1e-3, False), (1e-7, True), (0.0, True)])
def test_a_fine_step_is_computed_in_float64_and_never_too_fine(step: float, double: bool) -> None:
    settings = TileSettings(
        transform=usual_transform(SHAPE), step=1.0, center=0.0, low=-1.0, high=1.0
    )
    chosen = with_step(settings, step, Goal(psnr=50.0, data_range=2.0))
    assert chosen.double == double
    assert chosen.quantum == 0.0
    assert chosen.step >= step
    assert 2.0 / chosen.step < 2.0**30


def test_tiny_tiles_are_coded_few_times_where_their_bytes_cannot_be_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """600 tiles of 6 values: 30 trials on all of them took minutes for a file of 200 kB."""
    values = (1e18 * (2 + np.sin(np.arange(450 * 6) * 0.01))).astype(np.uint64).reshape(450, 2, 3)
    passes, samples = [], []
    code_all, run = encode_module._code_all, Sample.run

    def counted(*arguments: Any, **options: Any) -> Any:
        passes.append(1)
        return code_all(*arguments, **options)

    def sampled(sample: Sample, *arguments: Any, **options: Any) -> Any:
        samples.append(len(sample.tiles))
        return run(sample, *arguments, **options)

    monkeypatch.setattr(encode_module, "_code_all", counted)
    monkeypatch.setattr(Sample, "run", sampled)
    config = EncodeConfig(ratio=8, effort=2, tile="33x3x1x2")
    with pytest.raises(QualityError, match="8 were asked for"):
        fhash_codec.encode(values, tmp_path / "a.fhz", config)
    assert len(passes) <= 4
    assert max(samples) <= FEW_TILES < 600


def test_a_promise_below_any_step_needs_no_mlp(tmp_path: Path) -> None:
    """A step that cannot grow left a division by zero."""
    values = np.array([[[[-128, 127]]]], np.int8)
    report = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(psnr=0.0))
    assert report["bytes"] == (tmp_path / "a.fhz").stat().st_size
