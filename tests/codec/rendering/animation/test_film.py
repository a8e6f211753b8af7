"""Animations as pictures of several processes and as films."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fhash_codec import EncodeConfig, Renderer, Volume, encode_dataset
from fhash_codec.rendering import film as film_module
from fhash_codec.rendering.film import Animated, Target, film, rendered_by_workers
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.scenes import (
    Camera,
    Effects,
    Isosurface,
    Scene,
    TransferFunctionSpec,
    scene_in_png,
)
from fhash_codec.rendering.timeline import Animation, Key, mixed
from fhash_codec.rendering.tracking import COLOURS, Tracked, follow, parse_tracked, tracking_scene
from fhash_codec.rendering.transfer_function import TransferFunction
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InputError,
    MissingDependencyError,
    OutputError,
    OutputExistsError,
    RegionError,
)

SMALL = Scene(size=(20, 14))


def animate(
    volume: Volume,
    output: Path,
    words: str = "steps",
    *,
    scene: Scene = SMALL,
    draw: Any = None,
    **how: Any,
) -> Animated:
    """Draw an animation by a function in place of a renderer, if one is given."""
    animation, target = Animation.parse(words, volume), Target(output=output, **how)
    with pytest.MonkeyPatch.context() as patch:
        if draw is not None:
            patch.setattr(film_module, "Renderer", lambda *_, **__: SimpleNamespace(render=draw))
        return film_module.animate(volume, scene, animation, target)


def read_film(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Frames (n, H, W, 3) of an MP4."""
    import imageio_ffmpeg

    words = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-loglevel",
        "error",
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    done = subprocess.run(words, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, size[1], size[0], 3)


def test_a_film_shows_the_pictures_in_order(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    scene = dataclasses.replace(SMALL, size=(41, 27))
    done = animate(volume, tmp_path / "a.mp4", scene=scene, draw=drawing())
    assert [path.name for path in done.paths] == ["a.mp4"]
    frames = read_film(tmp_path / "a.mp4", (42, 28))
    assert len(frames) == 5
    np.testing.assert_allclose(frames[..., 0].mean(axis=(1, 2)), 25.5 * np.arange(5), atol=6)


def test_a_film_of_kept_pictures_is_the_same(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    more = {
        "scene": dataclasses.replace(SMALL, background="transparent"),
        "pictures": tmp_path / "p.png",
    }
    first = animate(volume, tmp_path / "a.mp4", **more, draw=drawing())
    assert [path.name for path in first.paths] == [
        *(f"p.000{number}.png" for number in range(5)),
        "a.mp4",
    ]
    draw = drawing()
    second = animate(volume, tmp_path / "b.mp4", **more, draw=draw)
    assert (second.kept, draw.scenes) == (5, [])
    np.testing.assert_array_equal(
        read_film(tmp_path / "a.mp4", (20, 14)), read_film(tmp_path / "b.mp4", (20, 14))
    )


def test_an_interrupted_film_leaves_nothing(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    def draw(scene: Scene, *, upcoming: Scene | None = None) -> Image:
        if scene.step == 2:
            raise KeyboardInterrupt
        return drawing()(scene)

    for name in ("a.mp4", "a.gif"):
        with pytest.raises(KeyboardInterrupt):
            animate(volume, tmp_path / name, draw=draw)
    assert list(tmp_path.iterdir()) == []


def test_without_the_package_an_mp4_says_what_to_install(
    volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawing: Any
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    draw = drawing()
    with pytest.raises(MissingDependencyError, match=r"fhash\[video\]"):
        animate(volume, tmp_path / "a.mp4", draw=draw)
    assert draw.scenes == []


def test_an_encoder_that_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    frames = iter([np.zeros((256, 256, 3), dtype=np.uint8)] * 50)
    with pytest.raises(OutputError, match="ffmpeg failed") as caught:
        film(tmp_path / "a.mp4", frames, (256, 256), 24.0)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_processes_write_the_files_of_one(volume: Volume, tmp_path: Path) -> None:
    words, there = "steps=0:4:2,orbit=60", tmp_path / "b"
    there.mkdir()
    one = animate(volume, tmp_path / "a.gif", words, pictures=tmp_path / "a.png")
    first = one.paths[0]
    # A picture that is there already is kept.
    (there / first.name).write_bytes(first.read_bytes())
    two = animate(volume, there / "a.gif", words, pictures=there / "a.png", processes=2)
    assert (one.rendered, two.rendered, two.kept) == (3, 2, 1)
    for before, after in zip(one.paths, two.paths, strict=True):
        assert before.name == after.name
        assert before.read_bytes() == after.read_bytes()
    assert not multiprocessing.active_children()
    with pytest.raises(InputError, match="processes is 0"):
        animate(volume, tmp_path / "c.gif", words, processes=0)


def test_a_process_opens_the_same_variable(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((1, 6, 7, 8), dtype=np.float32)
    path, config = tmp_path / "run.fhz", EncodeConfig(effort=1)
    encode_dataset({"a": values, "b": 1 - values}, path, config)
    pictures = {}
    for name in "ab":
        with open_volume(path, variable=name) as one:
            (picture,) = rendered_by_workers(one, [SMALL], 1)
            np.testing.assert_array_equal(picture.rgba, Renderer(one).render(SMALL).rgba)
            pictures[name] = picture.rgba
    assert not np.array_equal(pictures["a"], pictures["b"])


def test_what_a_process_raises_is_raised_here_and_none_is_left(volume: Volume) -> None:
    scenes = [SMALL, replace(SMALL, transfer_function=TransferFunctionSpec(density=0.0))]
    rendered = rendered_by_workers(volume, scenes, 1)
    np.testing.assert_array_equal(next(rendered).rgba, Renderer(volume).render(SMALL).rgba)
    assert len(multiprocessing.active_children()) == 1
    with pytest.raises(InputError, match="shows nothing"):
        next(rendered)
    assert not multiprocessing.active_children()


def test_a_process_that_ends_by_itself_is_an_error(volume: Volume) -> None:
    # More pictures than the pipe holds, so that the process cannot be ready before it is killed.
    rendered = rendered_by_workers(volume, [SMALL] * 300, 1)
    next(rendered)
    for child in multiprocessing.active_children():
        assert child.pid is not None
        os.kill(child.pid, signal.SIGKILL)
    with pytest.raises(FhashError, match="ended by itself"):
        list(rendered)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("spoil", ["cut", "scene", "another volume"])
def test_pictures_that_are_not_right_are_replaced_only_by_force(
    spoil: str, volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    animation, output = Animation.parse("steps", volume), tmp_path / "a.png"
    paths = animate(volume, output, draw=drawing()).paths
    scene = SMALL
    if spoil == "cut":
        paths[2].write_bytes(paths[2].read_bytes()[:-20])
    elif spoil == "scene":
        scene = dataclasses.replace(SMALL, background="red")
    else:
        # The same scene and the same file name, but other values.
        image = dataclasses.replace(
            drawing()(animation.scenes(SMALL, volume)[2]),
            scene=animation.scenes(SMALL, volume)[2].to_dict(),
        )
        dataclasses.replace(image, source=str(volume.path), digest="0" * 64).save(
            paths[2], force=True
        )
    draw = drawing()
    with pytest.raises(OutputExistsError, match=r"a\.000"):
        animate(volume, output, scene=scene, draw=draw)
    assert draw.scenes == []
    done = animate(volume, output, scene=scene, force=True, draw=draw)
    assert done.rendered == (5 if spoil == "scene" else 1)
    assert [scene_in_png(path) for path in paths] == animation.scenes(scene, volume)


def test_pictures_with_buffers_are_kept_only_with_them(
    volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    scene = dataclasses.replace(SMALL, effects=Effects(buffers=("depth",)))

    def draw(each: Scene, *, upcoming: Scene | None = None) -> Image:
        return dataclasses.replace(drawing()(each), depth=np.ones((14, 20), dtype=np.float32))

    given, more = (volume, tmp_path / "a.png", "steps=0:1"), {"scene": scene, "draw": draw}
    animate(*given, **more)
    assert animate(*given, **more).kept == 2
    (tmp_path / "a.0001.depth.npy").unlink()
    assert animate(*given, **more, force=True).kept == 1


def test_longer_animations_of_the_name_are_mentioned(
    volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    animate(volume, tmp_path / "a.png", draw=drawing())
    with pytest.warns(FhashWarning, match=r"a\.0003\.png and 1 more"):
        animate(volume, tmp_path / "a.png", "steps=0:2", draw=drawing())


def test_outputs_of_other_kinds_are_refused(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    draw = drawing()
    for output, pictures in (("a.avi", None), ("a.png", "b.png"), ("a.gif", "b.jpg")):
        with pytest.raises(InputError, match="use such a name"):
            animate(volume, tmp_path / output, pictures=pictures, draw=draw)
    assert draw.scenes == []
    assert list(tmp_path.iterdir()) == []


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


def test_features_get_colours_and_thresholds(volume: Volume) -> None:
    tracked = parse_tracked(["interval:0.2:0.4", "isosurface:0.7=#ff0000", "segmentation"], volume)
    assert [str(item.feature).split(":")[0] for item in tracked] == [
        "interval",
        "isosurface",
        "segmentation",
    ]
    assert [item.colour for item in tracked] == [COLOURS[0], "#ff0000", COLOURS[2]]
    assert 0.1 < tracked[2].feature.threshold < 0.9  # type: ignore[attr-defined]
    assert [str(item.feature) for item in parse_tracked([], volume)] == ["interval:-1:9"]


@pytest.mark.parametrize(
    "text", ["all", "mask:m.npy", "interval:0:1=#12", "blob:3", "interval:3:1"]
)
def test_features_that_values_do_not_tell(text: str, volume: Volume) -> None:
    with pytest.raises(InputError):
        parse_tracked([text], volume)


def test_a_value_of_two_features_has_both_colours_and_the_larger_opacity(volume: Volume) -> None:

    scene = tracking_scene(
        SMALL,
        parse_tracked(
            ["interval:0.2:0.6=#ff0000", "interval:0.4:0.8=#0000ff", "isosurface:0.9=#00ff00"],
            volume,
        ),
        volume,
    )
    assert scene.effects.isosurfaces == (Isosurface(value=0.9, colour="#00ff00"),)
    # The volume is thin: three vertices along z.
    full = 1 - (1 - 0.3) ** (8 / Grid.of(volume.coords).thinnest[1])
    function = TransferFunction.of(scene.transfer_function, value_range=(0.0, 1.0), spacing=1.0)
    np.testing.assert_allclose(
        function.colour([0.3, 0.5, 0.7]), [[1, 0, 0], [0.5, 0, 0.5], [0, 0, 1]], atol=0.01
    )
    np.testing.assert_allclose(
        function.opacity([0.1, 0.3, 0.5, 0.7, 0.85]), [0, full, full, full, 0], atol=1e-9
    )
    assert scene.effects.box
    assert [(entry.text, entry.colour) for entry in scene.effects.legend] == [
        (f"{volume.name}: 0.2 to 0.6", "#ff0000"),
        (f"{volume.name}: 0.4 to 0.8", "#0000ff"),
        (f"{volume.name} = 0.9", "#00ff00"),
    ]


def test_features_without_an_end_are_named_by_the_other(volume: Volume) -> None:
    texts = ["interval:0.3:inf", "interval:-inf:0.2", "segmentation:0.4"]
    scene = tracking_scene(SMALL, parse_tracked(texts, volume), volume)
    name = volume.name
    assert [entry.text for entry in scene.effects.legend] == [
        f"{name} ≥ 0.3",
        f"{name} ≤ 0.2",
        f"{name} ≥ 0.4",
    ]


def test_isosurfaces_alone_leave_the_volume_out(volume: Volume) -> None:
    scene = tracking_scene(SMALL, parse_tracked(["isosurface:0.5"], volume), volume)
    assert scene.transfer_function.nothing
    with pytest.raises(InputError, match="no feature"):
        tracking_scene(SMALL, [], volume)


def test_a_feature_is_followed(volume: Volume) -> None:
    (followed,) = follow(volume, parse_tracked(["segmentation:0.5"], volume), [0.0, 3.0])
    first, last = followed["steps"]
    assert (first["time"], last["time"]) == (0, 4)
    np.testing.assert_allclose(first["centroid"], [8, 4, 1.5], atol=0.3)  # x descends from 10
    np.testing.assert_allclose(last["centroid"], [5, 4, 1.5], atol=0.3)
    assert first["vertices"] > 10
    assert first["bounds"][2] == [1.0, 2.0]
    (nowhere,) = follow(
        volume,
        [Tracked(feature=parse_tracked(["interval:5:6"], volume)[0].feature, colour="red")],
        [0.0],
    )
    assert nowhere["steps"][0] == {
        "step": 0.0,
        "time": 0.0,
        "vertices": 0,
        "centroid": None,
        "bounds": None,
    }
