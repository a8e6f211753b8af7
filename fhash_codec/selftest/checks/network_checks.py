"""Checks of networks: recovery from divergence, tables at the ends of their number type, kinks,
engines, devices."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.devices import choose_device
from fhash_codec.encoding import encode
from fhash_codec.paper.model import decode_region, sample_points
from fhash_codec.paper.network import ArrayTable, Network, NumberType
from fhash_codec.selftest.case import Finding, Run, as_floats
from fhash_codec.selftest.checks.oracle import Oracle
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError

__all__ = [
    "constant_tables",
    "devices",
    "diverged",
    "ends_of_half_precision",
    "engines",
    "kinks",
    "large_tables",
    "recovered",
]

MAX_ENGINE_DIFFERENCE = 1e-5
"""Allowed difference of two engines after 90 updates, as a share of the range.

Measured: 3e-7. A wrong gradient gives 1e-2 and more.
"""
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
    yield Finding(
        name="rate and restarts told", worst=float(not consistent), limit=0.0, unit="of them wrong"
    )
    yield Finding(name="rate at the end", worst=rate, limit=run.config.learning_rate, unit="")
    error = float(np.sqrt(np.mean((run.decoded - values) ** 2)))
    yield Finding(
        name="better than a constant",
        worst=error / float(values.std()),
        limit=0.98,
        unit="of the deviation",
    )


def diverged(run: Run) -> Iterator[Finding]:
    """A training that diverges at its learning rate has restarted."""
    yield Finding(
        name="divergence not found",
        worst=float(not run.volume.container.header["training"].get("restarts", 0)),
        limit=0.0,
        unit="",
    )


def engines(run: Run) -> Iterator[Finding]:
    """The engine slab trains the same network as the one that is chosen."""
    yield _apart(run, "auto = slab", replace(run.config, engine="slab"), MAX_ENGINE_DIFFERENCE)


def devices(run: Run) -> Iterator[Finding]:
    """A CUDA device trains the same network as the CPU; nothing is compared without CUDA."""
    try:
        choose_device("cuda")
    except InputError:
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
    yield Finding(
        name="too large for float16", worst=float(accepted), limit=0.0, unit="tables accepted"
    )
    ends = np.array([MAX_FLOAT16, -MAX_FLOAT16], np.float32)
    kept = NumberType.of(ends, "float16").stored(ends)
    yield Finding(
        name="largest of float16",
        worst=float(np.count_nonzero(np.abs(kept) != MAX_FLOAT16)),
        limit=0.0,
        unit="values",
    )


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
        yield Finding(
            name="large tables",
            worst=float(off.max()),
            limit=1.0,
            unit="of the rounding of float32",
            under=name,
        )
        frame = decode_region(network, 0.0, ((0, 3), (0, 3), (0, 3)))
        worst = float(np.abs(frame[:, 0, 0] - [0.0, 0.5, 1.0]).max())
        yield Finding(
            name="large tables, vertices", worst=worst, limit=1e-6, unit="of the range", under=name
        )


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
    yield Finding(name="constant tables", worst=worst, limit=2.0**-23, unit="of the range")
    yield Finding(name="constant tables, slopes", worst=slope, limit=0.0, unit="of the range")
    for kind in ("float32", "float16", "uint8"):
        off = 0.0
        for value in (0.0, 1e-45, 1e-38, 1e-7, 1.0, -3.0):
            table = np.full(4, value, np.float32)
            numbers = NumberType.of(table, kind)
            back = numbers.stored(table).astype(np.float64) * numbers.scale + numbers.offset
            off = max(
                off, float(np.abs(back - np.float32(value)).max()) / max(abs(value) / 255, 6e-8)
            )
        yield Finding(
            name="constant tables, stored", worst=off, limit=1.0, unit="of a step", under=kind
        )


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
    yield Finding(name="derivatives about kinks", worst=float(wrong), limit=0.0, unit="wrong")
    yield Finding(
        name="derivatives about kinks, differences", worst=off, limit=1e-6, unit="of the range"
    )


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
    return Finding(name=name, worst=worst, limit=limit, unit="of the range")
