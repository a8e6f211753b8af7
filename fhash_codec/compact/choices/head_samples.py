"""Training samples of the neighbourhood head: voxels drawn from decoded tiles.

Native code (fhash_codec/native/head_inputs.cpp) computes the inputs that the head itself computes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_formats.transform.entropy.coder import checked
from fhash_formats.transform.head.inputs import INPUTS, OFFSETS

__all__ = [
    "BATCH_VOXELS",
    "BLOCK_VOXELS",
    "ERROR_UNIT",
    "MAX_ERROR",
    "Batches",
    "ErrorRange",
    "Pair",
    "Voxels",
    "batches",
    "count_voxels",
    "draw",
]

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]

BATCH_VOXELS = 4096
"""Voxels of a training batch."""
BLOCK_VOXELS = 64
"""Voxels that the network computes together; train_head.hpp holds the same number."""
ERROR_UNIT = 16384.0
"""Integer steps in one sigma of a target."""
MAX_ERROR = 1 << 24
"""Largest magnitude of an error that a training sees, in these steps; larger ones are clipped."""
MAX_TARGET = 1 << 30
"""Largest magnitude of a target, in integer steps."""


class Pair(NamedTuple):
    """A decoded tile (t, z, y, x) with its original."""

    decoded: Floats
    original: npt.NDArray[Any]
    counted: npt.NDArray[np.bool_] | None
    """Mask of the voxels that count; None if all count."""


class Voxels(NamedTuple):
    """Voxels drawn from one tile."""

    places: npt.NDArray[np.int64]
    """Coordinates (4, n)."""
    values: Floats
    """Clipped decoded values (n,)."""
    originals: npt.NDArray[Any]
    """Original values (n,)."""


@dataclass(frozen=True, kw_only=True)
class ErrorRange:
    """Range of the values, and the error of the decoded values in it."""

    low: np.float32
    high: np.float32
    sigma: np.float32
    """Root of the mean squared error."""


@dataclass(frozen=True, kw_only=True)
class Batches:
    """Batches of n = blocks * BLOCK_VOXELS voxels."""

    inputs: npt.NDArray[np.int16]
    """Inputs of the network (batches, blocks, INPUTS, voxels looked at, BLOCK_VOXELS)."""
    targets: Integers
    """Original minus decoded values (batches, n), in units of sigma / ERROR_UNIT."""
    lowest: Integers
    """Lowest useful output (batches, n), in the same unit: a lower one is clipped."""
    highest: Integers
    """Highest useful output (batches, n), in the same unit."""

    def __len__(self) -> int:
        return len(self.targets)


def count_voxels(pairs: Sequence[Pair]) -> npt.NDArray[np.int64]:
    """Return the number of voxels that count in each tile."""
    return np.array(
        [
            pair.original.size if pair.counted is None else np.count_nonzero(pair.counted)
            for pair in pairs
        ],
        dtype=np.int64,
    )


def draw(
    pairs: Sequence[Pair],
    samples: int,
    random: np.random.Generator,
    low: np.float32,
    high: np.float32,
) -> list[Voxels]:
    """Draw voxels that count, from each tile according to its number of them.

    At least one must count.
    """
    counts = count_voxels(pairs)
    ends = np.rint(np.cumsum(counts) / counts.sum() * samples).astype(np.int64)
    drawn = []
    for pair, number in zip(pairs, np.diff(ends, prepend=0), strict=True):
        among = pair.original.size if pair.counted is None else np.flatnonzero(pair.counted)
        chosen = np.sort(random.choice(among, number)) if number else np.empty(0, np.int64)
        places = np.stack(np.unravel_index(chosen, pair.original.shape))
        values = pair.decoded.ravel()[chosen]
        values = np.where(values > low, values, low)  # NaN becomes low, as the head has it
        values = np.where(values < high, values, high)
        drawn.append(Voxels(places, values, pair.original.ravel()[chosen]))
    return drawn


def batches(
    pairs: Sequence[Pair],
    drawn: Sequence[Voxels],
    offsets: Sequence[tuple[int, ...]],
    random: np.random.Generator,
    value_range: ErrorRange,
) -> Batches:
    """Return the drawn voxels in random order, as the network sees them.

    offsets: places, relative to a voxel, of the voxels whose inputs are computed.
    """
    low, high, sigma = value_range.low, value_range.high, value_range.sigma
    values = np.concatenate([voxels.values for voxels in drawn])
    originals = np.concatenate([voxels.originals for voxels in drawn])
    order = random.permutation(len(values))
    count = len(values) // BATCH_VOXELS
    blocks = BATCH_VOXELS // BLOCK_VOXELS
    inputs = np.empty((count * blocks, INPUTS, len(offsets), BLOCK_VOXELS), dtype=np.int16)
    first = 0
    for pair, voxels in zip(pairs, drawn, strict=True):
        slots = order[first : first + len(voxels.values)]
        _fill_slots(inputs, slots, pair.decoded, voxels.places, offsets, value_range)
        first += len(slots)

    def batched(unordered: npt.NDArray[np.float64]) -> Integers:
        shuffled = np.empty_like(unordered)
        shuffled[order] = unordered
        steps = np.rint(shuffled * (ERROR_UNIT / np.float64(sigma)))
        return np.clip(steps, -MAX_TARGET, MAX_TARGET).astype(np.int32).reshape(count, BATCH_VOXELS)

    wide = values.astype(np.float64)
    return Batches(
        inputs=inputs.reshape(count, blocks, *inputs.shape[1:]),
        targets=batched(originals - wide),
        lowest=batched(low - wide),
        highest=batched(high - wide),
    )


def _fill_slots(
    inputs: npt.NDArray[np.int16],
    slots: npt.NDArray[np.int64],
    decoded: Floats,
    places: npt.NDArray[np.int64],
    offsets: Sequence[tuple[int, ...]],
    value_range: ErrorRange,
) -> None:
    """Write the inputs of voxels of a tile into their slots.

    inputs: of all voxels, (blocks, INPUTS, offsets, BLOCK_VOXELS).
    slots: number of each of the n voxels of this tile among all voxels.
    places: coordinates (4, n) of the voxels.
    """
    inverse, unit = _scales(value_range)
    # In the order of the slots: a voxel has its inputs in many places, near those of the next slot.
    order = np.argsort(slots)
    arrays: tuple[npt.NDArray[Any], ...] = (
        np.ascontiguousarray(decoded, dtype=np.float32),
        np.array(decoded.shape, np.int64),
        np.ascontiguousarray(places[:, order], np.int64),
        np.ascontiguousarray(slots[order], np.int64),
        np.array(OFFSETS, np.int64),
        np.array(offsets, np.int64),
    )
    tile, shape, at, to, neighbours, seen = (ctypes.c_void_p(each.ctypes.data) for each in arrays)
    code = checked(
        native.library().fhash_head_inputs(
            *(tile, shape, at, to, len(slots), neighbours, seen, len(offsets)),
            *(float(value_range.low), float(value_range.high), float(inverse), float(unit)),
            ctypes.c_void_p(inputs.ctypes.data),
        )
    )
    assert code == 0, "offsets within the reach of a head"


def _scales(value_range: ErrorRange) -> tuple[np.float32, np.float32]:
    """Return 1 / (2 sigma), which scales differences, and 1024 over the length of the range."""
    span = value_range.high - value_range.low
    unit = np.float32(1024) / span if span > 0 else np.float32(0)
    return np.float32(0.5) / value_range.sigma, unit
