"""Cases of networks, their checks, and the network in float64, written as its definition."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.devices import choose_device
from fhash_codec.encoding import encode
from fhash_codec.paper.model import decode_region, sample_points
from fhash_codec.paper.network import ArrayTable, Network, NumberType
from fhash_codec.paper.storage import load_network
from fhash_codec.selftest.case import Case, Check, Finding, Run, as_floats
from fhash_codec.selftest.field_cases import Settings, noise, single, spike, waves
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.support.values import Double

UNIT = 2.0**-24
"""Largest relative error of one float32 rounding."""
N_POINTS = 40
"""Random points of each comparison."""
DIFFERENCE_STEP = 2.0**-16
"""Step of the finite differences in vertex spacings; a power of two, so that positions are exact.
"""
NEAR = 1e-4
"""Allowed float32 error of a trained network, as a share of the range. A network whose training was
stopped early may need more, since larger terms cancel in it."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The network's output at one point, normalised.

    Attributes:
        value: the output.
        rounding: bound on the error of a float32 evaluation.
        active: for every ReLU in order, whether its input is positive.
    """

    value: float
    rounding: float
    active: tuple[bool, ...]


class Oracle:
    """A network's tables and layers as float64, read once."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.sizes = (network.key_frames, *network.box_size)
        self.layers = [
            (weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in network.layers
        ]

    @cached_property
    def tables(self) -> list[Double]:
        """The table (t, z, y, x, embedding) of each level."""
        regions = [
            tuple(slice(0, length) for length in table.shape[:4]) for table in self.network.tables
        ]
        return [
            self.network.read(level, region).astype(np.float64)
            for level, region in enumerate(regions)
        ]

    def at(self, point: Sequence[float]) -> Answer:
        """The output at a point (key index, z, y, x), in vertices of the box."""
        inputs, magnitudes = [], []
        for table in self.tables:
            value, magnitude = self._embedding(table, point)
            inputs.append(value)
            magnitudes.append(magnitude)
        hidden, reach = np.concatenate(inputs), np.concatenate(magnitudes)
        # Five roundings along each of four axes: weight, its complement, two products and a sum.
        rounding = 4 * 5 * UNIT * reach
        active: list[bool] = []
        for number, (weight, bias) in enumerate(self.layers):
            if number > 0:
                active += (hidden > 0).tolist()
                hidden = np.maximum(hidden, 0.0)
            terms = np.abs(weight) @ np.abs(hidden) + np.abs(bias)
            # A sum of n + 1 products in any order. Earlier errors are multiplied by the weights; a
            # ReLU does not enlarge them.
            rounding = np.abs(weight) @ rounding + (weight.shape[1] + 2) * UNIT * (
                terms + np.abs(weight) @ rounding
            )
            hidden = weight @ hidden + bias
        return Answer(value=float(hidden[0]), rounding=float(rounding[0]), active=tuple(active))

    def _embedding(self, table: Double, point: Sequence[float]) -> tuple[Double, Double]:
        """The quadrilinear mean of the embeddings at the 16 corners around a point, and the largest
        magnitude among these."""
        before, share = [], []
        for place, size, corners in zip(point, self.sizes, table.shape, strict=False):
            position = place * (corners - 1) / max(size - 1, 1)
            first = min(int(position), max(corners - 2, 0))
            before.append(first)
            share.append(position - first)
        value, magnitude = np.zeros(table.shape[4]), np.zeros(table.shape[4])
        for corner in np.ndindex(2, 2, 2, 2):
            factor = 1.0
            for up, weight in zip(corner, share, strict=True):
                factor *= weight if up else 1.0 - weight
            at = tuple(
                min(first + up, length - 1)
                for first, up, length in zip(before, corner, table.shape, strict=False)
            )
            value += factor * table[at]
            magnitude = np.maximum(magnitude, np.abs(table[at]))
        return value, magnitude


def agrees(run: Run) -> Iterator[Finding]:
    """Decoded and sampled values equal the oracle's up to the rounding of float32."""
    oracle = Oracle(load_network(run.volume.container))
    network, generator = oracle.network, np.random.default_rng(11)
    ends = np.array(oracle.sizes)[:, None] - 1.0
    places = generator.random((4, N_POINTS)) * ends
    vertices = np.rint(generator.random((4, N_POINTS)) * ends)
    key = float(generator.random() * ends[0, 0])
    z, y, x = ((0, length) for length in network.box_size)
    frame = decode_region(network, key, (z, y, x))
    decoded = np.array([frame[tuple(vertices[1:, n].astype(int))] for n in range(N_POINTS)])
    on_frame = np.concatenate([np.full((1, N_POINTS), key), vertices[1:]])
    compared = {
        "sampling": (places, sample_points(network, *places)),
        "sampling at vertices": (vertices, sample_points(network, *vertices)),
        "decoding between key frames": (on_frame, decoded),
    }
    for name, (points, values) in compared.items():
        expected = [oracle.at(point) for point in points.T]
        off = np.abs(values.astype(np.float64) - [answer.value for answer in expected])
        allowed = np.array([answer.rounding for answer in expected])
        yield Finding(
            "float64 oracle", np.max(off / allowed), 1.0, "of the rounding of float32", name
        )
        yield Finding(
            "float64 oracle, error",
            off.max(),
            max(NEAR, float(allowed.max())),
            "of the range",
            name,
        )


def gradients(run: Run) -> Iterator[Finding]:
    """The analytic gradient equals the oracle's finite differences on the documented side of a cell
    or kink.

    On a vertex, the derivative is that of the cell after it, so the differences are taken towards
    that cell; at the end of an axis they are taken towards the cell before it. Within a cell, the
    network is a polynomial between kinks: differences across a kink are counted, not compared.
    """
    oracle = Oracle(load_network(run.volume.container))
    generator = np.random.default_rng(12)
    ends = np.array(oracle.sizes) - 1.0
    points = generator.random((N_POINTS, 4)) * ends
    points[::4] = np.rint(points[::4])
    points = np.rint(points / DIFFERENCE_STEP) * DIFFERENCE_STEP
    points = np.clip(points, 0.0, ends)
    _, slopes = sample_points(oracle.network, *points.T, gradient=True)
    scale = float(np.abs(slopes).max()) or 1.0
    worst, over = 0.0, 0
    for point, slope in zip(points, slopes, strict=True):
        start = oracle.at(point)
        for axis in range(4):
            if ends[axis] == 0:
                worst = max(worst, abs(float(slope[axis])) / scale)
                continue
            step = DIFFERENCE_STEP if point[axis] < ends[axis] else -DIFFERENCE_STEP
            first, second = (oracle.at(point + np.eye(4)[axis] * step * times) for times in (1, 2))
            if not start.active == first.active == second.active:
                over += 1
                continue
            difference = (-3 * start.value + 4 * first.value - second.value) / (2 * step)
            worst = max(worst, abs(difference - float(slope[axis])) / scale)
    yield Finding("gradient = differences", worst, 1e-3, "of the largest derivative")
    yield Finding("derivatives beside kinks", over / (4 * N_POINTS), 0.25, "of all, not compared")


MAX_DEVICE_DIFFERENCE = 1e-3
"""Allowed difference of two devices after 90 updates, as a share of the range.

Their products round differently in each update. Adam divides each gradient by its own size, so the
sign of a gradient that is rounding error alone moves an embedding by a full step.
"""
BEYOND_FLOAT16 = (65505.0, 65520.0, 1e9, 3e38)
"""Table entries that float16 cannot represent."""
MAX_FLOAT16 = 65504.0
"""The largest float16."""


def recovered(run: Run) -> Iterator[Finding]:
    """The training reports its learning rate and restarts, and its result is better than a
    constant, however high the first rate was."""
    training, values = run.volume.container.header["training"], run.values.astype(np.float64)
    rate, restarts = (
        training.get("learning_rate", run.config.learning_rate),
        training.get("restarts", 0),
    )
    consistent = rate == run.config.learning_rate * 0.25**restarts
    yield Finding("rate and restarts told", not consistent, 0.0, "of them wrong")
    yield Finding("rate at the end", rate, run.config.learning_rate, "")
    error = float(np.sqrt(np.mean((run.decoded - values) ** 2)))
    yield Finding("better than a constant", error / float(values.std()), 0.98, "of the deviation")


def diverged(run: Run) -> Iterator[Finding]:
    """A training that diverges at its learning rate has restarted."""
    yield Finding(
        "divergence not found",
        not run.volume.container.header["training"].get("restarts", 0),
        0.0,
        "",
    )


def devices(run: Run) -> Iterator[Finding]:
    """A CUDA device trains the same network as the CPU; nothing is compared without CUDA."""
    try:
        choose_device("cuda")
    except (InputError, MissingDependencyError):
        return
    yield _apart(run, "cuda = cpu", replace(run.config, device="cuda"), MAX_DEVICE_DIFFERENCE)


def ends_of_half_precision(run: Run) -> Iterator[Finding]:
    """Tables beyond the range of float16 are refused, and the largest float16 comes back."""
    accepted = 0
    for largest in BEYOND_FLOAT16:
        for sign in (1.0, -1.0):
            try:
                NumberType.of(np.array([0.5, sign * largest], np.float32), "float16")
            except InputError:
                continue
            accepted += 1
    yield Finding("too large for float16", accepted, 0.0, "tables accepted")
    ends = np.array([MAX_FLOAT16, -MAX_FLOAT16], np.float32)
    kept = NumberType.of(ends, "float16").stored(ends)
    other = int(np.count_nonzero(np.abs(kept) != MAX_FLOAT16))
    yield Finding("largest of float16", other, 0.0, "values")


def large_tables(run: Run) -> Iterator[Finding]:
    """Tables at the ends of float16 and float32 decode to finite values, correct up to the rounding
    of the terms that cancel."""
    for dtype, largest in ((np.float16, MAX_FLOAT16), (np.float32, 1e30)):
        table = np.full((1, 2, 2, 2, 1), largest, dtype)
        table[0, 0] = -largest
        network = _linear([table], weight=1 / (2 * largest), bias=0.5)
        oracle = Oracle(network)
        places = np.array(
            list(itertools.product((0.0,), (0.0, 0.3, 1.0, 2.0), (0.0, 0.7, 2.0), (1.1,)))
        ).T
        sampled = sample_points(network, *places)
        answers = [oracle.at(point) for point in places.T]
        off = np.abs(sampled.astype(np.float64) - [answer.value for answer in answers]) / [
            answer.rounding for answer in answers
        ]
        name = np.dtype(dtype).name
        yield Finding("large tables", off.max(), 1.0, "of the rounding of float32", name)
        frame = decode_region(network, 0.0, ((0, 3), (0, 3), (0, 3)))
        worst = float(np.abs(frame[:, 0, 0] - [0.0, 0.5, 1.0]).max())
        yield Finding("large tables, vertices", worst, 1e-6, "of the range", name)


def constant_tables(run: Run) -> Iterator[Finding]:
    """Constant tables, however small, give one value and no slope; each number type stores them."""
    worst, slope = 0.0, 0.0
    for value in (0.0, 1e-45, 1e-30, 1e-7, 1.0):
        table = np.full((2, 3, 3, 3, 1), value, np.float32)
        network = replace(_linear([table], weight=0.5, bias=0.25), key_frames=2)
        places = np.random.default_rng(3).random((4, 20)) * [[1.0], [2.0], [2.0], [2.0]]
        values, slopes = sample_points(network, *places, gradient=True)
        worst = max(worst, float(np.abs(values - (0.25 + 0.5 * value)).max()))
        slope = max(slope, float(np.abs(slopes).max()))
    yield Finding("constant tables", worst, 2.0**-23, "of the range")
    yield Finding("constant tables, slopes", slope, 0.0, "of the range")
    for kind in ("float32", "float16", "uint8"):
        off = 0.0
        for value in (0.0, 1e-45, 1e-38, 1e-7, 1.0, -3.0):
            table = np.full(4, value, np.float32)
            numbers = NumberType.of(table, kind)
            back = numbers.stored(table).astype(np.float64) * numbers.scale + numbers.offset
            off = max(
                off, float(np.abs(back - np.float32(value)).max()) / max(abs(value) / 255, 6e-8)
            )
        yield Finding("constant tables, stored", off, 1.0, "of a step", kind)


def kinks(run: Run) -> Iterator[Finding]:
    """The derivative on a ReLU's kink is that of its flat side, and beside the kink that of its
    side.

    Both directions of a kink are tested, in the first layer and behind another layer.
    """
    ramp = np.arange(5, dtype=np.float32).reshape(1, 1, 1, 5, 1) / 4
    one, zero = np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    wrong, off = 0, 0.0
    for rises, deep in itertools.product((1.0, -1.0), (False, True)):
        # max(0, +-(x - 2) / 4), which is flat on one side of x = 2.
        first = (np.float32(rises) * one, np.array([-0.5 * rises], np.float32))
        layers = (first, (one, zero), (one, zero)) if deep else (first, (one, zero))
        network = Network(
            levels=((1, 1, 1, 5),),
            embedding_size=1,
            tables=[ArrayTable(ramp)],
            layers=layers,
            box_size=(1, 1, 5),
            key_frames=1,
        )
        oracle = Oracle(network)
        x = np.array([0.5, 1.0, 2.0 - 2.0**-10, 2.0, 2.0 + 2.0**-10, 2.5, 4.0])
        values, slopes = sample_points(network, 0.0, 0.0, 0.0, x, gradient=True)
        expected = np.where((x - 2.0) * rises > 0, rises / 4, 0.0)
        wrong += int(np.count_nonzero(slopes[:, 3] != expected)) + int(
            np.count_nonzero(slopes[:, :3])
        )
        for place, value, slope in zip(x, values, slopes[:, 3], strict=True):
            off = max(off, abs(float(value) - oracle.at((0, 0, 0, place)).value))
            # Differences towards both sides. On the kink, only those towards its flat side.
            for step in (-(2.0**-12), 2.0**-12):
                if (place == 2.0 and step * rises > 0) or not 0 <= place + step <= 4:
                    continue
                change = (
                    oracle.at((0, 0, 0, place + step)).value - oracle.at((0, 0, 0, place)).value
                ) / step
                off = max(off, abs(change - float(slope)))
    yield Finding("derivatives about kinks", wrong, 0.0, "wrong")
    yield Finding("derivatives about kinks, differences", off, 1e-6, "of the range")


def _linear(tables: Sequence[npt.NDArray[Any]], *, weight: float, bias: float) -> Network:
    """A network without hidden layers over a box of 3 x 3 x 3 vertices and one key frame.

    Args:
        tables: a table (t, z, y, x, 1) for each level.
        weight: weight of every embedding.
        bias: value that is added.
    """
    size = sum(table.shape[4] for table in tables)
    layer = (np.full((1, size), weight, np.float32), np.array([bias], np.float32))
    levels = tuple(
        (int(t), int(z), int(y), int(x)) for t, z, y, x, _ in (table.shape for table in tables)
    )
    return Network(
        levels=levels,
        embedding_size=1,
        tables=[ArrayTable(table) for table in tables],
        layers=(layer,),
        box_size=(3, 3, 3),
        key_frames=1,
    )


def _apart(run: Run, name: str, config: EncodeConfig, limit: float) -> Finding:
    """The largest difference between this run and another training of the same series, as a share
    of the range."""
    encode(run.series, run.folder / "other.fhz", config, force=True)
    with open_volume(run.folder / "other.fhz") as volume:
        worst = float(np.nanmax(np.abs(as_floats(volume) - run.decoded))) / run.data_range
    return Finding(name, worst, limit, "of the range")


SHAPE = (3, 6, 7, 8)
PLAIN = EncodeConfig(preset="published", tables="float16", width=8, epochs=60, device="cpu")
EXACT = replace(PLAIN, tables="float32", epochs=30)


_waves, _noise = single(partial(waves, SHAPE)), single(partial(noise, SHAPE))


def _case(name: str, about: str, settings: Settings, *checks: Check, **rest: Any) -> Case:
    make = rest.pop("make", _waves)
    return Case("networks", name, about, make, settings, checks=checks, **rest)


def _sizes(field: str, sizes: Sequence[int]) -> Settings:
    changes: dict[str, dict[str, Any]] = {
        f"{field.replace('_', '-')}-{size}": {field: size} for size in sizes
    }
    return {name: replace(PLAIN, **change) for name, change in changes.items()}


WILD = {
    f"{layers}-layers-rate-{rate:g}": replace(
        PLAIN, hidden_layers=layers, width=64, learning_rate=rate
    )
    for layers, rate in itertools.product((0, 1, 2), (1.0, 0.3))
}
STEADY = {f"{name}-constant": replace(config, schedule="constant") for name, config in WILD.items()}

NETWORK_CASES = (
    _case(
        "folds",
        "every fold from 2 to 8: few levels or many",
        _sizes("fold", (2, 8)),
        agrees,
        gradients,
        more=_sizes("fold", range(3, 8)),
    ),
    _case(
        "layers",
        "0, 1 and 2 hidden layers",
        _sizes("hidden_layers", (0, 1, 2)),
        agrees,
        gradients,
    ),
    _case(
        "embeddings",
        "embeddings of 1 to 8 numbers",
        _sizes("embedding_size", (1, 8)),
        agrees,
        gradients,
        more=_sizes("embedding_size", range(2, 8)),
    ),
    _case(
        "widths",
        "layers of one neuron, and of widths around the size of a kernel",
        _sizes("width", (1, 65)),
        agrees,
        more=_sizes("width", (2, 63, 64, 128)),
    ),
    _case(
        "wild-rates",
        "learning rates at which training diverges: it restarts at a lower one and says so",
        {"2-layers-rate-1": WILD["2-layers-rate-1"]},
        recovered,
        diverged,
        agrees,
        more={
            name: config
            for name, config in {**WILD, **STEADY}.items()
            if "rate-1" in name and name != "2-layers-rate-1"
        },
    ),
    _case(
        "rates-on-the-edge",
        "learning rates at which training may diverge: the result is better than a constant",
        {"1-layers-rate-0.3": WILD["1-layers-rate-0.3"]},
        recovered,
        more={
            name: WILD[name]
            for name in WILD
            if name.endswith("0.3") and name != "1-layers-rate-0.3"
        },
        make=_noise,
    ),
    _case(
        "barely-trained",
        "embeddings as small as at the start of training",
        {
            tables: replace(PLAIN, epochs=1, learning_rate=1e-8, tables=tables)
            for tables in ("float16", "uint8")
        },
        agrees,
        more={
            tables: replace(PLAIN, epochs=1, learning_rate=1e-8, tables=tables)
            for tables in ("float32", "transform")
        },
    ),
    _case(
        "ends-of-tables",
        "embeddings beyond the range of float16, at its ends, constant and tiny",
        {"float16": PLAIN},
        ends_of_half_precision,
        large_tables,
        constant_tables,
    ),
    _case(
        "kinks",
        "derivatives at a ReLU's kink and beside it",
        {"2-layers": replace(PLAIN, hidden_layers=2)},
        kinks,
        gradients,
    ),
    _case(
        "devices",
        "two devices train one network",
        {"1-layer": EXACT},
        devices,
        more={
            "0-layers": replace(EXACT, hidden_layers=0),
            "2-layers": replace(EXACT, hidden_layers=2),
            "fold-5": replace(EXACT, fold=5),
        },
    ),
    _case(
        "devices-on-noise",
        "two devices train one network on noise",
        {"1-layer": EXACT},
        devices,
        make=_noise,
        quick=False,
    ),
    _case(
        "spike-in-a-network",
        "one vertex that differs from all others",
        {"2-layers": replace(PLAIN, hidden_layers=2)},
        agrees,
        make=single(spike(0.0, (1, 3, 3, 4), 1.0, shape=SHAPE)),
    ),
)
