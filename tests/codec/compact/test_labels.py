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
from fhash_codec.compact.attempt import Attempt
from fhash_codec.compact.labels import (
    ends_trials,
    holds_beside,
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
