"""Checks of hard scenes hold for easy ones and see the errors that are planted here."""

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
from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.cases.fields import series, waves
from fhash_codec.selftest.checks import ray_checks
from fhash_codec.selftest.checks.ray_checks import blocks, closed_form, key_times, scene, scenes

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
    path = ray_checks._path
    monkeypatch.setattr(ray_checks, "_path", lambda plan: 2 * path(plan))
    assert broken(even_run, closed_form({"even": EVEN}, 1.0)) == {"closed form"}


def test_a_picture_that_differs_from_the_oracle_is_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = ray_checks.reference_picture
    monkeypatch.setattr(ray_checks, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(waves_run, scenes({"small": SMALL})) == {"float64 picture"}


def test_an_empty_picture_proves_nothing(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_checks, "reference_picture", lambda *given: np.zeros((5, 6, 4)))
    assert "empty pictures" in broken(waves_run, scenes({"small": SMALL}))


def test_a_part_that_is_drawn_too_bright_is_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    march = ray_checks.march

    def brighter(frame: object, task: object) -> object:
        marched = march(frame, task)
        return replace(marched, rgba=marched.rgba * np.float32(1 + 1e-4 * (frame.first[0] > 0)))

    monkeypatch.setattr(ray_checks, "march", brighter)
    assert broken(waves_run, blocks) == {"blocks = whole"}


def test_pictures_that_depend_on_the_name_of_the_step_are_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    render = ray_checks.Renderer.render

    def other(renderer: object, given: object) -> object:
        image = render(renderer, given)
        return image if given.time is None else replace(image, rgba=image.rgba + np.float32(1e-6))

    monkeypatch.setattr(ray_checks.Renderer, "render", other)
    assert broken(waves_run, key_times) == {"picture at a key time"}
