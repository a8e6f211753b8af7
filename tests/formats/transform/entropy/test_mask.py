"""The coder of masks: round trips, fixed bytes, damaged bytes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats.transform.entropy.mask import (
    decode_mask,
    encode_mask,
    mask_prior_state,
)

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
def test_a_mask_comes_back(shape: tuple[int, ...]) -> None:
    for mask in masks(shape).values():
        for kind in ("nothing known", "noise", "likely"):
            levels = levels_for(kind, mask)
            decoded = decode_mask(encode_mask(mask, levels), levels)
            assert decoded.dtype == bool
            np.testing.assert_array_equal(decoded, mask)


def test_the_bytes_are_fixed() -> None:
    """The bytes are part of the format, so their lengths and checksums are written here."""
    results = {}
    for name, mask in masks((3, 2, 9, 33)).items():
        for kind in ("nothing known", "noise", "likely"):
            results[f"{name}, {kind}"] = (
                len(data := encode_mask(mask, levels_for(kind, mask))),
                sum(data) % 251,
            )
    assert results == PINNED


PINNED = {
    "none, nothing known": (0, 0),
    "none, noise": (1, 229),
    "none, likely": (1, 180),
    "all, nothing known": (2, 212),
    "all, noise": (0, 0),
    "all, likely": (0, 0),
    "noise, nothing known": (234, 160),
    "noise, noise": (284, 106),
    "noise, likely": (113, 226),
    "few, nothing known": (43, 37),
    "few, noise": (47, 210),
    "few, likely": (16, 197),
    "a ball, nothing known": (22, 189),
    "a ball, noise": (31, 105),
    "a ball, likely": (16, 74),
    "half, nothing known": (6, 80),
    "half, noise": (15, 1),
    "half, likely": (8, 147),
}


def test_what_the_levels_tell_need_not_be_coded() -> None:
    mask = masks((4, 8, 24, 40))["a ball"]
    certain = np.where(mask, 31, 0).astype(np.uint8)
    told = encode_mask(mask, (certain, certain // 2))
    untold = encode_mask(mask, levels_for("nothing known", mask))
    assert 3 * len(told) < len(untold) < mask.size / 50


def test_damaged_bytes_give_some_mask() -> None:
    mask = masks((2, 3, 9, 17))["a ball"]
    levels = levels_for("likely", mask)
    data = encode_mask(mask, levels)
    rng = np.random.default_rng(3)
    damaged = [data[:n] for n in range(len(data))] + [
        bytes(rng.integers(0, 256, n, np.uint8)) for n in (0, 1, 5, 500)
    ]
    for other in damaged:
        assert decode_mask(other, levels).shape == mask.shape


def test_the_prior_follows_the_tile_soon_and_is_not_changed() -> None:
    state = mask_prior_state()
    assert 0 < state.slots[:, 2].max() <= 12
    assert not state.slots.flags.writeable
