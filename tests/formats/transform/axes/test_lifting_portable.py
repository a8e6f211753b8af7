"""The portable twin of the transform: the bits of the native library, and one level by itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from specs import MIXES, SHAPES, TYPES, mixes_and_depths, noise, spec_of

from fhash_formats import native
from fhash_formats.transform.axes.lifting import Transform
from fhash_formats.transform.axes.lifting_portable import forward_axis, inverse_axis
from fhash_formats.transform.axes.spec import WAVELETS


@pytest.mark.skipif(native.library() is None, reason="the native library was not built here")
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize(
    ("kinds", "depths"), mixes_and_depths(MIXES, [(1, 1, 1, 1), (2, 3, 4, 4), (2, 1, 3, 5)])
)
@pytest.mark.parametrize("shape", SHAPES)
def test_both_engines_give_the_same_bits(
    shape: tuple[int, ...],
    kinds: tuple[str, ...],
    depths: tuple[int, ...],
    dtype: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec = spec_of(kinds, depths, shape, step=2.0)
    values = noise(shape, dtype, 1) * dtype(100)
    results = []
    for setting in ("1", "0"):
        monkeypatch.setenv("FHASH_NATIVE", setting)
        transform = Transform(spec, shape, dtype)
        coefficients = transform.forward(values)
        results.append([coefficients, *(transform.inverse(values, lod) for lod in (0, 1, 2, 5))])
    for native_result, portable_result in zip(*results, strict=True):
        assert native_result.shape == portable_result.shape
        assert native_result.tobytes() == portable_result.tobytes()


@pytest.mark.parametrize("kind", WAVELETS)
@pytest.mark.parametrize("n", [1, 2, 3, 8, 13])
@pytest.mark.parametrize("axis", [0, 1])
def test_one_level_comes_back(kind: str, n: int, axis: int) -> None:
    values = np.moveaxis(noise((n, 3), np.float64), 0, axis)
    again = inverse_axis(forward_axis(values, axis, kind), axis, kind)
    assert np.allclose(again, values, rtol=0, atol=1e-14)


def test_a_haar_level_is_means_and_differences() -> None:
    values = np.array([1.0, 4.0, 2.0, 8.0, 5.0])
    assert forward_axis(values, 0, "haar").tolist() == [2.5, 5.0, 5.0, 3.0, 6.0]
