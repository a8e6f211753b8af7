"""The neighbourhood head's arithmetic in numpy: features of a tile's voxels and the network on them. native/head.cpp has the same bits.

Features and activations are integers held in float32, of at most 4095 either way; weights are integers of at most 31. A weighted sum of up
to 64 of them stays below 2**24: it is exact in whatever order it is formed, by BLAS as well. All else is elementwise, rounded step by step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["FEATURES", "LIMIT", "STEPS", "apply_network", "clip", "compress", "locate"]

Floats = npt.NDArray[np.float32]

STEPS: tuple[tuple[int, int, int, int], ...] = (
    *((step, 0, 0, 0) for step in (-1, 1)),
    *((0, step, 0, 0) for step in (-1, 1)),
    *((0, 0, step, 0) for step in (-1, 1)),
    *((0, 0, 0, step) for step in (-1, 1)),
    *((0, step, 0, 0) for step in (-2, 2)),
    *((0, 0, step, 0) for step in (-2, 2)),
    *((0, 0, 0, step) for step in (-2, 2)),
    *((0, 0, first, second) for first in (-1, 1) for second in (-1, 1)),
    *((0, first, 0, second) for first in (-1, 1) for second in (-1, 1)),
    *((0, first, second, 0) for first in (-1, 1) for second in (-1, 1)),
)
"""Steps along (t, z, y, x) from a voxel to its 26 neighbours, in the order of the features."""

FEATURES = len(STEPS) + 2
"""Inputs of the network: one per neighbour, two functions of the voxel's own value."""

LIMIT = np.float32(4095)
_ONE = 0x3F800000  # the bits of 1.0
_HALO = 2
_SLAB = 1 << 16  # voxels whose features are held at once


def clip(values: Floats, low: np.float32, high: np.float32) -> Floats:
    """Values within [low, high]; NaN becomes low. np.clip leaves the sign of zero open."""
    raised = np.where(values > low, values, low)
    return np.where(raised < high, raised, high)


def compress(scaled: Floats) -> Floats:
    """floor(512 log2(1 + |d|)) with the sign of d, at most 4095; linear between powers of two, as a float's bits have it."""
    magnitude = np.abs(scaled)
    magnitude += np.float32(1)
    octaves = magnitude.view(np.int32)
    octaves -= _ONE
    octaves >>= 14
    np.minimum(octaves, int(LIMIT), out=octaves)
    return np.copysign(octaves.astype(np.float32), scaled)


def locate(values: Floats, low: np.float32, unit: np.float32) -> Floats:
    """The place of values >= low in the clip range as integers in [-512, 512]; unit is 1024 over the range's length."""
    place = (values - low) * unit + np.float32(0.5)
    return (np.where(place < 1024, place, np.float32(1024)).astype(np.int32) - 512).astype(np.float32)


def apply_network(
    decoded: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats], low: np.float32, high: np.float32,
    inverse: np.float32, unit: np.float32,
) -> Floats:  # fmt: skip
    """Decoded values (t, z, y, x), each plus its correction, within [low, high].

    weights: (out, in) of each layer; a layer's output is sum * scale + bias. inverse: 1 / (2 sigma), which scales differences.
    """
    values = clip(decoded, low, high)
    steps, z, y, x = values.shape
    out = np.empty_like(values)
    planes = max(1, _SLAB // (y * x))
    with np.errstate(over="ignore", invalid="ignore"):  # extreme constants may overflow on the way: the clip has the last word
        for step in range(steps):
            frames = {at: np.pad(values[min(max(step + at, 0), steps - 1)], _HALO, mode="edge") for at in (-1, 0, 1)}
            for start in range(0, z, planes):
                stop = min(start + planes, z)
                centre = values[step, start:stop]
                features = np.empty((FEATURES, *centre.shape), dtype=np.float32)
                for feature, (dt, dz, dy, dx) in zip(features, STEPS, strict=False):
                    rows = slice(_HALO + start + dz, _HALO + stop + dz)
                    neighbour = frames[dt][rows, _HALO + dy : _HALO + dy + y, _HALO + dx : _HALO + dx + x]
                    feature[...] = compress((neighbour - centre) * inverse)
                features[-2] = locate(centre, low, unit)
                features[-1] = compress((centre - low) * inverse)
                correction = _network(features.reshape(FEATURES, -1), weights, scales, biases)
                out[step, start:stop] = clip(centre + correction.reshape(centre.shape), low, high)
    return out


def _network(inputs: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats]) -> Floats:
    last = len(weights) - 1
    for layer, (weight, scale, bias) in enumerate(zip(weights, scales, biases, strict=True)):
        sums = weight @ inputs + np.float32(0)  # a sum of zeros is +0, whatever the signs of its terms
        outputs = sums * scale + bias[:, None]
        if layer < last:
            leaky = np.where(outputs > 0, outputs, np.float32(0.125) * outputs)
            above = np.where(leaky > -LIMIT, leaky, -LIMIT)
            outputs = np.rint(np.where(above < LIMIT, above, LIMIT))
        inputs = outputs
    return inputs
