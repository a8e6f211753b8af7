"""Animations and their timelines."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec import Volume
from fhash_codec.rendering.scenes import Camera, Effects, Isosurface, Scene, TransferFunctionSpec
from fhash_codec.rendering.timeline import Animation, Key, mixed
from fhash_formats.errors import InputError, RegionError


def test_mixing_keeps_order_and_kinds() -> None:
    one, other = (
        Isosurface(value=1.0, colour="white", opacity=1.0),
        Isosurface(value=3.0, colour="black", opacity=0.0),
    )
    between = mixed((one,), (other,), 0.25)
    assert between == (Isosurface(value=1.5, colour="#bfbfbf", opacity=0.75),)
    assert mixed("viridis", "plasma", 0.5) == "viridis"
    assert mixed(None, one, 0.9) is None
    assert mixed(one, other, 1.0) is other


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


def test_times_may_be_dates(volume: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    dated = dataclasses.replace(volume.coords["t"], attributes={"units": "days since 2001-02-10"})
    monkeypatch.setitem(volume.coords, "t", dated)
    animation = Animation.parse("time=2001-02-11T12:00:2001-02-14:0.5,orbit=90", volume)
    assert (animation.times, animation.every, animation.orbit) == ((1.5, 4.0), 0.5, 90.0)
    assert [scene.time for scene in animation.scenes(SMALL, volume)] == [1.5, 2, 2.5, 3, 3.5, 4]
    with pytest.raises(InputError, match="'time=2001-02-11' is malformed"):
        Animation.parse("time=2001-02-11", volume)
    with pytest.raises(RegionError, match="outside the series"):
        Animation.parse("time=2001-02-11:2002-01-01", volume)
    monkeypatch.setitem(volume.coords, "t", dataclasses.replace(dated, attributes={"units": "s"}))
    with pytest.raises(InputError, match="the times are no dates"):
        Animation.parse("time=2001-02-11:2002-01-01", volume)


def test_a_whole_turn_ends_before_it_begins_again(volume: Volume) -> None:
    animation = dataclasses.replace(Animation.parse("orbit", volume), frames=8)
    scene = dataclasses.replace(SMALL, camera=Camera(azimuth=10), step=2.0)
    scenes = animation.scenes(scene, volume)
    assert [each.camera.azimuth for each in scenes] == [10 + 45 * number for number in range(8)]
    assert {each.step for each in scenes} == {2.0}
    half = dataclasses.replace(Animation.parse("orbit=180", volume), frames=3).scenes(scene, volume)
    assert [each.camera.azimuth for each in half] == [10, 100, 190]


def test_a_file_says_what_the_words_say(volume: Volume, tmp_path: Path) -> None:
    toml = tmp_path / "animation.toml"
    toml.write_text(
        "steps = [0, 4]\norbit = 90\nframes = 3\n"
        '[[keys]]\ncamera = {view = "xy"}\n'
        '[[keys]]\ncamera = {view = "xy", zoom = 4}\n'
    )
    animation = Animation.parse(str(toml), volume)
    scenes = animation.scenes(SMALL, volume)
    assert [scene.camera.azimuth for scene in scenes] == [0, 45, 90]
    np.testing.assert_allclose([scene.camera.zoom for scene in scenes], [1, 2, 4])
    assert Animation.from_dict(animation.to_dict()) == animation
    other = tmp_path / "scene.json"
    other.write_text('{"camera": {"view": "yz"}, "background": "#102030", "size": [999, 9]}')
    keyed = Key(scene=str(other), step=1.0).over(SMALL)
    assert (keyed.camera.view, keyed.background, keyed.size, keyed.step) == (
        "yz",
        "#102030",
        SMALL.size,
        1.0,
    )


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("steps=3", "malformed"),
        ("orbit=left", "malformed"),
        ("steps=0:4:1:1", "malformed"),
        ("steps=0:4:x", "malformed"),
        ("steps=0:4:0", "allowed"),
        ("nowhere.toml", "no such animation"),
    ],
)
def test_words_that_mean_nothing(words: str, part: str, volume: Volume) -> None:
    with pytest.raises(InputError, match=part):
        Animation.parse(words, volume)


@pytest.mark.parametrize(
    ("values", "part"),
    [
        ({"steps": [0, 1], "times": [0, 1]}, "exclude"),
        ({"frame": 3}, "did you mean 'frames'"),
        ({"keys": [{"at": 0.5}, {"at": 0.5}]}, "ascend"),
        ({"keys": [{"at": 0.5}, {}]}, "ascend"),
        ({"keys": [{"camra": {}}]}, "did you mean 'camera'"),
        ({"steps": [0, 1], "keys": [{"step": 1}, {}]}, "not by both"),
        ({"frames": 0}, "allowed"),
        ({"steps": [0, 4], "every": 2, "frames": 3}, "exclude each other"),
        ({"orbit": 90, "every": 2}, "is of steps or times"),
        ({"steps": [0, 4], "every": 0}, "allowed"),
    ],
)
def test_animations_that_are_none(values: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        Animation.from_dict(values)


def test_nothing_changes_and_steps_outside_are_refused(volume: Volume) -> None:
    with pytest.raises(InputError, match="nothing changes"):
        Animation(frames=4).scenes(SMALL, volume)
    for animation in (
        Animation(steps=(0, 5)),
        Animation(times=(-1, 2)),
        Animation(steps=(0, 5), every=4.0),
        Animation(times=(0, 9), every=4.0),
        Animation(keys=(Key(step=9.0), Key())),
    ):
        with pytest.raises(RegionError):
            animation.scenes(SMALL, volume)


@pytest.mark.parametrize(
    ("words", "steps"),
    [
        ("steps=0:4:2", [0, 2, 4]),
        ("steps=0:4:3", [0, 3]),
        ("steps=4:0:2", [4, 2, 0]),
        ("steps=::2", [0, 2, 4]),
        ("steps=1::0.5", [1, 1.5, 2, 2.5, 3, 3.5, 4]),
        ("steps=:3:1", [0, 1, 2, 3]),
        ("steps=0:3:0.1", [number / 10 for number in range(31)]),
        ("steps=2:3:5", [2]),
    ],
)
def test_every_n_th_step(words: str, steps: list[float], volume: Volume) -> None:
    animation = Animation.parse(words, volume)
    assert [scene.step for scene in animation.scenes(SMALL, volume)] == steps
    assert animation.rate == (8.0 if all(float(step).is_integer() for step in steps) else 24.0)
