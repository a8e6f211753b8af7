"""The presets: nothing but lists of effects, at the shapes of the paper, and worth a look."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from fhash_codec.simulation.effects.catalogue import EFFECTS
from fhash_codec.simulation.presets import PRESETS
from fhash_codec.simulation.simulate import simulate

PAPER = {
    "flame": (54, 172, 200, 136),
    "bubble": (256, 128, 128, 241),
    "shell": (216, 216, 216, 136),
}
"""Vertices along z, y and x, and steps, of Table 2."""


def test_presets_are_plain_lists_that_a_file_could_hold() -> None:
    for name, preset in PRESETS.items():
        plain = json.loads(json.dumps(preset))
        assert simulate(plain).scene == simulate(name).scene
        assert {table["effect"] for table in plain["effects"]} <= set(EFFECTS)


@pytest.mark.parametrize("name", PAPER)
def test_paper_shapes_are_those_of_the_paper(name: str) -> None:
    scene = simulate(name).scene
    large = scene.as_in_paper()
    assert (*large.shape, large.steps) == PAPER[name]
    # Both shapes have the same proportions as the box, so that cells are cubes, about.
    for shape in (scene.shape, large.shape):
        cells = [length / count for length, count in zip(scene.size, shape, strict=True)]
        assert max(cells) < 1.05 * min(cells)


@pytest.mark.parametrize("name", PRESETS)
def test_the_default_is_small_and_its_feature_a_small_part(name: str) -> None:
    series = simulate(name)
    assert math.prod(series.shape) < 6e6
    _, low, high = series.scene.feature.split(":")
    small = simulate(name, (5, *(max(8, n // 2) for n in series.scene.shape)))
    for step in range(1, 5):
        frame = small.read(step)
        share = ((frame >= float(low)) & (frame <= float(high))).mean()
        assert 0.005 < share < 0.35


@pytest.mark.parametrize("name", PRESETS)
def test_something_happens_and_the_seed_changes_it(name: str) -> None:
    shape = (4, 12, 16, 14)
    first, again, other = (simulate(name, shape, seed) for seed in (0, 0, 1))
    for step in range(3):
        assert not np.array_equal(first.read(step), first.read(step + 1))
    np.testing.assert_array_equal(first.read(3), again.read(3))
    assert not np.array_equal(first.read(3), other.read(3))
