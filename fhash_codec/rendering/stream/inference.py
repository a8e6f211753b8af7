"""A network's values at scattered places of one key index, for streamed samples.

On the host the value of a place has the same bits whatever other places are evaluated with it
(fhash_codec/paper/points.py).

On a device it has the same bits as well where fused kernels evaluate it
(fhash_codec/paper/engines/fused/points.py).

By the operations of torch it has not: a library of matrix products chooses its kernels by the
number of samples. There two evaluations of a place differ by at most twice the rounding error of
the layers' sums. A sum of k products is off by at most k u / (1 - k u) times the sum of their
magnitudes, u = 2**-24, and each layer hands on the error of the layer before it. Slopes at a place
within that distance of a kink of a ReLU may be those of either side.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fhash_codec.paper.network import Network
from fhash_codec.paper.point_tables import PointTables
from fhash_codec.paper.points import PointSampler, interpolate
from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_formats.support.threads import usable_threads

__all__ = ["DenseInference", "Inference", "PatchInference", "inference_in"]


class Inference(Protocol):
    """A network at places (n, 3), float64, x, y, z in vertices of its box, within the box."""

    def values(self, places: Array) -> Array:
        """Normalised values, float32 (n,)."""
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives by x, y and z per vertex, float32 (n, 3), as `sample_points` has them."""
        ...


def inference_in(arrays: Arrays, network: Network, key: float) -> Inference:
    """Inference for places in arrays: on a device by fused kernels, or by torch, with a warning."""
    if arrays.device is None:
        return PatchInference(network, key)
    # Only tensors have a device, so torch is here.
    from fhash_codec.paper.engines.fused.start import start_points

    return start_points(network, key, arrays.device) or DenseInference(network, key, arrays)


class PatchInference:
    """Inference on the host, in several threads.

    The tables of the whole box are held in memory. They are interpolated in time once, since a
    picture has one key index.
    """

    def __init__(self, network: Network, key: float) -> None:
        self._sampler = PointSampler(PointTables.of_box(network, key), key)

    def values(self, places: Array) -> Array:
        return self._sampled(places, None)

    def slopes(self, places: Array) -> Array:
        slopes = np.empty((len(places), 4), np.float32)
        self._sampled(places, slopes)
        return slopes[:, :0:-1]

    def _sampled(self, places: Array, slopes: Array | None) -> Array:
        """Values (n,) at places; derivatives by t, z, y and x (n, 4) go into `slopes`."""
        values = np.empty(len(places), np.float32)
        x, y, z = places.T
        self._sampler.sample((np.zeros(1), z, y, x), values, slopes, usable_threads())
        return values


class DenseInference:
    """Inference by an array library on a device, which holds the whole table of every level.

    The two time nodes of a table are blended once, since a picture has one key index.
    """

    def __init__(self, network: Network, key: float, arrays: Arrays) -> None:
        self._arrays = arrays
        self._layers = [
            (arrays.array(weight, "float32"), arrays.array(bias, "float32"))
            for weight, bias in network.layers
        ]
        self._levels = [_Level(network, level, key, arrays) for level in range(len(network.levels))]

    def values(self, places: Array) -> Array:
        result = self._arrays.empty((len(places),), "float32")
        for start in range(0, len(places), self._arrays.batch):
            inputs, _ = self._inputs(places[start : start + self._arrays.batch], False)
            result[start : start + len(inputs)] = self._outputs(inputs)[-1][:, 0]
        return result

    def slopes(self, places: Array) -> Array:
        xp = self._arrays.xp
        result = self._arrays.empty((len(places), 3), "float32")
        for start in range(0, len(places), self._arrays.batch):
            inputs, changes = self._inputs(places[start : start + self._arrays.batch], True)
            slope = self._layers[-1][0]
            # Backwards through the layers; on a ReLU's kink the slope is that of the flat side.
            for (weight, _), output in zip(
                self._layers[-2::-1], self._outputs(inputs)[-2::-1], strict=True
            ):
                slope = (slope * self._arrays.to_float32(output > 0)) @ weight
            for axis, change in enumerate(changes):
                result[start : start + len(inputs), axis] = xp.sum(slope * change, axis=1)
        return result

    def _outputs(self, inputs: Array) -> list[Array]:
        """Outputs (n, width) of the layers for inputs (n, k); the last are the values (n, 1)."""
        outputs = [inputs]
        for number, (weight, bias) in enumerate(self._layers):
            output = outputs[-1] @ weight.T + bias
            last = number == len(self._layers) - 1
            outputs.append(output if last else self._arrays.xp.clip(output, 0.0, None))
        return outputs[1:]

    def _inputs(self, places: Array, gradient: bool) -> tuple[Array, list[Array]]:
        """The inputs (n, k) of the layers at places: all levels' embeddings.

        With `gradient` also their derivatives (n, k) by x, y and z.
        """
        xp = self._arrays.xp
        embeddings, changes = [], []
        for level in self._levels:
            embedding, change = level.embeddings(places, gradient)
            embeddings.append(embedding)
            changes.append(change)
        return xp.concatenate(embeddings, axis=1), [
            xp.concatenate(levels, axis=1) for levels in zip(*changes, strict=True)
        ]


class _Level:
    """The table of a level at one key index, on a device."""

    def __init__(self, network: Network, level: int, key: float, arrays: Arrays) -> None:
        self._arrays = arrays
        shape = network.levels[level][1:]
        nodes = _nodes(network, level, key)
        table = arrays.array(
            network.read(level, (nodes, *(slice(0, length) for length in shape))), "float32"
        )
        share = float(_position(network, level, key) - nodes.start)
        self._table = (table[0] * (1 - share) + table[-1] * share).reshape(
            -1, network.embedding_size
        )
        self._shape = shape
        spans = [max(size - 1, 1) for size in network.box_size]
        pace = [(length - 1) / span for length, span in zip(shape, spans, strict=True)]
        # x, y, z as places are.
        self._pace = arrays.array(pace[::-1])
        self._last = arrays.array([max(length - 2.0, 0.0) for length in shape[::-1]])

    def embeddings(self, places: Array, gradient: bool) -> tuple[Array, list[Array]]:
        """Embeddings (n, E) at places and, if asked for, their derivatives by x, y and z."""
        arrays, xp, shape = self._arrays, self._arrays.xp, self._shape
        at = places * self._pace
        before = xp.minimum(xp.floor(at), self._last)
        after = arrays.to_float32(at - before)
        x, y, z = arrays.to_int64(before).T
        first = (z * shape[1] + y) * shape[2] + x
        # An axis of one vertex has no corner after it: both are the same.
        jumps = [
            jump if length > 1 else 0
            for jump, length in zip((shape[1] * shape[2], shape[2], 1), shape, strict=True)
        ]
        offsets = [k * jumps[0] + j * jumps[1] + i * jumps[2] for k, j, i in np.ndindex(2, 2, 2)]
        corners = xp.stack([self._table[first + offset] for offset in offsets]).reshape(
            2, 2, 2, *first.shape, -1
        )
        # Along z, y and x in turn.
        embeddings, across = interpolate(
            corners, [after[:, axis, None] for axis in (2, 1, 0)], gradient
        )
        pace = arrays.to_float32(self._pace)
        return embeddings, [change * pace[axis] for axis, change in enumerate(across[::-1])]


def _position(network: Network, level: int, key: float) -> float:
    """A key index in time nodes of a level."""
    return key * (network.levels[level][0] - 1) / max(network.key_frames - 1, 1)


def _nodes(network: Network, level: int, key: float) -> slice:
    """The one or two time nodes of a level around a key index."""
    count = network.levels[level][0]
    first = min(int(_position(network, level, key)), max(count - 2, 0))
    return slice(first, min(first + 2, count))
