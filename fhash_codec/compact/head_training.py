"""Training of a head: its samples, its network, its optimiser."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.native import pointer
from fhash_formats.support.threads import usable_threads
from fhash_formats.support.values import Double, Single
from fhash_formats.transform.head import (
    INPUTS,
    MAX_BIAS,
    MAX_WEIGHT,
    SIGMA_RANGE,
    Layer,
    NeighbourHead,
    Scaled,
    offsets_in,
)
from fhash_formats.transform.spec import checked

BATCH_VOXELS = 4096
"""Voxels of a training batch."""
LOOKED_THROUGH = 1 << 20
"""Voxels that are drawn from: of a larger number, every second or third is one of them."""
BLOCK_VOXELS = 64
"""Voxels that the network computes together; train_head.hpp holds the same number."""
ERROR_UNIT = 16384.0
"""Integer steps in one sigma of a target."""
MAX_ERROR = 1 << 24
"""Largest magnitude of an error that a training sees, in these steps; larger ones are clipped."""
MAX_TARGET = 1 << 30
"""Largest magnitude of a target, in integer steps."""


class Pair(NamedTuple):
    """A decoded tile (t, z, y, x) with its original."""

    decoded: Single
    original: npt.NDArray[Any]
    counted: npt.NDArray[np.bool_] | None
    """Mask of the voxels that count; None if all count."""


class Voxels(NamedTuple):
    """Voxels drawn from one tile."""

    places: npt.NDArray[np.int64]
    """Coordinates (4, n)."""
    values: Single
    """Clipped decoded values (n,)."""
    originals: npt.NDArray[Any]
    """Original values (n,)."""
    weights: Single
    """Weights of their squared errors (n,)."""


@dataclass(frozen=True, kw_only=True)
class ErrorRange:
    """Range of the values, and the error of the decoded values in it."""

    low: np.float32
    high: np.float32
    sigma: np.float32
    """Root of the mean squared error."""


@dataclass(frozen=True, kw_only=True)
class Batches:
    """Batches of n = blocks * BLOCK_VOXELS voxels."""

    inputs: npt.NDArray[np.int16]
    """Inputs of the network (batches, blocks, INPUTS, BLOCK_VOXELS)."""
    targets: npt.NDArray[np.int32]
    """Original minus decoded values (batches, n), in units of sigma / ERROR_UNIT."""
    lowest: npt.NDArray[np.int32]
    """Lowest useful output (batches, n), in the same unit: a lower one is clipped."""
    highest: npt.NDArray[np.int32]
    """Highest useful output (batches, n), in the same unit."""
    weights: Single
    """Weights of the squared errors (batches, n), up to 1."""

    def __len__(self) -> int:
        return len(self.targets)

    def part(self, first: int, last: int | None) -> Batches:
        """Return some of the batches."""
        return Batches(**{name: array[first:last] for name, array in vars(self).items()})


def draw(
    pairs: Sequence[Pair],
    samples: int,
    random: np.random.Generator,
    low: np.float32,
    high: np.float32,
) -> list[Voxels]:
    """Draw voxels that count, each as often as the size of its error and the mean one add up to.

    Most of the squared error, and of the bytes, is where few voxels are: drawn alike, these would
    hardly be learned from. The weights take back half of that, on a logarithmic scale: all of it
    cost 3 to 5 % of the bytes of mixing and of shocks, none of it 1 to 4 % of others. Without a
    voxel that counts, none are drawn.
    """
    stride = max(1, sum(pair.original.size for pair in pairs) // LOOKED_THROUGH)
    first = int(random.integers(stride))
    errors = [_magnitudes(pair, slice(first, None, stride)) for pair in pairs]
    counted = [error >= 0 for error in errors]
    count = sum(map(np.count_nonzero, counted))
    total = sum(float(np.sum(error[of])) for error, of in zip(errors, counted, strict=True))
    least = total / count if total > 0 else 1.0
    sums = [np.cumsum((error + least) * of) for error, of in zip(errors, counted, strict=True)]
    ends = np.cumsum([each[-1] if each.size else 0.0 for each in sums])
    ends = np.rint(ends / (ends[-1] or 1.0) * samples * bool(count)).astype(np.int64)
    numbers, drawn = np.diff(ends, prepend=0), []
    for pair, error, each, number in zip(pairs, errors, sums, numbers, strict=True):
        at = np.sort(random.random(int(number))) * each[-1:].sum()
        place = np.searchsorted(each, at, side="right")
        chosen = first + stride * place
        values = pair.decoded.ravel()[chosen]
        values = np.where(values > low, values, low)  # NaN becomes low, as the head has it
        values = np.where(values < high, values, high)
        drawn.append(
            Voxels(
                places=np.stack(np.unravel_index(chosen, pair.original.shape)),
                values=values,
                originals=pair.original.ravel()[chosen],
                weights=np.sqrt(least / (error[place] + least)).astype(np.float32),
            )
        )
    return drawn


def _magnitudes(pair: Pair, part: slice) -> Double:
    """Return the magnitude of the error of some voxels; -1 where none counts."""
    with np.errstate(over="ignore", invalid="ignore"):
        decoded = pair.decoded.ravel()[part].astype(np.float64)
        error: Double = np.abs(pair.original.ravel()[part] - decoded)
    error[~np.isfinite(error)] = 0
    if pair.counted is not None:
        error[~pair.counted.ravel()[part]] = -1
    return error


def batches(
    pairs: Sequence[Pair],
    drawn: Sequence[Voxels],
    random: np.random.Generator,
    value_range: ErrorRange,
) -> Batches:
    """Return the drawn voxels in random order, as the network sees them."""
    low, high, sigma = value_range.low, value_range.high, value_range.sigma
    values = np.concatenate([voxels.values for voxels in drawn])
    originals = np.concatenate([voxels.originals for voxels in drawn])
    order = random.permutation(len(values))
    count = len(values) // BATCH_VOXELS
    blocks = BATCH_VOXELS // BLOCK_VOXELS
    inputs = np.empty((count * blocks, INPUTS, BLOCK_VOXELS), dtype=np.int16)
    first = 0
    for pair, voxels in zip(pairs, drawn, strict=True):
        slots = order[first : first + len(voxels.values)]
        _fill_slots(inputs, slots, pair.decoded, voxels.places, value_range)
        first += len(slots)

    def batched(unordered: npt.NDArray[Any]) -> npt.NDArray[Any]:
        shuffled = np.empty_like(unordered)
        shuffled[order] = unordered
        return shuffled.reshape(count, BATCH_VOXELS)

    def in_steps(differences: Double) -> npt.NDArray[np.int32]:
        steps = np.rint(differences * (ERROR_UNIT / np.float64(sigma)))
        return batched(np.clip(steps, -MAX_TARGET, MAX_TARGET).astype(np.int32))

    wide = values.astype(np.float64)
    return Batches(
        inputs=inputs.reshape(count, blocks, *inputs.shape[1:]),
        targets=in_steps(originals - wide),
        lowest=in_steps(low - wide),
        highest=in_steps(high - wide),
        weights=batched(np.concatenate([voxels.weights for voxels in drawn])),
    )


def _fill_slots(
    inputs: npt.NDArray[np.int16],
    slots: npt.NDArray[np.int64],
    decoded: Single,
    places: npt.NDArray[np.int64],
    value_range: ErrorRange,
) -> None:
    """Write the inputs of voxels of a tile into their slots.

    inputs: of all voxels, (blocks, INPUTS, BLOCK_VOXELS).
    slots: number of each of the n voxels of this tile among all voxels.
    places: coordinates (4, n) of the voxels.
    """
    inverse, unit = _scales(value_range)
    # In the order of the slots: a voxel has its inputs in many places, near those of the next slot.
    order = np.argsort(slots)
    arrays: tuple[npt.NDArray[Any], ...] = (
        np.ascontiguousarray(decoded, dtype=np.float32),
        np.array(decoded.shape, np.int64),
        np.ascontiguousarray(places[:, order], np.int64),
        np.ascontiguousarray(slots[order], np.int64),
        offsets_in(decoded.shape[0]),
    )
    tile, shape, at, to, neighbours = map(pointer, arrays)
    code = checked(
        native.library().fhash_head_inputs(
            *(tile, shape, at, to, len(slots), neighbours),
            *(float(value_range.low), float(value_range.high), float(inverse), float(unit)),
            pointer(inputs),
        )
    )
    assert code == 0, "offsets within the reach of a head"


def _scales(value_range: ErrorRange) -> tuple[np.float32, np.float32]:
    """Return 1 / (2 sigma), which scales differences, and 1024 over the length of the range."""
    span = value_range.high - value_range.low
    unit = np.float32(1024) / span if span > 0 else np.float32(0)
    return np.float32(0.5) / value_range.sigma, unit


BETA1 = 0.9
"""Decay of Adam's mean of gradients per update."""
BETA2 = 0.999
"""Decay of Adam's mean of squared gradients per update."""
MIN_SCALE = 1e-6
"""Least unit of weights and biases in the file."""


def adam_factors(rates: Double) -> tuple[Double, Double]:
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
        parameters: weights (out, in) and biases (out,) of each layer in turn, float64 (n,).
        means: Adam's means of the gradients, likewise.
        squares: Adam's means of the squared gradients, likewise.
    """

    def __init__(self, widths: tuple[int, int], random: np.random.Generator):
        """Begin with uniform random numbers; the last layer begins near 0."""
        self.widths = widths
        rows, columns = (*widths, 1), (INPUTS, *widths)
        parts = []
        for number, (out, count) in enumerate(zip(rows, columns, strict=True)):
            reach = 1 / np.sqrt(np.float64(count))
            last = number == len(rows) - 1
            weights = random.uniform(-1, 1, size=out * count) * reach
            biases = random.uniform(-1, 1, size=out) * reach
            parts += [weights * 0.1 if last else weights, biases * 0.0 if last else biases]
        self.parameters: Double = np.concatenate(parts)
        self.means, self.squares = np.zeros((2, len(self.parameters)))

    def learn(
        self,
        voxels: Batches,
        first: int,
        rates: Double,
        roots: Double,
        *,
        rounded: bool,
        threads: int = 1,
    ) -> None:
        """Do some updates. Update u learns from batch u % batches.

        first: number of the first of these updates.
        rates, roots: `adam_factors` of these updates.
        rounded: whether weights and biases are rounded as in the file. Gradients pass through the
            rounding unchanged.
        threads: number that work on a batch together; they change no bit.
        """
        factors = np.ascontiguousarray(rates), np.ascontiguousarray(roots)
        _check(
            native.library().fhash_head_learn(
                *self._arguments(voxels),
                *map(pointer, (self.parameters, self.means, self.squares, *factors)),
                first,
                len(rates),
                rounded,
                threads,
            )
        )

    def squared_errors(self, voxels: Batches, *, rounded: bool) -> list[int]:
        """Return the sum of the squared errors of each batch, in squares of ERROR_UNIT."""
        sums = np.empty(len(voxels), dtype=np.int64)
        _check(
            native.library().fhash_head_errors(
                *self._arguments(voxels), pointer(self.parameters), rounded, pointer(sums)
            )
        )
        return sums.tolist()

    def layers(self) -> tuple[Layer, ...]:
        """Return the layers as the file holds them."""
        return tuple(
            Layer.of(as_in_file(weights, MAX_WEIGHT), as_in_file(biases, MAX_BIAS))
            for weights, biases in self.parts()
        )

    def parts(self) -> Iterator[tuple[Double, Double]]:
        """Yield the weights (out, in) and the biases (out,) of each layer."""
        at = 0
        for inputs, outputs in zip((INPUTS, *self.widths), (*self.widths, 1), strict=True):
            end = at + outputs * inputs
            yield self.parameters[at:end].reshape(outputs, inputs), self.parameters[end:][:outputs]
            at = end + outputs

    def _arguments(self, voxels: Batches) -> list[Any]:
        """Return the arguments of the native functions that describe the voxels."""
        batches, blocks, _, block = voxels.inputs.shape
        fields = ("inputs", "targets", "lowest", "highest", "weights")
        return [
            *(pointer(getattr(voxels, name)) for name in fields),
            (batches, blocks, block, *self.widths),
        ]


def as_in_file(values: Double, most: int) -> Scaled:
    """Return weights or biases as the integers of the file, at most `most` either way.

    Their unit is a float16 that maps the largest magnitude to at most `most`.
    """
    scale = float(np.float16(max(float(np.abs(values).max()) / most, MIN_SCALE)))
    return np.clip(np.rint(values / scale), -most, most).astype(np.int8), scale


def _check(code: int) -> None:
    """Raise MemoryError for a native function that failed."""
    if code != 0:
        raise MemoryError(f"no memory to train a head (code {code})")


WARM_UP = 0.1
"""Share of the schedule in which the learning rate rises."""
ROUNDED_FROM = 0.6
"""Share of the schedule from which on weights are rounded as in the file."""
STARTS = 2
"""Networks that are trained side by side at first."""
CHOSEN_AT = 0.15
"""Share of the schedule at which the best of them goes on alone."""
MEASUREMENTS = 5
"""Number of measurements of the gain during the training."""
UPDATES_AT_ONCE = 20
"""Updates after which the training says how far it is, and may be stopped."""


@dataclass(frozen=True, kw_only=True)
class TrainedHead:
    """A trained head and what it gains."""

    head: NeighbourHead
    gain_db: float
    """Gain in dB on held-out voxels."""
    history: tuple[tuple[float, int, float], ...]
    """Gain during the training: (seconds, update, gain in dB)."""
    samples: int
    """Voxels that it learned from."""
    parameters: Double
    """Weights and biases before they were rounded, as `Network` has them."""


def weights_of(widths: tuple[int, int]) -> int:
    """Return the number of weights of a head, biases not included.

    widths: of its two hidden layers.
    """
    first, second = widths
    return INPUTS * first + first * second + second


Learn = Callable[[Network, int, Double, Double, bool], None]
"""Function that does some updates by the batches that it holds: of a network, from the number of
the first one on, with their `adam_factors`, rounded as in the file or not (`Network.learn`)."""


def native_learner(voxels: Batches) -> Learn:
    """Return what learns from some batches by the native code, with all threads."""

    def learn(network: Network, first: int, rates: Double, roots: Double, rounded: bool) -> None:
        threads = usable_threads()
        network.learn(voxels, first, rates, roots, rounded=rounded, threads=threads)

    return learn


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Length of the training of a head, and what trains it."""

    updates: int
    """Number of training updates."""
    samples: int
    """Number of voxels that are learned from: what few teach, often repeated, holds for few."""
    seed: int = 0
    """Seed of the random numbers of its start and its samples."""
    rate: float = 1e-2
    """Highest learning rate. A short training gains as much as one of twice its length where it
    learns three times as fast; a long one does not."""
    learner: Callable[[Batches], Learn] = native_learner
    """Function of the batches that are learned from."""


def train_head(
    pairs: Sequence[Pair],
    low: float,
    high: float,
    widths: tuple[int, int],
    budget: Budget,
    *,
    progress: Callable[[float], None] | None = None,
    start: TrainedHead | None = None,
) -> TrainedHead | None:
    """Train a head that lowers the squared error of the voxels that count.

    The result is None where there is nothing to learn: where no voxel counts, where the decoded
    values are the original ones, or where their error is beyond what a head can state.

    pairs: decoded and original tiles (t, z, y, x) in data units.
    low, high: range that decoded values are clipped to.
    widths: of the hidden layers.
    budget: at least one update; a fifth as many further samples measure the gain.
    progress: called with the share of the training that is done, 0 to 1, after every few updates.
        What it raises ends the training.
    start: a head of these widths that goes on learning; None for a random start.
    """
    random = np.random.default_rng(budget.seed)
    bounds = np.float32(low), np.float32(high)
    counts = [max(1, round(n / BATCH_VOXELS)) for n in (budget.samples, budget.samples // 5)]
    drawn = draw(pairs, sum(counts) * BATCH_VOXELS, random, *bounds)
    if not any(voxels.values.size for voxels in drawn):
        return None
    sigma = _sigma(drawn) if start is None else np.float32(start.head.sigma)
    if not SIGMA_RANGE[0] <= sigma <= SIGMA_RANGE[1]:
        return None
    value_range = ErrorRange(low=bounds[0], high=bounds[1], sigma=sigma)
    both = batches(pairs, drawn, random, value_range)
    training, held_out = both.part(0, counts[0]), both.part(counts[0], None)
    networks = [Network(widths, random) for _ in range(STARTS if start is None else 1)]
    if start is not None:
        networks[0].parameters[:] = start.parameters
    learn = budget.learner(training)
    rates = _rates(budget.updates, budget.rate)
    history, network = _optimise(networks, learn, held_out, rates, progress)
    head = NeighbourHead(
        layers=network.layers(),
        sigma=float(sigma),
        low=float(bounds[0]),
        high=float(bounds[1]),
    )
    return TrainedHead(
        head=head,
        gain_db=history[-1][2],
        history=tuple(history),
        samples=counts[0] * BATCH_VOXELS,
        parameters=network.parameters,
    )


FEATURES = 48
"""Random features of the least squares that foretells the gain of a head."""
LOOKED_AT = 32_768
"""Voxels that it is fitted on; half as many measure its gain."""
SPREAD = 1.5
"""Deviation of its random weights, for inputs of about unit length."""
RIDGE = 1e-4
"""Share of the mean square of a feature that keeps the least squares well posed."""


def foretold_gain(pairs: Sequence[Pair], low: float, high: float, seed: int = 0) -> float:
    """Return the dB that least squares of random features of a head's inputs gain.

    Heads gain about twice as much. It is 0 where there is nothing to learn, see `train_head`.

    pairs: decoded and original tiles (t, z, y, x) in data units.
    low, high: range that decoded values are clipped to.
    """
    random = np.random.default_rng(seed)
    bounds = np.float32(low), np.float32(high)
    drawn = draw(pairs, LOOKED_AT + LOOKED_AT // 2, random, *bounds)
    if not any(voxels.values.size for voxels in drawn):
        return 0.0
    sigma = _sigma(drawn)
    if not SIGMA_RANGE[0] <= sigma <= SIGMA_RANGE[1]:
        return 0.0
    value_range = ErrorRange(low=bounds[0], high=bounds[1], sigma=sigma)
    both = batches(pairs, drawn, random, value_range)
    learned = both.part(0, LOOKED_AT // BATCH_VOXELS)
    tested = both.part(LOOKED_AT // BATCH_VOXELS, None)
    scale = SPREAD / math.sqrt(INPUTS)
    weights = random.standard_normal((INPUTS, FEATURES)) * scale
    biases = random.standard_normal(FEATURES) * SPREAD

    def design(voxels: Batches) -> tuple[Double, Double]:
        inputs = voxels.inputs.transpose(0, 1, 3, 2).reshape(-1, INPUTS) / 512.0
        features = np.maximum(inputs @ weights + biases, 0.0)
        targets = np.clip(voxels.targets, -MAX_ERROR, MAX_ERROR).reshape(-1) / ERROR_UNIT
        rows = np.concatenate([inputs, features, np.ones((len(inputs), 1))], axis=1)
        roots = np.sqrt(voxels.weights.astype(np.float64)).reshape(-1)
        return rows * roots[:, np.newaxis], targets * roots

    rows, targets = design(learned)
    gram = rows.T @ rows
    gram += RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    fitted = np.linalg.solve(gram, rows.T @ targets)
    rows, targets = design(tested)
    before, after = (float(np.sum(error * error)) for error in (targets, targets - rows @ fitted))
    # Rounded, since the last bits of products of matrices depend on the number of threads.
    return round(10 * math.log10(before / after), 2) if before > 0 and after > 0 else 0.0


def _sigma(drawn: Sequence[Voxels]) -> np.float32:
    """Return the root of the mean squared error of all voxels that count, by those drawn."""
    errors = np.concatenate(
        [voxels.originals - voxels.values.astype(np.float64) for voxels in drawn]
    )
    weights = np.concatenate([voxels.weights for voxels in drawn]).astype(np.float64)
    with np.errstate(over="ignore", under="ignore"):
        return np.float32(np.sqrt(np.sum(weights * errors * errors) / np.sum(weights)))


def _optimise(
    networks: list[Network],
    learn: Learn,
    held_out: Batches,
    rates: Double,
    progress: Callable[[float], None] | None,
) -> tuple[list[tuple[float, int, float]], Network]:
    """Train networks, from some update on only the best; return its gains on the way and it.

    The gains are tuples (seconds, update, dB).

    rates: learning rate of each update.
    """
    history: list[tuple[float, int, float]] = []
    updates = len(rates)
    factors, roots = adam_factors(rates)
    chosen, unrounded = (
        max(1, math.ceil(CHOSEN_AT * updates) - 1),
        math.floor(ROUNDED_FROM * updates),
    )
    measured = {-(-updates * number // MEASUREMENTS) for number in range(1, MEASUREMENTS + 1)}
    pauses = {*range(UPDATES_AT_ONCE, updates, UPDATES_AT_ONCE), *measured, chosen, unrounded}
    began, done = perf_counter(), 0
    for pause in sorted(pauses - {0}):
        for network in networks:
            learn(network, done + 1, factors[done:pause], roots[done:pause], done >= unrounded)
        done = pause
        if done == chosen:
            gains = [_gain(network, held_out, rounded=False) for network in networks]
            networks = [networks[gains.index(max(gains))]]
        if done in measured:
            gains = [_gain(network, held_out, rounded=True) for network in networks]
            history.append((perf_counter() - began, done, max(gains)))
        if progress is not None:
            progress(done / updates)
    return history, networks[0]


def _rates(updates: int, highest: float) -> Double:
    """Return the learning rate of each update: a linear rise, then a smooth fall to 0.

    The fall is the cubic 1 - f**2 (3 - 2 f), within 0.01 of a half cosine. The last bit of a
    cosine would depend on the machine.
    """
    share = np.arange(1, updates + 1) / updates
    fall = np.maximum(share - WARM_UP, 0) / (1 - WARM_UP)
    return highest * np.where(share < WARM_UP, share / WARM_UP, 1 - fall * fall * (3 - 2 * fall))


def _gain(network: Network, held_out: Batches, *, rounded: bool) -> float:
    """Return the dB that a network gains on the held-out voxels.

    Squares below that of the unit of errors count as that of the unit, so the gain is finite.
    """
    after = sum(network.squared_errors(held_out, rounded=rounded))
    return 10 * math.log10(max(_squares_before(held_out), 1) / max(after, 1))


def _squares_before(held_out: Batches) -> int:
    """Return the sum of the squared errors of the decoded values, as `squared_errors` has them."""
    sums = 0
    for targets, weights in zip(held_out.targets, held_out.weights, strict=True):
        errors = np.clip(targets.astype(np.int64), -MAX_ERROR, MAX_ERROR)
        sums += int((errors * np.rint(errors * weights.astype(np.float64)).astype(np.int64)).sum())
    return sums
