"""Peers give back what they hold, and take the settings that they are given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.bench.rate.peers import (
    Variant,
    filled,
    peers,
    read_all,
    read_region,
    stored,
    stored_bytes,
    touched_bytes,
)

Field = Callable[..., np.ndarray]

VARIANTS = [variant for chosen in peers().values() for variant in chosen]
"""Every variant of every peer."""
CUT = [replace(variant, chunk=8) for variant in VARIANTS if variant.layout == "frame"]
"""Variants with chunks of a frame, cut into small ones."""
REGION = ((1, 4), (2, 12), (5, 17))


@pytest.mark.parametrize("variant", [*VARIANTS, *CUT], ids=lambda variant: variant.name)
def test_a_peer_returns_the_region_of_what_it_returns(variant: Variant, field: Field) -> None:
    values = field()
    with stored(values, variant, 3.0, 60.0) as file:
        decoded = read_all(file, variant, values.shape)
        assert decoded.shape == values.shape
        assert np.abs(decoded - values).max() < 0.5
        region = read_region(file, variant, values.shape, 2, REGION)
        np.testing.assert_array_equal(region, decoded[2][tuple(slice(*span) for span in REGION)])
        touched, total = touched_bytes(file, variant, values.shape, 2, REGION), stored_bytes(file)
    assert 0 < touched <= total
    if variant.layout == "frame":
        assert touched < total / 2
    if variant.lossless:
        np.testing.assert_array_equal(decoded, values)
    else:
        assert total < values.nbytes


@pytest.mark.parametrize(
    "variant",
    [variant for variant in VARIANTS if variant.mode == "tolerance"],
    ids=lambda variant: variant.name,
)
def test_a_level_is_a_tolerance(variant: Variant, field: Field) -> None:
    values = field()
    with stored(values, variant, 3.0, 40.0) as file:
        assert np.abs(
            read_all(file, variant, values.shape).astype(np.float64) - values
        ).max() <= 0.03 * (1 + 1e-4)


def test_sperr_is_given_the_axes_in_its_own_order() -> None:
    """A field that is smooth along x and y alone costs far more with its axes in reverse."""
    import hdf5plugin

    values = np.broadcast_to(
        np.random.default_rng(0).normal(size=(2, 3, 1, 1)), (2, 3, 40, 90)
    ).astype(np.float32)
    values = values + np.sin(np.linspace(0, 3, 90, dtype=np.float32))
    variant = next(
        variant
        for variant in peers()["SPERR"]
        if variant.layout == "frame" and variant.mode == "tolerance"
    )
    other = replace(
        variant,
        setting=lambda part, data_range, level: hdf5plugin.Sperr(
            absolute=data_range * 10 ** (-level / 20)
        ),
    )
    with (
        stored(values, variant, 6.0, 50.0) as file,
        stored(values.copy(), other, 6.0, 50.0) as file_without,
    ):
        assert stored_bytes(file) < 0.8 * stored_bytes(file_without)


def test_missing_values_are_filled_from_their_row_first() -> None:
    values = np.arange(24, dtype=np.float32).reshape(1, 2, 3, 4)
    broken = values.copy()
    broken[0, 0, 0, 1:3] = np.nan
    broken[0, 0, 1, 0] = np.inf
    broken[0, 1, 2] = np.nan
    result = filled(broken)
    known = np.isfinite(broken)
    np.testing.assert_array_equal(result[known], values[known])
    assert result[0, 0, 0].tolist() == [0, 0, 0, 3]
    assert result[0, 0, 1, 0] == 5
    np.testing.assert_array_equal(result[0, 1, 2], values[0, 1, 1])
