"""Quality of a model in training, over the coreset alone: the promise is about no other vertex."""

from __future__ import annotations

from math import log10, prod

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.bricks import Coreset, tile
from fhash_codec.paper.engines import Engine
from fhash_formats.errors import TrainingError

AT_ONCE = 64
"""Bricks that are evaluated at a time."""


class Diverged(TrainingError):
    """A training came to nothing at its learning rate; a lower rate may do better."""


class Probe:
    """Bricks on which the quality of a model is measured, as a reader decodes them.

    The samples of the fringe do not count. They train embeddings that only times between key
    frames need.

    Attributes:
        bricks: numbers of the bricks, ascending; each holds a vertex of the coreset.
        samples: number of vertices of the coreset in them.
    """

    def __init__(self, coreset: Coreset, limit: int | None = None, seed: int = 0) -> None:
        """Choose bricks of a coreset: all, or at most `limit` at random."""
        self._coreset = coreset
        self._counted = _without_fringe(coreset)
        counts = np.bitwise_count(self._counted).sum(axis=1, dtype=np.int64)
        order = np.random.default_rng(seed).permutation(len(counts))
        self.bricks: npt.NDArray[np.int64] = np.sort(order[counts[order] > 0][:limit])
        self.samples = int(counts[self.bricks].sum())

    def psnr(self, engine: Engine) -> float | None:
        """Return the PSNR in dB of a model; None if its error is 0.

        The values are normalised, so their range is 1. Raises Diverged if the error is not finite.
        """
        error = 0.0
        for chosen in np.array_split(self.bricks, -(-len(self.bricks) // AT_ONCE)):
            values, counted = self._values(chosen)
            inferred = engine.infer(chosen).double().cpu().numpy()[counted]
            # A reader clips values to their range. Clipping must not hide an infinite one.
            decoded = np.where(np.isinf(inferred), np.nan, np.clip(inferred, 0.0, 1.0))
            error += float(np.square(decoded - values).sum())
        if not np.isfinite(error):
            raise Diverged(
                "training diverged: the error is no longer finite; set a lower --learning-rate"
            )
        return None if error == 0 else -10 * log10(error / self.samples)

    def error_of_constant(self) -> float:
        """Return the mean squared error of the best constant for all samples of the bricks."""
        first, end = self._coreset.offsets[self.bricks], self._coreset.offsets[self.bricks + 1]
        trained = np.concatenate(
            [self._coreset.values[low:high] for low, high in zip(first, end, strict=True)]
        )
        values, _ = self._values(self.bricks)
        constant = float(trained.mean(dtype=np.float64))
        return float(np.square(values.astype(np.float64) - constant).mean())

    def _values(
        self, chosen: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        """Return the counted values (n,) of bricks, and their vertices (bricks, vertices)."""
        vertices = prod(self._coreset.brick_shape)
        samples, counted = (
            np.unpackbits(bits[chosen], axis=1, count=vertices).view(np.bool_)
            for bits in (self._coreset.mask_bits, self._counted)
        )
        offsets = self._coreset.offsets
        values = np.concatenate([self._coreset.values[offsets[i] : offsets[i + 1]] for i in chosen])
        return values[counted[samples]], counted


def _without_fringe(coreset: Coreset) -> npt.NDArray[np.uint8]:
    """Return `Coreset.mask_bits` of the coreset alone."""
    bits = np.zeros_like(coreset.mask_bits)
    depth = coreset.brick_shape[0]
    for key, packed in enumerate(coreset.occupancy):
        mask = occupancy.unpack(packed, coreset.box.shape)
        of_key = coreset.bricks[:, 0] == key
        for layer in np.unique(coreset.bricks[of_key, 1]):
            numbers = np.flatnonzero(of_key & (coreset.bricks[:, 1] == layer))
            bricks = tile(mask[layer * depth : (layer + 1) * depth], coreset.brick_shape)
            chosen = bricks[coreset.bricks[numbers, 2], coreset.bricks[numbers, 3]]
            bits[numbers] = np.packbits(chosen.reshape(len(numbers), -1), axis=1)
    return bits & coreset.mask_bits
