"""Tiles that say which of their vertices are occupied."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tiles import damaged_copies

from fhash_formats.errors import DamagedFileError
from fhash_formats.transform.coder import MaskLevels
from fhash_formats.transform.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.encoding import CodedTile, Coding, encode_tile, exact_tile
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import MASKED, TileSettings

SHAPE = (2, 3, 12, 17)
NINE = AxisTransform(kind="9/7", depth=2)
SETTINGS = TileSettings(
    transform=TransformSpec(
        axes=(AxisTransform(kind="haar", depth=1), AxisTransform(kind="none"), NINE, NINE)
    ),
    step=2.0,
    center=50.0,
    low=0.0,
    high=120.0,
    quantum=1.0 * (1 - 1e-6),
    mask=MaskLevels(edges=(55.0, 60.0, 65.0), scores=(0, 60, 200, 900), reach=1),
)


def tile(dtype: str = "f4") -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    t, z, y, x = np.indices(SHAPE)
    values = 50 + 25 * np.sin(0.3 * t + 0.5 * y) + 30 * np.cos(0.4 * x - 0.2 * z)
    return values.astype(dtype), values >= 60


@pytest.mark.parametrize("dtype", ["f4", "f8", "f2", "i2", "u1"])
@pytest.mark.parametrize(
    "options",
    [{}, {"weight": 0.09, "rounds": 2, "density": 2}, {"error": 0.5}, {"error": 1e-9}],
    ids=str,
)
@pytest.mark.parametrize("own", [False, True])
def test_a_tile_says_what_is_occupied(dtype: str, options: dict[str, Any], own: bool) -> None:
    values, care = tile(dtype)
    coded = encode_tile(values, SETTINGS, Coding(own_settings=own, **options), in_coreset=care)
    settings = None if own else SETTINGS
    decoded, mask = decode_tile_mask(coded.data, SHAPE, dtype, settings)
    np.testing.assert_array_equal(mask, care)
    np.testing.assert_array_equal(decoded, coded.decoded)
    np.testing.assert_array_equal(decode_tile(coded.data, SHAPE, dtype, settings), decoded)
    if values.dtype.kind == "f":
        np.testing.assert_array_equal(np.isnan(decoded), ~care)
    else:
        assert (decoded[~care] == decoded[~care][0]).all()
    assert np.abs(decoded.astype(float) - values.astype(float))[care].max() <= options.get(
        "error", 4.0
    )
    assert coded.data[4] & MASKED


def coded_with(occupied: npt.NDArray[np.bool_] | None) -> CodedTile:
    return encode_tile(tile()[0], SETTINGS, in_coreset=occupied)


def test_all_or_nothing_costs_next_to_nothing() -> None:
    values = tile()[0]
    plain = encode_tile(values, replace(SETTINGS, mask=None))
    for care in (None, np.ones(SHAPE, bool)):
        assert len(coded_with(care).data) <= len(plain.data) + 2
        assert decode_tile_mask(coded_with(care).data, SHAPE, "f4", SETTINGS)[1].all()
    nothing = coded_with(np.zeros(SHAPE, bool))
    decoded, mask = decode_tile_mask(nothing.data, SHAPE, "f4", SETTINGS)
    assert len(nothing.data) == 5
    assert not mask.any()
    assert np.isnan(decoded).all()


def test_without_a_mask_all_is_occupied_and_the_stream_is_what_it_was() -> None:
    plain = encode_tile(tile()[0], replace(SETTINGS, mask=None))
    assert not plain.data[4] & MASKED
    assert decode_tile_mask(plain.data, SHAPE, "f4", SETTINGS)[1].all()


def test_what_is_not_finite_is_not_occupied_and_comes_back() -> None:
    values, care = tile()
    values[0, 0, :3], values[1, 2, 5, 6:9] = np.nan, [np.inf, -np.inf, np.nan]
    for error in (None, 0.5):
        coded = encode_tile(values, SETTINGS, Coding(error=error), in_coreset=care)
        decoded, mask = decode_tile_mask(coded.data, SHAPE, "f4", SETTINGS)
        np.testing.assert_array_equal(mask, care & np.isfinite(values))
        np.testing.assert_array_equal(decoded[~np.isfinite(values)], values[~np.isfinite(values)])
    coded = encode_tile(values, SETTINGS, Coding(keep_missing=False), in_coreset=care)
    dropped = decode_tile(coded.data, SHAPE, "f4", SETTINGS)
    np.testing.assert_array_equal(np.isnan(dropped), ~(care & np.isfinite(values)))


@pytest.mark.parametrize("dtype", ["f4", "u1"])
def test_an_exact_tile_says_it_as_well(dtype: str) -> None:
    values, care = tile(dtype)
    decoded, mask = decode_tile_mask(exact_tile(values, occupied=care).data, SHAPE, dtype, SETTINGS)
    np.testing.assert_array_equal(mask, care)
    np.testing.assert_array_equal(decoded[care], values[care])


def test_less_detail_needs_no_mask() -> None:
    coded = coded_with(tile()[1])
    coarse = decode_tile(coded.data, SHAPE, "f4", SETTINGS, lod=1)
    assert coarse.shape == (2, 2, 6, 9)
    assert np.isfinite(coarse).all()


def test_a_mask_needs_settings_that_know_of_it() -> None:
    with pytest.raises(DamagedFileError, match="no mask levels"):
        decode_tile(coded_with(tile()[1]).data, SHAPE, "f4", replace(SETTINGS, mask=None))


@pytest.mark.parametrize("name", ["mask", "exact", "empty"])
def test_damage_to_a_tile_with_a_mask_is_found(name: str) -> None:
    values, care = tile()
    small = (1, 2, 6, 9)
    part = tuple(slice(0, n) for n in small)
    values, care = values[part].copy(), care[part]
    own = Coding(own_settings=True)
    data = {
        "mask": encode_tile(values, SETTINGS, own, in_coreset=care).data,
        "exact": exact_tile(values, occupied=care).data,
        "empty": encode_tile(values, SETTINGS, own, in_coreset=np.zeros(small, bool)).data,
    }[name]
    for other in damaged_copies(data):
        with pytest.raises(DamagedFileError):
            decode_tile_mask(other, small, "f4")
