"""Scores of a mask's levels, and small blocks of integers that settings pack."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from itertools import pairwise
from math import prod

import numpy as np

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.support.arrays import Integers

NO_MEMORY = -2
"""Code that a native function returns where it had no memory; twin of `NO_MEMORY` in guard.hpp."""


def encode_block(integers: Integers) -> bytes:
    """Code a small block of int32 integers (four axes) that stands alone."""
    given = np.ascontiguousarray(integers, np.int32)
    room = np.empty(8 * given.size + 4096, np.uint8)
    shape = (ctypes.c_int64 * 4)(*given.shape)
    if not given.size:
        return b""
    size = checked(
        native.library().fhash_encode_block(given.ctypes.data, shape, room.ctypes.data, room.size)
    )
    assert 0 <= size <= room.size, "eight bytes are enough for an integer"
    return room[:size].tobytes()


def decode_block(data: bytes | memoryview, shape: tuple[int, ...]) -> Integers:
    """The block that `encode_block` coded.

    Raises DamagedFileError for bytes that no encoder writes, as far as the decoder can tell.
    """
    if prod(shape) == 0:
        if len(data):
            raise DamagedFileError("bytes where nothing is coded")
        return np.zeros(shape, dtype=np.int32)
    integers, source = np.zeros(shape, np.int32), np.frombuffer(data, np.uint8)
    code = native.library().fhash_decode_block(
        source.ctypes.data, source.size, (ctypes.c_int64 * 4)(*shape), integers.ctypes.data
    )
    if checked(code) < 0:
        raise DamagedFileError("the coded integers are damaged")
    return integers


def checked(code: int) -> int:
    """The code that a native function returned; raises MemoryError where it is NO_MEMORY."""
    if code == NO_MEMORY:
        raise MemoryError("no memory for the work of a native function")
    return code


MAX_LABELS = 65536
"""Most labels of a tile."""

MAX_EDGES = 15
"""Most edges between classes of values."""
MAX_REACH = 64
"""Largest reach, in vertices."""
MAX_SCORE = 4095
"""Largest score, and largest sum of scores."""
MAX_FLOAT = float(np.finfo(np.float64).max)
"""Largest magnitude of an edge."""
UNIT = 128
"""Scores per bit."""


@dataclass(frozen=True, kw_only=True)
class MaskLevels:
    """Scores of the decoded values; raises InputError for values that are not allowed.

    Attributes:
        edges: at most MAX_EDGES ascending numbers; class i holds the values from edge i - 1 on and
            below edge i.
        scores: score of each class, 0 to MAX_SCORE, in 1/UNIT bit.
        others: scores for the second level; without them it is the level of the vertex alone by
            `scores`.
        reach: vertices along z, y and x by which a feature was grown, 0 to MAX_REACH.
    """

    edges: tuple[float, ...] = ()
    scores: tuple[int, ...] = (0,)
    others: tuple[int, ...] = ()
    reach: int = 0

    def __post_init__(self) -> None:
        numbers = all(type(edge) in (int, float) and abs(edge) <= MAX_FLOAT for edge in self.edges)
        if (
            len(self.edges) > MAX_EDGES
            or not numbers
            or any(low >= high for low, high in pairwise(self.edges))
        ):
            raise InputError(
                f"edges of a mask are {self.edges!r:.80}; "
                f"at most {MAX_EDGES} ascending numbers are needed"
            )
        for scores in (self.scores, *([self.others] if self.others else [])):
            if len(scores) != len(self.edges) + 1 or not all(
                type(n) is int and 0 <= n <= MAX_SCORE for n in scores
            ):
                raise InputError(
                    f"scores of a mask are {scores!r:.80}; "
                    f"{len(self.edges) + 1} whole numbers to {MAX_SCORE} are needed"
                )
        if type(self.reach) is not int or not 0 <= self.reach <= MAX_REACH:
            raise InputError(
                f"reach of a mask is {self.reach!r:.40}; a whole number to {MAX_REACH} is needed"
            )
