"""Training of the neighbourhood head (fhash_formats.transform.head.head) on decoded tiles and their originals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from time import perf_counter
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.training.adam import adam_step
from fhash_formats.errors import InputError
from fhash_formats.transform.head.head import (
    MAX_BIAS,
    MAX_WEIGHT,
    Layer,
    NeighbourHead,
    layer_inputs,
)
from fhash_formats.transform.head.head_portable import centre_inputs, clip, compress
from fhash_formats.transform.head.inputs import CROSS, INPUTS, OFFSETS

__all__ = ["Pair", "TrainedHead", "train_head"]

Floats = npt.NDArray[np.float32]
Pair = tuple[Floats, Floats, npt.NDArray[np.bool_] | None]
"""A decoded tile (t, z, y, x), its original, and which voxels count (None: all)."""

_BATCH = 4096
_PIECE = 1 << 16  # voxels whose features are found at once
_RATE = 1e-2
_WARM_UP = 0.1  # the part of the schedule in which the rate rises
_ROUNDED_FROM = 0.6  # weights are rounded from this part of the schedule on
_STARTS = 3  # networks trained side by side at first
_CHOSEN_AT = 0.15  # from this part on the best of them goes on alone
_MEASUREMENTS = 10
_GRADIENT_NORM = 1.0


@dataclass(frozen=True, kw_only=True)
class TrainedHead:
    """A head, its gain in dB on held-out voxels, and the gain on the way there: (seconds, step, dB)."""

    head: NeighbourHead
    gain_db: float
    history: tuple[tuple[float, int, float], ...]


@dataclass(frozen=True, kw_only=True)
class _Samples:
    """Batches of n voxels.

    inputs: features (batches, INPUTS, voxels looked at, n), int16. targets, least and greatest useful output: (batches, n), in sigmas.
    """

    inputs: Tensor
    targets: Tensor
    least: Tensor
    greatest: Tensor

    def __len__(self) -> int:
        return len(self.targets)


class _Drawn(NamedTuple):
    """Voxels of one tile: coordinates (4, n), clipped decoded values (n,), originals (n,)."""

    places: npt.NDArray[np.int64]
    values: Floats
    originals: Floats


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
    """A head of the given hidden widths that lowers the squared error of the voxels that count.

    pairs: decoded and original float32 tiles (t, z, y, x) in data units; low, high: the clip range. cross: see `Head`.
    samples: about how many voxels are drawn to learn from; a fifth as many measure the gain.
    steps: length of the training, 4000 if neither it nor seconds is given; with seconds the schedule follows the clock and two runs differ.
    Otherwise the same seed and device give the same head. device: cpu, cuda, or auto. progress gets the part done, 0 to 1.

    Raises InputError for no voxels that count, a decoded series without error, both steps and seconds, or an impossible device.
    """
    if steps is not None and seconds is not None:
        raise InputError("give the steps or the seconds of a head's training, not both")
    if device not in ("auto", "cpu", "cuda") or (
        device == "cuda" and not torch.cuda.is_available()
    ):
        raise InputError(
            f"a head cannot be trained on device {device!r}: allowed are auto, cpu, and cuda where there is one"
        )
    place = torch.device(
        "cuda"
        if device == "auto" and torch.cuda.is_available()
        else "cpu"
        if device == "auto"
        else device
    )
    bounds = np.float32(low), np.float32(high)
    random = np.random.default_rng(seed)
    learnt, tested = (
        _draw(pairs, max(1, round(count / _BATCH)) * _BATCH, random, *bounds)
        for count in (samples, samples // 5)
    )
    errors = np.concatenate([drawn.originals - drawn.values for drawn in learnt])
    sigma = np.sqrt(np.mean(errors.astype(np.float64) ** 2)).astype(np.float32)
    if not sigma > 0:
        raise InputError("a head has nothing to learn: the decoded values are the original ones")
    seen = CROSS if cross else CROSS[:1]
    training, held_out = (
        _samples(pairs, drawn, seen, random, sigma, *bounds, place) for drawn in (learnt, tested)
    )
    with _one_thread:
        layers, history = _optimise(
            training,
            held_out,
            hidden,
            cross,
            4000 if steps is None else steps,
            seconds,
            seed,
            progress,
        )
    head = NeighbourHead(
        layers=layers, sigma=float(sigma), low=float(bounds[0]), high=float(bounds[1]), cross=cross
    )
    return TrainedHead(head=head, gain_db=history[-1][2], history=tuple(history))


class _OneThread:
    """Torch on one thread: batches this small gain little from a second, and wait for ever where another process holds its core.

    Of the trainings at one time the first sets the number, and the last sets it back: it is one for the process in part.
    """

    def __init__(self) -> None:
        self._lock, self._inside, self._before = Lock(), 0, 1

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = torch.get_num_threads()
            self._inside += 1
            torch.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                torch.set_num_threads(self._before)


_one_thread = _OneThread()


def _optimise(
    training: _Samples, held_out: _Samples, hidden: Sequence[int], cross: bool, steps: int, seconds: float | None, seed: int,
    progress: Callable[[float], None] | None,
) -> tuple[tuple[Layer, ...], list[tuple[float, int, float]]]:  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    parameters = _initial(
        layer_inputs(hidden, cross), [*hidden, 1], generator, training.inputs.device
    )
    means, squares = ([torch.zeros_like(parameter) for parameter in parameters] for _ in range(2))
    step, part = 0, 0.0
    history: list[tuple[float, int, float]] = []
    began = perf_counter()
    while part < 1:
        step += 1
        elapsed = perf_counter() - began
        part = min(1.0, step / steps if seconds is None else elapsed / seconds)
        if len(parameters[0]) > 1 and part >= _CHOSEN_AT:
            best = int(_gains(parameters, held_out, rounded=False).argmax())
            parameters, means, squares = (
                [tensor[best : best + 1].detach() for tensor in held]
                for held in (parameters, means, squares)
            )
        rate = _RATE * (
            part / _WARM_UP
            if part < _WARM_UP
            else 0.5 + 0.5 * math.cos(math.pi * (part - _WARM_UP) / (1 - _WARM_UP))
        )
        for parameter in parameters:
            parameter.requires_grad_(True)
        error = _errors(parameters, training, step % len(training), rounded=part > _ROUNDED_FROM)
        gradients = torch.autograd.grad(error.square().mean(dim=1).sum(), parameters)
        with torch.no_grad():
            norms = (
                torch.stack([gradient.square().flatten(1).sum(dim=1) for gradient in gradients])
                .sum(dim=0)
                .sqrt()
            )
            shrink = (_GRADIENT_NORM / (norms + 1e-9)).clamp(max=1.0)[:, None, None]
            for parameter, gradient, mean, square in zip(
                parameters, gradients, means, squares, strict=True
            ):
                adam_step(parameter, gradient * shrink, mean, square, step, rate)
        if part >= min(1.0, (len(history) + 1) / _MEASUREMENTS):
            gain = float(_gains(parameters, held_out, rounded=True).max())
            history.append((perf_counter() - began, step, gain))
            if progress is not None:
                progress(part)
    return _layers(parameters), history


def _draw(
    pairs: Sequence[Pair],
    samples: int,
    random: np.random.Generator,
    low: np.float32,
    high: np.float32,
) -> list[_Drawn]:
    """So many voxels that count, of each tile its share."""
    counted = np.array(
        [original.size if care is None else np.count_nonzero(care) for _, original, care in pairs],
        dtype=np.int64,
    )
    if counted.sum() == 0:
        raise InputError("a head cannot be trained: no voxel counts")
    ends = np.rint(np.cumsum(counted) / counted.sum() * samples).astype(np.int64)
    drawn = []
    for (decoded, original, care), number in zip(pairs, np.diff(ends, prepend=0), strict=True):
        among = original.size if care is None else np.flatnonzero(care)
        chosen = np.sort(random.choice(among, number)) if number else np.empty(0, np.int64)
        values = clip(decoded.ravel()[chosen], low, high)
        drawn.append(
            _Drawn(
                np.stack(np.unravel_index(chosen, original.shape)), values, original.ravel()[chosen]
            )
        )
    return drawn


def _samples(
    pairs: Sequence[Pair], drawn: Sequence[_Drawn], seen: Sequence[tuple[int, ...]], random: np.random.Generator, sigma: np.float32,
    low: np.float32, high: np.float32, device: torch.device,
) -> _Samples:  # fmt: skip
    """The drawn voxels in random order as the network sees them: by the head's own features, of the voxels at the steps of `seen`."""
    inverse, span = np.float32(0.5) / sigma, high - low
    unit = np.float32(1024) / span if span > 0 else np.float32(0)
    values, originals = (np.concatenate(parts) for parts in list(zip(*drawn, strict=True))[1:])
    order = random.permutation(len(values))
    batches = len(values) // _BATCH
    inputs = np.empty((batches, INPUTS, len(seen), _BATCH), dtype=np.int16)
    first = 0
    for (decoded, _, _), (places, _, _) in zip(pairs, drawn, strict=True):
        padded = np.pad(clip(decoded, low, high), ((1, 1), (2, 2), (2, 2), (2, 2)), mode="edge")
        flat, strides = padded.ravel(), np.array(padded.strides) // padded.itemsize
        origin = int(strides @ np.array((1, 2, 2, 2)))
        edges = np.array(decoded.shape)[:, None] - 1
        piece = _PIECE // len(seen)
        for start in range(0, places.shape[1], piece):
            part = places[:, start : start + piece]
            at = np.stack(
                [
                    origin + strides @ np.clip(part + np.array(step)[:, None], 0, edges)
                    for step in seen
                ]
            )
            centre = flat[at]
            features = np.empty((INPUTS, *at.shape), dtype=np.int16)
            for number, step in enumerate(OFFSETS):
                features[number] = compress(
                    (flat[at + int(strides @ np.array(step))] - centre) * inverse
                )
            features[-2:] = centre_inputs(centre, low, inverse, unit)
            batch, slot = np.divmod(order[first : first + at.shape[1]], _BATCH)
            inputs[batch, :, :, slot] = features.transpose(2, 0, 1)
            first += at.shape[1]

    def tensor(one: Floats) -> Tensor:
        shuffled = np.empty_like(one)
        shuffled[order] = one
        return torch.from_numpy((shuffled / sigma).reshape(batches, _BATCH)).to(device)

    return _Samples(
        inputs=torch.from_numpy(inputs).to(device),
        targets=tensor(originals - values),
        least=tensor(low - values),
        greatest=tensor(high - values),
    )


def _initial(
    inputs: Sequence[int], outputs: Sequence[int], generator: torch.Generator, device: torch.device
) -> list[Tensor]:
    """Weights (starts, out, in) and biases (starts, out, 1) of each layer in turn; the last layer begins near 0."""
    parameters = []
    for number, (columns, rows) in enumerate(zip(inputs, outputs, strict=True)):
        last = number == len(outputs) - 1
        reach = columns**-0.5
        for shape, scale in (
            ((_STARTS, rows, columns), 0.1 if last else 1.0),
            ((_STARTS, rows, 1), 0.0 if last else 1.0),
        ):
            parameters.append(
                ((torch.rand(shape, generator=generator) * 2 - 1) * reach * scale).to(device)
            )
    return parameters


def _scale(parameter: Tensor, most: int) -> Tensor:
    """The float16 step (starts, 1, 1) that puts the largest magnitude at `most`."""
    largest = parameter.detach().abs().amax(dim=(1, 2), keepdim=True)
    return (largest / most).clamp(min=1e-6).half().float()


def _rounded(parameter: Tensor, most: int) -> Tensor:
    """The parameter on its quantiser's steps; gradients pass through as if it were not."""
    scale = _scale(parameter, most)
    steps = (parameter.detach() / scale).round().clamp(-most, most)
    return parameter + (steps * scale - parameter).detach()


def _errors(
    parameters: Sequence[Tensor], samples: _Samples, batch: int, *, rounded: bool
) -> Tensor:
    """Corrected minus original values of a batch (starts, n) in units of sigma."""
    inputs = samples.inputs[batch].to(torch.float32).mul_(1 / 512)
    values = inputs.reshape(1, INPUTS, -1).expand(len(parameters[0]), -1, -1)
    for layer in range(0, len(parameters), 2):
        weights, biases = parameters[layer : layer + 2]
        if rounded:
            weights, biases = _rounded(weights, MAX_WEIGHT), _rounded(biases, MAX_BIAS)
        # Before the second layer, the voxels looked at become inputs: those of one output of the first layer after those of another.
        values = torch.baddbmm(
            biases,
            weights,
            values.reshape(len(values), -1, inputs.shape[2]) if layer == 2 else values,
        )
        if layer + 2 < len(parameters):
            values = torch.nn.functional.leaky_relu(values, 0.125)
    # Whatever lies beyond the clip range costs nothing more: the decoder clips it.
    return (
        torch.minimum(torch.maximum(values[:, 0], samples.least[batch]), samples.greatest[batch])
        - samples.targets[batch]
    )


def _gains(parameters: Sequence[Tensor], held_out: _Samples, *, rounded: bool) -> Tensor:
    """dB that each of the starts gains on the held-out samples."""
    with torch.no_grad():
        errors = [
            _errors(parameters, held_out, batch, rounded=rounded).square().mean(dim=1)
            for batch in range(len(held_out))
        ]
        return 10 * torch.log10(held_out.targets.square().mean() / torch.stack(errors).mean(dim=0))


def _layers(parameters: Sequence[Tensor]) -> tuple[Layer, ...]:
    layers = []
    for number in range(0, len(parameters), 2):
        quantised, scales = [], []
        for parameter, most in zip(
            parameters[number : number + 2], (MAX_WEIGHT, MAX_BIAS), strict=True
        ):
            scale = _scale(parameter, most)
            quantised.append(
                (parameter.detach() / scale)
                .round()
                .clamp(-most, most)[0]
                .to(torch.int8)
                .cpu()
                .numpy()
            )
            scales.append(float(scale))
        weights, biases = (
            np.ascontiguousarray(quantised[0]),
            np.ascontiguousarray(quantised[1][:, 0]),
        )
        layers.append(
            Layer(weights=weights, biases=biases, weight_scale=scales[0], bias_scale=scales[1])
        )
    return tuple(layers)
