"""Axes of an array along which its tiles are coded."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.transform.array_axes import TILE_AXES, ArrayAxes, take_axes


@pytest.mark.parametrize("names", list(itertools.permutations(TILE_AXES)), ids="".join)
def test_a_tile_has_the_axes_in_its_own_order_and_gives_the_chunk_back(
    names: tuple[str, ...],
) -> None:
    lengths = {"t": 2, "z": 3, "y": 4, "x": 5}
    chunk = np.arange(120).reshape([lengths[name] for name in names])
    axes = ArrayAxes(names)
    tile = axes.to_tile(chunk)
    assert tile.shape == axes.tile_shape(chunk.shape) == (2, 3, 4, 5)
    place = dict(zip(TILE_AXES, (1, 2, 3, 4), strict=True))
    assert tile[1, 2, 3, 4] == chunk[tuple(place[name] for name in names)]
    assert np.array_equal(axes.from_tile(tile), chunk)
    assert axes.usual == (names == TILE_AXES)


@pytest.mark.parametrize(
    ("names", "chunk", "tile"),
    [
        (("t", "y", "x"), (2, 3, 4), (2, 1, 3, 4)),
        (("z", "y", "x"), (2, 3, 4), (1, 2, 3, 4)),
        (("x",), (7,), (1, 1, 1, 7)),
        (("", "x", "", "t"), (1, 5, 1, 3), (3, 1, 1, 5)),
        (("x", "t", "", "y", "z"), (5, 2, 1, 3, 4), (2, 4, 3, 5)),
    ],
)
def test_an_axis_that_is_not_named_has_length_1(
    names: tuple[str, ...], chunk: tuple[int, ...], tile: tuple[int, ...]
) -> None:
    values = np.arange(np.prod(chunk)).reshape(chunk)
    axes = ArrayAxes(names)
    assert axes.to_tile(values).shape == tile
    assert np.array_equal(axes.from_tile(axes.to_tile(values)), values)


def test_a_tile_with_less_detail_gives_a_smaller_chunk() -> None:
    tile = np.arange(24).reshape(2, 3, 4, 1)
    assert ArrayAxes(("y", "t", "z")).from_tile(tile).shape == (4, 2, 3)


def test_the_last_axes_are_the_usual_ones() -> None:
    assert ArrayAxes(("y", "x")).usual
    assert not ArrayAxes(("t", "y", "x")).usual


def test_they_are_taken_from_a_configuration() -> None:
    assert take_axes({"step": 1}) == ({"step": 1}, None)
    assert take_axes({"step": 1, "axes": ["t", "x"]}) == ({"step": 1}, ArrayAxes(("t", "x")))


@pytest.mark.parametrize("wrong", [[], ["t", "t"], ["u"], "tzyx", 3, [1], ["t", None]], ids=str)
def test_other_axes_are_refused(wrong: object) -> None:
    with pytest.raises(InputError, match="axes are"):
        take_axes({"axes": wrong})


def test_chunks_of_another_form_are_refused() -> None:
    axes = ArrayAxes(("t", "", "x"))
    with pytest.raises(InputError, match="of 2 axes"):
        axes.tile_shape((2, 3))
    with pytest.raises(InputError, match="length 1"):
        axes.tile_shape((2, 3, 4))
