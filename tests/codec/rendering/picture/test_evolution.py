"""Evolutions: several steps side by side in one picture."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import Renderer, Volume
from fhash_codec.rendering.picture.evolution import evolution
from fhash_codec.rendering.scene.scene import (
    Effects,
    Evolution,
    Scene,
)
from fhash_formats.errors import (
    InputError,
)

SMALL = Scene(size=(20, 14))


def test_an_evolution_is_a_grid_of_its_steps(volume: Volume, drawing: Any) -> None:
    draw = drawing()
    asked = Evolution(steps=(0.0, 1.0, 2.5, 3.0, 4.0), columns=3)
    scene = dataclasses.replace(
        SMALL, effects=Effects(colour_bar=True), background="transparent", evolution=asked
    )
    image = evolution(volume, scene, draw=draw)
    assert image.rgba.shape == (2 * 14 + 1, 3 * 20 + 2, 4)
    for number, step in enumerate([0, 1, 2.5, 3, 4]):
        row, column = divmod(number, 3)
        panel = image.rgba[row * 15 : row * 15 + 14, column * 21 : column * 21 + 20]
        np.testing.assert_allclose(panel[..., 0], step / 10, rtol=1e-6)
    assert not image.rgba[:, 20].any()
    assert not image.rgba[15:, 42:].any()
    assert not any(each.effects.colour_bar or each.effects.legend for each in draw.scenes)
    assert all(each.effects.time_label for each in draw.scenes)
    assert image.counters == {"rays": 5 * 280}
    assert image.seconds == 2.5
    assert Scene.from_dict(image.scene) == scene


@pytest.mark.parametrize(
    ("count", "size", "columns"),
    [(1, (64, 64), 1), (6, (64, 64), 3), (5, (128, 16), 1), (4, (16, 128), 4)],
)
def test_an_evolution_is_wider_than_high(
    count: int, size: tuple[int, int], columns: int, volume: Volume, drawing: Any
) -> None:
    scene = dataclasses.replace(SMALL, size=size, evolution=Evolution(steps=(0.0,) * count))
    image = evolution(volume, scene, draw=drawing())
    assert image.rgba.shape[1] // size[0] == columns


def test_evolutions_that_cannot_be(volume: Volume, drawing: Any) -> None:
    for steps, columns, size, part in (
        ([], None, (9, 9), "at least one"),
        ([0], 2, (9, 9), "columns"),
        ([0] * 9, 9, (9999, 9), "pixels"),
    ):
        with pytest.raises(InputError, match=part):
            evolution(
                volume,
                dataclasses.replace(
                    SMALL, size=size, evolution=Evolution(steps=steps, columns=columns)
                ),
                draw=drawing(),
            )
    with pytest.raises(InputError, match="at least one"):
        evolution(volume, SMALL, draw=drawing())
    with pytest.raises(InputError, match="steps of its own"):
        dataclasses.replace(SMALL, step=1.0, evolution=Evolution(steps=(0.0,)))
    with pytest.raises(InputError, match="the scene is an evolution"):
        Renderer(volume).plan(dataclasses.replace(SMALL, evolution=Evolution(steps=(0.0,))))


def test_a_renderer_draws_evolutions(files: dict[str, Path]) -> None:
    with fhash_codec.open(files["compact"]) as real:
        image = fhash_codec.render(
            real, dataclasses.replace(SMALL, evolution=Evolution(steps=(0.0, 1.5), columns=2))
        )
        single = fhash_codec.render(
            real, dataclasses.replace(SMALL, step=1.5, effects=Effects(time_label=True))
        )
        np.testing.assert_array_equal(image.rgba[:, -SMALL.size[0] :], single.rgba)
