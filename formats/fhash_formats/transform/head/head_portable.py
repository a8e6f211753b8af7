"""The arithmetic of the neighbourhood head in numpy: the inputs of a tile's voxels and the network.

native/head.cpp computes the same bits. Inputs and activations are integers held in float32, of at
most 4095 either way; weights are integers of at most 31. A weighted sum of up to 132 of them stays
below 2**24, so it is exact in whatever order it is formed, by BLAS as well. All other operations
are elementwise and rounded one by one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from fhash_formats.transform.head.inputs import CROSS, INPUTS, OFFSETS

__all__ = ["LIMIT", "apply_cross", "apply_network", "centre_inputs", "clip", "compress", "locate"]

Floats = npt.NDArray[np.float32]


LIMIT = np.float32(4095)
"""Largest magnitude of an input or activation."""
_ONE_BITS = 0x3F800000
"""The bits of the float32 1.0."""
_HALO = 2
"""Farthest neighbour along an axis of space, in voxels."""
_SLAB = 1 << 16
"""Voxels whose inputs are held at once."""


def clip(values: Floats, low: np.float32, high: np.float32) -> Floats:
    """Values clipped to [low, high]; NaN becomes low."""
    # np.clip leaves the sign of zero open.
    raised = np.where(values > low, values, low)
    return np.where(raised < high, raised, high)


def compress(scaled: Floats) -> Floats:
    """floor(512 log2(1 + |d|)) with the sign of d, at most 4095.

    The logarithm is linear between powers of two, as the bits of a float are.
    """
    magnitude = np.abs(scaled)
    magnitude += np.float32(1)
    octaves = magnitude.view(np.int32)
    octaves -= _ONE_BITS
    octaves >>= 14
    np.minimum(octaves, int(LIMIT), out=octaves)
    return np.copysign(octaves.astype(np.float32), scaled)


def locate(values: Floats, low: np.float32, unit: np.float32) -> Floats:
    """The position of values >= low in the clip range, as integers in [-512, 512].

    unit: 1024 over the length of the range.
    """
    position = (values - low) * unit + np.float32(0.5)
    clipped = np.where(position < 1024, position, np.float32(1024))
    return (clipped.astype(np.int32) - 512).astype(np.float32)


def apply_network(
    decoded: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats], low:
        np.float32, high: np.float32,
    inverse: np.float32, unit: np.float32,
) -> Floats:  # fmt: skip
    """Decoded values (t, z, y, x), each plus its correction, clipped to [low, high].

    Args:
        decoded: decoded values.
        weights: (out, in) of each layer; the output of a layer is sum * scale + bias.
        scales: scale of each layer.
        biases: biases (out,) of each layer.
        low: lower end of the clip range.
        high: upper end of the clip range.
        inverse: 1 / (2 sigma), which scales differences.
        unit: 1024 over the length of the clip range.
    """
    values = clip(decoded, low, high)
    out = np.empty_like(values)
    # Extreme constants may overflow on the way; the final clip sets the result.
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(len(values)):
            for start, inputs in _inputs(values, step, low, inverse, unit):
                centre = values[step, start : start + inputs.shape[1]]
                correction = _network(inputs.reshape(INPUTS, -1), weights, scales, biases)
                out[step, start : start + len(centre)] = clip(
                    centre + correction.reshape(centre.shape), low, high
                )
    return out


def apply_cross(
    decoded: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats], low:
        np.float32, high: np.float32,
    inverse: np.float32, unit: np.float32,
) -> Floats:  # fmt: skip
    """Like `apply_network`, for a second layer that sees the first layer's outputs over the cross.

    The weights of that layer are (out, 9 * in), the nine of each input together.
    """
    values = clip(decoded, low, high)
    steps, z, y, x = values.shape
    out = np.empty_like(values)
    planes = max(1, _SLAB // (y * x))
    padded_outputs: dict[int, Floats] = {}
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(steps):
            for ahead in range(step, min(step + 2, steps)):
                if ahead not in padded_outputs:
                    inputs = _inputs(values, ahead, low, inverse, unit)
                    first = np.empty((len(weights[0]), z, y, x), dtype=np.float32)
                    _first_layer(inputs, weights[0], scales[0], biases[0], out=first)
                    padded_outputs[ahead] = np.pad(
                        first, ((0, 0), (1, 1), (1, 1), (1, 1)), mode="edge"
                    )
            padded_outputs.pop(step - 2, None)
            for start in range(0, z, planes):
                stop = min(start + planes, z)
                on_cross = [
                    padded_outputs[min(max(step + dt, 0), steps - 1)][
                        :, 1 + start + dz : 1 + stop + dz, 1 + dy : 1 + dy + y, 1 + dx : 1 + dx + x
                    ]
                    for dt, dz, dy, dx in CROSS
                ]
                correction = _network(
                    np.stack(on_cross, axis=1).reshape(len(CROSS) * len(weights[0]), -1),
                    weights[1:],
                    scales[1:],
                    biases[1:],
                )
                centre = values[step, start:stop]
                out[step, start:stop] = clip(centre + correction.reshape(centre.shape), low, high)
    return out


def _first_layer(
    slabs: Iterator[tuple[int, Floats]],
    weight: Floats,
    scale: np.float32,
    bias: Floats,
    out: Floats,
) -> None:
    """Write the outputs of the first layer for one frame into `out` (width, z, y, x).

    slabs: the inputs of the frame, as `_inputs` gives them.
    """
    for start, inputs in slabs:
        target = out[:, start : start + inputs.shape[1]]
        target[...] = _hidden(inputs.reshape(INPUTS, -1), weight, scale, bias).reshape(target.shape)


def _inputs(
    values: Floats, step: int, low: np.float32, inverse: np.float32, unit: np.float32
) -> Iterator[tuple[int, Floats]]:
    """The inputs of one frame of the clipped values, some planes at a time.

    Yields the first plane, and the inputs (INPUTS, planes, y, x).
    """
    steps, z, y, x = values.shape
    planes = max(1, _SLAB // (y * x))
    frames = {
        dt: np.pad(values[min(max(step + dt, 0), steps - 1)], _HALO, mode="edge")
        for dt in (-1, 0, 1)
    }
    for start in range(0, z, planes):
        stop = min(start + planes, z)
        centre = values[step, start:stop]
        inputs = np.empty((INPUTS, *centre.shape), dtype=np.float32)
        for target, (dt, dz, dy, dx) in zip(inputs, OFFSETS, strict=False):
            rows = slice(_HALO + start + dz, _HALO + stop + dz)
            neighbour = frames[dt][rows, _HALO + dy : _HALO + dy + y, _HALO + dx : _HALO + dx + x]
            target[...] = compress((neighbour - centre) * inverse)
        inputs[-2:] = centre_inputs(centre, low, inverse, unit)
        yield start, inputs


def centre_inputs(centre: Floats, low: np.float32, inverse: np.float32, unit: np.float32) -> Floats:
    """The two inputs that are functions of the clipped values themselves, (2, ...)."""
    return np.stack([locate(centre, low, unit), compress((centre - low) * inverse)])


def _network(
    inputs: Floats, weights: list[Floats], scales: list[np.float32], biases: list[Floats]
) -> Floats:
    """The correction (1, voxels) from the inputs (in, voxels) of the first of some layers."""
    for weight, scale, bias in zip(weights[:-1], scales[:-1], biases[:-1], strict=True):
        inputs = _hidden(inputs, weight, scale, bias)
    return _layer(inputs, weights[-1], scales[-1], biases[-1])


def _hidden(inputs: Floats, weight: Floats, scale: np.float32, bias: Floats) -> Floats:
    """The activations of a hidden layer: leaky, clipped, rounded."""
    outputs = _layer(inputs, weight, scale, bias)
    leaky = np.where(outputs > 0, outputs, np.float32(0.125) * outputs)
    above = np.where(leaky > -LIMIT, leaky, -LIMIT)
    return np.rint(np.where(above < LIMIT, above, LIMIT))


def _layer(inputs: Floats, weight: Floats, scale: np.float32, bias: Floats) -> Floats:
    """The outputs of a layer before its activation."""
    # Adding 0 makes a sum of zeros +0, whatever the signs of its terms.
    sums = weight @ inputs + np.float32(0)
    return sums * scale + bias[:, None]
