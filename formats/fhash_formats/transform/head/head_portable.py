"""The neighbourhood head's arithmetic in numpy: features of a tile's voxels and the network on them. native/head.cpp has the same bits.

Features and activations are integers held in float32, of at most 4095 either way; weights are integers of at most 31. A weighted sum of
up to 132 stays below 2**24: it is exact in whatever order it is formed, by BLAS as well. All else is elementwise, rounded step by step.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.head.inputs import CROSS, FEATURES, STEPS

__all__ = ["LIMIT", "apply_cross", "apply_network", "centre_features", "clip", "compress", "locate"]

Floats = npt.NDArray[np.float32]


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
    return (np.where(place < 1024, place, np.float32(1024)).astype(np.int32) - 512).astype(
        np.float32
    )


def apply_network(
    decoded: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats], low: np.float32, high: np.float32,
    inverse: np.float32, unit: np.float32,
) -> Floats:  # fmt: skip
    """Decoded values (t, z, y, x), each plus its correction, within [low, high].

    weights: (out, in) of each layer; a layer's output is sum * scale + bias. inverse: 1 / (2 sigma), which scales differences.
    """
    values = clip(decoded, low, high)
    out = np.empty_like(values)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # extreme constants may overflow on the way: the clip has the last word
        for step in range(len(values)):
            for start, features in _features(values, step, low, inverse, unit):
                centre = values[step, start : start + features.shape[1]]
                correction = _network(features.reshape(FEATURES, -1), weights, scales, biases)
                out[step, start : start + len(centre)] = clip(
                    centre + correction.reshape(centre.shape), low, high
                )
    return out


def apply_cross(
    decoded: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats], low: np.float32, high: np.float32,
    inverse: np.float32, unit: np.float32,
) -> Floats:  # fmt: skip
    """As `apply_network`, with a second layer over the cross: its weights are (out, 9 * in), the nine of each input together."""
    values = clip(decoded, low, high)
    steps, z, y, x = values.shape
    width = len(weights[0])
    out = np.empty_like(values)
    planes = max(1, _SLAB // (y * x))
    frames: dict[
        int, Floats
    ] = {}  # first-layer outputs of a frame, its edges repeated once along z, y, x
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(steps):
            for ahead in range(step, min(step + 2, steps)):
                if ahead not in frames:
                    first = np.empty((width, z, y, x), dtype=np.float32)
                    for start, features in _features(values, ahead, low, inverse, unit):
                        part = first[:, start : start + features.shape[1]]
                        part[...] = _hidden(
                            features.reshape(FEATURES, -1), weights[0], scales[0], biases[0]
                        ).reshape(part.shape)
                    frames[ahead] = np.pad(first, ((0, 0), (1, 1), (1, 1), (1, 1)), mode="edge")
            frames.pop(step - 2, None)
            for start in range(0, z, planes):
                stop = min(start + planes, z)
                taken = [
                    frames[min(max(step + dt, 0), steps - 1)][
                        :, 1 + start + dz : 1 + stop + dz, 1 + dy : 1 + dy + y, 1 + dx : 1 + dx + x
                    ]
                    for dt, dz, dy, dx in CROSS
                ]
                correction = _network(
                    np.stack(taken, axis=1).reshape(len(CROSS) * width, -1),
                    weights[1:],
                    scales[1:],
                    biases[1:],
                )
                centre = values[step, start:stop]
                out[step, start:stop] = clip(centre + correction.reshape(centre.shape), low, high)
    return out


def _features(
    values: Floats, step: int, low: np.float32, inverse: np.float32, unit: np.float32
) -> Iterator[tuple[int, Floats]]:
    """Of one frame of the clipped values, some planes at a time: the first plane, and the features (FEATURES, planes, y, x)."""
    steps, z, y, x = values.shape
    planes = max(1, _SLAB // (y * x))
    frames = {
        at: np.pad(values[min(max(step + at, 0), steps - 1)], _HALO, mode="edge")
        for at in (-1, 0, 1)
    }
    for start in range(0, z, planes):
        stop = min(start + planes, z)
        centre = values[step, start:stop]
        features = np.empty((FEATURES, *centre.shape), dtype=np.float32)
        for feature, (dt, dz, dy, dx) in zip(features, STEPS, strict=False):
            rows = slice(_HALO + start + dz, _HALO + stop + dz)
            neighbour = frames[dt][rows, _HALO + dy : _HALO + dy + y, _HALO + dx : _HALO + dx + x]
            feature[...] = compress((neighbour - centre) * inverse)
        features[-2:] = centre_features(centre, low, inverse, unit)
        yield start, features


def centre_features(
    centre: Floats, low: np.float32, inverse: np.float32, unit: np.float32
) -> Floats:
    """The two features of clipped values themselves, (2, ...)."""
    return np.stack([locate(centre, low, unit), compress((centre - low) * inverse)])


def _network(
    inputs: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats]
) -> Floats:
    for weight, scale, bias in zip(weights[:-1], scales[:-1], biases[:-1], strict=True):
        inputs = _hidden(inputs, weight, scale, bias)
    return _layer(inputs, weights[-1], scales[-1], biases[-1])


def _hidden(inputs: Floats, weight: Floats, scale: np.float32, bias: Floats) -> Floats:
    outputs = _layer(inputs, weight, scale, bias)
    leaky = np.where(outputs > 0, outputs, np.float32(0.125) * outputs)
    above = np.where(leaky > -LIMIT, leaky, -LIMIT)
    return np.rint(np.where(above < LIMIT, above, LIMIT))


def _layer(inputs: Floats, weight: Floats, scale: np.float32, bias: Floats) -> Floats:
    sums = weight @ inputs + np.float32(0)  # a sum of zeros is +0, whatever the signs of its terms
    return sums * scale + bias[:, None]
