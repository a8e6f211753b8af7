"""Films: their frames, and what an interrupted or failing one leaves."""

from __future__ import annotations

import dataclasses
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pictures

from fhash_codec import Volume
from fhash_codec.rendering.animation.animate import animate
from fhash_codec.rendering.animation.animation import Animation
from fhash_codec.rendering.animation.film import film
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import (
    Scene,
)
from fhash_formats.errors import (
    MissingDependencyError,
    OutputError,
    OutputExistsError,
)

SMALL = Scene(size=(20, 14))


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


def test_a_gif_shows_the_pictures_in_order(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    animation = dataclasses.replace(Animation.parse("steps", volume), fps=10.0)
    animate(volume, SMALL, animation, tmp_path / "a.gif", draw=drawing())
    with Pictures.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.info["duration"], picture.info["loop"]) == (5, 100, 0)
        for number in range(5):
            picture.seek(number)
            np.testing.assert_allclose(
                np.asarray(picture.convert("RGB"))[0, 0, 0], 25.5 * number, atol=2
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


def test_an_existing_film_is_refused_before_any_work(
    volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    (tmp_path / "a.gif").write_bytes(b"mine")
    draw = drawing()
    with pytest.raises(OutputExistsError):
        animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.gif", draw=draw)
    assert draw.scenes == []
    animate(
        volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.gif", draw=draw, force=True
    )
    assert (tmp_path / "a.gif").read_bytes().startswith(b"GIF")


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
