"""Quality of a model in training, over the coreset alone: the promise is about no other vertex."""

from __future__ import annotations

from math import log10

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.bricks import Coreset
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
        self._coreset, counts = coreset, coreset.counts
        order = np.random.default_rng(seed).permutation(len(counts))
        self.bricks: npt.NDArray[np.int64] = np.sort(order[counts[order] > 0][:limit])
        self.samples = int(counts[self.bricks].sum())

    def psnr(self, engine: Engine) -> float | None:
        """Return the PSNR in dB of a model; None if its error is 0.

        The values are normalised, so their range is 1. Raises Diverged if the error is not finite.
        """
        error = 0.0
        for chosen in np.array_split(self.bricks, -(-len(self.bricks) // AT_ONCE)):
            places, counted = self._places(chosen)
            values = self._coreset.values[places[counted]]
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
        places, counted = self._places(self.bricks)
        trained = self._coreset.values[places]
        constant = float(trained.mean(dtype=np.float64))
        return float(np.square(trained[counted].astype(np.float64) - constant).mean())

    def _places(
        self, chosen: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return the places (n,) of the samples of bricks in `Coreset.values`, and which count."""
        places, fringe = self._coreset.places(chosen), self._coreset.fringe
        return places, np.ones(len(places), np.bool_) if fringe is None else ~fringe[places]
