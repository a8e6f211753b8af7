"""Settings and strategies of the property-based tests.

`make test` tries few examples, always the same ones; the long set tries many new ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from reporting import LONG

INTEGERS = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
FLOATS = ("float16", "float32", "float64")
NUMBERS = (*INTEGERS, *FLOATS)


def looking(few: int, many: int = 2000) -> settings:
    """Return the settings of a test: `few` examples, or `many` in the long set."""
    return settings(
        max_examples=many if LONG else few,
        derandomize=not LONG,
        deadline=None,
        database=None,
        print_blob=True,
        # A failure of the quick set is reproducible. Shrinking it takes minutes and is left to the
        # long set.
        phases=list(Phase) if LONG else [Phase.explicit, Phase.generate],
        suppress_health_check=[
            HealthCheck.too_slow,
            HealthCheck.data_too_large,
            HealthCheck.function_scoped_fixture,
        ],
    )


def arrays(
    dtypes: tuple[str, ...] = NUMBERS, *, dims: tuple[int, int] = (4, 4), side: int = 6
) -> st.SearchStrategy[np.ndarray]:
    """Draw arrays of any numbers, with NaN, infinities, denormals and signed zeros."""
    shapes = hnp.array_shapes(min_dims=dims[0], max_dims=dims[1], min_side=1, max_side=side)
    return st.sampled_from(dtypes).flatmap(lambda dtype: hnp.arrays(np.dtype(dtype), shapes))


def chunks(shape: tuple[int, ...]) -> st.SearchStrategy[tuple[int, ...]]:
    """Draw the shape of a chunk of an array: from one vertex to all, along each axis."""
    return st.tuples(*(st.integers(1, length) for length in shape))


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two arrays have the same type, shape and values.

    The signs of zeros must be the same; all NaN are alike.
    """
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    if one.dtype.kind != "f":
        return bool((one == other).all())
    return bool(
        (
            ((one == other) & (np.signbit(one) == np.signbit(other)))
            | (np.isnan(one) & np.isnan(other))
        ).all()
    )


def one_line(error: Exception) -> None:
    """Assert that the message of an error is one line of reasonable length."""
    text = str(error)
    assert text
    assert "\n" not in text
    assert len(text) < 500


Draw = Any
"""The type of the argument that `st.data()` and `st.composite` give."""
