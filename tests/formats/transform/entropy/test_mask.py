"""Masks: levels from decoded values, the coder in its three forms, and tiles that say what is occupied."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.axes.spec import AxisTransform, TransformSpec
from fhash_formats.transform.entropy import mixing_portable
from fhash_formats.transform.entropy.mask import (
    decode_mask,
    encode_mask,
    mask_prior_state,
    pack_mask_prior,
)
from fhash_formats.transform.entropy.mask_levels import BOUNDS, MAX_SCORE, MaskLevels
from fhash_formats.transform.tile.decoding import decode_tile, decode_tile_mask
from fhash_formats.transform.tile.encoding import CodedTile, Coding, encode_tile, exact_tile
from fhash_formats.transform.tile.settings import TileSettings

SHAPES = [
    (1, 1, 1, 1),
    (2, 3, 4, 5),
    (3, 2, 9, 33),
    (1, 1, 1, 50),
    (5, 1, 1, 1),
    (1, 7, 1, 1),
    (2, 5, 16, 16),
    (1, 1, 11, 17),
]


@pytest.fixture(params=["native", "compiled", "plain"])
def form(request: pytest.FixtureRequest) -> Iterator[str]:
    """native, or portable: compiled or plain Python."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param != "native":
            patch.setenv("FHASH_NATIVE", "0")
        elif native.library() is None:
            pytest.skip("the native library was not built here")
        if request.param == "plain":
            patch.setattr(mixing_portable, "_numba", lambda: None)
        elif request.param == "compiled" and mixing_portable._numba() is None:
            pytest.skip("numba cannot be imported here")
        yield request.param


def masks(shape: tuple[int, ...]) -> dict[str, npt.NDArray[np.bool_]]:
    t, z, y, x = np.indices(shape)
    random = np.random.default_rng(1).random(shape)
    return {
        "none": np.zeros(shape, bool),
        "all": np.ones(shape, bool),
        "noise": random < 0.5,
        "few": random < 0.02,
        "a ball": (z - 1) ** 2 + (y - 5) ** 2 + (x - 8 - t) ** 2 < 14,
        "half": x < shape[3] // 2,
    }


def levels_for(
    kind: str, mask: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    rng = np.random.default_rng(2)
    if kind == "nothing known":
        return np.zeros(mask.shape, np.uint8), np.zeros(mask.shape, np.uint8)
    if kind == "noise":
        return rng.integers(0, 32, mask.shape, np.uint8), rng.integers(0, 16, mask.shape, np.uint8)
    level = np.clip(np.where(mask, 24, 7) + rng.normal(0, 6, mask.shape), 0, 31).astype(np.uint8)
    return level, (level // 2).astype(np.uint8)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_mask_comes_back(shape: tuple[int, ...], form: str) -> None:
    for mask in masks(shape).values():
        for kind in ("nothing known", "noise", "likely"):
            levels = levels_for(kind, mask)
            decoded = decode_mask(encode_mask(mask, levels), levels)
            assert decoded.dtype == bool
            np.testing.assert_array_equal(decoded, mask)


def test_every_form_gives_the_same_bytes(form: str) -> None:
    """Pinned: these bytes are part of the format."""
    found = {}
    for name, mask in masks((3, 2, 9, 33)).items():
        for kind in ("nothing known", "noise", "likely"):
            found[f"{name}, {kind}"] = (
                len(data := encode_mask(mask, levels_for(kind, mask))),
                sum(data) % 251,
            )
    assert found == PINNED


PINNED = {
    "none, nothing known": (0, 0),
    "none, noise": (1, 223),
    "none, likely": (1, 172),
    "all, nothing known": (2, 42),
    "all, noise": (0, 0),
    "all, likely": (0, 0),
    "noise, nothing known": (234, 240),
    "noise, noise": (285, 141),
    "noise, likely": (114, 72),
    "few, nothing known": (43, 229),
    "few, noise": (47, 112),
    "few, likely": (16, 31),
    "a ball, nothing known": (22, 172),
    "a ball, noise": (30, 152),
    "a ball, likely": (16, 104),
    "half, nothing known": (6, 94),
    "half, noise": (14, 156),
    "half, likely": (8, 176),
}


def test_what_the_levels_tell_need_not_be_coded() -> None:
    mask = masks((4, 8, 24, 40))["a ball"]
    certain = np.where(mask, 31, 0).astype(np.uint8)
    told = encode_mask(mask, (certain, certain // 2))
    untold = encode_mask(mask, levels_for("nothing known", mask))
    assert 3 * len(told) < len(untold) < mask.size / 50


def test_damaged_bytes_give_some_mask(form: str) -> None:
    mask = masks((2, 3, 9, 17))["a ball"]
    levels = levels_for("likely", mask)
    data = encode_mask(mask, levels)
    rng = np.random.default_rng(3)
    damaged = [data[:n] for n in range(len(data))] + [
        bytes(rng.integers(0, 256, n, np.uint8)) for n in (0, 1, 5, 500)
    ]
    for other in damaged:
        assert decode_mask(other, levels).shape == mask.shape


def test_the_prior_is_what_was_packed() -> None:
    state = mask_prior_state()
    assert state.slots[:, 2].max() <= 12
    assert pack_mask_prior(state) == pack_mask_prior(mask_prior_state())
    assert not state.slots.flags.writeable


def test_levels_rise_with_the_value_and_reach_as_far_as_the_feature_grew() -> None:
    values = np.zeros((1, 1, 3, 9), np.float32)
    values[0, 0, 1, 4] = 5.0
    levels, others = MaskLevels(edges=(1.0, 4.0), scores=(0, 128, 2000), reach=2).levels(values)
    np.testing.assert_array_equal(
        levels[0, 0, 1] > 0, [False, False, True, True, True, True, True, False, False]
    )
    assert levels.max() == sum(bound <= 2000 for bound in BOUNDS)
    np.testing.assert_array_equal(np.argwhere(others), [[0, 0, 1, 4]])
    rising = MaskLevels(edges=(1.0, 4.0), scores=(0, 128, 2000)).levels(
        np.array([0, 1, 3.9, 4], np.float64).reshape(1, 1, 1, 4)
    )[0]
    assert list(rising.ravel()) == [0, 16, 16, levels.max()]
    assert all(low < high <= MAX_SCORE for low, high in pairwise(BOUNDS))


@pytest.mark.parametrize(
    "change",
    [
        {"edges": [1.0]},
        {"edges": [1.0, 1.0], "scores": [0, 1, 2]},
        {"edges": [float("nan")], "scores": [0, 1]},
        {"edges": [10**400], "scores": [0, 1]},
        {"edges": list(range(16)), "scores": [0] * 17},
        {"scores": [-1]},
        {"scores": [4096]},
        {"scores": [1.5]},
        {"scores": 3},
        {"others": [1, 2]},
        {"reach": 65},
        {"reach": True},
        {"other": 1},
        [],
    ],
    ids=str,
)
def test_settings_that_are_not_allowed(change: Any) -> None:
    with pytest.raises(InputError):
        MaskLevels.from_dict(change)


def test_settings_are_what_their_values_say() -> None:
    for levels in (
        MaskLevels(),
        MaskLevels(edges=(-1.0, 2.5), scores=(0, 7, 9), others=(9, 7, 0), reach=3),
    ):
        assert MaskLevels.from_dict(levels.to_dict()) == levels


# -- tiles -----------------------------------------------------------------------------------------------------------------------

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
    assert coded.data[0] >> 5 == 2


def coded_with(occupied: npt.NDArray[np.bool_] | None) -> CodedTile:
    return encode_tile(tile()[0], SETTINGS, in_coreset=occupied)


def test_all_or_nothing_costs_next_to_nothing() -> None:
    values = tile()[0]
    plain = encode_tile(values, replace(SETTINGS, mask=None))
    for care in (None, np.ones(SHAPE, bool)):
        assert len(coded_with(care).data) == len(plain.data) + 1
        assert decode_tile_mask(coded_with(care).data, SHAPE, "f4", SETTINGS)[1].all()
    nothing = coded_with(np.zeros(SHAPE, bool))
    decoded, mask = decode_tile_mask(nothing.data, SHAPE, "f4", SETTINGS)
    assert len(nothing.data) == 1
    assert not mask.any()
    assert np.isnan(decoded).all()


def test_without_a_mask_all_is_occupied_and_the_stream_is_what_it_was() -> None:
    plain = encode_tile(tile()[0], replace(SETTINGS, mask=None))
    assert plain.data[0] >> 5 == 1
    assert decode_tile_mask(plain.data, SHAPE, "f4", SETTINGS)[1].all()


def test_what_is_not_finite_is_not_occupied_and_comes_back() -> None:
    values, care = tile()
    values[0, 0, :3], values[1, 2, 5, 6:9] = np.nan, [np.inf, -np.inf, np.nan]
    for options in ({}, {"error": 0.5}):
        coded = encode_tile(values, SETTINGS, Coding(**options), in_coreset=care)
        decoded, mask = decode_tile_mask(coded.data, SHAPE, "f4", SETTINGS)
        np.testing.assert_array_equal(mask, care & np.isfinite(values))
        np.testing.assert_array_equal(decoded[~np.isfinite(values)], values[~np.isfinite(values)])
    dropped = decode_tile(
        encode_tile(values, SETTINGS, Coding(keep_missing=False), in_coreset=care).data,
        SHAPE,
        "f4",
        SETTINGS,
    )
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
    data = {
        "mask": encode_tile(values, SETTINGS, Coding(own_settings=True), in_coreset=care).data,
        "exact": exact_tile(values, occupied=care).data,
        "empty": encode_tile(
            values, SETTINGS, Coding(own_settings=True), in_coreset=np.zeros(small, bool)
        ).data,
    }[name]
    sound, mask = decode_tile_mask(data, small, "f4")
    damaged = [data[:n] for n in range(len(data))] + [data + b"\0", data + b"\x01a"]
    damaged += [
        data[:n] + bytes([data[n] ^ 1 << bit]) + data[n + 1 :]
        for n in range(len(data))
        for bit in range(8)
    ]
    refused = 0
    for other in damaged:
        try:
            found, other_mask = decode_tile_mask(other, small, "f4")
            assert np.array_equal(found, sound, equal_nan=True)
            assert np.array_equal(other_mask, mask)
        except DamagedFileError:
            refused += 1
    assert refused > 0.95 * len(damaged)
