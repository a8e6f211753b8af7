"""Arrays whose values lie in a file one after the other, without chunks: .npy and raw."""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError

BLOCK_BYTES = 8 * 2**20
"""Bytes read at once where the requested values are scattered, as with time fastest."""

SHORTEST_RUN = 16 * 2**10
"""Bytes below which a run of values is not worth a read of its own."""


class FlatArray:
    """An array of `shape` (slowest dimension first) and `dtype` from byte `offset` of a file on.

    It is read with seek and read: a memory map would kill the process if the file were cut
    meanwhile.
    """

    def __init__(
        self, path: Path, shape: tuple[int, ...], dtype: np.dtype[Any], *, offset: int = 0
    ) -> None:
        self.path, self.shape, self.dtype, self.offset = path, shape, dtype, offset

    @property
    def end(self) -> int:
        """The byte after the last value, which is the expected size of the file."""
        return self.offset + prod(self.shape) * self.dtype.itemsize

    def read(self, ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Values in ranges of the dimensions, one for each.

        Raises InputError where the file ends too early.
        """
        parts = [
            place
            for place, (part, length) in enumerate(zip(ranges, self.shape, strict=True))
            if part != slice(0, length)
        ]
        if len(parts) > 1:
            return self._read_parts(ranges, parts[0])
        place = parts[0] if parts else 0
        part = ranges[place]
        rows, inner = prod(self.shape[:place]), prod(self.shape[place + 1 :])
        result = np.empty((rows, (part.stop - part.start) * inner), self.dtype)
        with self.path.open("rb") as file:
            self._fill(file, result, self.shape[place] * inner, part.start * inner)
        return result.reshape(*self.shape[:place], part.stop - part.start, *self.shape[place + 1 :])

    def _read_parts(self, ranges: tuple[slice, ...], place: int) -> npt.NDArray[Any]:
        """Values in ranges of which several are parts; `place` is the slowest of these.

        Whatever lies behind an index along it is an array of its own.
        """
        inner = self.shape[place + 1 :]
        bytes_inside = prod(inner) * self.dtype.itemsize
        slow = [range(part.start, part.stop) for part in ranges[: place + 1]]
        result = np.empty([len(part) for part in slow] + _lengths(ranges[place + 1 :]), self.dtype)
        strides = [prod(self.shape[deeper + 1 : place + 1]) for deeper in range(place + 1)]
        for where in np.ndindex(*(len(part) for part in slow)):
            number = sum(
                part[index] * stride
                for part, index, stride in zip(slow, where, strides, strict=True)
            )
            offset = self.offset + number * bytes_inside
            array = FlatArray(self.path, inner, self.dtype, offset=offset)
            result[where] = array.read(ranges[place + 1 :])
        return result

    def _fill(self, file: BinaryIO, result: npt.NDArray[Any], stride: int, first: int) -> None:
        """Fill each row of the result from `first` on in each `stride` values of the file."""
        rows, run = result.shape
        item = self.dtype.itemsize
        if rows == 1 or run * item >= SHORTEST_RUN or stride * item > BLOCK_BYTES:
            for row in range(rows):
                self._read(file, result[row], row * stride + first)
            return
        together = max(1, BLOCK_BYTES // (stride * item))
        for row in range(0, rows, together):
            count = min(together, rows - row)
            block = np.empty(count * stride, self.dtype)
            self._read(file, block, row * stride)
            result[row : row + count] = block.reshape(count, stride)[:, first : first + run]

    def _read(self, file: BinaryIO, into: npt.NDArray[Any], start: int) -> None:
        file.seek(self.offset + start * self.dtype.itemsize)
        view = into.view(np.uint8).data
        done = 0
        while done < len(view):
            count = file.readinto(view[done:])  # type: ignore[attr-defined]
            if not count:
                raise InputError(
                    f"{self.path} ends after {file.tell()} bytes, {self.end} are needed"
                )
            done += count


def _lengths(ranges: tuple[slice, ...]) -> list[int]:
    return [part.stop - part.start for part in ranges]
