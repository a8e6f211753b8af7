"""Products of lines: sums line after line, near those of a matrix product."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.compact.choices.gram import gram_of


def planes(shape: tuple[int, int, int], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    values = np.random.default_rng(sum(shape)).normal(3.0, 40.0, shape).astype(dtype)
    if values.dtype.kind == "f":
        values.flat[:: max(1, values.size // 5)] = [np.nan, np.inf, -np.inf, 1.0, 0.0, 2.0][
            : len(values.flat[:: max(1, values.size // 5)])
        ]
    return values


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
@pytest.mark.parametrize("shape", [(1, 1, 6), (200, 20, 1), (3, 37, 70), (2, 128, 65), (70, 9, 3)])
def test_lines_are_added_one_after_the_other(
    shape: tuple[int, int, int], dtype: npt.DTypeLike
) -> None:
    values = planes(shape, dtype)
    gram = gram_of(values, 0.3)
    lines = values.astype(np.float64).transpose(1, 0, 2).reshape(shape[1], -1) - 0.3
    lines[~np.isfinite(lines)] = 0.0
    added = np.zeros_like(gram)
    for plane in np.split(lines, shape[0], axis=1):
        for line in plane.T:
            added += line[:, None] * line
    np.testing.assert_array_equal(gram, added)
    # Sums of n products in another order differ by n roundings of the largest sum at most.
    bound = lines.shape[1] * np.finfo(np.float64).eps * np.max(np.sum(lines * lines, axis=1))
    np.testing.assert_allclose(gram, lines @ lines.T, rtol=0, atol=bound)


def test_values_beyond_the_type_leave_a_matrix_that_is_symmetric() -> None:
    values = np.full((1, 3, 2), 1e200)
    values[0, 1] = -1e200
    gram = gram_of(values, 0.0)
    np.testing.assert_array_equal(gram, gram.T)
    assert np.isinf(gram[0, 0])
