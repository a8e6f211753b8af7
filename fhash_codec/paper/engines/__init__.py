"""Engines: how the network is trained and evaluated on the lattice; same results, different speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import torch

    from fhash_codec.coreset.bricks import Coreset
    from fhash_codec.paper.architecture import Architecture
    from fhash_codec.paper.engines.initial import Parameters


class Engine(Protocol):
    """Trains one model on one coreset, a batch of bricks at a time, by Adam on the mean squared error of the batch.

    `rates` holds the learning rate of every step of the training, 1-based (rates[0] is unused).
    """

    step: int

    def train(self, chosen: npt.NDArray[np.int64]) -> torch.Tensor:
        """One Adam step on the bricks `chosen`; the sum of squared errors (float64 scalar) before it."""

    def settle(self) -> None:
        """Finish what training has put off; until the next step, evaluation is faster for it."""

    def infer(self, chosen: npt.NDArray[np.int64]) -> torch.Tensor:
        """Values (bricks, vertices), normalised, of the bricks `chosen` at all their vertices."""

    def squared_error(self, chosen: npt.NDArray[np.int64]) -> float:
        """Sum of squared errors over the coreset vertices of the bricks `chosen`."""

    def parameters(self) -> Parameters:
        """The trained numbers, on the CPU."""

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Everything that the next step depends on, as arrays."""

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Go on from `state`."""


def make_engine(
    name: str,
    architecture: Architecture,
    coreset: Coreset,
    rates: npt.NDArray[np.float64],
    *,
    seed: int,
    device: torch.device,
) -> Engine:
    """The engine of this name; 'auto' is the fastest at hand. Raises InputError for an unknown name."""
    if name in ("auto", "slab"):
        from fhash_codec.paper.engines.slab import SlabEngine

        return SlabEngine(architecture, coreset, rates, seed=seed, device=device)
    if name == "naive":
        from fhash_codec.paper.engines.naive import NaiveEngine

        return NaiveEngine(architecture, coreset, rates, seed=seed, device=device)
    raise InputError(f"unknown engine '{name}'; known: auto, slab, naive")
