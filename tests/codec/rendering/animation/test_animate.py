"""Numbered pictures on disk: which are rendered, which are kept."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec import Volume
from fhash_codec.rendering.animation.animate import animate, numbered
from fhash_codec.rendering.animation.animation import Animation
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.scene import (
    Effects,
    Scene,
    scene_in_png,
)
from fhash_formats.errors import (
    FhashWarning,
    InputError,
    OutputExistsError,
)

SMALL = Scene(size=(20, 14))


def test_pictures_are_numbered_and_hold_their_scene(
    volume: Volume, tmp_path: Path, drawing: Any
) -> None:
    draw = drawing()
    done = animate(volume, SMALL, Animation.parse("steps", volume), tmp_path / "a.png", draw=draw)
    assert [path.name for path in done.paths] == [f"a.000{number}.png" for number in range(5)]
    assert (done.rendered, done.kept, done.counters) == (5, 0, {"rays": 5 * 280})
    assert [scene_in_png(path) for path in done.paths] == draw.scenes
    assert draw.upcoming == [*draw.scenes[1:], None]
    assert [path.name for path in numbered(Path("b.png"), 10_001)][-1] == "b.10000.png"


def test_an_interrupted_animation_goes_on(volume: Volume, tmp_path: Path, drawing: Any) -> None:
    animation, output = Animation.parse("steps", volume), tmp_path / "a.png"
    whole = animate(volume, SMALL, animation, output, draw=drawing())
    before = [path.read_bytes() for path in whole.paths]
    whole.paths[1].unlink()
    whole.paths[3].unlink()
    draw = drawing()
    done = animate(volume, SMALL, animation, output, draw=draw)
    assert (done.rendered, done.kept) == (2, 3)
    assert [scene.step for scene in draw.scenes] == [1, 3]
    assert draw.upcoming == [None, None]  # what follows is there already
    assert [path.read_bytes() for path in whole.paths] == before


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
