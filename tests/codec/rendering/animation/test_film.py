"""Animations as pictures of several processes and as films."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec import EncodeConfig, Renderer, Volume, encode_dataset
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering import film as film_module
from fhash_codec.rendering.film import Animated, Target, film, rendered_by_workers
from fhash_codec.rendering.image import Draw, Image
from fhash_codec.rendering.scenes import Effects, Scene, TransferFunctionSpec, scene_in_png
from fhash_codec.rendering.timeline import Animation
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InputError,
    MissingDependencyError,
    OutputError,
    OutputExistsError,
)

SMALL = Scene(size=(20, 14))


def animate(
    volume: Volume,
    scene: Scene,
    animation: Animation,
    output: Path,
    *,
    progress: Progress = silent,
    draw: Draw | None = None,
    **how: Any,
) -> Animated:
    target = Target(output=output, **how)
    return film_module.animate(volume, scene, animation, target, progress=progress, draw=draw)


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
    done = animate(
        volume, scene, Animation.parse("steps", volume), tmp_path / "a.mp4", draw=drawing()
    )
    assert [path.name for path in done.paths] == ["a.mp4"]
    frames = read_film(tmp_path / "a.mp4", (42, 28))
    assert len(frames) == 5
    np.testing.assert_allclose(frames[..., 0].mean(axis=(1, 2)), 25.5 * np.arange(5), atol=6)


def test_a_film_of_kept_pictures_is_the_same(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    animation = Animation.parse("steps", volume)
    scene = dataclasses.replace(SMALL, background="transparent")
    first = animate(
        volume, scene, animation, tmp_path / "a.mp4", pictures=tmp_path / "p.png", draw=drawing()
    )
    assert [path.name for path in first.paths] == [
        *(f"p.000{number}.png" for number in range(5)),
        "a.mp4",
    ]
    draw = drawing()
    second = animate(
        volume, scene, animation, tmp_path / "b.mp4", pictures=tmp_path / "p.png", draw=draw
    )
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
            animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / name, draw=draw)
    assert list(tmp_path.iterdir()) == []


def test_without_the_package_an_mp4_says_what_to_install(
    volume: Volume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drawing: Any
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    draw = drawing()
    with pytest.raises(MissingDependencyError, match=r"fhash\[video\]"):
        animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.mp4", draw=draw)
    assert draw.scenes == []


def test_an_encoder_that_fails_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    frames = iter([np.zeros((256, 256, 3), dtype=np.uint8)] * 50)
    with pytest.raises(OutputError, match="ffmpeg failed") as caught:
        film(tmp_path / "a.mp4", frames, (256, 256), 24.0)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_processes_write_the_files_of_one(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    animation = Animation.parse("steps=0:4:2,orbit=60", volume)
    (tmp_path / "b").mkdir()
    one = animate(volume, SMALL, animation, tmp_path / "a.gif", pictures=tmp_path / "a.png")
    first = one.paths[0]
    # A picture that is there already is kept.
    (tmp_path / "b" / first.name).write_bytes(first.read_bytes())
    two = animate(
        volume,
        SMALL,
        animation,
        tmp_path / "b" / "a.gif",
        pictures=tmp_path / "b" / "a.png",
        processes=2,
    )
    assert (one.rendered, two.rendered, two.kept) == (3, 2, 1)
    for before, after in zip(one.paths, two.paths, strict=True):
        assert before.name == after.name
        assert before.read_bytes() == after.read_bytes()
    assert not multiprocessing.active_children()
    for processes, draw in ((0, None), (2, drawing())):
        with pytest.raises(InputError, match=f"processes is {processes}"):
            animate(volume, SMALL, animation, tmp_path / "c.gif", processes=processes, draw=draw)


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
    paths = animate(volume, SMALL, animation, output, draw=drawing()).paths
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
        animate(volume, scene, animation, output, draw=draw)
    assert draw.scenes == []
    done = animate(volume, scene, animation, output, force=True, draw=draw)
    assert done.rendered == (5 if spoil == "scene" else 1)
    assert [scene_in_png(path) for path in paths] == animation.scenes(scene, volume)


def test_pictures_with_buffers_are_kept_only_with_them(
    volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    scene = dataclasses.replace(SMALL, effects=Effects(buffers=("depth",)))

    def draw(each: Scene, *, upcoming: Scene | None = None) -> Image:
        return dataclasses.replace(drawing()(each), depth=np.ones((14, 20), dtype=np.float32))

    animation, output = Animation.parse("steps=0:1", volume), tmp_path / "a.png"
    animate(volume, scene, animation, output, draw=draw)
    assert animate(volume, scene, animation, output, draw=draw).kept == 2
    (tmp_path / "a.0001.depth.npy").unlink()
    assert animate(volume, scene, animation, output, draw=draw, force=True).kept == 1


def test_longer_animations_of_the_name_are_mentioned(
    volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.png", draw=drawing())
    with pytest.warns(FhashWarning, match=r"a\.0003\.png and 1 more"):
        animate(
            volume, SMALL, Animation.parse("steps=0:2", volume), tmp_path / "a.png", draw=drawing()
        )


def test_outputs_of_other_kinds_are_refused(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    animation, draw = Animation.parse("steps", volume), drawing()
    for output, pictures in (("a.avi", None), ("a.png", "b.png"), ("a.gif", "b.jpg")):
        with pytest.raises(InputError, match="use such a name"):
            animate(volume, SMALL, animation, tmp_path / output, pictures=pictures, draw=draw)
    assert draw.scenes == []
    assert list(tmp_path.iterdir()) == []
