"""The arrays that rays are marched with: numpy's on the host, or torch's on a device (torch_arrays.py), by one set of operations.

Marching calls functions that both libraries have under one name and with one meaning through `Arrays.xp`; what differs is a method here.
Integers and floats are never mixed in one operation with a Python number: torch would make float32 of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["NUMPY", "Array", "Arrays"]

Array = Any
"""An array of numpy or a tensor of torch."""


class Arrays:
    """numpy on the host. xp: the library. batch: elements that are worked on at a time; what they take stays in a processor's cache."""

    xp: Any = np
    batch = 1 << 15

    def array(self, values: npt.ArrayLike, kind: str | None = None) -> Array:
        """Numbers of the host here, of their own kind or of another, as 'float64' or 'int64'."""
        return np.asarray(values, dtype=kind)

    def host(self, array: Array) -> npt.NDArray[Any]:
        """An array from here on the host."""
        return np.asarray(array)

    def empty(self, shape: Sequence[int], kind: str = "float64") -> Array:
        """Numbers of no meaning yet."""
        return np.empty(shape, dtype=kind)

    def full(self, shape: Sequence[int] | int, value: float, kind: str = "float64") -> Array:
        """One number everywhere."""
        return np.full(shape, value, dtype=kind)

    def range(self, count: int) -> Array:
        """0 .. count - 1, int64."""
        return np.arange(count)

    def whole(self, array: Array) -> Array:
        """As int64, towards 0."""
        return array.astype(np.int64)

    def real(self, array: Array) -> Array:
        """As float64."""
        return array.astype(np.float64)

    def single(self, array: Array) -> Array:
        """As float32."""
        return array.astype(np.float32)

    def copy(self, array: Array) -> Array:
        """The same numbers in memory of their own."""
        return array.copy()

    def nonzero(self, array: Array) -> tuple[Array, ...]:
        """Where an array is not 0, in rows: an index for each of its axes."""
        return array.nonzero()  # type: ignore[no-any-return]

    def take_along(self, array: Array, index: Array, axis: int) -> Array:
        """Of each line along an axis the elements that `index` names."""
        return np.take_along_axis(array, index, axis=axis)

    def add_rows(self, array: Array, rows: Array, values: Array) -> None:
        """Add values (m, k) to rows (m,) of an array (n, k), one after the other where a row is named more than once."""
        width = array.shape[1]
        # Along one axis numpy is some times faster.
        np.add.at(
            array.reshape(-1),
            (rows[:, None] * width + np.arange(width)).reshape(-1),
            values.reshape(-1),
        )

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Within it a device that has not enough memory raises InputError."""
        yield


NUMPY = Arrays()
