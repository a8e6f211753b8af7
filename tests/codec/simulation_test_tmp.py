"""The simulated scenes: laws of physics that they keep, and the same values every time."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.demo.simulate import SCENES, simulate
from fhash_formats.errors import InputError

SMALL = (4, 8, 12, 10)


@pytest.mark.parametrize("name", SCENES)
def test_scene_is_a_finite_float32_series_with_coordinates_in_si_units(name: str) -> None:
    series = simulate(name, SMALL)
    assert series.shape == SMALL
    assert series.dtype == np.float32
    assert all(np.isfinite(frame).all() for frame in series.frames())
    assert [series.coords[axis].attributes["units"] for axis in "tzyx"] == ["s", "m", "m", "m"]
    assert all(np.all(np.diff(series.coords[axis].values) > 0) for axis in "tzyx")
    assert series.name == SCENES[name].name


@pytest.mark.parametrize("name", SCENES)
def test_same_seed_same_values_other_seed_other_values(name: str) -> None:
    first, again, other = (
        simulate(name, SMALL),
        simulate(name, SMALL),
        simulate(name, SMALL, seed=1),
    )
    np.testing.assert_array_equal(first.values, again.values)
    assert not np.array_equal(first.values, other.values)


@pytest.mark.parametrize("name", SCENES)
def test_feature_of_a_scene_selects_a_small_part_of_every_frame(name: str) -> None:
    _, low, high = SCENES[name].feature.split(":")
    for frame in simulate(name, (16, 16, 32, 32)).frames():
        share = ((frame >= float(low)) & (frame <= float(high))).mean()
        assert 0.01 < share < 0.3


def test_vortex_keeps_the_amount_of_tracer_and_mixes_it() -> None:
    series = simulate("vortex", (5, 16, 24, 24))
    amounts = [float(frame.mean(dtype=np.float64)) for frame in series.frames()]
    spreads = [float((frame.astype(np.float64) ** 2).mean()) for frame in series.frames()]
    np.testing.assert_allclose(amounts, amounts[0], rtol=1e-6)
    assert np.all(np.diff(spreads) < 0)


def test_front_moves_outwards() -> None:
    series = simulate("front")
    _, z, y, x = np.meshgrid(
        [0], *(series.coords[axis].values - 0.5 for axis in "zyx"), indexing="ij"
    )
    radius = np.sqrt(z**2 + y**2 + x**2)[0]
    means = [float(radius[frame > 0.4].mean()) for frame in series.frames()]
    assert np.all(np.diff(means) > 0)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [("fire", SMALL, "vortex, front"), ("front", (1, 8, 8, 8), "at least 2 steps")],
)
def test_unsuitable_request_says_what_is_allowed(
    name: str, shape: tuple[int, int, int, int], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        simulate(name, shape)
