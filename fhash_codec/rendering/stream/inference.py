"""A network's values at scattered places of one key index, for streamed samples.

On the host the value of a place has the same bits whatever other places are evaluated with it.
On a device it has not: a library of matrix products chooses its kernels by the number of samples.
There two evaluations of a place differ by at most twice the rounding error of the layers' sums:
a sum of k products is off by at most k u / (1 - k u) times the sum of their magnitudes, u = 2**-24,
in each layer, and a layer hands on the error of the layer before it. Slopes at a place within that
distance of a kink of a ReLU may be those of either side.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.network import Network, TableSource
from fhash_codec.paper.points import interpolate, sample_points
from fhash_codec.rendering.task.arrays import Array, Arrays

__all__ = ["DenseInference", "Inference", "PatchInference"]


class Inference(Protocol):
    """A network at places (n, 3), float64, x, y, z in vertices of its box, within it."""

    def values(self, places: Array) -> Array:
        """Normalised values float32 (n,)."""
        ...

    def slopes(self, places: Array) -> Array:
        """Their derivatives float32 (n, 3) by x, y and z per vertex, as `sample_points` has them."""
        ...


class PatchInference:
    """On the host: places that lie close together are evaluated together, with several threads."""

    def __init__(self, network: Network, key: float) -> None:
        tables = [
            _Nodes(table, _nodes(network, level, key)) for level, table in enumerate(network.tables)
        ]
        self._network, self._key = replace(network, tables=tables), key

    def values(self, places: Array) -> Array:
        """As `Inference` has it."""
        return sample_points(self._network, self._key, *places.T[::-1])

    def slopes(self, places: Array) -> Array:
        """As `Inference` has it."""
        return sample_points(self._network, self._key, *places.T[::-1], gradient=True)[1][:, :0:-1]


class DenseInference:
    """On a device: every level's table whole, its two time nodes blended once, as a picture has but one key index."""

    def __init__(self, network: Network, key: float, arrays: Arrays) -> None:
        self._arrays = arrays
        self._layers = [
            (arrays.array(weight, "float32"), arrays.array(bias, "float32"))
            for weight, bias in network.layers
        ]
        self._tables, self._shapes = [], [resolution[1:] for resolution in network.levels]
        for level, shape in enumerate(self._shapes):
            nodes = _nodes(network, level, key)
            table = arrays.array(
                network.read(level, (nodes, *(slice(0, length) for length in shape))), "float32"
            )
            share = float(_position(network, level, key) - nodes.start)
            self._tables.append(
                (table[0] * (1 - share) + table[-1] * share).reshape(-1, network.embedding_size)
            )
        spans = [max(size - 1, 1) for size in network.box_size]
        paces = [
            [(length - 1) / span for length, span in zip(shape, spans, strict=True)]
            for shape in self._shapes
        ]
        # x, y, z as places are.
        self._paces = [arrays.array(pace[::-1]) for pace in paces]
        self._lasts = [
            arrays.array([max(length - 2.0, 0.0) for length in shape[::-1]])
            for shape in self._shapes
        ]

    def values(self, places: Array) -> Array:
        """As `Inference` has it."""
        result = self._arrays.empty((len(places),), "float32")
        for start in range(0, len(places), self._arrays.batch):
            features, _ = self._features(places[start : start + self._arrays.batch], False)
            result[start : start + len(features)] = self._hidden(features)[-1][:, 0]
        return result

    def slopes(self, places: Array) -> Array:
        """As `Inference` has it."""
        xp = self._arrays.xp
        result = self._arrays.empty((len(places), 3), "float32")
        for start in range(0, len(places), self._arrays.batch):
            features, changes = self._features(places[start : start + self._arrays.batch], True)
            slope = self._layers[-1][0]
            # Backwards through the layers; on a ReLU's kink the derivative is that of its flat side.
            for (weight, _), hidden in zip(
                self._layers[-2::-1], self._hidden(features)[-2::-1], strict=True
            ):
                slope = (slope * self._arrays.single(hidden > 0)) @ weight
            for axis, change in enumerate(changes):
                result[start : start + len(features), axis] = xp.sum(slope * change, axis=1)
        return result

    def _hidden(self, features: Array) -> list[Array]:
        """What each layer puts out (n, width), the last one the values (n, 1)."""
        outputs = [features]
        for number, (weight, bias) in enumerate(self._layers):
            found = outputs[-1] @ weight.T + bias
            outputs.append(
                found if number == len(self._layers) - 1 else self._arrays.xp.clip(found, 0.0, None)
            )
        return outputs[1:]

    def _features(self, places: Array, gradient: bool) -> tuple[Array, list[Array]]:
        """All levels' embeddings (n, features) at places and, if asked for, their derivatives by x, y and z."""
        arrays, xp = self._arrays, self._arrays.xp
        found, changes = [], []
        for table, shape, pace, last in zip(
            self._tables, self._shapes, self._paces, self._lasts, strict=True
        ):
            at = places * pace
            before = xp.minimum(xp.floor(at), last)
            after = arrays.single(at - before)
            x, y, z = arrays.whole(before).T
            first = (z * shape[1] + y) * shape[2] + x
            # An axis of one vertex has no corner after it: both are the same.
            jumps = [
                jump if length > 1 else 0
                for jump, length in zip((shape[1] * shape[2], shape[2], 1), shape, strict=True)
            ]
            offsets = [
                k * jumps[0] + j * jumps[1] + i * jumps[2] for k, j, i in np.ndindex(2, 2, 2)
            ]
            corners = xp.stack([table[first + offset] for offset in offsets]).reshape(
                2, 2, 2, *first.shape, -1
            )
            # Along z, y and x in turn.
            embeddings, steps = interpolate(
                corners, [after[:, axis, None] for axis in (2, 1, 0)], gradient
            )
            found.append(embeddings)
            changes.append(
                [
                    step * arrays.single(pace)[axis]
                    for step, axis in zip(steps[::-1], range(3), strict=False)
                ]
            )
        return xp.concatenate(found, axis=1), [
            xp.concatenate(parts, axis=1) for parts in zip(*changes, strict=True)
        ]


class _Nodes:
    """The time nodes of a table between which one key index lies, in memory, so that a pass of samples does not read them again."""

    def __init__(self, table: TableSource, nodes: slice) -> None:
        self.shape = tuple(table.shape)
        self._first = nodes.start
        self._values = table.read((nodes, *(slice(0, length) for length in self.shape[1:])))

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Values of a region (t, z, y, x) whose times are among the nodes."""
        time = region[0]
        return self._values[(slice(time.start - self._first, time.stop - self._first), *region[1:])]


def _position(network: Network, level: int, key: float) -> float:
    """A key index in time nodes of a level."""
    return key * (network.levels[level][0] - 1) / max(network.key_frames - 1, 1)


def _nodes(network: Network, level: int, key: float) -> slice:
    count = network.levels[level][0]
    first = min(int(_position(network, level, key)), max(count - 2, 0))
    return slice(first, min(first + 2, count))
