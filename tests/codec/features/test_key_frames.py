"""Key frames: which steps, and where times lie between them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fhash_codec.features.key_frames import (
    KeyTimes,
    select_key_frames,
)
from fhash_codec.progress import silent
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import ArraySeries

UNEVEN = np.array([0.0, 1.0, 1.5, 4.0, 4.25, 9.0, 9.5, 10.0])


def series_of(steps, seed=0, shape=(2, 3, 4)):
    rng = np.random.default_rng(seed)
    return ArraySeries(rng.random((steps, *shape)).cumsum(axis=0))


def pick(spec, series, times=None):
    return select_key_frames(
        spec, series, np.arange(series.shape[0], dtype=float) if times is None else times, silent
    )


def interpolation_error(array, times, keys):
    """Summed squared error of all frames, straight from the definition."""
    flat = array.reshape(len(array), -1)
    sign = -1 if times[-1] < times[0] else 1
    rebuilt = np.stack(
        [
            np.interp(sign * times, sign * times[list(keys)], column[list(keys)])
            for column in flat.T
        ],
        axis=1,
    )
    return ((rebuilt - flat) ** 2).sum()


@pytest.mark.parametrize(
    ("spec", "steps", "expected"),
    [
        ("all", 4, (0, 1, 2, 3)),
        ("every:1", 3, (0, 1, 2)),
        ("every:3", 7, (0, 3, 6)),
        ("every:3", 8, (0, 3, 6, 7)),
        ("every:99", 5, (0, 4)),
        ("every:2", 1, (0,)),
        ("0,4,9", 10, (0, 4, 9)),
        (" 1, 3 ", 5, (1, 3)),
        ("2", 5, (2,)),
        ("auto:1", 1, (0,)),
        ("auto:9", 4, (0, 1, 2, 3)),
        ("auto:2", 6, (0, 5)),
    ],
)
def test_what_a_spec_names(spec, steps, expected) -> None:
    assert pick(spec, series_of(steps)) == expected


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("", "allowed: all, every:K, auto:N or a list such as 0,4,9"),
        ("some", "allowed: all"),
        ("0,,1", "allowed: all"),
        ("-1,2", "allowed: all"),
        ("every:0", "write every:K with K >= 1"),
        ("every", "write every:K"),
        ("every:x", "write every:K"),
        ("auto:0", "write auto:N with N >= 2"),
        ("auto:2.5", "write auto:N"),
        ("auto:1", "at least 2"),
        ("0,5", r"ascend without repeats within 0\.\.4"),
        ("2,1", "ascend without repeats"),
        ("1,1", "ascend without repeats"),
    ],
)
def test_what_a_spec_may_not_be(spec, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        pick(spec, series_of(5))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [2, 3, 4, 6, 7])
@pytest.mark.parametrize(
    "times", [np.arange(8.0), UNEVEN, -UNEVEN, UNEVEN * 1e-300, UNEVEN * 1e300, 1e9 + UNEVEN]
)
def test_auto_is_the_best_of_all_subsets(count, times) -> None:
    series = series_of(8, seed=count)
    chosen = pick(f"auto:{count}", series, times)
    subsets = [(0, *inner, 7) for inner in itertools.combinations(range(1, 7), count - 2)]
    best = min(interpolation_error(series.values, times, subset) for subset in subsets)
    assert len(chosen) == count
    assert interpolation_error(series.values, times, chosen) == pytest.approx(best, rel=1e-9)


def test_auto_needs_times_that_go_one_way() -> None:
    with pytest.raises(InputError, match="step numbers"):
        pick("auto:2", series_of(4), np.array([0.0, 1, 1, 2]))


@pytest.mark.parametrize(
    "times",
    [UNEVEN, -UNEVEN, UNEVEN[::-1].copy(), 1e9 + UNEVEN],
    ids=["up", "down", "back", "late"],
)
@pytest.mark.parametrize("key_frames", [(0, 7), (0, 2, 3, 7), (1, 4, 5), tuple(range(8)), (3,)])
def test_key_index_is_whole_at_key_frames_and_linear_in_time_between(times, key_frames) -> None:
    keys = KeyTimes(times=times, key_frames=key_frames)
    assert [keys.key_index(step) for step in key_frames] == list(range(len(key_frames)))
    steps = np.linspace(0, 7, 141)
    indices = keys.key_indices(steps)
    assert (np.diff(indices) >= 0).all()
    assert (indices[0], indices[-1]) == (0, len(key_frames) - 1)
    for a, b in itertools.pairwise(key_frames):
        for step in np.linspace(a, b, 7):
            time = np.interp(step, range(8), times)
            inside = (time - times[a]) / (times[b] - times[a])
            assert keys.key_index(step) - key_frames.index(a) == pytest.approx(
                inside, abs=1e-6 if times[0] > 1e6 else 1e-12
            )


@pytest.mark.parametrize("times", [UNEVEN, UNEVEN[::-1].copy(), -UNEVEN])
def test_step_of_time_inverts_the_times(times) -> None:
    keys = KeyTimes(times=times, key_frames=(0, 7))
    assert [keys.step_of_time(time) for time in times] == list(range(8))
    assert keys.step_of_time((times[2] + times[3]) / 2) == pytest.approx(2.5)
    np.testing.assert_allclose(keys.steps_of_times(times.reshape(2, 4)), np.arange(8).reshape(2, 4))


def test_what_lies_outside_is_refused() -> None:
    keys = KeyTimes(times=UNEVEN[::-1].copy(), key_frames=(0, 7))
    for time in (-0.1, 10.5, np.nan, np.inf):
        with pytest.raises(RegionError, match=r"outside 0\.\.10"):
            keys.step_of_time(time)
    for step in (-0.5, 7.01, np.nan):
        with pytest.raises(RegionError, match=r"outside 0\.\.7"):
            keys.key_index(step)
    with pytest.raises(InputError, match="step numbers"):
        KeyTimes(times=np.array([0.0, 0.0]), key_frames=(0,))
