"""The network of the profile paper in float64, written as its definition reads: loops over points, levels and corners.

Nothing is shared with the decoder but the numbers: no blocks, no separable products, no float32. Beside each value stands how far the
decoder's float32 may be from it: the magnitudes of all that is added up on the way to it, times the roundings that it goes through.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.network import Network
from fhash_codec.paper.points import sample_points
from fhash_codec.paper.regions import decode_region
from fhash_codec.paper.storage import load_network
from fhash_codec.selftest.case import Finding, Run

__all__ = ["Answer", "Oracle", "agrees", "gradients"]

Floats = npt.NDArray[np.float64]

UNIT = 2.0**-24
"""Relative error of one float32 rounding."""
POINTS = 40
BESIDE = 2.0**-16
"""Of a vertex spacing, how far from a point its differences are taken; a power of two, so that the places are exact."""
NEAR = 1e-4
"""Of the range, by which float32 may be off in a network that was trained to an end; one that is not may have more to cancel."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What the network says at one point, normalised.

    rounding: bound of what float32 may be off. active: of every ReLU in turn, whether it lets through.
    """

    value: float
    rounding: float
    active: tuple[bool, ...]


class Oracle:
    """A network's tables and layers, read once, as float64."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.sizes = (network.key_frames, *network.box_size)
        self.layers = [
            (weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in network.layers
        ]

    @cached_property
    def tables(self) -> list[Floats]:
        """Of each level (t, z, y, x, embedding)."""
        parts = [
            tuple(slice(0, length) for length in table.shape[:4]) for table in self.network.tables
        ]
        return [
            self.network.read(level, part).astype(np.float64) for level, part in enumerate(parts)
        ]

    def at(self, point: Sequence[float]) -> Answer:
        """The value at (key index, z, y, x), in vertices of the box."""
        features, magnitudes = [], []
        for table in self.tables:
            value, magnitude = self._embedding(table, point)
            features.append(value)
            magnitudes.append(magnitude)
        hidden, reach = np.concatenate(features), np.concatenate(magnitudes)
        # Along each of four axes: the weight and its complement, two products and a sum.
        rounding = 4 * 5 * UNIT * reach
        active: list[bool] = []
        for number, (weight, bias) in enumerate(self.layers):
            if number > 0:
                active += (hidden > 0).tolist()
                hidden = np.maximum(hidden, 0.0)
            terms = np.abs(weight) @ np.abs(hidden) + np.abs(bias)
            # A sum of n + 1 products in any order; what was rounded before goes through the weights, and a ReLU lets through no more of it.
            rounding = np.abs(weight) @ rounding + (weight.shape[1] + 2) * UNIT * (
                terms + np.abs(weight) @ rounding
            )
            hidden = weight @ hidden + bias
        return Answer(value=float(hidden[0]), rounding=float(rounding[0]), active=tuple(active))

    def _embedding(self, table: Floats, point: Sequence[float]) -> tuple[Floats, Floats]:
        """The quadrilinear mean of the 16 corners around a point, and the largest magnitude among them."""
        before, share = [], []
        for place, size, corners in zip(point, self.sizes, table.shape, strict=False):
            position = place * (corners - 1) / max(size - 1, 1)
            first = min(int(position), max(corners - 2, 0))
            before.append(first)
            share.append(position - first)
        value, magnitude = np.zeros(table.shape[4]), np.zeros(table.shape[4])
        for corner in np.ndindex(2, 2, 2, 2):
            factor = 1.0
            for up, part in zip(corner, share, strict=True):
                factor *= part if up else 1.0 - part
            at = tuple(
                min(first + up, length - 1)
                for first, up, length in zip(before, corner, table.shape, strict=False)
            )
            value += factor * table[at]
            magnitude = np.maximum(magnitude, np.abs(table[at]))
        return value, magnitude


def agrees(run: Run) -> Iterator[Finding]:
    """Decoding and sampling are what the definition says, to the rounding of float32."""
    oracle = Oracle(load_network(run.volume.container))
    network, generator = oracle.network, np.random.default_rng(11)
    ends = np.array(oracle.sizes)[:, None] - 1.0
    places = generator.random((4, POINTS)) * ends
    vertices = np.rint(generator.random((4, POINTS)) * ends)
    key = float(generator.random() * ends[0, 0])
    z, y, x = ((0, length) for length in network.box_size)
    frame = decode_region(network, key, (z, y, x))
    decoded = np.array([frame[tuple(vertices[1:, n].astype(int))] for n in range(POINTS)])
    on_frame = np.concatenate([np.full((1, POINTS), key), vertices[1:]])
    compared = {
        "sampling": (places, sample_points(network, *places)),
        "sampling at vertices": (vertices, sample_points(network, *vertices)),
        "decoding between key frames": (on_frame, decoded),
    }
    for name, (points, found) in compared.items():
        expected = [oracle.at(point) for point in points.T]
        off = np.abs(found.astype(np.float64) - [answer.value for answer in expected])
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
    """The analytic gradient equals the oracle's differences, on the side of a cell or a kink where it is documented to be.

    On a vertex the derivative is that of the cell after it, so differences are taken there too; at the end of an axis, before it.
    Within a cell the network is a polynomial between kinks: differences over one are counted, not compared.
    """
    oracle = Oracle(load_network(run.volume.container))
    generator = np.random.default_rng(12)
    ends = np.array(oracle.sizes) - 1.0
    points = generator.random((POINTS, 4)) * ends
    points[::4] = np.rint(points[::4])
    points = np.rint(points / BESIDE) * BESIDE
    points = np.clip(points, 0.0, ends)
    _, slopes = sample_points(oracle.network, *points.T, gradient=True)
    scale = float(np.abs(slopes).max()) or 1.0
    worst, over = 0.0, 0
    for point, slope in zip(points, slopes, strict=True):
        here = oracle.at(point)
        for axis in range(4):
            if ends[axis] == 0:
                worst = max(worst, abs(float(slope[axis])) / scale)
                continue
            step = BESIDE if point[axis] < ends[axis] else -BESIDE
            one, two = (oracle.at(point + np.eye(4)[axis] * step * times) for times in (1, 2))
            if not here.active == one.active == two.active:
                over += 1
                continue
            difference = (-3 * here.value + 4 * one.value - two.value) / (2 * step)
            worst = max(worst, abs(difference - float(slope[axis])) / scale)
    yield Finding(
        name="gradient = differences", worst=worst, limit=1e-3, unit="of the largest derivative"
    )
    yield Finding(
        name="derivatives beside kinks",
        worst=over / (4 * POINTS),
        limit=0.25,
        unit="of all, not compared",
    )
