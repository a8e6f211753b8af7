"""A network's values at scattered places of one key index, for streamed samples.

The value of a place has the same bits whatever other places are evaluated with it, on the host
(fhash_codec/paper/points.py) and by fused kernels (fhash_codec/paper/engines/fused/points.py).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fhash_codec.paper.network import Network
from fhash_codec.paper.points import PointSampler, PointTables
from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_formats.support.threads import usable_threads

__all__ = ["HostInference", "Inference", "inference_in"]


class Inference(Protocol):
    """A network at places (n, 3), float64, x, y, z in vertices of its box, within the box."""

    def values(self, places: Array) -> Array:
        """Normalised values, float32 (n,)."""
        ...

    def slopes(self, places: Array) -> Array:
        """Derivatives by x, y and z per vertex, float32 (n, 3), as `sample_points` has them."""
        ...


def inference_in(arrays: Arrays, network: Network, key: float) -> Inference:
    """Inference for places in arrays: fused kernels on a device, or the host, with a warning."""
    if arrays.device is not None:
        # Only tensors have a device, so torch is here.
        from fhash_codec.paper.engines.fused.start import start_points

        fused = start_points(network, key, arrays.device)
        if fused is not None:
            return fused
    return HostInference(network, key, arrays)


class HostInference:
    """Inference on the host, in several threads, for places in any arrays.

    The tables of the whole box are held in memory. They are interpolated in time once, since a
    picture has one key index.
    """

    def __init__(self, network: Network, key: float, arrays: Arrays) -> None:
        self._arrays = arrays
        self._sampler = PointSampler(PointTables.of_box(network, key), key)

    def values(self, places: Array) -> Array:
        return self._arrays.array(self._sampled(places, None))

    def slopes(self, places: Array) -> Array:
        slopes = np.empty((len(places), 4), np.float32)
        self._sampled(places, slopes)
        return self._arrays.array(slopes[:, :0:-1])

    def _sampled(self, places: Array, slopes: Array | None) -> Array:
        """Values (n,) at places; derivatives by t, z, y and x (n, 4) go into `slopes`."""
        values = np.empty(len(places), np.float32)
        x, y, z = self._arrays.host(places).T
        self._sampler.sample((np.zeros(1), z, y, x), values, slopes, usable_threads())
        return values
