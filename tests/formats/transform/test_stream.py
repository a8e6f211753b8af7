"""The coder of containers: chunks of fewer axes, masks, and configurations that are refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tiles import SETTINGS, SHAPE, same, wave

from fhash_formats.errors import DamagedFileError, InputError, UnsupportedFileError
from fhash_formats.transform.entropy.mask_levels import MaskLevels
from fhash_formats.transform.stream import TransformCoder
from fhash_formats.transform.tile.encoding import Coding, encode_tile
from fhash_formats.transform.tile.settings import TileSettings

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
