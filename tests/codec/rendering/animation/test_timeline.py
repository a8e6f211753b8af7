"""Scenes between the keys of an animation."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import Volume
from fhash_codec.rendering.animation.animation import Animation, Key
from fhash_codec.rendering.animation.timeline import Timeline
from fhash_codec.rendering.scene.scene import (
    Effects,
    Scene,
    TransferFunctionSpec,
)
from fhash_formats.errors import RegionError

SMALL = Scene(size=(20, 14))


def test_keys_are_met_and_their_settings_mixed(volume: Volume) -> None:
    keys = (
        Key(
            at=0.0,
            background="#000000",
            step=0.0,
            transfer_function=TransferFunctionSpec(opacity=((0.0, 0.0), (1.0, 0.2))),
        ),
        Key(
            at=0.5,
            background="#804020",
            step=4.0,
            transfer_function=TransferFunctionSpec(opacity=((0.5, 0.4), (3.0, 0.6))),
        ),
        Key(at=1.0, background="#804020", step=4.0, effects=Effects(shadows=True)),  # type: ignore[arg-type]
    )
    scenes = Animation(frames=9, keys=keys).scenes(SMALL, volume)
    assert [scene.step for scene in scenes[:5]] == [0, 1, 2, 3, 4]
    assert scenes[2].background == "#402010"
    np.testing.assert_allclose(scenes[2].transfer_function.opacity, [[0.25, 0.2], [2.0, 0.4]])
    assert [scene.effects.shadows is None for scene in scenes] == [True] * 8 + [False]
    assert scenes[4].transfer_function == keys[1].transfer_function


def test_a_timeline_passes_its_keys_and_rests_beyond_them(volume: Volume) -> None:
    keys = [(0.25, Scene(step=1.0, size=(20, 14))), (0.75, Scene(step=3.0, size=(20, 14)))]
    timeline = Timeline(keys, volume, scale=None)
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    assert [timeline.scene(share).step for share in shares] == [1, 1, 2, 3, 3]


def test_given_times_replace_those_of_the_keys(volume: Volume) -> None:
    keys = [(0.0, Scene(step=1.0)), (1.0, Scene(step=3.0))]
    assert Timeline(keys, volume, scale=None, steps=(4, 0)).scene(0.5).step == 2
    by_time = Timeline(keys, volume, scale=None, times=(0, 8)).scene(0.25)
    assert (by_time.step, by_time.time) == (None, 2)


def test_a_still_scene_keeps_its_time_and_turns(volume: Volume) -> None:
    timeline = Timeline([(0.0, Scene(time=4.0))], volume, scale=None, orbit=90.0)
    scene = timeline.scene(0.5)
    assert (scene.step, scene.time, scene.camera.azimuth) == (None, 4.0, 45.0)


def test_keys_outside_the_series_are_refused_even_where_other_times_are_given(
    volume: Volume,
) -> None:
    with pytest.raises(RegionError):
        Timeline([(0.0, Scene(step=9.0))], volume, scale=None, steps=(0, 1))
