"""Coding of a trained model: its tables by the planner of every table, with the error allowed.

The inputs of the network are nearly independent small errors, so that the derivatives of its value
tell which error of the tables adds which error to the values: no step is searched for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import prod
from operator import itemgetter

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.compact.encode import CodedTable, at_step, code_series
from fhash_codec.compact.goal import SLOPE, Bracket, step_after_gain
from fhash_codec.config import EncodeConfig
from fhash_codec.features.bricks import Coreset
from fhash_codec.features.features import Extent
from fhash_codec.features.scan import Scan
from fhash_codec.features.selection import FeatureSelection
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.paper.fit import TrainedModel
from fhash_codec.paper.network import Architecture, Layer, Network
from fhash_codec.paper.storage import Bricks, component_name
from fhash_codec.paper.tables import (
    Samples,
    TrainedTable,
    quantised_layers,
    trained_tables,
    write_layers,
    write_mask,
)
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter
from fhash_formats.series import AXES, Series, index_coordinate
from fhash_formats.support.values import Mask, Single
from fhash_formats.transform.tile import plain_step

Matrix = npt.NDArray[np.float64]
Tables = list[list[CodedTable]]
"""Coded components of each level, finest first."""

MIN_IMPORTANCE = 1e-4
"""Smallest eigenvalue of M that is used, as a share of the largest of the same level.

The network is not linear, so a direction that seems not to matter may still matter a little.
"""
MIN_LEVEL_IMPORTANCE = 1e-12
"""Smallest eigenvalue of M that is used, as a share of the largest trace of M of all levels."""
MAX_LOSS = 0.1
"""dB that coding may cost over the samples where no PSNR is promised or the promise is lost."""
MIN_ERROR = 1e-20
"""Smallest mean squared error that coding may reach, for tables without any error."""
MAX_PSNR = 120.0
"""Largest PSNR in dB of a component: float32, in which readers evaluate, hardly has more."""
LAYERS_SHARE = 0.04
"""Share of the error that coding may add, for the quantised layers."""
WRITINGS = 16
"""Times that a model is written at most until its file keeps the promise."""
COMMON = 8
"""Times up to which all tables have one step."""
EXCESS = 0.06
"""dB of the error that tables may add, some 0.5 % of the bytes, for which they are coded again."""
NEAR = 0.03
"""dB of the error that coding adds by which a correction aims below what is allowed."""
MOST = 6.0
"""dB by which a correction changes that error, at most."""


class Component(Series):
    """One number at each vertex of a level, as a series of its time nodes.

    Components of all levels are such that equal errors add equal errors to the values.

    Attributes:
        table: the trained table.
        mixing: float32 (E,), the embedding that 1 of the component adds.
        unmixing: float64 (E,); the component is the product of it and the embedding.
        count: number of needed vertices.
        variance: of the component at these.
        value_range: of the component at these.
    """

    def __init__(self, table: TrainedTable, mixing: Single, unmixing: Matrix) -> None:
        t, z, y, x = table.shape[:4]
        self.shape = t, z, y, x
        self.source = self.name = "component"
        self.dtype, self.units, self.attributes = np.dtype(np.float32), "", {}
        self.coords = {a: index_coordinate(a, n) for a, n in zip(AXES, self.shape, strict=True)}
        self.table, self.mixing, self.unmixing = table, mixing, unmixing
        self._region = (slice(0, z), slice(0, y), slice(0, x))
        needed = [self._needed(node) for node in range(t)]
        numbers = [self.read(node)[mask].astype(np.float64) for node, mask in enumerate(needed)]
        held = [each for each in numbers if len(each)] or [np.zeros(1)]
        self.count = sum(map(len, numbers))
        low, high = min(float(each.min()) for each in held), max(float(e.max()) for e in held)
        self.value_range = ValueRange(low, high)
        mean = sum(float(each.sum()) for each in held) / max(self.count, 1)
        squares = sum(float(np.square(each - mean).sum()) for each in held)
        self.variance = squares / max(self.count, 1)
        self._packed = [np.packbits(mask) for mask in needed]

    def read(self, step: int) -> Single:
        """Return the component (z, y, x) at a time node."""
        region = (slice(step, step + 1), *self._region, slice(0, len(self.mixing)))
        return np.ascontiguousarray(self.table.read(region)[0] @ self.unmixing, np.float32)

    def _needed(self, node: int) -> Mask:
        mask: Mask = self.table.needed((slice(node, node + 1), *self._region))[0]
        return mask

    def selection(self) -> FeatureSelection:
        """Return the needed vertices as the feature of the series."""
        space = self.shape[1:]
        return FeatureSelection(
            scanned=Scan(
                value_range=self.value_range, mean=0.0, finite_count=self.count, missing={}
            ),
            features=(),
            extent=Extent(
                box=Box.of_shape(space),
                key_frames=tuple(range(self.shape[0])),
                packed=self._packed,
                domain=space,
                samples=self.count,
                background=0.0,
                stored=False,
            ),
        )

    def code(self, error: float, progress: Progress) -> CodedTable:
        """Code the component with a mean squared error at the needed vertices."""
        low, high = self.value_range.ends
        psnr = 0.0
        if low < high and error < self.variance:
            psnr = max(20 * math.log10(high - low) - 10 * math.log10(error), 0.0)
            psnr = min(psnr, MAX_PSNR)
        config = EncodeConfig(psnr=psnr, train="none", preset="small")
        return code_series(self, self.selection(), config, progress)


@dataclass(frozen=True, kw_only=True)
class ModelCoding:
    """A trained model, and the error that its coding may add.

    Attributes:
        coreset: the samples at the key frames.
        samples: those of the training.
        components: those of each level, finest first.
        layers: weight and bias of each layer, as the file gets them.
        scales: of weight and bias of each layer in turn; None for plain numbers.
        exact: mean squared error of the trained model at the samples.
        error: the same with the layers of the file.
        in_reach: whether the trained model keeps the promise; False without one.
        allowed: mean squared error that the written model may have.
        step: the quantiser step of all components.
        tables: the coded components of each level.
        tried: logarithms of `step` that were too low and too high.
        kept: of the codings before this one whose file kept the promise the one with the largest
            error, and what it was missing, below 0; None without one.
        nearest: of all before this one that whose file came nearest to the promise, likewise.
        writings: how often the model was written, this time included.
    """

    coreset: Coreset
    samples: Samples
    components: list[list[Component]]
    layers: list[Layer]
    scales: list[float] | None
    exact: float
    error: float
    in_reach: bool
    allowed: float
    step: float
    tables: Tables
    tried: Bracket = field(default_factory=lambda: Bracket(-math.inf, math.inf))
    kept: tuple[float, ModelCoding] | None = None
    nearest: tuple[float, ModelCoding] | None = None
    writings: int = 1

    @classmethod
    def of(
        cls,
        architecture: Architecture,
        samples_of: Coreset,
        model: TrainedModel,
        psnr: float | None,
        progress: Progress,
    ) -> ModelCoding:
        """Code a model for a promised PSNR in dB over the samples, if any.

        Where the model has less, and without a promise, coding costs MAX_LOSS.

        samples_of: the samples of the training.
        """
        coreset, samples = samples_of.lattice or samples_of, Samples(samples_of)
        tables = trained_tables(architecture, coreset, Bricks(coreset), model.fine, model.tables)

        def network(layers: Sequence[Layer]) -> Network:
            return Network.of(architecture, tables, layers)

        exact = samples.error(network(model.layers))
        allowed = 0.0 if psnr is None else 10 ** (-psnr / 10)
        in_reach = allowed > exact
        if not in_reach:
            allowed = max(exact * 10 ** (MAX_LOSS / 10), MIN_ERROR)
        few, share = samples.error_of_few(network(model.layers)), LAYERS_SHARE * (allowed - exact)

        def added(layers: Sequence[Layer]) -> float:
            """The error that layers add: at few samples, and at all where it is small there."""
            quick = samples.error_of_few(network(layers)) - few
            return quick if quick > share else samples.error(network(layers)) - exact

        layers, scales, more = quantised_layers(model.layers, added, share)
        error = exact + more
        slopes = samples.slopes(network(layers)).astype(np.float64)
        components = _components(architecture, samples.count, tables, slopes)
        step, coded = _coded(components, samples.count * (allowed - error), progress)
        return cls(
            coreset=coreset,
            samples=samples,
            components=components,
            layers=layers,
            scales=scales,
            exact=exact,
            error=error,
            in_reach=in_reach,
            allowed=allowed,
            step=step,
            tables=coded,
        )

    def write(self, writer: ContainerWriter) -> None:
        """Write tables, layers and occupancy."""
        for level, (tables, components) in enumerate(
            zip(self.tables, self.components, strict=True), start=1
        ):
            for number, (table, component) in enumerate(
                zip(tables, components, strict=True), start=1
            ):
                mixing = [float(str(each)) for each in component.mixing]
                table.parts.write(writer, component_name(level, number), {"mixing": mixing})
        write_layers(writer, self.layers, self.scales)
        write_mask(writer, self.coreset)

    def loss(self, network: Network) -> float:
        """Return the dB of PSNR over the samples that the coding of a written model has cost."""
        error = self.samples.error(network)
        return 10 * math.log10(error / self.exact) if error > 0 and self.exact > 0 else 0.0

    def unused(self, missing: float) -> float:
        """Return by how many dB the tables could add more error.

        missing: dB of PSNR that the file has less than allowed; below 0 what it has beyond that.
        """
        found = self.allowed * 10 ** (missing / 10) - self.error
        return 10 * math.log10((self.allowed - self.error) / found) if found > 0 else math.inf

    def following(self, missing: float, loss: float, progress: Progress) -> ModelCoding | None:
        """Code the tables so that the file should have what is missing; None where this one is it.

        missing: as in `unused`.
        loss: dB that coding has cost.
        """
        enough = missing <= 0 and self.unused(missing) < EXCESS
        if math.isinf(missing) or enough or self.writings == WRITINGS:
            return None
        kept, nearest, alone = self.kept, self.nearest, replace(self, kept=None, nearest=None)
        if missing <= 0 and (kept is None or missing > kept[0]):
            kept = missing, alone
        if nearest is None or abs(missing) < abs(nearest[0]):
            nearest = missing, alone
        of_coding = self.exact * 10 ** (loss / 10) - self.error
        if self.allowed * (10 ** (missing / 10) - 1) > of_coding:
            return None  # more is missing than coding has cost
        number = self.writings + 1
        if number == WRITINGS:
            return kept and replace(kept[1], writings=WRITINGS)
        found = replace(self, kept=kept, nearest=nearest, writings=number)
        if number > COMMON and kept is not None:
            turns, level = divmod(number - COMMON - 1, len(self.tables))
            tables = nearest[1]._with_other_step(nearest[0], level, 0.5**turns, progress)
            return replace(found, tables=tables)
        tried = self.tried.narrowed(math.log(self.step), too_low=missing <= 0)
        change = min(max(self.unused(missing) - NEAR, -MOST), MOST)
        step = math.exp(tried.inside(math.log(self.step) + change / SLOPE))
        tables = _at_step(self.tables, step, progress)
        return replace(found, step=step, tables=tables, tried=tried)

    def _with_other_step(
        self, missing: float, level: int, share: float, progress: Progress
    ) -> Tables:
        """Return the tables, one level with the step that adds a share of the error that is left.

        The error of small tables jumps from one step of all levels to the next.
        """
        left = share * (self.allowed - self.error) * (1 - 10 ** (-self.unused(missing) / 10))
        own = sum(table.outcome.squares for table in self.tables[level]) / self.samples.count
        change = 1 + left / own if own > 0 else math.inf
        gain = min(max(10 * math.log10(max(change, 1e-9)), -MOST), MOST)
        tables = list(self.tables)
        step = step_after_gain(plain_step(tables[level][-1].plan.settings), gain)
        tables[level] = [at_step(each, step, progress) for each in tables[level]]
        return tables


def _coded(
    components: list[list[Component]], squares: float, progress: Progress
) -> tuple[float, Tables]:
    """Code all components with one step, by a sum of the squared errors of all; step and tables.

    Each is planned for its share. One step for all is then what the same error costs least with.
    """
    error = _error_of_each(components, squares)
    tables = [[each.code(error, progress) for each in level] for level in components]
    largest = max((each for level in tables for each in level), key=lambda each: each.outcome.size)
    widest = max(each.plan.goal.data_range for level in tables for each in level)
    step = min(plain_step(largest.plan.settings), widest or math.inf)
    tables = _at_step(tables, step, progress)
    found = sum(each.outcome.squares for level in tables for each in level)
    gain = 10 * math.log10(squares / found) if found > 0 else 0.0
    if abs(gain) > EXCESS:
        step = step_after_gain(step, gain)
        tables = _at_step(tables, step, progress)
    return step, tables


def _at_step(tables: Tables, step: float, progress: Progress) -> Tables:
    return [[at_step(each, step, progress) for each in level] for level in tables]


def _error_of_each(components: list[list[Component]], squares: float) -> float:
    """Return the mean squared error at the needed vertices of each component.

    It is the same for all, and the variance where a component has less.

    squares: sum of the squared errors of all.
    """
    parts = [(each.count, each.variance) for level in components for each in level]
    vertices = sum(count for count, _ in parts)
    for count, variance in sorted(parts, key=itemgetter(1)):
        if variance * vertices >= squares:
            break
        squares, vertices = squares - count * variance, vertices - count
    return squares / vertices if vertices else math.inf


def _components(
    architecture: Architecture,
    samples: int,
    tables: Sequence[TrainedTable],
    slopes: Matrix,
) -> list[list[Component]]:
    """Return the components of each level.

    Args:
        architecture: the sizes of the tables.
        samples: number of samples of the training.
        tables: the trained tables, finest first.
        slopes: derivatives (inputs, n) of the value by the network's inputs at some samples.
    """
    moments = [_moments(table) for table in tables]
    importances: list[Matrix] = []
    for level, of_level, (count, _, _) in zip(
        architecture.levels, np.split(slopes, len(tables)), moments, strict=True
    ):
        weight = prod(
            squared_weights(length, resolution)
            for length, resolution in zip(architecture.sizes, level, strict=True)
        )
        square = of_level @ of_level.T / of_level.shape[1]
        importances.append(square * (samples * weight / max(count, 1)))
    floor = MIN_LEVEL_IMPORTANCE * max(float(np.trace(matrix)) for matrix in importances) or 1.0
    return [
        [Component(table, *pair) for pair in zip(*_mixing(importance, floor, *known), strict=True)]
        for table, importance, known in zip(tables, importances, moments, strict=True)
    ]


def squared_weights(length: int, resolution: int) -> float:
    """Return the mean of the summed squared interpolation weights at the vertices of an axis.

    Args:
        length: vertices of the box along the axis.
        resolution: vertices of the level along the axis.
    """
    span = max(length - 1, 1)
    after_weight = np.arange(length) * (resolution - 1) % span / span
    return float((after_weight**2 + (1 - after_weight) ** 2).mean())


def _moments(table: TrainedTable) -> tuple[int, Matrix, Matrix]:
    """Return number, sum (E,) and sum of products (E, E) of the needed embeddings of a level."""
    t, z, y, x, size = table.shape
    count, total, squares = 0, np.zeros(size), np.zeros((size, size))
    for node in range(t):
        region = (slice(node, node + 1), slice(0, z), slice(0, y), slice(0, x), slice(0, size))
        embeddings = table.read(region)[table.needed(region)].astype(np.float64)
        count += len(embeddings)
        total, squares = total + embeddings.sum(axis=0), squares + embeddings.T @ embeddings
    return count, total, squares


def _mixing(
    importance: Matrix, floor: float, count: int, total: Matrix, squares: Matrix
) -> tuple[Single, Matrix]:
    """Return mixing and unmixing (E, E) of a level: components = unmixing @ embedding.

    Args:
        importance: the matrix M of the level.
        floor: smallest eigenvalue of M that is used.
        count, total, squares: of `_moments`.
    """
    values, axes = np.linalg.eigh(importance)
    roots = np.sqrt(np.maximum(values, max(MIN_IMPORTANCE * float(values[-1]), floor)))
    half, inverse = axes * roots @ axes.T, axes / roots @ axes.T
    mean = total / max(count, 1)
    _, principal = np.linalg.eigh(half @ (squares / max(count, 1) - np.outer(mean, mean)) @ half)
    # The file has the mixing in float32. The unmixing is the inverse of that.
    mixing = np.ascontiguousarray((inverse @ principal).T.astype(np.float32))
    return mixing, np.linalg.inv(mixing.T.astype(np.float64))
