"""The protocol of an input encoding in training, with the network that it feeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from torch import Tensor

HIDDEN_LAYERS = 2
"""Hidden layers of the network of every encoding (paper, section 4.2: 2 layers)."""
WIDTH = 64
"""Neurons of each of these layers (paper, section 4.2)."""
EMBEDDING_SIZE = 2
"""Numbers of an embedding of every encoding (paper, section 4.2)."""

Values = npt.NDArray[np.float32]
"""Normalised values: 0 and 1 are the least and the largest value of the series."""


class Encoding(Protocol):
    """All key frames of one series in training: one model, or one for each key frame.

    A place is (z, y, x) in vertices of the domain. A key is the number of a key frame, from 0 on.
    """

    @property
    def name(self) -> str:
        """Name of the encoding, as in `catalogue.NAMES`."""

    @property
    def tables(self) -> int:
        """Trained numbers in the tables of all models."""

    @property
    def mlp(self) -> int:
        """Trained numbers in the networks of all models."""

    @property
    def samples_an_epoch(self) -> int:
        """Samples that all models together see in an epoch."""

    @property
    def steps_an_epoch(self) -> int:
        """Adam steps of each model in an epoch."""

    def train_epoch(self, epoch: int) -> None:
        """Train every model on all of its samples once; epochs count from 0.

        On a GPU the work may still run when this returns.
        """

    def settle(self) -> None:
        """Finish work that training put off: evaluation is then faster until the next epoch."""

    def buckets_used(self) -> float:
        """Share of the embeddings of all tables that a gradient ever moved, 0 to 1."""

    def frame(self, key: int) -> Values:
        """Values (z, y, x) at every vertex of the domain at a key frame.

        Vertices on which no model was trained hold the background of the series (`Data`).
        """

    def sample(self, key: int, places: Tensor) -> Tensor:
        """Values (n,) at places (n, 3) of a key frame; the background outside the model's box.

        It is what a ray of a picture asks for. The tables are those of the last `settle`.
        """

    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """The trained numbers of all models; embeddings that no gradient moved are 0."""
