"""The network of profile paper in float64, written as its definition: loops over points, levels and
corners.

The oracle shares only the stored numbers with the decoder: it has no blocks, no separable products
and no float32. With each value it gives a bound on the error of the decoder's float32 arithmetic:
the sum of the magnitudes of all terms, times the number of roundings that they undergo.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.model import decode_region, sample_points
from fhash_codec.paper.network import Network
from fhash_codec.paper.storage import load_network
from fhash_codec.selftest.case import Finding, Run

__all__ = ["Answer", "Oracle", "agrees", "gradients"]

Floats = npt.NDArray[np.float64]

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
    def tables(self) -> list[Floats]:
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

    def _embedding(self, table: Floats, point: Sequence[float]) -> tuple[Floats, Floats]:
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
            name="float64 oracle",
            worst=float(np.max(off / allowed)),
            limit=1.0,
            unit="of the rounding of float32",
            under=name,
        )
        yield Finding(
            name="float64 oracle, error",
            worst=float(off.max()),
            limit=max(NEAR, float(allowed.max())),
            unit="of the range",
            under=name,
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
    yield Finding(
        name="gradient = differences", worst=worst, limit=1e-3, unit="of the largest derivative"
    )
    yield Finding(
        name="derivatives beside kinks",
        worst=over / (4 * N_POINTS),
        limit=0.25,
        unit="of all, not compared",
    )
