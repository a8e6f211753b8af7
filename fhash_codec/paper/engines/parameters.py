"""Parameters of an engine: initial values, places in the coarse tables, and Adam's constants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_codec.features.bricks import Coreset, sample_places
from fhash_codec.paper.network import Architecture, Resolution
from fhash_formats.support.values import Double, Longs, Single

BETA1 = 0.9
"""Decay of the mean of gradients per step."""
BETA2 = 0.999
"""Decay of the mean of squared gradients per step."""
EPSILON = 1e-8
"""Number added to the root of the mean square before it divides."""
WINDOW = 200
"""Steps without a gradient after which a parameter no longer moves.

(BETA1 / sqrt(BETA2))**200 is 8e-10.
"""

Chosen = Longs
"""Numbers (n,) of some bricks of the coreset, without repetition."""


class CatchUp(NamedTuple):
    """Effect of steps without a gradient on parameters, each float32 (n,).

    With Adam's mean m and mean square v as they were before these steps, a parameter moves by
    -factor * m / (sqrt(v) + epsilon). Then m decays by `mean_decay` and v by `square_decay`.
    """

    factor: Single
    epsilon: Single
    mean_decay: Single
    square_decay: Single


def corrections(step: int, rate: float) -> tuple[float, float]:
    """Return the numbers of a step of Adam: the factor of the mean square's root, and the pace.

    A parameter moves by -pace * mean / (factor * root + EPSILON).

    Args:
        step: number of the step, from 1 on.
        rate: learning rate.
    """
    return 1 / (1 - BETA2**step) ** 0.5, rate / (1 - BETA1**step)


def catch_up(visited: Longs, step: int, rates: Double) -> CatchUp:
    """Return the effect of the steps visited + 1 .. step, all with a gradient of zero.

    At step j = visited + i Adam moves a parameter by
    -rate_j m b1^i / (1 - b1^j) / (sqrt(v b2^i / (1 - b2^j)) + eps). With r = b1 / sqrt(b2) and
    c_j = sqrt(1 - b2^j) / (1 - b1^j) that is
    -rate_j r^i c_j m / (sqrt(v) + eps sqrt((1 - b2^j) / b2^i)).
    All but the last root leave the sum over i. The root varies slowly and is replaced by its
    harmonic mean under the weights rate_j r^i c_j. That is exact where sqrt(v) is far above eps and
    where it is far below.

    Args:
        visited: number of the last step with a gradient for each parameter, int64 (n,); 0 for none.
        step: number of the present step.
        rates: learning rate of every step, counted from 1.
    """
    gap = step - visited
    missed = np.where(visited > 0, gap, 0)
    i = np.arange(1, min(int(missed.max(initial=0)), WINDOW) + 1)
    j = visited[:, None] + i
    within = i <= missed[:, None]
    correction2 = -np.expm1(j * np.log(BETA2))
    weight = np.where(within, rates[np.minimum(j, len(rates) - 1)] * (BETA1 / BETA2**0.5) ** i, 0.0)
    weight *= np.sqrt(correction2) / -np.expm1(j * np.log(BETA1))
    factor = weight.sum(axis=1)
    inverse = (weight / np.sqrt(correction2 / BETA2**i)).sum(axis=1)
    epsilon = EPSILON * np.divide(factor, inverse, out=np.ones_like(factor), where=inverse > 0)
    return CatchUp(
        factor=factor.astype(np.float32),
        epsilon=epsilon.astype(np.float32),
        mean_decay=(BETA1 ** missed.astype(np.float64)).astype(np.float32),
        square_decay=(BETA2 ** missed.astype(np.float64)).astype(np.float32),
    )


SPREAD = 1e-4
"""Bound of the initial embeddings, uniform in -SPREAD .. SPREAD (Müller et al. 2022, section 4)."""
LIFT = 1.0
"""Amount by which the input that layers pass on is above ReLU's kink: values are in 0 .. 1."""
OTHERS = 0.1
"""Share of what other neurons add to it at the start."""
BRICKS_AT_A_TIME = 1024
"""Bricks whose vertices draw their embeddings at a time."""
DRAWN_AT_A_TIME = 1 << 15
"""Numbers that are drawn at a time: they stay in a core's cache."""


Numbers = TypeVar("Numbers", bound=Any)
"""A vector of numpy or of torch."""


@dataclass(frozen=True)
class Parameters:
    """The trained numbers of a model.

    Attributes:
        fine: embeddings of the finest level (E, samples), those of the samples alone, in the order
            of `Coreset.values`. At all other vertices they are 0.
        coarse: the coarser tables, each (buckets, E), level by level in one vector.
        network: the layers, each a matrix (out, in + 1) whose last column is the bias, in one
            vector.
    """

    fine: Single
    coarse: Single
    network: Single

    def dense(self, architecture: Architecture) -> tuple[list[Single], list[tuple[Single, Single]]]:
        """Return views of the coarse tables and of the layers.

        Returns:
            The tables (buckets, E), and weight (out, in) and bias (out,) of each layer.
        """
        size = architecture.embedding_size
        shapes = [(prod(level), size) for level in architecture.levels[1:]]
        layers = layer_matrices(architecture, self.network)
        return matrices_of(self.coarse, shapes), [(each[:, :-1], each[:, -1]) for each in layers]

    def as_trained(self, architecture: Architecture, coreset: Coreset) -> Parameters:
        """Return these of an engine that interpolates `coarse_levels`, the finest with them."""
        lattice = coreset.lattice
        if lattice is None:
            return self
        size = architecture.embedding_size
        finest = np.zeros((prod(architecture.levels[0]), size), np.float32)
        finest[_of_samples(architecture, lattice)] = self.fine.T
        coarse = np.concatenate([finest.reshape(-1), self.coarse])
        return Parameters(np.empty((0, len(coreset.values)), np.float32), coarse, self.network)

    def as_stored(self, architecture: Architecture, coreset: Coreset) -> Parameters:
        """Return them with the finest embeddings at the samples, from `as_trained`."""
        lattice = coreset.lattice
        if lattice is None:
            return self
        finest, coarse = np.split(self.coarse, [architecture.parameters_of_finest])
        fine = finest.reshape(-1, architecture.embedding_size)[_of_samples(architecture, lattice)]
        return Parameters(np.ascontiguousarray(fine.T), coarse, self.network)


def _of_samples(architecture: Architecture, lattice: Coreset) -> Longs:
    """Return the vertices (samples,) of the finest table at which the samples lie."""
    places = sample_places(lattice)
    return np.asarray(np.ravel_multi_index(tuple(places.T), architecture.sizes))


def matrices_of(vector: Numbers, shapes: Sequence[tuple[int, int]]) -> list[Numbers]:
    """Return views of the matrices that follow each other inside a vector."""
    ends = np.cumsum([0, *map(prod, shapes)])
    parts = zip(ends, ends[1:], shapes, strict=False)
    return [vector[first:end].reshape(shape) for first, end, shape in parts]


def layer_matrices(architecture: Architecture, network: Numbers) -> list[Numbers]:
    """Return views of the layers (out, in + 1) inside one vector."""
    shapes = [(outputs, inputs + 1) for outputs, inputs in architecture.layer_shapes]
    return matrices_of(network, shapes)


class _Uniform:
    """Uniform random numbers, the same bits as those of a generator of torch on a CPU."""

    def __init__(self, seed: int) -> None:
        # Both are the Mersenne twister of one seed; newer generators of numpy have other streams.
        self._random = np.random.RandomState(seed & 0xFFFFFFFF)

    def draw(self, count: int, bound: float) -> Single:
        """Return numbers in -bound .. bound, float32 (count,)."""
        numbers, limit = np.empty(count, np.float32), float(np.float32(bound))
        for first in range(0, count, DRAWN_AT_A_TIME):
            part = numbers[first : first + DRAWN_AT_A_TIME]
            share = self._random.randint(0, 1 << 32, len(part), np.uint32) & 0xFFFFFF
            # One rounding to float32, as by a fused multiply-add.
            part[:] = share * (2 * limit / (1 << 24)) - limit
        return numbers


def initial_parameters(architecture: Architecture, coreset: Coreset, seed: int) -> Parameters:
    """Return random parameters that depend on the seed alone, as an engine trains them.

    Embeddings are uniform in +-SPREAD (paper, section 3.2.4: uniform initialization). Layers are
    uniform in +-1/sqrt(inputs), as torch.nn.Linear starts them. Of one number at a vertex they then
    begin near the identity of the finest one, where all samples lie at key frames: the tables stay
    as even as the values, and take up to half of the bytes less. Samples between key frames are
    0.2 to 3 dB better from the random start, which leaves more to the coarser tables.
    """
    random = _Uniform(seed)
    fine = _initial_fine(architecture.embedding_size, coreset.lattice or coreset, random)
    coarse = random.draw(architecture.coarse_numbers, SPREAD)
    layers = [
        random.draw(outputs * (inputs + 1), inputs**-0.5)
        for outputs, inputs in architecture.layer_shapes
    ]
    start = Parameters(fine=fine, coarse=coarse, network=np.concatenate(layers))
    one_number = architecture.embedding_size == 1 and architecture.hidden_layers > 0
    if one_number and coreset.lattice is None:
        _pass_first_input(layer_matrices(architecture, start.network))
    return start.as_trained(architecture, coreset)


def _pass_first_input(layers: Sequence[Single]) -> None:
    """Let layers (out, in + 1) begin as x -> x of their first input, and little of all else.

    The first neuron of each layer has the input, lifted above ReLU's kink; the last layer lowers it
    again. All others stay as they are, and count OTHERS of what they would.
    """
    for layer in layers[:-1]:
        layer[0] = 0
        layer[0, 0] = 1
    layers[0][0, -1] = LIFT
    layers[-1][0] *= np.float32(OTHERS)
    layers[-1][0, 0], layers[-1][0, -1] = 1, -LIFT


def _initial_fine(size: int, coreset: Coreset, random: _Uniform) -> Single:
    """Return the finest embeddings (E, samples) at the start.

    All vertices of a brick draw a number, samples or not: where a vertex starts depends on its
    brick alone.
    """
    fine = np.empty((size, len(coreset.values)), np.float32)
    vertices = prod(coreset.brick_shape)
    for first in range(0, len(coreset.bricks), BRICKS_AT_A_TIME):
        bits = coreset.mask_bits[first : first + BRICKS_AT_A_TIME]
        drawn = random.draw(len(bits) * size * vertices, SPREAD).reshape(-1, size, vertices)
        in_coreset = np.unpackbits(bits, axis=1, count=vertices).view(np.bool_)
        span = slice(*coreset.offsets[[first, first + len(bits)]].tolist())
        for number in range(size):
            fine[number, span] = drawn[:, number][in_coreset]
    return fine


def check_state(
    state: Mapping[str, npt.NDArray[np.generic]], shapes: Mapping[str, Sequence[int]]
) -> None:
    """Raise KeyError or ValueError where a state of a checkpoint is of another model.

    It does so before a device is asked for memory: whatever fails then is not the checkpoint.

    Args:
        state: arrays by name.
        shapes: the shape that each array must have.
    """
    for name, shape in shapes.items():
        if state[name].shape != tuple(shape):
            raise ValueError(f"{name} is {state[name].shape}; the model has {tuple(shape)}")


@dataclass(frozen=True)
class LevelAxes:
    """The sub-lattices of one coarse level for every coordinate of a brick, axis by axis.

    Attributes:
        starts: for (key frame, z) together, for y and for x, the start of the sub-lattice in the
            flat tables, int64 (coordinates,).
        offsets: positions of the numbers of a sub-lattice relative to its start, in the order
            (corners t z x y, E), int64.
        axes: `axis_matrices` along t, z, y and x.
    """

    starts: tuple[Longs, ...]
    offsets: Longs
    axes: tuple[tuple[Longs, Double], ...]


def axis_matrices(size: int, corners: int, length: int, count: int) -> tuple[Longs, Double]:
    """Return the sub-lattice and the weights of each run of vertices along an axis.

    The first and the last vertex of the axis are the first and the last corner
    (`tesseract.locate`). Vertices beyond its end repeat the last one.

    Args:
        size: vertices of the axis.
        corners: corners of the level along the axis.
        length: vertices of a run.
        count: number of runs.

    Returns:
        The first corner of each sub-lattice (count,), and the weights (count, length, corners of a
        sub-lattice).
    """
    vertex = np.minimum(np.arange(count * length), size - 1).reshape(count, length)
    return weights_at(vertex * (corners - 1) / max(size - 1, 1), corners)


def weights_at(position: Double, corners: int) -> tuple[Longs, Double]:
    """Return what `axis_matrices` does of runs of positions (runs, vertices), in corners."""
    count, length = position.shape
    before = np.minimum(position.astype(np.int64), max(corners - 2, 0))
    after_weight = position - before
    sub_corners = min(int((before[:, -1] - before[:, 0]).max()) + 2, corners)
    start = np.minimum(before[:, 0], corners - sub_corners)
    weights = np.zeros((count, length, sub_corners))
    rows, columns = np.ogrid[:count, :length]
    weights[rows, columns, before - start[:, None]] = 1 - after_weight
    if corners > 1:
        weights[rows, columns, before - start[:, None] + 1] = after_weight
    return start, weights


def coarse_levels(architecture: Architecture, coreset: Coreset) -> tuple[Resolution, ...]:
    """Return the levels that are interpolated.

    They are all but the finest, and that one, too, where some samples lie between key frames.
    """
    return architecture.levels[coreset.lattice is None :]


def coarse_axes(architecture: Architecture, coreset: Coreset) -> list[LevelAxes]:
    """Return the sub-lattices of the coarse levels, whose flat tables follow each other."""
    levels, numbers = [], 0
    for resolution in coarse_levels(architecture, coreset):
        levels.append(_level_axes(architecture, coreset, resolution, numbers))
        numbers += prod(resolution) * architecture.embedding_size
    return levels


def _level_axes(
    architecture: Architecture, coreset: Coreset, resolution: tuple[int, ...], numbers: int
) -> LevelAxes:
    """Return the sub-lattices of one coarse level; `numbers` precede its flat table.

    A step of the samples is a run along time.
    """
    size, places = architecture.embedding_size, coreset.key_places
    corners_of_time = places[:, None] * (resolution[0] - 1) / max(architecture.key_frames - 1, 1)
    axes = (
        weights_at(corners_of_time, resolution[0]),
        *(
            axis_matrices(*along_axis)
            for along_axis in zip(
                *(architecture.box_size, resolution[1:], coreset.brick_shape, coreset.brick_grid),
                strict=True,
            )
        ),
    )
    stride = [prod(resolution[axis + 1 :]) * size for axis in range(4)]
    t, z, y, x = (start * step for (start, _), step in zip(axes, stride, strict=True))
    corners = [np.arange(w.shape[2]) * step for (_, w), step in zip(axes, stride, strict=True)]
    ct, cz, cx, cy, e = np.ix_(corners[0], corners[1], corners[3], corners[2], np.arange(size))
    return LevelAxes(
        starts=((t[:, None] + z).reshape(-1) + numbers, y, x),
        offsets=(ct + cz + cx + cy + e).reshape(-1),
        axes=axes,
    )


def used_numbers(
    levels: Sequence[LevelAxes], coreset: Coreset, numbers: int
) -> tuple[Longs, npt.NDArray[np.int32] | None]:
    """Return the numbers of the flat coarse tables that some brick needs.

    Training holds only these: around a sparse feature most of the coarse tables is out of reach.

    Args:
        levels: the coarse levels (`coarse_axes`).
        coreset: the training samples.
        numbers: numbers of all coarse tables.

    Returns:
        Their positions, ascending, and for each position its place among them; None if all are
        used.
    """
    in_use = np.zeros(numbers, np.bool_)
    for first in range(0, len(coreset.bricks), BRICKS_AT_A_TIME):
        t, z, y, x = coreset.bricks[first : first + BRICKS_AT_A_TIME].astype(np.int64).T
        along = (t * coreset.brick_grid[0] + z, y, x)
        for level in levels:
            starts = (start[c] for start, c in zip(level.starts, along, strict=True))
            in_use[np.unique(sum(starts, np.int64(0)))[:, None] + level.offsets] = True
    used = np.flatnonzero(in_use)
    if len(used) == numbers:
        return used, None
    return used, np.cumsum(in_use, dtype=np.int32) - np.int32(1)


LIBRARIES = 1 << 28
"""Bytes for the libraries of CUDA and what kernels take for a step."""


def needed_bytes(architecture: Architecture, coreset: Coreset) -> int:
    """Return about how many bytes of a device a training takes, rather too many than too few.

    Args:
        architecture: the sizes of the model.
        coreset: the training samples.
    """
    bricks, samples = len(coreset.bricks), len(coreset.values)
    network = sum(outputs * (inputs + 1) for outputs, inputs in architecture.layer_shapes)
    size, lattice = architecture.embedding_size, coreset.lattice
    numbers = architecture.coarse_numbers
    # Values, masks, offsets and coordinates.
    held = 4 * samples + coreset.mask_bits.nbytes + bricks * (8 + 8 + 4 * 8)
    if lattice is None:
        # Embeddings, mean and square of the finest level.
        held += 12 * size * samples
    else:
        # What bricks reach of the finest table at their key frame and the next.
        corners = 2 * len(lattice.bricks) * prod(length + 1 for length in lattice.brick_shape)
        numbers += min(architecture.parameters_of_finest, corners * size)
    # Four vectors of the numbers in use, and their places.
    return LIBRARIES + held + numbers * (4 * 4 + 4) + 16 * network
