"""Training of the neighbourhood head (fhash_formats.transform.head.head).

It learns from decoded tiles and their originals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.compact.choices.head_samples import (
    BATCH_VOXELS,
    Batches,
    ErrorRange,
    Pair,
    batches,
    draw,
)
from fhash_codec.training.adam import adam_step
from fhash_codec.training.devices import choose_device
from fhash_codec.training.threads import one_thread
from fhash_formats.errors import InputError
from fhash_formats.transform.head.head import (
    MAX_BIAS,
    MAX_WEIGHT,
    Layer,
    NeighbourHead,
    layer_inputs,
)
from fhash_formats.transform.head.inputs import CROSS, INPUTS

__all__ = ["TrainedHead", "train_head"]

RATE = 1e-2
"""Highest learning rate."""
WARM_UP = 0.1
"""Share of the schedule in which the learning rate rises."""
ROUNDED_FROM = 0.6
"""Share of the schedule from which on weights are rounded as in the file."""
STARTS = 3
"""Networks that are trained side by side at first."""
CHOSEN_AT = 0.15
"""Share of the schedule at which the best of them goes on alone."""
MEASUREMENTS = 10
"""Number of measurements of the gain during the training."""
MAX_GRADIENT_NORM = 1.0
"""Norm to which longer gradients are shortened."""
DEFAULT_UPDATES = 4000
"""Training updates where neither their number nor a time is given."""


@dataclass(frozen=True, kw_only=True)
class TrainedHead:
    """A trained head and what it gains."""

    head: NeighbourHead
    gain_db: float
    """Gain in dB on held-out voxels."""
    history: tuple[tuple[float, int, float], ...]
    """Gain during the training: (seconds, update, gain in dB)."""


class _Samples:
    """`Batches` as tensors on a device, with the same attributes."""

    def __init__(self, arrays: Batches, device: torch.device) -> None:
        self.inputs = torch.from_numpy(arrays.inputs).to(device)
        self.targets = torch.from_numpy(arrays.targets).to(device)
        self.lowest = torch.from_numpy(arrays.lowest).to(device)
        self.highest = torch.from_numpy(arrays.highest).to(device)

    def __len__(self) -> int:
        return len(self.targets)


@dataclass(frozen=True, kw_only=True)
class _Schedule:
    """Length of a training: a number of updates, or of seconds."""

    updates: int
    seconds: float | None

    def share(self, update: int, elapsed: float) -> float:
        """Return the share of the training that is done, 0 to 1."""
        return min(1.0, update / self.updates if self.seconds is None else elapsed / self.seconds)


def train_head(
    pairs: Sequence[Pair],
    *,
    low: float,
    high: float,
    hidden: Sequence[int] = (12, 8),
    cross: bool = False,
    steps: int | None = None,
    seconds: float | None = None,
    samples: int = 800_000,
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[float], None] | None = None,
) -> TrainedHead:
    """Train a head that lowers the squared error of the voxels that count.

    The same seed and device give the same head, unless its training is given in seconds.

    pairs: decoded and original tiles (t, z, y, x) in data units.
    low, high: range that decoded values are clipped to.
    hidden: widths of the hidden layers.
    cross: whether the head looks at the hidden values of neighbours, see `NeighbourHead`.
    steps: number of training updates (default 4000).
    seconds: time of the training instead; the schedule then follows the clock.
    samples: approximate number of voxels to learn from; a fifth as many measure the gain.
    device: cpu, cuda, or auto.
    progress: called with the share of the training that is done, 0 to 1.

    Raises InputError if no voxel counts, if the decoded series has no error, for both steps and
    seconds, and for an impossible device.
    """
    if steps is not None and seconds is not None:
        raise InputError("give the steps or the seconds of a head's training, not both")
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(
            f"a head cannot be trained on device {device!r}: allowed are auto, cpu and cuda"
        )
    place = choose_device(device)
    random = np.random.default_rng(seed)
    bounds = np.float32(low), np.float32(high)
    learned, tested = (
        draw(pairs, max(1, round(count / BATCH_VOXELS)) * BATCH_VOXELS, random, *bounds)
        for count in (samples, samples // 5)
    )
    errors = np.concatenate([drawn.originals - drawn.values for drawn in learned])
    sigma = np.sqrt(np.mean(errors.astype(np.float64) ** 2)).astype(np.float32)
    if not sigma > 0:
        raise InputError("a head has nothing to learn: the decoded values are the original ones")
    value_range = ErrorRange(low=bounds[0], high=bounds[1], sigma=sigma)
    offsets = CROSS if cross else CROSS[:1]
    training, held_out = (
        _Samples(batches(pairs, drawn, offsets, random, value_range), place)
        for drawn in (learned, tested)
    )
    generator = torch.Generator().manual_seed(seed)
    network = _Network(layer_inputs(hidden, cross), [*hidden, 1], generator, place)
    schedule = _Schedule(updates=DEFAULT_UPDATES if steps is None else steps, seconds=seconds)
    with one_thread():
        history = _optimise(network, training, held_out, schedule, progress)
        layers = _layers(network.parameters)
    head = NeighbourHead(
        layers=layers, sigma=float(sigma), low=float(bounds[0]), high=float(bounds[1]), cross=cross
    )
    return TrainedHead(head=head, gain_db=history[-1][2], history=tuple(history))


def _optimise(
    network: _Network,
    training: _Samples,
    held_out: _Samples,
    schedule: _Schedule,
    progress: Callable[[float], None] | None,
) -> list[tuple[float, int, float]]:
    """Train a network in place; the gain on the way, as (seconds, update, dB)."""
    history: list[tuple[float, int, float]] = []
    update, share = 0, 0.0
    began = perf_counter()
    while share < 1:
        update += 1
        share = schedule.share(update, perf_counter() - began)
        if network.starts > 1 and share >= CHOSEN_AT:
            network.keep(int(_gains(network.parameters, held_out, rounded=False).argmax()))
        batch = update % len(training)
        network.learn(training, batch, update, _rate(share), rounded=share > ROUNDED_FROM)
        if share >= min(1.0, (len(history) + 1) / MEASUREMENTS):
            gain = float(_gains(network.parameters, held_out, rounded=True).max())
            history.append((perf_counter() - began, update, gain))
            if progress is not None:
                progress(share)
    return history


def _rate(share: float) -> float:
    """Return the learning rate at a share of the schedule: a linear rise, then a half cosine."""
    return RATE * (
        share / WARM_UP
        if share < WARM_UP
        else 0.5 + 0.5 * math.cos(math.pi * (share - WARM_UP) / (1 - WARM_UP))
    )


class _Network:
    """Parameters of networks that are trained side by side from several starts, with Adam's means.

    Attributes:
        parameters: weights (starts, out, in) and biases (starts, out, 1) of each layer in turn.
    """

    def __init__(
        self,
        inputs: Sequence[int],
        outputs: Sequence[int],
        generator: torch.Generator,
        device: torch.device,
    ) -> None:
        self.parameters = _initial(inputs, outputs, generator, device)
        self._means, self._squares = (
            [torch.zeros_like(parameter) for parameter in self.parameters] for _ in range(2)
        )

    @property
    def starts(self) -> int:
        """Number of networks."""
        return len(self.parameters[0])

    def keep(self, start: int) -> None:
        """Keep one network only."""
        self.parameters, self._means, self._squares = (
            [tensor[start : start + 1].detach() for tensor in tensors]
            for tensors in (self.parameters, self._means, self._squares)
        )

    def learn(
        self, samples: _Samples, batch: int, update: int, rate: float, *, rounded: bool
    ) -> None:
        """Update the parameters by a batch: one step of Adam along the shortened gradient."""
        for parameter in self.parameters:
            parameter.requires_grad_(True)
        error = _errors(self.parameters, samples, batch, rounded=rounded)
        gradients = torch.autograd.grad(error.square().mean(dim=1).sum(), self.parameters)
        with torch.no_grad():
            squared_norms = torch.stack(
                [gradient.square().flatten(1).sum(dim=1) for gradient in gradients]
            )
            norms = squared_norms.sum(dim=0).sqrt()
            shrink = (MAX_GRADIENT_NORM / (norms + 1e-9)).clamp(max=1.0)[:, None, None]
            for parameter, gradient, mean, square in zip(
                self.parameters, gradients, self._means, self._squares, strict=True
            ):
                adam_step(parameter, gradient * shrink, mean, square, update, rate)


def _initial(
    inputs: Sequence[int], outputs: Sequence[int], generator: torch.Generator, device: torch.device
) -> list[Tensor]:
    """Return weights (starts, out, in) and biases (starts, out, 1) of each layer in turn.

    The last layer begins near 0.
    """
    parameters = []
    for number, (columns, rows) in enumerate(zip(inputs, outputs, strict=True)):
        last = number == len(outputs) - 1
        reach = columns**-0.5
        for shape, scale in (
            ((STARTS, rows, columns), 0.1 if last else 1.0),
            ((STARTS, rows, 1), 0.0 if last else 1.0),
        ):
            uniform = torch.rand(shape, generator=generator) * 2 - 1
            parameters.append((uniform * reach * scale).to(device))
    return parameters


def _scale(parameter: Tensor, max_integer: int) -> Tensor:
    """Return the float16 quantum (starts, 1, 1) that maps the largest magnitude to an integer."""
    largest = parameter.detach().abs().amax(dim=(1, 2), keepdim=True)
    return (largest / max_integer).clamp(min=1e-6).half().float()


def _rounded(parameter: Tensor, max_integer: int) -> Tensor:
    """Return the parameter rounded as in the file; gradients pass through unchanged."""
    scale = _scale(parameter, max_integer)
    integers = (parameter.detach() / scale).round().clamp(-max_integer, max_integer)
    return parameter + (integers * scale - parameter).detach()


def _errors(
    parameters: Sequence[Tensor], samples: _Samples, batch: int, *, rounded: bool
) -> Tensor:
    """Return corrected minus original values of a batch (starts, n) in units of sigma."""
    inputs = samples.inputs[batch].to(torch.float32).mul_(1 / 512)
    values = inputs.reshape(1, INPUTS, -1).expand(len(parameters[0]), -1, -1)
    for layer in range(0, len(parameters), 2):
        weights, biases = parameters[layer : layer + 2]
        if rounded:
            weights, biases = _rounded(weights, MAX_WEIGHT), _rounded(biases, MAX_BIAS)
        if layer == 2:
            # Flatten the voxels looked at into inputs of the second layer, ordered by the output
            # of the first layer, then by voxel.
            values = values.reshape(len(values), -1, inputs.shape[2])
        values = torch.baddbmm(biases, weights, values)
        if layer + 2 < len(parameters):
            values = torch.nn.functional.leaky_relu(values, 0.125)
    # Outputs beyond the clip range cost nothing more: the decoder clips them.
    clipped = torch.minimum(
        torch.maximum(values[:, 0], samples.lowest[batch]), samples.highest[batch]
    )
    return clipped - samples.targets[batch]


def _gains(parameters: Sequence[Tensor], held_out: _Samples, *, rounded: bool) -> Tensor:
    """Return the dB that the network of each start gains on the held-out samples."""
    with torch.no_grad():
        errors = [
            _errors(parameters, held_out, batch, rounded=rounded).square().mean(dim=1)
            for batch in range(len(held_out))
        ]
        return 10 * torch.log10(held_out.targets.square().mean() / torch.stack(errors).mean(dim=0))


def _layers(parameters: Sequence[Tensor]) -> tuple[Layer, ...]:
    """Return the rounded layers of the network of the first start."""
    layers = []
    for weights, biases in zip(parameters[::2], parameters[1::2], strict=True):
        layers.append(
            Layer(
                weights=_integers(weights, MAX_WEIGHT),
                biases=np.ascontiguousarray(_integers(biases, MAX_BIAS)[:, 0]),
                weight_scale=float(_scale(weights, MAX_WEIGHT)),
                bias_scale=float(_scale(biases, MAX_BIAS)),
            )
        )
    return tuple(layers)


def _integers(parameter: Tensor, max_integer: int) -> npt.NDArray[np.int8]:
    """Return a parameter of the first start as integers (out, in)."""
    integers = (parameter.detach() / _scale(parameter, max_integer)).round()
    clamped = integers.clamp(-max_integer, max_integer)[0]
    return np.ascontiguousarray(clamped.to(torch.int8).cpu().numpy())
