"""The features of the cases lie where their names say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import prod
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.selftest import (
    field_cases as features,
)
from fhash_codec.selftest import (
    field_cases as fronts,
)
from fhash_codec.selftest import (
    field_cases as shapes,
)
from fhash_codec.selftest import (
    field_cases as times,
)
from fhash_codec.selftest.case import Case, Check, Run
from fhash_codec.selftest.field_cases import (
    COMPACT,
    EXACT,
    MORE,
    PAPER,
    QUICK,
    SHAPE,
    lattice,
    noise,
    of_all,
    series,
    waves,
)

CASES = {case.name: case for case in features.CASES}


def values_of(case: Case) -> np.ndarray:
    return np.stack(list(case.make().frames()))


def in_feature(name: str) -> np.ndarray:
    """The vertices (t, z, y, x) in the interval of a case."""
    (config, *_) = CASES[name].settings.values()
    (feature,) = config.features
    low, high = map(float, feature.removeprefix("interval:").split(":"))
    values = values_of(CASES[name])
    return (values >= low) & (values <= high)


def test_all_settings_of_a_case_have_its_feature() -> None:
    for case in features.CASES:
        configs = [*case.settings.values(), *case.more.values()]
        assert len({(config.features, config.dilation) for config in configs}) == 1, case.name


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("one-vertex", [1, 1, 1, 1]),
        ("whole-box", [2, 2, 2, 2]),
        ("opposite-corners", [8, 8, 8, 16]),
        ("empty-key-frames", [0, 0, 630, 0]),
        ("one-key-frame-filled", [0, 0, 0, 99]),
        ("nothing-selected", [0, 0, 0, 0]),
        ("everything", [990] * 4),
        ("open-interval", [990] * 4),
    ],
)
def test_a_feature_has_the_stated_number_of_vertices(name: str, counts: list[int]) -> None:
    assert in_feature(name).sum(axis=(1, 2, 3)).tolist() == counts


def test_the_feature_at_every_border_is_the_surface_of_the_domain() -> None:
    inside = np.zeros(SHAPE, dtype=bool)
    inside[:, 1:-1, 1:-1, 1:-1] = True
    np.testing.assert_array_equal(in_feature("at-every-border"), ~inside)


def test_no_two_vertices_of_every_second_vertex_touch() -> None:
    selected = in_feature("every-second-vertex")
    for axis in range(4):
        before = np.moveaxis(selected, axis, 0)
        assert not (before[1:] & before[:-1]).any()


def test_the_feature_beside_missing_values_touches_them() -> None:
    missing = np.isnan(values_of(CASES["beside-missing"]))
    _, _, y, _ = lattice()
    assert (in_feature("beside-missing") & (np.abs(y - 5) == 1)).any()
    assert missing[y == 5].all()


@pytest.mark.parametrize("shape", [SHAPE, (2, 2, 2, 2), (1, 1, 1, 5)])
def test_waves_reach_both_ends_of_their_range(shape: tuple[int, int, int, int]) -> None:
    assert waves(shape).shape == shape
    assert (waves(shape).min(), waves(shape).max()) == (0.0, 1.0)


def test_waves_of_one_value_are_finite() -> None:
    assert waves((1, 1, 1, 1)).tolist() == [[[[0.0]]]]


def test_the_lattice_counts_vertices() -> None:
    for axis, index in enumerate(lattice((2, 3, 4, 5))):
        assert index.shape == (2, 3, 4, 5)
        np.testing.assert_array_equal(np.diff(index, axis=axis), 1.0)


def test_noise_is_the_same_for_a_seed_and_another_for_another() -> None:
    np.testing.assert_array_equal(noise(), noise())
    assert not np.array_equal(noise(), noise(seed=1))


def test_a_series_has_the_given_coordinates() -> None:
    given = series(waves((2, 3, 1, 1)), times=[5.0, 7.0], units="K", z=np.array([1.0, 2.0, 4.0]))
    assert given.units == "K"
    assert given.coords["t"].values.tolist() == [5.0, 7.0]
    assert given.coords["z"].values.tolist() == [1.0, 2.0, 4.0]
    assert given.coords["x"].values.tolist() == [0.0]


CASES_FRONTS = {case.name: case for case in fronts.CASES}


def values_of_fronts(name: str) -> np.ndarray:
    return np.stack(list(CASES_FRONTS[name].make().frames()))


@pytest.mark.parametrize("name", ["checkerboard", "checkerboard-uint8"])
def test_the_checkerboard_alternates_along_every_axis(name: str) -> None:
    values = values_of_fronts(name).astype(int)
    for axis in range(4):
        assert set(np.abs(np.diff(values, axis=axis)).ravel()) == {1}


def test_flicker_changes_the_sign_with_every_step() -> None:
    values = values_of_fronts("flicker")
    assert (values[1:] * values[:-1] < 0).all()


def test_spikes_are_single_vertices() -> None:
    assert np.count_nonzero(values_of_fronts("spike")) == 1
    for axis in range(1, 4):
        nonzero = np.moveaxis(values_of_fronts("spikes") != 0, axis, 0)
        assert nonzero.any()
        assert not (nonzero[1:] & nonzero[:-1]).any()


@pytest.mark.parametrize(
    ("name", "levels"), [("step-on-vertex", {0.0, 0.5, 1.0}), ("step-between", {0.0, 1.0})]
)
def test_a_step_has_its_middle_on_a_vertex_or_between_two(name: str, levels: set[float]) -> None:
    assert set(values_of_fronts(name).ravel().tolist()) == levels


@pytest.mark.parametrize(
    ("name", "share"), [("creeping-front", 1e-3), ("slow-front", 0.15), ("fast-front", 1.0)]
)
def test_a_front_moves_as_fast_as_its_name_says(name: str, share: float) -> None:
    """A share of the vertices, at most, changes its side from one step to the next."""
    ahead = values_of_fronts(name) > 0
    changed = (ahead[1:] != ahead[:-1]).mean()
    assert changed <= share
    if name != "creeping-front":
        assert changed > 0


def test_the_settings_cover_profiles_promises_and_tables() -> None:
    configs = [*QUICK.values(), *MORE.values()]
    assert {config.profile for config in configs} == {"compact", "paper"}
    assert {config.tables for config in configs if config.profile == "paper"} >= {
        "float32",
        "uint8",
        "transform",
    }
    compact = [config for config in configs if config.profile == "compact"]
    assert any(config.psnr is not None for config in compact)
    assert any(config.max_error_rel is not None for config in compact)
    assert any(config.max_error == 0 for config in compact)
    assert not QUICK.keys() & MORE.keys()


def test_a_change_is_made_in_all_settings() -> None:
    changed = of_all({**COMPACT, **EXACT, **PAPER}, dilation=3)
    assert changed.keys() == {*COMPACT, *EXACT, *PAPER}
    assert {config.dilation for config in changed.values()} == {3}
    assert changed["psnr"].psnr == COMPACT["psnr"].psnr


CASES_SHAPES = {case.name: case for case in shapes.CASES}


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("one-voxel", (1, 1, 1, 1)),
        ("one-frame", (1, 9, 10, 11)),
        ("one-along-y", (4, 9, 1, 11)),
        ("twos", (2, 2, 2, 2)),
        ("primes", (5, 7, 11, 13)),
    ],
)
def test_a_case_has_the_shape_of_its_name(name: str, shape: tuple[int, ...]) -> None:
    assert CASES_SHAPES[name].make().shape == shape


def test_long_axes_are_hundreds_of_times_as_long_as_the_others() -> None:
    for axis, name in enumerate(("long-t", "long-z", "long-y", "long-x")):
        lengths = list(CASES_SHAPES[name].make().shape)
        assert lengths.pop(axis) >= 200 * max(lengths)


def test_series_are_small() -> None:
    assert max(prod(case.make().shape) for case in shapes.CASES) <= 10_000


def test_odd_tiles_do_not_divide_the_lengths_but_one() -> None:
    tile = [int(n) for n in CASES_SHAPES["odd-tiles"].settings["tiles"].tile.split("x")]
    lengths = CASES_SHAPES["odd-tiles"].make().shape
    assert [length % n for length, n in zip(lengths, tile, strict=True)] == [1, 1, 0, 4]


@pytest.mark.parametrize(
    ("name", "holds"),
    [
        ("descending-positions", lambda positions: (np.diff(positions) < 0).all()),
        ("tiny-positions", lambda positions: np.ptp(positions) < 1e-10),
        ("huge-positions", lambda positions: np.ptp(positions) > 1e300),
        (
            "far-positions",
            lambda positions: np.ptp(positions) < 1000 * np.spacing(positions[0]),
        ),
        ("uneven-positions", lambda positions: (positions[1:] == 2 * positions[:-1]).all()),
    ],
)
def test_positions_are_as_their_name_says(name: str, holds: object) -> None:
    coords = CASES_SHAPES[name].make().coords
    assert all(holds(coords[axis].values) for axis in "zyx")


CASES_TIMES = {case.name: case for case in times.CASES}


@pytest.mark.parametrize(
    ("name", "holds"),
    [
        ("uneven", lambda times: np.diff(times).max() >= 1e5 * np.diff(times).min() > 0),
        ("tiny", lambda times: (np.diff(times) < 2e-12).all()),
        ("denormal", lambda times: (np.diff(times) == 5e-324).all()),
        ("huge-and-fine", lambda times: (np.nextafter(times[:-1], np.inf) == times[1:]).all()),
        ("descending", lambda times: (np.diff(times) < 0).all()),
        ("negative", lambda times: (times < 0).all()),
        ("both-ends", lambda times: not np.isfinite(times[-1] * 2 - times[0] * 2)),
        ("repeated", lambda times: (np.diff(times) == 0).sum() == 1),
        ("not-a-time", lambda times: (~np.isfinite(times)).sum() == 2),
        ("one-time", lambda times: times.tolist() == [1e5]),
    ],
)
def test_times_are_as_their_name_says(name: str, holds: Callable[[np.ndarray], bool]) -> None:
    with np.errstate(over="ignore"):
        assert holds(CASES_TIMES[name].make().coords["t"].values)


def test_answers_outside_the_series_are_counted(
    compact_run: Run, broken: Callable[[Run, Check], set[str]]
) -> None:
    (outside,) = CASES_TIMES["tiny"].checks
    assert broken(compact_run, outside) == set()
    volume = compact_run.volume
    clamped = SimpleNamespace(
        shape=volume.shape,
        key_times=volume.key_times,
        read=lambda step: volume.read(0),
        step_of_time=volume.step_of_time,
        sample=volume.sample,
    )
    assert broken(replace(compact_run, volume=clamped), outside) == {"outside is refused"}
