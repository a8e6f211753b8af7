"""The trained correction of decoded values: a small network that looks at a vertex's neighbours.

All numbers within the network are whole and small enough that their sums are exact in float32.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[Any]

LIMIT = np.float32(4095)
"""Largest magnitude of an input or activation."""
INPUT_UNIT, ACTIVATION_UNIT = 512.0, 128.0
"""Steps in 1 of inputs and of activations."""


def _along(axis: int, *moves: int) -> list[tuple[int, ...]]:
    return [tuple(move if i == axis else 0 for i in range(4)) for move in moves]


def _diagonal(one: int, other: int) -> list[tuple[int, ...]]:
    return [
        tuple(a if i == one else b if i == other else 0 for i in range(4))
        for a in (-1, 1)
        for b in (-1, 1)
    ]


OFFSETS = [
    *(place for axis in range(4) for place in _along(axis, -1, 1)),
    *(place for axis in (0, 2, 3) for place in _along(axis, -2, 2)),
    *(place for pair in ((2, 3), (0, 3), (0, 2)) for place in _diagonal(*pair)),
]
"""The 26 neighbours of a vertex, along t, z, y, x, in the order of the inputs. Where there is one
step, those along t are along z."""


class Layer(NamedTuple):
    """One layer: scale * (weights @ inputs) + biases."""

    weights: Floats
    scale: np.float32
    biases: Floats


class Head(NamedTuple):
    """A network, the error that it was trained for, and the range of its results."""

    layers: list[Layer]
    sigma: np.float32
    low: np.float32
    high: np.float32


def unpack_head(data: bytes) -> Head:
    """The head of its packed bytes."""
    count = data[0]
    widths = [*data[1 : 1 + count], 1]
    inputs = [len(OFFSETS) + 2, *widths[:-1]]
    sigma, low, high = (np.float32(v) for v in struct.unpack_from("<3f", data, 1 + count))
    at = 13 + count
    scales = [struct.unpack_from("<ee", data, at + 4 * layer) for layer in range(count + 1)]
    at += 4 * (count + 1)
    biases = []
    for width in widths:
        biases.append(np.frombuffer(data, np.int8, width, at).astype(np.float32))
        at += width
    layers = []
    for number, (weight_scale, bias_scale) in enumerate(scales):
        size = widths[number] * inputs[number]
        weights = np.frombuffer(data, np.int8, size, at).astype(np.float32)
        at += size
        matrix = weights.reshape(widths[number], inputs[number])
        unit_in = INPUT_UNIT if number == 0 else ACTIVATION_UNIT
        unit_out = sigma if number == count else np.float32(ACTIVATION_UNIT)
        with np.errstate(over="ignore"):
            scale = np.float32(weight_scale / unit_in) * unit_out
            shift = np.float32(bias_scale) * biases[number] * unit_out
        layers.append(Layer(matrix, scale, shift))
    if at != len(data):
        raise ValueError("the weights of a head do not end with its bytes")
    return Head(layers, sigma, low, high)


def apply_head(decoded: Floats, head: Head) -> Floats:
    """Decoded values (t, z, y, x), float32, each corrected and clipped."""
    values = clip(decoded, head.low, head.high)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        activations = np.stack(inputs_of(values, head))
        for layer in head.layers:
            outputs = np.tensordot(layer.weights, activations, 1) + np.float32(0)
            outputs = outputs * layer.scale + layer.biases.reshape(-1, 1, 1, 1, 1)
            leaky = np.where(outputs > 0, outputs, np.float32(0.125) * outputs)
            activations = np.rint(clip(leaky, -LIMIT, LIMIT))
        return clip(values + outputs[0], head.low, head.high)


def inputs_of(values: Floats, head: Head) -> list[Floats]:
    """The 28 inputs of each vertex, from clipped values: differences of its neighbours, its
    position in the range, and its distance from the lower end."""
    inverse = np.float32(0.5) / head.sigma
    places = [(0, t + z, y, x) if len(values) == 1 else (t, z, y, x) for t, z, y, x in OFFSETS]
    inputs = [compress((moved(values, place) - values) * inverse) for place in places]
    span = head.high - head.low
    unit = np.float32(1024) / span if span > 0 else np.float32(0)
    unit = unit if np.isfinite(unit) else np.float32(0)
    position = (values - head.low) * unit + np.float32(0.5)
    position = np.where(position < 1024, position, np.float32(1024))
    inputs.append((position.astype(np.int32) - 512).astype(np.float32))
    return [*inputs, compress((values - head.low) * inverse)]


def moved(values: Floats, offset: tuple[int, ...]) -> Floats:
    """The value at an offset from each vertex; indices are clamped to the tile."""
    for axis, by in enumerate(offset):
        n = values.shape[axis]
        values = values.take(np.clip(np.arange(n) + by, 0, n - 1), axis)
    return values


def clip(values: Floats, low: np.float32, high: np.float32) -> Floats:
    """Values in [low, high]; NaN becomes low."""
    raised = np.where(values > low, values, low)
    return np.where(raised < high, raised, high)


def compress(scaled: Floats) -> Floats:
    """floor(512 log2(1 + |d|)) with the sign of d, at most 4095; linear between powers of two."""
    bits = (np.abs(scaled) + np.float32(1)).view(np.int32)
    steps = np.minimum((bits - 0x3F800000) >> 14, int(LIMIT))
    return np.copysign(steps.astype(np.float32), scaled)
