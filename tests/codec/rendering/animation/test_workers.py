"""Pictures of an animation by several processes: the same files, errors, and no process left."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec import EncodeConfig, Renderer, Volume, encode_dataset
from fhash_codec.rendering.animation.animate import animate
from fhash_codec.rendering.animation.animation import Animation
from fhash_codec.rendering.animation.workers import rendered_by_workers
from fhash_codec.rendering.scene.scene import Scene, TransferFunctionSpec
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import FhashError, InputError

SMALL = Scene(size=(20, 14))


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
