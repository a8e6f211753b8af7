"""Training of the neighbourhood head (fhash_formats.transform.head) on decoded tiles and their originals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.engines.adam import adam_step
from fhash_formats.errors import InputError
from fhash_formats.transform.head import MAX_BIAS, MAX_WEIGHT, Head, Layer
from fhash_formats.transform.head_portable import FEATURES, STEPS, clip, compress, locate

__all__ = ["HIDDEN", "Pair", "TrainedHead", "train_head"]

Floats = npt.NDArray[np.float32]
Pair = tuple[Floats, Floats, npt.NDArray[np.bool_] | None]
"""A decoded tile (t, z, y, x), its original, and which voxels count (None: all)."""

HIDDEN = ((12, 8), (24, 12), (48, 24))
"""Hidden widths worth trying, of about 0.35, 0.7 and 1.7 kB: the larger pay in larger files."""

_SEGMENT = 16  # voxels in a row drawn together
_BATCH = 4096
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

    head: Head
    gain_db: float
    history: tuple[tuple[float, int, float], ...]


@dataclass(frozen=True, kw_only=True)
class _Samples:
    """Network inputs (n, FEATURES), targets (n,) and the least and greatest useful output (n,), in units of sigma."""

    inputs: Tensor
    targets: Tensor
    least: Tensor
    greatest: Tensor

    def __getitem__(self, part: Tensor | slice) -> _Samples:
        return _Samples(inputs=self.inputs[part], targets=self.targets[part], least=self.least[part], greatest=self.greatest[part])


def train_head(
    pairs: Sequence[Pair],
    *,
    low: float,
    high: float,
    hidden: Sequence[int] = HIDDEN[0],
    steps: int | None = None,
    seconds: float | None = None,
    samples: int = 800_000,
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[float], None] | None = None,
) -> TrainedHead:
    """A head of the given hidden widths that lowers the squared error of the voxels that count.

    pairs: decoded and original float32 tiles (t, z, y, x) in data units; low, high: the clip range.
    samples: about how many voxels are drawn to learn from; a fifth as many measure the gain.
    steps: length of the training, 4000 if neither it nor seconds is given; with seconds the schedule follows the clock and two runs differ.
    Otherwise the same seed and device give the same head. device: cpu, cuda, or auto. progress gets the part done, 0 to 1.

    Raises InputError for no voxels that count, a decoded series without error, both steps and seconds, or an impossible device.
    """
    if steps is not None and seconds is not None:
        raise InputError("give the steps or the seconds of a head's training, not both")
    if device not in ("auto", "cpu", "cuda") or (device == "cuda" and not torch.cuda.is_available()):
        raise InputError(f"a head cannot be trained on device {device!r}: allowed are auto, cpu, and cuda where there is one")
    place = torch.device("cuda" if device == "auto" and torch.cuda.is_available() else "cpu" if device == "auto" else device)
    bounds = np.float32(low), np.float32(high)
    random = np.random.default_rng(seed)
    learnt, tested = (_draw(pairs, count, random, *bounds) for count in (samples, samples // 5))
    sigma = np.sqrt(np.mean((learnt[2] - learnt[1]).astype(np.float64) ** 2)).astype(np.float32)
    if not sigma > 0:
        raise InputError("a head has nothing to learn: the decoded values are the original ones")
    training, held_out = (_samples(*drawn, sigma, *bounds, place) for drawn in (learnt, tested))
    with _one_thread():
        layers, history = _optimise(training, held_out, hidden, 4000 if steps is None else steps, seconds, seed, progress)
    head = Head(layers=layers, sigma=float(sigma), low=float(bounds[0]), high=float(bounds[1]))
    return TrainedHead(head=head, gain_db=history[-1][2], history=tuple(history))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Torch on one thread: batches this small gain little from a second, and wait for ever where another process holds its core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _optimise(
    training: _Samples, held_out: _Samples, hidden: Sequence[int], steps: int, seconds: float | None, seed: int,
    progress: Callable[[float], None] | None,
) -> tuple[tuple[Layer, ...], list[tuple[float, int, float]]]:  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    parameters = _initial((FEATURES, *hidden, 1), generator, training.inputs.device)
    means, squares = ([torch.zeros_like(parameter) for parameter in parameters] for _ in range(2))
    count, step, part, position = len(training.targets), 0, 0.0, 0
    order = torch.randperm(count, generator=generator).to(training.inputs.device)
    history: list[tuple[float, int, float]] = []
    began = perf_counter()
    while part < 1:
        step += 1
        elapsed = perf_counter() - began
        part = min(1.0, step / steps if seconds is None else elapsed / seconds)
        if len(parameters[0]) > 1 and part >= _CHOSEN_AT:
            best = int(_gains(parameters, held_out, rounded=False).argmax())
            parameters, means, squares = ([tensor[best : best + 1].detach() for tensor in held] for held in (parameters, means, squares))
        if position + _BATCH > count:
            order, position = torch.randperm(count, generator=generator).to(order.device), 0
        batch = training[order[position : position + _BATCH]]
        position += _BATCH
        rate = _RATE * (part / _WARM_UP if part < _WARM_UP else 0.5 + 0.5 * math.cos(math.pi * (part - _WARM_UP) / (1 - _WARM_UP)))
        for parameter in parameters:
            parameter.requires_grad_(True)
        error = _errors(parameters, batch, rounded=part > _ROUNDED_FROM)
        gradients = torch.autograd.grad(error.square().mean(dim=1).sum(), parameters)
        with torch.no_grad():
            norms = torch.stack([gradient.square().flatten(1).sum(dim=1) for gradient in gradients]).sum(dim=0).sqrt()
            shrink = (_GRADIENT_NORM / (norms + 1e-9)).clamp(max=1.0)[:, None, None]
            for parameter, gradient, mean, square in zip(parameters, gradients, means, squares, strict=True):
                adam_step(parameter, gradient * shrink, mean, square, step, rate)
        if part >= min(1.0, (len(history) + 1) / _MEASUREMENTS):
            gain = float(_gains(parameters, held_out, rounded=True).max())
            history.append((perf_counter() - began, step, gain))
            if progress is not None:
                progress(part)
    return _layers(parameters), history


def _draw(
    pairs: Sequence[Pair], samples: int, random: np.random.Generator, low: np.float32, high: np.float32
) -> tuple[Floats, Floats, Floats]:
    """Of about `samples` voxels that count, in segments along x: differences to neighbours (26, n), decoded values (n,), originals (n,)."""
    counted = np.array([original.size if care is None else np.count_nonzero(care) for _, original, care in pairs], dtype=np.int64)
    if counted.sum() == 0:
        raise InputError("a head cannot be trained: no voxel counts")
    parts = []
    for (decoded, original, care), number in zip(pairs, counted, strict=True):
        segment = min(_SEGMENT, decoded.shape[3])
        padded = np.pad(clip(decoded, low, high), ((0, 0), (0, 0), (0, 0), (2, 2)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, segment + 4, axis=3)
        originals = np.lib.stride_tricks.sliding_window_view(original, segment, axis=3)
        segments = math.ceil(samples * number / counted.sum() / segment)
        among = original.size if care is None else np.flatnonzero(care)
        t, z, y, x = np.unravel_index(random.choice(among, segments), original.shape)
        starts = t, z, y, np.clip(x - random.integers(0, segment, segments), 0, original.shape[3] - segment)
        counts = None if care is None else np.lib.stride_tricks.sliding_window_view(care, segment, axis=3)[starts].ravel()
        rows = {}
        for step in {step[:3] for step in STEPS}:
            moved = (np.clip(at + move, 0, size - 1) for at, move, size in zip((t, z, y), step, original.shape, strict=False))
            rows[step] = windows[(*moved, starts[3])]
        centre = rows[0, 0, 0][:, 2 : 2 + segment]
        differences = np.stack([(rows[step[:3]][:, 2 + step[3] : 2 + step[3] + segment] - centre).ravel() for step in STEPS])
        flat = differences, centre.ravel(), originals[starts].ravel()
        parts.append(flat if counts is None else tuple(values[..., counts] for values in flat))
    differences, centre, original = (np.concatenate([part[index] for part in parts], axis=-1) for index in range(3))
    return differences, centre, original


def _samples(
    differences: Floats, centre: Floats, original: Floats, sigma: np.float32, low: np.float32, high: np.float32, device: torch.device
) -> _Samples:
    """The drawn voxels as the network sees them: the head's own features, in octaves."""
    inverse = np.float32(0.5) / sigma
    span = high - low
    unit = np.float32(1024) / span if span > 0 else np.float32(0)
    features = np.empty((FEATURES, len(centre)), dtype=np.float32)
    features[:-2] = compress(differences * inverse)
    features[-2] = locate(centre, low, unit)
    features[-1] = compress((centre - low) * inverse)

    def tensor(values: Floats) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device)

    return _Samples(
        inputs=tensor(features.T / np.float32(512)),
        targets=tensor((original - centre) / sigma),
        least=tensor((low - centre) / sigma),
        greatest=tensor((high - centre) / sigma),
    )


def _initial(widths: Sequence[int], generator: torch.Generator, device: torch.device) -> list[Tensor]:
    """Weights (starts, in, out) and biases (starts, 1, out) of each layer in turn; the last layer begins near 0."""
    parameters = []
    for number, (inputs, outputs) in enumerate(pairwise(widths)):
        last = number == len(widths) - 2
        reach = inputs**-0.5
        for shape, scale in (((_STARTS, inputs, outputs), 0.1 if last else 1.0), ((_STARTS, 1, outputs), 0.0 if last else 1.0)):
            parameters.append(((torch.rand(shape, generator=generator) * 2 - 1) * reach * scale).to(device))
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


def _errors(parameters: Sequence[Tensor], samples: _Samples, *, rounded: bool) -> Tensor:
    """Corrected minus original values (starts, n) in units of sigma."""
    values = samples.inputs.expand(len(parameters[0]), -1, -1)
    for number in range(0, len(parameters), 2):
        weights, biases = parameters[number : number + 2]
        if rounded:
            weights, biases = _rounded(weights, MAX_WEIGHT), _rounded(biases, MAX_BIAS)
        values = torch.baddbmm(biases, values, weights)
        if number + 2 < len(parameters):
            values = torch.nn.functional.leaky_relu(values, 0.125)
    # Whatever lies beyond the clip range costs nothing more: the decoder clips it.
    return torch.minimum(torch.maximum(values[..., 0], samples.least), samples.greatest) - samples.targets


def _gains(parameters: Sequence[Tensor], held_out: _Samples, *, rounded: bool) -> Tensor:
    """dB that each of the starts gains on the held-out samples."""
    with torch.no_grad():
        left = _errors(parameters, held_out, rounded=rounded).square().mean(dim=1)
        return 10 * torch.log10(held_out.targets.square().mean() / left)


def _layers(parameters: Sequence[Tensor]) -> tuple[Layer, ...]:
    layers = []
    for number in range(0, len(parameters), 2):
        quantised, scales = [], []
        for parameter, most in zip(parameters[number : number + 2], (MAX_WEIGHT, MAX_BIAS), strict=True):
            scale = _scale(parameter, most)
            quantised.append((parameter.detach() / scale).round().clamp(-most, most)[0].T.to(torch.int8).cpu().numpy())
            scales.append(float(scale))
        weights, biases = np.ascontiguousarray(quantised[0]), np.ascontiguousarray(quantised[1][:, 0])
        layers.append(Layer(weights=weights, biases=biases, weight_scale=scales[0], bias_scale=scales[1]))
    return tuple(layers)
