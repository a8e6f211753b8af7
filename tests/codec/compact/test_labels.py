"""Labels are planned where nothing else takes fewer bytes, whatever quality is promised."""

from __future__ import annotations

import lzma
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from planned import plan_task

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact import plan as planning
from fhash_codec.compact.attempt import Attempt
from fhash_codec.compact.labels import (
    ends_trials,
    holds_beside,
    is_hopeless,
    look_at_labels,
    rank_share,
)
from fhash_codec.compact.sample import Sample
from fhash_codec.compact.stages import first_settings
from fhash_codec.compact.tiles import Coding


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
        settings = volume.container.arrays["tables/level_1"].settings
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


def test_a_plateau_beside_a_shell_of_many_values_does_not_end_the_trials() -> None:
    """Tiles of a sample may all lie on the plateau; those of the shell are no labels."""
    regions = moving_regions().astype("f4")
    shell = regions.copy()
    shell[:, :, -16:, -16:] = np.random.default_rng(0).normal(0, 1, (6, 12, 16, 16))
    with ThreadPoolExecutor(2) as workers:
        for values, alone in ((regions, True), (shell, False)):
            task = plan_task(values, workers, psnr=45.0)
            tiled = task.blocks.retile((6, 12, 16, 16))
            trial = look_at_labels(task, tiled, first_settings(task, tiled))
            assert trial.alone is alone
            assert ends_trials(trial, 1e9) is alone


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


def test_values_that_a_transform_codes_in_fewer_bytes_are_no_labels(tmp_path) -> None:
    smooth = np.indices((4, 10, 24, 24)).sum(0).astype("f4") ** 2 / 16
    assert "labels" not in encoded(tmp_path, smooth.astype("u1"), psnr=30.0)[1]
    noise = np.random.default_rng(0).integers(0, 200, (2, 4, 20, 20)).astype("u1")
    assert "labels" not in encoded(tmp_path, noise, psnr=30.0, effort=1)[1]
    assert "labels" not in encoded(tmp_path, noise, max_error=20.0)[1]
    many = np.random.default_rng(0).integers(0, 9999, (2, 4, 20, 20)).astype("i2")
    assert "labels" not in encoded(tmp_path, many, effort=1)[1]


def grains(count: int) -> np.ndarray:
    """Columns (3, 4, 40, 60) of `count` numbers in a random order, some of which change."""
    chance = np.random.default_rng(1)
    numbers = chance.permutation(count)[np.arange(600).reshape(20, 30) % count]
    values = np.broadcast_to(numbers.repeat(2, 0).repeat(2, 1), (3, 4, 40, 60)).copy()
    values[1:, :, 10:20, 10:30] = values[1:, :, 11:21, 10:30]
    return values.astype("u2") * 7


@pytest.mark.parametrize("count", [256, 257, 600])
def test_few_and_many_labels_take_few_bytes(tmp_path, count) -> None:
    values = grains(count)
    size, features, decoded = encoded(tmp_path, values)
    assert "labels" in features
    np.testing.assert_array_equal(decoded, values)
    assert 20 * size < values.nbytes


@pytest.mark.parametrize(
    ("other", "entropy", "rank", "hopeless"),
    [
        (125, 200, 1.0, True),  # a first guess much above labels, though these found a structure
        (124, 200, 1.0, False),
        (250, 200, 0.5, True),  # the same after a basis of half of the vectors
        (249, 200, 0.5, False),
        (100, 103, 0.9, True),  # noise, which no way takes for anything else
        (99, 103, 1.0, False),
        (100, 104, 1.0, False),  # labels found a little structure
    ],
)
def test_trials_end_where_they_cannot_gain(
    other: float, entropy: float, rank: float, hopeless: bool
) -> None:
    assert is_hopeless(100, other, entropy, rank) is hopeless


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


@pytest.mark.parametrize("kind", ["i8", "u8", "f4", "f8"])
def test_the_rank_of_extreme_values(kind: str) -> None:
    limits = np.finfo(kind) if kind[0] == "f" else np.iinfo(kind)
    values = np.array([limits.min, limits.max], kind)[pieces([9, 5]) % 2]
    assert rank_share([values]) == 2 / 14
    if kind[0] == "f":
        values[0, 0, 0] = [np.nan, np.inf, -np.inf, *values[0, 0, 0, 3:]]
        assert 0 < rank_share([values]) <= 1


def test_an_axis_that_is_too_long_for_a_basis_does_not_count() -> None:
    lines = np.repeat(np.arange(4, dtype="u1").reshape(1, 1, 4, 1), 700, axis=3)
    assert rank_share([lines[..., :512]]) == 1 / 512
    assert rank_share([lines]) == 1 / 4


def test_pieces_at_fixed_places_are_tried_further(tmp_path, monkeypatch) -> None:
    """Their first guess is three times as long as labels; with their own basis it is shorter."""

    def tried(*_: object) -> None:
        raise LookupError

    monkeypatch.setattr(planning, "_improved", tried)
    with pytest.raises(LookupError):
        encoded(tmp_path, np.tile(pieces([14, 14]), 2))


def test_noise_is_planned_without_further_trials(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(planning, "_improved", lambda *_: pytest.fail("a trial of noise"))
    noise = np.random.default_rng(0).integers(0, 6, (2, 8, 24, 24)).astype("u1")
    size, features, decoded = encoded(tmp_path, noise)
    assert "labels" in features
    np.testing.assert_array_equal(decoded, noise)
    assert size < noise.size * np.log2(6) / 8 + 2000


def test_smooth_values_are_tried_further(tmp_path) -> None:
    t, z, y, x = np.indices((2, 8, 24, 24))
    smooth = np.rint(120 + 100 * np.sin(x / 9 + t / 3) * np.cos(y / 7 + z / 5)).astype("u1")
    size, _, decoded = encoded(tmp_path, smooth)
    np.testing.assert_array_equal(decoded, smooth)
    assert 3 * size < smooth.size


def test_labels_whose_sum_overflows_are_labels_all_the_same(tmp_path) -> None:
    values = (moving_regions() % 5 + 1).astype(np.float32) * np.float32(4e37)
    values[1, 2:5, 3:9, 2:7] = np.nan
    _, used, decoded = encoded(tmp_path, values)
    assert "labels" in used
    np.testing.assert_array_equal(decoded, values)
