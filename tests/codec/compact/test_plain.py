"""Corrections take predicted values to decoded ones, of every number type."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.compact.plain import corrected, correction_of, correction_type, head_of, predicted
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
    for scale, value in ((0.1, 0.5), (0.25, 100.0), (0.25, np.nan), (1e-300, 0.5)):
        wrong = {**arrays, "mlp/weight_2": array("mlp/weight_2", [[value]], scale)}
        with pytest.raises(DamagedFileError, match=r"head|scale"):
            head_of(model, wrong)  # type: ignore[arg-type]
