"""Training of a head by torch, on a CUDA device: the numbers of native/train_head.cpp, bit by bit.

All sums over voxels are of integers below 2**53, which float64 holds whatever their order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.head_training import (
    BETA1,
    BETA2,
    ERROR_UNIT,
    MAX_ERROR,
    Batches,
    Learn,
    Network,
    as_in_file,
    native_learner,
)
from fhash_codec.devices import choose_device
from fhash_formats.support.values import Double
from fhash_formats.transform.head import INPUTS, MAX_BIAS, MAX_WEIGHT

if TYPE_CHECKING:
    from torch import Tensor

# native/train_head.hpp and train_head.cpp have the same numbers.
INPUT_UNIT = 512.0
"""Integer steps of an input."""
ACTIVATION_UNIT = 128.0
"""Integer steps of an activation."""
WEIGHT_UNIT = 65536.0
"""Integer steps of a weight that is not rounded as in the file."""
MAX_ACTIVATION = 4095.0
"""Largest magnitude of an activation, in steps."""
MAX_PARAMETER = 64.0
"""Largest magnitude of a weight or bias in training."""
MAX_NORM = 1.0
"""Length from which on a gradient is shortened."""
EPSILON = 1e-8
"""Least divisor of a move, as Adam has it."""


def learner_on(device: str) -> Callable[[Batches], Learn]:
    """Return the learner of `train_head` on a device, 'cpu' or 'cuda', with the same bits.

    Raises MissingDependencyError without torch, InputError where there is no such device.
    """
    if device == "cpu":
        return native_learner
    return lambda voxels: DeviceLearner(voxels, device).learn


class DeviceLearner:
    """Updates of a network by batches that lie on a device."""

    def __init__(self, voxels: Batches, device: str) -> None:
        """Send the batches to a device, as `choose_device` has it."""
        import torch

        self._torch, self._device = torch, choose_device(device)
        self._voxels = {name: self._sent(array) for name, array in vars(voxels).items()}
        self._batches = len(voxels)

    def learn(
        self, network: Network, first: int, rates: Double, roots: Double, rounded: bool
    ) -> None:
        """Do some updates, as a `Learn`."""
        for update, (rate, root) in enumerate(zip(rates, roots, strict=True), start=first):
            slopes = self._gradient(network, update % self._batches, rounded=rounded)
            _adam_step(network, slopes, float(rate), float(root))

    def _gradient(self, network: Network, batch: int, *, rounded: bool) -> Double:
        """Return the gradient of the mean squared error of a batch."""
        inputs = self._voxels["inputs"][batch].double().permute(1, 0, 2).reshape(INPUTS, -1)
        layers = [self._layer(*layer, rounded=rounded) for layer in network.parts()]
        (one, scale_1, bias_1), (two, scale_2, bias_2), (three, scale_3, bias_3) = layers
        first = _activated(one @ inputs, scale_1 * (ACTIVATION_UNIT / INPUT_UNIT), bias_1)
        second = _activated(two @ first, scale_2, bias_2)
        outputs = three @ second * (scale_3 * (ERROR_UNIT / ACTIVATION_UNIT)) + bias_3 * ERROR_UNIT
        slopes_3 = self._slopes(outputs.round(), batch)
        slopes_2 = _descended(three.T @ slopes_3, scale_3, second)
        slopes_1 = _descended(two.T @ slopes_2, scale_2, first)
        per_voxel = 2 / (ERROR_UNIT * inputs.shape[1])
        pairs = (slopes_1, inputs), (slopes_2, first), (slopes_3, second)
        units = INPUT_UNIT, ACTIVATION_UNIT, ACTIVATION_UNIT
        sums = [
            part
            for (slopes, values), unit in zip(pairs, units, strict=True)
            for part in (
                (slopes @ values.T * (per_voxel / unit)).reshape(-1),
                slopes.sum(dim=1) * per_voxel,
            )
        ]
        gradient: Double = self._torch.cat(sums).cpu().numpy()
        return gradient

    def _layer(
        self, weights: Double, biases: Double, *, rounded: bool
    ) -> tuple[Tensor, float, Tensor]:
        """Return a layer's integers (out, in), their unit, and its biases (out, 1)."""
        if rounded:
            integers, scale = as_in_file(weights, MAX_WEIGHT)
            of_biases, unit = as_in_file(biases, MAX_BIAS)
            used = of_biases.astype(np.float64) * unit
        else:
            most, scale = WEIGHT_UNIT * MAX_PARAMETER, 1 / WEIGHT_UNIT
            integers, used = np.clip(np.rint(weights * WEIGHT_UNIT), -most, most), biases
        return (
            self._sent(integers.astype(np.float64)),
            scale,
            self._sent(used.copy()[:, np.newaxis]),
        )

    def _slopes(self, outputs: Tensor, batch: int) -> Tensor:
        """Return the slopes (1, n) of rounded outputs; 0 for one beyond the range of values."""
        of = {name: array[batch].double() for name, array in self._voxels.items()}
        useful = outputs.maximum(of["lowest"]).minimum(of["highest"])
        errors = (useful - of["targets"]).clamp(-MAX_ERROR, MAX_ERROR)
        weighted = (errors * of["weights"]).round()
        return self._torch.where(useful == outputs, weighted, 0.0)

    def _sent(self, array: npt.NDArray[Any]) -> Tensor:
        return self._torch.from_numpy(array).to(self._device)


def _activated(sums: Tensor, scale: float, biases: Tensor) -> Tensor:
    """Return the activations of sums: leaky, clipped, rounded half to even."""
    values = sums * scale + biases * ACTIVATION_UNIT
    return (values * 0.125).maximum(values).clamp(-MAX_ACTIVATION, MAX_ACTIVATION).round()


def _descended(slopes: Tensor, scale: float, activations: Tensor) -> Tensor:
    """Return the slopes of sums from those of activations."""
    leaky = (activations > 0) * 0.875 + 0.125
    return (slopes * scale * leaky).clamp(-MAX_ERROR, MAX_ERROR).round()


def _adam_step(network: Network, gradient: Double, rate: float, root: float) -> None:
    """Do one step of Adam along a gradient, shortened to MAX_NORM."""
    # One after the other, as the native code adds them up.
    norm = float(np.sqrt(np.add.accumulate(gradient * gradient)[-1]))
    slopes = gradient * (MAX_NORM / norm if norm > MAX_NORM else 1.0)
    network.means += (slopes - network.means) * (1 - BETA1)
    network.squares += (slopes * slopes - network.squares) * (1 - BETA2)
    moves = rate * network.means / (np.sqrt(network.squares) * root + EPSILON)
    np.clip(network.parameters - moves, -MAX_PARAMETER, MAX_PARAMETER, out=network.parameters)
