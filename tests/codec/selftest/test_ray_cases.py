"""Checks of rays see pictures that differ; the float64 picture has its closed forms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import Frame, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.selftest import ray_cases
from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.field_cases import series, waves
from fhash_codec.selftest.ray_cases import (
    blocks,
    closed_form,
    key_times,
    reference_picture,
    scene,
    scenes,
)

Broken = Callable[[Run, Check], set[str]]
FOG = {"opacity": [[0.0, 0.02], [1.0, 0.5]]}
SMALL = scene(size=[6, 5], transfer_function=FOG)
EVEN = scene(size=[2, 2], transfer_function={"opacity": [[0.0, 0.5]]}, march={"step": 0.1})


@contextmanager
def opened(run: Run, path: Path, values: np.ndarray) -> Iterator[Run]:
    """A run of other values; few, since the oracle takes its time."""
    source = series(values.astype(np.float32))
    encode(source, path, EncodeConfig(max_error_rel=1e-3, effort=1))
    with fhash_codec.open(path) as volume:
        yield replace(run, series=source, values=values, path=path, volume=volume)


@pytest.fixture(scope="module")
def waves_run(compact_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with opened(
        compact_run, tmp_path_factory.mktemp("waves") / "a.fhz", waves((2, 4, 5, 6))
    ) as run:
        yield run


@pytest.fixture(scope="module")
def even_run(compact_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with opened(
        compact_run, tmp_path_factory.mktemp("even") / "a.fhz", np.ones((1, 2, 3, 3))
    ) as run:
        yield run


@pytest.mark.parametrize("check", [scenes({"small": SMALL}), blocks, key_times])
def test_easy_scenes_keep_every_property(waves_run: Run, broken: Broken, check: Check) -> None:
    assert broken(waves_run, check) == set()


def test_an_even_volume_has_its_closed_form(even_run: Run, broken: Broken) -> None:
    assert broken(even_run, closed_form({"even": EVEN}, 1.0)) == set()


def test_a_longer_path_breaks_the_closed_form(
    even_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ray_cases._path
    monkeypatch.setattr(ray_cases, "_path", lambda plan: 2 * path(plan))
    assert broken(even_run, closed_form({"even": EVEN}, 1.0)) == {"closed form"}


def test_a_picture_that_differs_from_the_oracle_is_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = ray_cases.reference_picture
    monkeypatch.setattr(ray_cases, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(waves_run, scenes({"small": SMALL})) == {"float64 picture"}


def test_an_empty_picture_proves_nothing(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_cases, "reference_picture", lambda *given: np.zeros((5, 6, 4)))
    assert "empty pictures" in broken(waves_run, scenes({"small": SMALL}))


def test_a_part_that_is_drawn_too_bright_is_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    march = ray_cases.march

    def brighter(frame: object, task: object) -> object:
        marched = march(frame, task)
        return replace(marched, rgba=marched.rgba * np.float32(1 + 1e-4 * (frame.first[0] > 0)))

    monkeypatch.setattr(ray_cases, "march", brighter)
    assert broken(waves_run, blocks) == {"blocks = whole"}


def test_pictures_that_depend_on_the_name_of_the_step_are_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    render = ray_cases.Renderer.render

    def other(renderer: object, given: object) -> object:
        image = render(renderer, given)
        return image if given.time is None else replace(image, rgba=image.rgba + np.float32(1e-6))

    monkeypatch.setattr(ray_cases.Renderer, "render", other)
    assert broken(waves_run, key_times) == {"picture at a key time"}


SHAPE = (5, 4, 4)


def task_of(**more: object) -> Task:
    """Four parallel rays from above, through a volume of `SHAPE`."""
    grid = Grid(counts=SHAPE[::-1], origin=np.zeros(3), spacing=np.ones(3))
    camera = Camera(view="xy", projection="parallel", parallel_scale=1.0)
    return Task(rays=Rays.of(camera, grid, (2, 2)), step=0.3, threshold=0.0, **more)


@pytest.mark.parametrize("extinction", [1e-6, 0.3, 50.0])
def test_a_constant_slab_has_its_closed_form(extinction: float) -> None:
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.tile(np.float32([1.0, 0.5, 0.0]), (3, 1)),
        extinctions=np.full(3, extinction),
    )
    frame = Frame(values=np.full(SHAPE, 0.5, np.float32), first=(0, 0, 0))
    opacity = -np.expm1(-4 * extinction)
    np.testing.assert_allclose(
        reference_picture(frame, task_of(table=table)),
        np.broadcast_to(opacity * np.array([1, 0.5, 0, 1]), (2, 2, 4)),
        rtol=1e-9,
    )


def test_surfaces_are_drawn_over_those_behind_them() -> None:
    ramp = np.broadcast_to(np.arange(5, dtype=np.float32)[:, None, None], SHAPE)
    surfaces = tuple(
        Surface(value=value, colour=np.array(colour), opacity=0.5)
        for value, colour in ((1.0, (0, 1, 0)), (4.0, (1, 0, 0)))
    )
    picture = reference_picture(
        Frame(values=ramp, first=(0, 0, 0)), task_of(table=None, surfaces=surfaces)
    )
    # Seen from above, the surface at 4 lies on the face where the rays enter, and the one at 1
    # behind it, exactly on vertices.
    np.testing.assert_allclose(
        picture, np.broadcast_to([0.5, 0.25, 0.0, 0.75], (2, 2, 4)), rtol=1e-12
    )


def test_nothing_is_seen_where_a_vertex_with_a_weight_has_no_value() -> None:
    values = np.full(SHAPE, 0.5, np.float32)
    values[2] = np.nan
    table = Table(
        low=0.0, high=1.0, colours=np.ones((2, 3), np.float32), extinctions=np.full(2, 0.1)
    )
    picture = reference_picture(Frame(values=values, first=(0, 0, 0)), task_of(table=table))
    # Samples lie at 0.15, 0.45, ..., 3.75; one of length 0.1 lies at 3.95. Those from 1 to 3 lie
    # beside the layer without values.
    lengths = 0.3 * np.count_nonzero(np.abs(np.arange(0.15, 3.9, 0.3) - 2) >= 1) + 0.1
    np.testing.assert_allclose(picture[..., 3], -np.expm1(-0.1 * lengths), rtol=1e-6)
