"""Tables of the native engine: corners of vertices, and structures that equal the C++ ones."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.native import network
from fhash_codec.paper.engines import native_task
from fhash_codec.paper.engines.native_task import (
    GROUP,
    REACH,
    Bricks,
    Gaps,
    Level,
    groups_of_corners,
    two_corners,
)
from fhash_codec.paper.engines.upsampling import axis_matrices

HEADER = (Path(network.__file__).parent / "bricks.hpp").read_text(encoding="utf-8")
AXES = [(125, 63, 16, 8), (35, 3, 12, 3), (1, 1, 1, 1), (700, 350, 700, 1), (20, 20, 7, 3)]
"""Vertices and corners of an axis, and vertices and number of the runs along it."""


@pytest.mark.parametrize("structure", [Level, Gaps, Bricks])
def test_structures_have_the_fields_of_the_header_in_its_order(structure) -> None:
    text = re.search(rf"struct Fhash{structure.__name__} {{(.*?)\n}};", HEADER, re.DOTALL)
    assert text is not None
    names = []
    for line in text.group(1).splitlines():
        declared = line.split("//")[0].strip()
        if declared:
            words = re.sub(r"\[\d\]|[*;]", " ", declared.split(" ", 1)[1].replace("const ", ""))
            names += [word.split()[-1] for word in words.split(",")]
    assert names == [name for name, _ in structure._fields_]


@pytest.mark.parametrize("name", ["GROUP", "REACH", "BLOCK", "WIDEST"])
def test_constants_are_those_of_the_header(name) -> None:
    value = re.search(rf"FHASH_{name} = (\d+);", HEADER)
    assert value is not None
    assert int(value.group(1)) == getattr(native_task, name)


@pytest.mark.parametrize("axis", AXES, ids=str)
def test_two_corners_have_all_the_weight(axis) -> None:
    _, weights = axis_matrices(*axis)
    first, two = two_corners(weights)
    again = np.zeros((*weights.shape[:2], weights.shape[2] + 1))
    np.put_along_axis(again, first[..., None] + np.arange(2), two, axis=2)
    np.testing.assert_allclose(again[..., :-1], weights, atol=1e-7)


@pytest.mark.parametrize("axis", AXES, ids=str)
def test_groups_hold_the_weights_of_their_vertices(axis) -> None:
    _, weights = axis_matrices(*axis)
    reach, spread = groups_of_corners(weights)
    again = np.zeros((weights.shape[0], reach.shape[1] * GROUP, weights.shape[2] + REACH))
    for coordinate, group in np.ndindex(reach.shape[:2]):
        first, count = reach[coordinate, group]
        assert 0 < count <= GROUP + 1
        assert not spread[coordinate, group, count:].any()
        part = again[coordinate, group * GROUP : (group + 1) * GROUP]
        part[:, first : first + REACH] = spread[coordinate, group].T
    np.testing.assert_allclose(again[:, : weights.shape[1], : weights.shape[2]], weights, atol=1e-7)
    assert not again[:, weights.shape[1] :].any()
