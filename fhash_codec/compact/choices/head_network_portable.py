"""The training of a head's network in numpy; native/train_head.cpp computes the same numbers.

`head_network` states the arithmetic. Matrices of float64 hold integers, and their products are
exact in whatever order BLAS forms them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.choices.head_samples import (
    BLOCK_VOXELS,
    ERROR_UNIT,
    MAX_ERROR,
    Batches,
)
from fhash_formats.transform.head.head import MAX_BIAS, MAX_WEIGHT
from fhash_formats.transform.head.inputs import INPUTS

__all__ = [
    "BETA1",
    "BETA2",
    "MAX_INTEGERS",
    "file_scale",
    "integers",
    "layer_arrays",
    "learn",
    "squared_errors",
]

Doubles = npt.NDArray[np.float64]

BETA1 = 0.9
"""Decay of Adam's mean of gradients per update."""
BETA2 = 0.999
"""Decay of Adam's mean of squared gradients per update."""
EPSILON = 1e-8
"""Number added to the root of the mean square before it divides."""
MAX_NORM = 1.0
"""Norm to which longer gradients are shortened."""
MAX_PARAMETER = 64.0
"""Largest magnitude of a weight or bias in training."""
MAX_INTEGERS = (MAX_WEIGHT, MAX_BIAS)
"""Largest magnitudes of the weights and of the biases in the file."""
MIN_SCALE = 1e-6
"""Least unit of weights and biases in the file."""
WEIGHT_UNIT = 65536.0
"""Integer steps in 1 of a weight that is not rounded as in the file."""
INPUT_UNIT = 512.0
"""Integer steps in 1 of an input."""
ACTIVATION_UNIT = 128.0
"""Integer steps in 1 of an activation."""
MAX_ACTIVATION = 4095.0
"""Largest magnitude of an activation, in integer steps."""
BLOCKS_AT_ONCE = 2
"""Blocks of voxels that are computed together."""
LEAK = 0.125
"""Slope of the leaky unit below 0."""


class _Layer(NamedTuple):
    """A layer as it is used: outputs = scale * integers @ inputs + biases."""

    integers: Doubles
    """Integers of the weights (out, in)."""
    scale: float
    """Unit of these integers."""
    biases: Doubles
    """Biases (out,)."""


class _Pass(NamedTuple):
    """Some n voxels in the network, which looks at m voxels for each; all are integers."""

    inputs: Doubles
    """Inputs (INPUTS, m * n)."""
    first: Doubles
    """Activations of the first layer (out * m, n)."""
    second: Doubles
    """Activations of the second layer (out, n)."""
    errors: Doubles
    """Corrected minus original values (1, n)."""
    slopes: Doubles
    """Errors whose output was not clipped; 0 for the others (1, n)."""


def layer_arrays(
    parameters: Doubles, widths: tuple[int, int], looked_at: int
) -> list[tuple[Doubles, Doubles]]:
    """Return views of the weights (out, in) and biases (out,) of each layer."""
    arrays, at = [], 0
    for inputs, outputs in (
        (INPUTS, widths[0]),
        (widths[0] * looked_at, widths[1]),
        (widths[1], 1),
    ):
        end = at + outputs * inputs
        arrays.append(
            (parameters[at:end].reshape(outputs, inputs), parameters[end : end + outputs])
        )
        at = end + outputs
    return arrays


def file_scale(values: Doubles, most: int) -> float:
    """Return the float16 unit that maps the largest magnitude to an integer of at most `most`."""
    return float(np.float16(max(float(np.abs(values).max()) / most, MIN_SCALE)))


def integers(values: Doubles, scale: float, most: float) -> Doubles:
    """Return values in units of a scale, as integers of at most `most` either way."""
    return np.clip(np.rint(values / scale), -most, most)


def learn(
    voxels: Batches,
    widths: tuple[int, int],
    state: tuple[Doubles, Doubles, Doubles],
    first: int,
    rates: Doubles,
    roots: Doubles,
    *,
    as_in_file: bool,
) -> None:
    """Do the updates of `Network.learn` in place; state: parameters, means and squares."""
    parameters, means, squares = state
    for update, (rate, root) in enumerate(zip(rates, roots, strict=True), first):
        gradient = _gradient(voxels, update % len(voxels), widths, parameters, as_in_file)
        norm = np.sqrt(np.add.accumulate(gradient * gradient)[-1])
        slope = gradient * (MAX_NORM / norm if norm > MAX_NORM else 1.0)
        means[:] = means + (slope - means) * (1 - BETA1)
        squares[:] = squares + (slope * slope - squares) * (1 - BETA2)
        move = rate * means / (np.sqrt(squares) * root + EPSILON)
        parameters[:] = np.clip(parameters - move, -MAX_PARAMETER, MAX_PARAMETER)


def squared_errors(
    voxels: Batches, widths: tuple[int, int], parameters: Doubles, *, as_in_file: bool
) -> list[int]:
    """Return the figures of `Network.squared_errors`."""
    layers = _used(parameters, widths, voxels.inputs.shape[3], as_in_file)
    sums = []
    for batch in range(len(voxels)):
        total = 0
        for done in _forward(voxels, batch, layers):
            errors = done.errors.astype(np.int64)
            total += int((errors * errors).sum())
        sums.append(total)
    return sums


def _used(
    parameters: Doubles, widths: tuple[int, int], looked_at: int, as_in_file: bool
) -> list[_Layer]:
    """Return the layers as they are used."""
    layers = []
    for weights, biases in layer_arrays(parameters, widths, looked_at):
        if as_in_file:
            scale, unit = (
                file_scale(values, most)
                for values, most in zip((weights, biases), MAX_INTEGERS, strict=True)
            )
            used = integers(biases, unit, MAX_BIAS) * unit
            layers.append(_Layer(integers(weights, scale, MAX_WEIGHT), scale, used))
        else:
            scale = 1 / WEIGHT_UNIT
            finest = integers(weights, scale, WEIGHT_UNIT * MAX_PARAMETER)
            layers.append(_Layer(finest, scale, biases))
    return layers


def _forward(voxels: Batches, batch: int, layers: list[_Layer]) -> Iterator[_Pass]:
    """Yield a batch in the network, some blocks at a time, which fit the cache."""
    one, two, three = layers
    scale = one.scale * (ACTIVATION_UNIT / INPUT_UNIT)
    for start in range(0, voxels.inputs.shape[1], BLOCKS_AT_ONCE):
        blocks = slice(start, start + BLOCKS_AT_ONCE)
        # The voxels looked at become inputs of the second layer, ordered by the output of the
        # first layer, then by voxel.
        inputs = voxels.inputs[batch, blocks].transpose(1, 2, 0, 3).astype(np.float64)
        looked_at = inputs.shape[1]
        inputs = inputs.reshape(INPUTS, -1)
        size = inputs.shape[1] // looked_at
        first = _activations(one.integers @ inputs, scale, one.biases).reshape(-1, size)
        second = _activations(two.integers @ first, two.scale, two.biases)
        outputs = (three.integers @ second) * (three.scale * (ERROR_UNIT / ACTIVATION_UNIT))
        outputs = np.rint(outputs + three.biases * ERROR_UNIT)
        at = slice(start * BLOCK_VOXELS, start * BLOCK_VOXELS + size)
        clipped: Doubles = np.maximum(outputs, voxels.lowest[batch, at])
        clipped = np.minimum(clipped, voxels.highest[batch, at])
        errors: Doubles = np.clip(
            clipped - voxels.targets[batch, at], float(-MAX_ERROR), float(MAX_ERROR)
        )
        yield _Pass(inputs, first, second, errors, np.where(clipped == outputs, errors, 0.0))


def _activations(sums: Doubles, scale: float, biases: Doubles) -> Doubles:
    """Return the activations of a hidden layer: leaky, clipped, rounded half to even."""
    values = sums * scale + (biases * ACTIVATION_UNIT)[:, None]
    leaky: Doubles = np.maximum(values, LEAK * values)
    return np.rint(np.clip(leaky, -MAX_ACTIVATION, MAX_ACTIVATION))


def _gradient(
    voxels: Batches, batch: int, widths: tuple[int, int], parameters: Doubles, as_in_file: bool
) -> Doubles:
    """Return the gradient of the mean squared error of a batch by the parameters (n,)."""
    layers = _used(parameters, widths, voxels.inputs.shape[3], as_in_file)
    sums = [np.zeros((len(each.biases), each.integers.shape[1] + 1)) for each in layers]
    for done in _forward(voxels, batch, layers):
        second = _descended(done.slopes, layers[2], done.second)
        first = _descended(second, layers[1], done.first).reshape(widths[0], -1)
        for total, slopes, inputs in zip(
            sums,
            (first, second, done.slopes),
            (done.inputs, done.first, done.second),
            strict=True,
        ):
            total[:, :-1] += slopes @ inputs.T
            total[:, -1] += slopes.sum(axis=1)
    per_voxel = 2 / (ERROR_UNIT * voxels.targets.shape[1])
    parts = []
    for total, unit in zip(sums, (INPUT_UNIT, ACTIVATION_UNIT, ACTIVATION_UNIT), strict=True):
        parts += [total[:, :-1].ravel() * (per_voxel / unit), total[:, -1] * per_voxel]
    return np.concatenate(parts)


def _descended(slopes: Doubles, layer: _Layer, activations: Doubles) -> Doubles:
    """Return the slopes of the sums of the layer before a layer, from those of its own sums."""
    leaky = np.where(activations > 0, 1.0, LEAK)
    before = (layer.integers.T @ slopes) * layer.scale * leaky
    return np.rint(np.clip(before, -MAX_ERROR, MAX_ERROR))
