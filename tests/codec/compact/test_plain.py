"""Corrections take predicted values to decoded ones, of every number type."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.compact.plain import (
    PlainArray,
    corrected,
    correction_of,
    correction_type,
    head_of,
    predicted,
)
from fhash_formats.errors import DamagedFileError


@pytest.mark.parametrize("dtype", ["int8", "uint8", "int16", "uint32", "int64", "uint64"])
def test_integers_come_back_exactly(dtype: str) -> None:
    limits = np.iinfo(dtype)
    values = np.array([limits.min, limits.max, limits.max - 1, 7], dtype)
    base = predicted(values.astype(np.float64).reshape(1, 1, 1, 4), None, values.dtype)
    corrections = correction_of(values, base.ravel())
    assert corrections.dtype == correction_type(values.dtype)
    np.testing.assert_array_equal(corrected(base.ravel(), corrections), values)


@pytest.mark.parametrize(("dtype", "kind"), [("float16", "f4"), ("float32", "f4"), ("f8", "f8")])
def test_floats_come_back_and_what_is_not_finite_has_no_correction(dtype: str, kind: str) -> None:
    values = np.array([1.5, -3.25, np.nan, np.inf], dtype)
    base = np.array([1.25, -3.25, 1, 1], dtype)
    corrections = correction_of(values, base)
    np.testing.assert_array_equal(corrections, [0.25, 0, 0, 0])
    assert corrections.dtype == np.dtype(kind)
    np.testing.assert_array_equal(corrected(base, corrections)[:2], values[:2])


def test_a_head_that_is_no_head_is_damage() -> None:
    model = {"head": {"hidden": [1], "cross": False, "sigma": 1.0, "low": 0.0, "high": 1.0}}
    assert head_of({"head": None}, {}) is None

    def array(name: str, values: object, scale: float) -> SimpleNamespace:
        read = np.asarray(values, np.float32)
        return SimpleNamespace(name=name, attributes={"scale": scale}, read=lambda: read)

    arrays = {
        "mlp/weight_1": array("mlp/weight_1", np.full((1, 28), 0.5), 0.25),
        "mlp/bias_1": array("mlp/bias_1", [0.5], 0.25),
        "mlp/weight_2": array("mlp/weight_2", [[0.5]], 0.25),
        "mlp/bias_2": array("mlp/bias_2", [0.5], 0.25),
    }
    head = head_of(model, arrays)  # type: ignore[arg-type]
    assert head is not None
    assert head.layers[0].weights.tolist() == [[2] * 28]
    for scale, value in ((0.1, 0.55), (0.25, 100.0), (0.25, np.nan), (1e-300, 0.5), (0.2, 0.5)):
        wrong = {**arrays, "mlp/weight_2": array("mlp/weight_2", [[value]], scale)}
        with pytest.raises(DamagedFileError, match=r"head|scale"):
            head_of(model, wrong)  # type: ignore[arg-type]


def plain_array(corrections: object, dtype: str, *, tile: int = 2) -> PlainArray:
    """A plain array of the values 0 to 3 along x, without a head."""
    table = np.arange(4, dtype=np.float32).reshape(1, 1, 1, 4, 1)
    added = np.asarray(corrections, np.float64).reshape(1, 1, 1, 4)
    arrays = {
        "tables/level_1": SimpleNamespace(shape=table.shape, read=lambda region: table[region]),
        "corrections": SimpleNamespace(read=lambda region: added[region]),
    }
    model = {"tile": [1, 1, 1, tile], "values": dtype, "head": None, "levels": [[1, 1, 1, 4]]}
    return PlainArray(model, arrays)  # type: ignore[arg-type]


ALL = (*[slice(0, 1)] * 3, slice(0, 4))


@pytest.mark.parametrize("dtype", ["int16", "int64", "float32", "float64"])
def test_without_a_head_any_region_is_read_at_once(dtype: str) -> None:
    for tile in (1, 3, 1 << 40):
        array = plain_array([5, 0, -1, 0], dtype, tile=tile)
        np.testing.assert_array_equal(array.read(ALL).ravel(), [5, 1, 1, 3])
        assert array.read((*ALL[:3], slice(2, 3))).item() == 1
        assert array.read(ALL).dtype == dtype


@pytest.mark.parametrize("dtype", ["int16", "float64"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_corrections_that_are_not_finite_are_damage(dtype: str, wrong: float) -> None:
    with pytest.raises(DamagedFileError, match="corrections has numbers beyond"):
        plain_array([0, wrong, 0, 0], dtype).read(ALL)


def test_corrections_of_integers_are_within_64_bits() -> None:
    most = 2.0**63
    array = plain_array([0, -most, 0, 0], "int64")
    np.testing.assert_array_equal(array.read(ALL).ravel(), [0, 1 - 2**63, 2, 3])
    with pytest.raises(DamagedFileError, match="corrections has numbers beyond"):
        plain_array([0, np.nextafter(most, np.inf), 0, 0], "int64").read(ALL)
    assert plain_array([0, 2.0**70, 0, 0], "float64").read(ALL)[0, 0, 0, 1] == 2.0**70
