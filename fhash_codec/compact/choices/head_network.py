"""The network of a head in training: weights, biases and Adam's means of them.

The source of Adam is Kingma and Ba 2015, algorithm 1. The C++ (fhash_codec/native/train_head.cpp)
gives the same bits with any number of threads and on any machine: every sum over voxels is a sum of
integers, and is exact in whatever order it is formed.

- Inputs are integers of 1/512, activations of 1/128 and at most 4095 units, both as in the decoder.
- Weights are integers of 1/65536 in a product, or, `as_in_file`, those that the file would hold.
- Errors are integers of 2**-14 sigma. Slopes, which are derivatives of half the squared error by
  the sums of a layer, have the same unit. Both are limited to 2**24 units.

No weight exceeds 64, no layer has more than 64 outputs or 576 inputs, and a batch has 4096 voxels,
each of which looks at up to 9. Products of slopes with weights (24 + 22 bits, 64 terms) and with
inputs (24 + 12 bits, 2**16 terms) thus stay below 2**53, up to which a float64 holds every integer.
All else is computed one operation at a time, in a stated order, without functions whose last bit
depends on the machine.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.compact.choices.head_samples import Batches
from fhash_formats.transform.head.head import MAX_BIAS, MAX_WEIGHT, Layer, Scaled, layer_inputs
from fhash_formats.transform.head.inputs import INPUTS

__all__ = ["Network", "adam_factors"]

Doubles = npt.NDArray[np.float64]

BETA1 = 0.9
"""Decay of Adam's mean of gradients per update."""
BETA2 = 0.999
"""Decay of Adam's mean of squared gradients per update."""
MIN_SCALE = 1e-6
"""Least unit of weights and biases in the file."""


def adam_factors(rates: Doubles) -> tuple[Doubles, Doubles]:
    """Return the learning rates and the factors of Adam's root, corrected for its start.

    rates: learning rate of each update from the first one on, (updates,).
    """
    # Products one after the other: the last bit of a power depends on the machine.
    first, second = (
        1 - np.multiply.accumulate(np.full(len(rates), beta)) for beta in (BETA1, BETA2)
    )
    return rates / first, 1 / np.sqrt(second)


class Network:
    """A head with two hidden layers in training.

    Attributes:
        widths: outputs of the hidden layers.
        looked_at: voxels whose first layer the second layer sees: 1, or 9 for a cross.
        parameters: weights (out, in) and biases (out,) of each layer in turn, float64 (n,).
        means: Adam's means of the gradients, likewise.
        squares: Adam's means of the squared gradients, likewise.
    """

    def __init__(self, widths: tuple[int, int], looked_at: int, random: np.random.Generator):
        """Begin with uniform random numbers; the last layer begins near 0."""
        self.widths, self.looked_at = widths, looked_at
        rows = [*widths, 1]
        columns = layer_inputs(widths, cross=looked_at > 1)
        parts = []
        for number, (out, count) in enumerate(zip(rows, columns, strict=True)):
            reach = 1 / np.sqrt(np.float64(count))
            last = number == len(rows) - 1
            weights = random.uniform(-1, 1, size=out * count) * reach
            biases = random.uniform(-1, 1, size=out) * reach
            parts += [weights * 0.1 if last else weights, biases * 0.0 if last else biases]
        self.parameters: Doubles = np.concatenate(parts)
        self.means, self.squares = np.zeros((2, len(self.parameters)))

    def learn(
        self,
        voxels: Batches,
        first: int,
        rates: Doubles,
        roots: Doubles,
        *,
        as_in_file: bool,
    ) -> None:
        """Do some updates. Update u learns from batch u % batches.

        first: number of the first of these updates.
        rates, roots: `adam_factors` of these updates.
        as_in_file: whether weights and biases are rounded as in the file. Gradients pass through
            the rounding unchanged.
        """
        factors = np.ascontiguousarray(rates), np.ascontiguousarray(roots)
        _check(
            native.library().fhash_head_learn(
                *self._arguments(voxels),
                *map(_address, (self.parameters, self.means, self.squares, *factors)),
                first,
                len(rates),
                as_in_file,
            )
        )

    def squared_errors(self, voxels: Batches, *, as_in_file: bool) -> list[int]:
        """Return the sum of the squared errors of each batch, in squares of ERROR_UNIT."""
        sums = np.empty(len(voxels), dtype=np.int64)
        _check(
            native.library().fhash_head_errors(
                *self._arguments(voxels), _address(self.parameters), as_in_file, _address(sums)
            )
        )
        return sums.tolist()

    def layers(self) -> tuple[Layer, ...]:
        """Return the layers as the file holds them."""
        layers, at = [], 0
        columns = (INPUTS, self.widths[0] * self.looked_at, self.widths[1])
        for inputs, outputs in zip(columns, (*self.widths, 1), strict=True):
            end = at + outputs * inputs
            weights = self.parameters[at:end].reshape(outputs, inputs)
            biases = self.parameters[end : end + outputs]
            layers.append(Layer.of(_as_in_file(weights, MAX_WEIGHT), _as_in_file(biases, MAX_BIAS)))
            at = end + outputs
        return tuple(layers)

    def _arguments(self, voxels: Batches) -> Sequence[ctypes.c_void_p]:
        """Return the arguments of the native functions that describe the voxels."""
        batches, blocks, _, looked_at, block = voxels.inputs.shape
        assert looked_at == self.looked_at
        sizes = (ctypes.c_int64 * 6)(batches, blocks, block, looked_at, *self.widths)
        arrays = voxels.inputs, voxels.targets, voxels.lowest, voxels.highest
        assert all(array.flags.c_contiguous for array in arrays)
        addresses = [_address(array) for array in arrays]
        return [*addresses, ctypes.cast(sizes, ctypes.c_void_p)]


def _as_in_file(values: Doubles, most: int) -> Scaled:
    """Return weights or biases as the integers of the file, at most `most` either way.

    Their unit is a float16 that maps the largest magnitude to at most `most`.
    """
    scale = float(np.float16(max(float(np.abs(values).max()) / most, MIN_SCALE)))
    return np.clip(np.rint(values / scale), -most, most).astype(np.int8), scale


def _address(array: npt.NDArray[np.generic]) -> ctypes.c_void_p:
    """Return the address of an array's first number."""
    return ctypes.c_void_p(array.ctypes.data)


def _check(code: int) -> None:
    """Raise MemoryError for a native function that failed."""
    if code != 0:
        raise MemoryError(f"no memory to train a head (code {code})")
