"""Dense layers at scattered points: the value of a point never depends on the other points.

A matrix product of BLAS does not promise that. BLAS chooses its kernels by the shape of the
product, and some of them add the terms of a column in another order at another place in the
product. `DenseLayers` (network.py) keeps both fixed for the vertices of a region; scattered points
come in any number and order. `PointwiseLayers` therefore adds with `numpy.einsum`: input by input,
each time for all points with the same operations. Every point gets the same bits, by construction,
whatever the library of BLAS, the number of threads and the points evaluated with it.
"""

from __future__ import annotations

import numpy as np

from fhash_codec.paper.network import COLUMNS, Floats, Network

__all__ = ["PointwiseLayers"]

BLOCK = 16 * COLUMNS
"""Points that pass through all layers at a time. Longer rows leave the second-level cache."""


class PointwiseLayers:
    """The dense layers of a network with room for a fixed number of points; one per thread.

    Attributes:
        inputs: (inputs + 1, points) float32, to be filled by the caller; the last row is 1. The
            number of points is rounded up to a multiple of COLUMNS, so that a single point takes
            no other path through numpy than many do.
    """

    def __init__(self, network: Network, points: int) -> None:
        columns = -(-points // COLUMNS) * COLUMNS
        self._matrices = network.matrices
        self.inputs = np.zeros((self._matrices[0].shape[1], columns), np.float32)
        self.inputs[-1] = 1.0
        self._outputs = [
            np.empty((matrix.shape[0], columns), np.float32) for matrix in self._matrices
        ]

    def run(self) -> Floats:
        """The outputs (points,) for `inputs`; the next run overwrites them."""
        # Hostile weights overflow; the caller clips values to their range.
        with np.errstate(over="ignore", invalid="ignore"):
            for start in range(0, self.inputs.shape[1], BLOCK):
                block = slice(start, start + BLOCK)
                current = self.inputs[:, block]
                for matrix, outputs in zip(self._matrices, self._outputs, strict=True):
                    np.einsum("oi,in->on", matrix, current, out=outputs[:, block])
                    current = outputs[:, block]
                    if outputs is not self._outputs[-1]:
                        np.maximum(current, 0.0, out=current)
        result: Floats = self._outputs[-1][0]
        return result

    def slopes(self, changes: Floats) -> Floats:
        """Derivatives (axes, points) of the last run's outputs along some axes.

        changes: (axes, inputs, points) float32, the derivatives of the inputs along those axes,
        with as many points as `inputs` has. The chain rule goes backwards through the layers; on a
        ReLU's kink the derivative is that of its flat side.
        """
        result = np.empty((len(changes), self.inputs.shape[1]), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for start in range(0, self.inputs.shape[1], BLOCK):
                block = slice(start, start + BLOCK)
                slope = np.repeat(self._matrices[-1][:1].T, result[:, block].shape[1], axis=1)
                for matrix, outputs in zip(
                    self._matrices[-2::-1], self._outputs[-2::-1], strict=True
                ):
                    slope = np.einsum("oi,on->in", matrix, slope * (outputs[:, block] > 0))
                np.einsum("in,ain->an", slope[:-1], changes[..., block], out=result[:, block])
        return result
