"""Axes of an array along which its tiles are coded."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tiles import SETTINGS, SHAPE, same, wave

from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.transform.coder import MaskLevels
from fhash_formats.transform.encoding import Coding, encode_tile
from fhash_formats.transform.stream import TILE_AXES, ArrayAxes, TransformCoder, take_axes
from fhash_formats.transform.tile_format import TileSettings


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


FLOAT = np.dtype(np.float32)


def named(settings: TileSettings) -> dict[str, Any]:
    return {"settings": settings.to_text()}


def coder(settings: TileSettings | None, shape: tuple[int, ...] = SHAPE) -> TransformCoder:
    configuration = {} if settings is None else named(settings)
    return TransformCoder([{"configuration": configuration}], FLOAT, shape)


@pytest.mark.parametrize("axes", [1, 2, 3, 4])
def test_a_chunk_of_fewer_axes_comes_back(axes: int) -> None:
    values = wave()[(0,) * (4 - axes)]
    shared = coder(SETTINGS, values.shape)
    decoded = shared.decode(memoryview(shared.encode(values)))
    assert decoded.shape == values.shape
    assert np.abs(decoded - values).max() <= 0.4


def test_a_reduced_chunk_has_every_second_vertex_of_space() -> None:
    shared = coder(SETTINGS)
    assert shared.decode(memoryview(shared.encode(wave())), lod=1).shape == (2, 2, 4, 5)


def test_without_shared_settings_each_stream_has_its_own() -> None:
    coded = encode_tile(wave(), SETTINGS, Coding(own_settings=True))
    assert same(coder(None).decode(memoryview(coded.data)), coded.decoded)
    with pytest.raises(InputError, match="only decodes"):
        coder(None).encode(wave())


def test_the_mask_comes_with_the_values() -> None:
    settings, occupied = replace(SETTINGS, mask=MaskLevels()), wave() > 0.5
    masked = coder(settings)
    assert masked.masked
    coded = encode_tile(wave(), settings, in_coreset=occupied)
    values, mask = masked.decode_masked(memoryview(coded.data))
    assert same(values, coded.decoded)
    assert np.array_equal(mask, occupied)


@pytest.mark.parametrize(
    ("codecs", "shape", "error", "message"),
    [
        ([{}, {}], SHAPE, UnsupportedFileError, "no codec may follow"),
        ([{}], (1, *SHAPE), DamagedFileError, "at most 4 axes"),
        ([{"configuration": {"transform": 3}}], SHAPE, DamagedFileError, "has settings, and axes"),
        ([{"configuration": {"settings": "a"}}], SHAPE, DamagedFileError, "no base64"),
    ],
)
def test_other_configurations_are_refused(
    codecs: list[dict[str, Any]], shape: tuple[int, ...], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        TransformCoder(codecs, FLOAT, shape)


AXES = ("y", "x", "t", "z")


@pytest.mark.parametrize("settings", [SETTINGS, None])
def test_a_chunk_is_coded_along_the_axes_that_are_named(settings: TileSettings | None) -> None:
    order = ["tzyx".index(axis) for axis in AXES]
    values = wave().transpose(order)
    configuration = {**({} if settings is None else named(settings)), "axes": list(AXES)}
    given = TransformCoder([{"configuration": configuration}], FLOAT, values.shape)
    coded = encode_tile(wave(), SETTINGS, Coding(own_settings=settings is None))
    assert not given.parted
    assert same(given.decode(coded.data), coded.decoded.transpose(order))
    if settings is not None:
        assert given.encode(values) == coded.data


def test_a_level_of_detail_keeps_every_position_along_the_first_axis() -> None:
    plain, data = coder(SETTINGS), encode_tile(wave(), SETTINGS).data
    time_first = {**named(SETTINGS), "axes": ["t", "x", "y", "z"]}
    shape = tuple(wave().transpose(0, 3, 2, 1).shape)
    given = TransformCoder([{"configuration": time_first}], FLOAT, shape)
    assert same(given.decode(data, lod=1), plain.decode(data, lod=1).transpose(0, 3, 2, 1))
    swapped = {**named(SETTINGS), "axes": ["z", "t", "y", "x"]}
    shape = tuple(wave().transpose(1, 0, 2, 3).shape)
    given = TransformCoder([{"configuration": swapped}], FLOAT, shape)
    everything = plain.decode(data).transpose(1, 0, 2, 3)
    assert same(given.decode(data, lod=1), everything[:, ::2, ::2, ::2])


def test_axes_come_with_masks() -> None:
    settings, occupied = replace(SETTINGS, mask=MaskLevels()), wave() > 0.5
    configuration = {**named(settings), "axes": ["x", "z", "y", "t"]}
    shape = tuple(wave().transpose(3, 1, 2, 0).shape)
    given = TransformCoder([{"configuration": configuration}], FLOAT, shape)
    coded = encode_tile(wave(), settings, in_coreset=occupied)
    values, mask = given.decode_masked(coded.data)
    assert same(values, coded.decoded.transpose(3, 1, 2, 0))
    assert np.array_equal(mask, occupied.transpose(3, 1, 2, 0))


@pytest.mark.parametrize(
    "axes", [["t", "z", "y"], ["t", "t", "y", "x"], "tzyx", ["", "z", "y", "x"]]
)
def test_axes_that_do_not_fit_are_damage(axes: object) -> None:
    with pytest.raises(DamagedFileError, match=r"axes|chunks"):
        TransformCoder([{"configuration": {"axes": axes}}], FLOAT, SHAPE)
