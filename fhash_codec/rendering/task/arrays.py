"""The arrays that rays are marched with: numpy's on the host, or torch's on a device.

Marching calls functions that both libraries have under one name and with one meaning through
`Arrays.xp`. Where the libraries differ, `Arrays` has a method, which `TorchArrays` replaces. An
operation never mixes an array with a Python number of the other kind, integer or float: torch would
make float32 of them.

The host picks elements by a mask and works on those alone. On a device it would have to wait until
their number is known, which takes longer than work on all. So marching takes the `candidates` of a
mask and what is `kept` of their results, and lets the host wait only where the work is large.
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
    """The operations of numpy on the host.

    Attributes:
        xp: the library.
        device: the device of torch that holds tensors; None for arrays of numpy.
        batch: elements to work on at a time, so few that they stay in a processor's cache.
        leaps: leaps over invisible bricks after which the rays that arrived are left out.
        turns: turns of a search for roots after which those that are found are left out.
    """

    xp: Any = np
    device: Any = None
    batch = 1 << 15
    leaps = 1
    turns = 1

    def array(self, values: npt.ArrayLike, dtype: str | None = None) -> Array:
        """An array of numbers from the host, of their own type or of another, as 'float64'."""
        return np.asarray(values, dtype=dtype)

    def host(self, array: Array) -> npt.NDArray[Any]:
        """An array on the host with the numbers of an array of this library."""
        return np.asarray(array)

    def empty(self, shape: Sequence[int], dtype: str = "float64") -> Array:
        """An uninitialised array."""
        return np.empty(shape, dtype=dtype)

    def full(self, shape: Sequence[int] | int, value: float, dtype: str = "float64") -> Array:
        """An array of one number."""
        return np.full(shape, value, dtype=dtype)

    def range(self, count: int) -> Array:
        """The integers 0 .. count - 1, int64."""
        return np.arange(count)

    def to_int64(self, array: Array) -> Array:
        """Round an array towards 0 to int64."""
        return array.astype(np.int64)

    def to_float64(self, array: Array) -> Array:
        """Convert an array to float64."""
        return array.astype(np.float64)

    def to_float32(self, array: Array) -> Array:
        """Round an array to float32."""
        return array.astype(np.float32)

    def copy(self, array: Array) -> Array:
        """Copy an array."""
        return array.copy()

    def nonzero(self, array: Array) -> tuple[Array, ...]:
        """Indices of the elements that are not 0, one array for each axis, in C order."""
        return array.nonzero()  # type: ignore[no-any-return]

    def candidates(self, mask: Array) -> Array:
        """An index of elements (n,) with those of a mask (n,) among them; on the host no others."""
        return mask.nonzero()[0]

    def kept(self, mask: Array, results: Array, other: Array | float) -> Array:
        """Results (m, ...) for the candidates of a mask, and `other` for those not in the mask.

        mask: the mask at the candidates (m,).
        """
        return results

    def counts(self, *numbers: Array) -> list[int]:
        """Integers of no axis as numbers of Python, for one wait."""
        return [int(number) for number in numbers]

    def chosen(self, mask: Array, count: int) -> Array:
        """Indices (count,) of the elements of a mask (n,), whose number is known, ascending."""
        return mask.nonzero()[0]

    def take_along(self, array: Array, index: Array, axis: int) -> Array:
        """Pick the elements that `index` names from each line along an axis."""
        return np.take_along_axis(array, index, axis=axis)

    def add_rows(self, array: Array, rows: Array, values: Array) -> None:
        """Add values (m, k) to rows (m,) of an array (n, k), in order where a row is repeated."""
        width = array.shape[1]
        # Along one axis numpy is several times faster.
        np.add.at(
            array.reshape(-1),
            (rows[:, None] * width + np.arange(width)).reshape(-1),
            values.reshape(-1),
        )

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """A context that raises InputError where the memory of a device is not enough."""
        yield


NUMPY = Arrays()
"""The arrays of the host."""
