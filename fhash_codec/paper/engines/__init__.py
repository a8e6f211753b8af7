"""Engines: implementations of training and evaluation on the lattice, equal but for their speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol, SupportsFloat

import numpy as np
import numpy.typing as npt

from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.devices import first_line, need_torch
from fhash_codec.progress import tell
from fhash_formats.errors import InputError
from fhash_formats.support.values import Single

if TYPE_CHECKING:
    from fhash_codec.features.bricks import Coreset
    from fhash_codec.paper.engines.parameters import Chosen, Parameters
    from fhash_codec.paper.network import Architecture


class Engine(Protocol):
    """One model in training on one coreset, a batch of bricks at a time.

    Training is Adam on the mean squared error of the batch. Engines start from the same parameters
    and follow the same learning rates.

    Attributes:
        name: name of the engine.
        rates: learning rate of every training step, float64 and counted from 1; rates[0] is unused.
        step: training steps done so far.
    """

    name: str
    rates: npt.NDArray[np.float64]
    step: int

    def train(self, chosen: Chosen) -> SupportsFloat:
        """Do one training step on a batch of bricks.

        Returns the sum of squared errors before the step. Of a device, a number to wait for.
        """

    def settle(self) -> None:
        """Finish work that training put off: evaluation is then faster until the next step."""

    def infer(self, chosen: Chosen) -> Single:
        """Return the normalised values (n,) at the samples of some bricks.

        They come brick by brick, in C order in a brick, as `Coreset.values` has them.
        """

    def parameters(self) -> Parameters:
        """Return the trained numbers."""

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return everything that the next step depends on, as arrays for a checkpoint."""

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`; raises KeyError or ValueError for one of another model."""


ENGINES = {"fused": "cuda", "native": "cpu"}
"""Device of each engine, the fastest first."""


def make_engine(
    architecture: Architecture,
    coreset: Coreset,
    rates: npt.NDArray[np.float64],
    *,
    seed: int,
    device: str,
) -> Engine:
    """Return a new engine: fused on CUDA, native on a CPU.

    Args:
        architecture: the sizes of the model.
        coreset: the training samples.
        rates: learning rate of every training step, counted from 1.
        seed: seed of the initial parameters.
        device: 'cpu' or 'cuda', where the engine computes, or 'auto' for CUDA unless the kernels
            cannot be had or cannot do the model, which the stage `engine` then says.

    Raises InputError where the engine cannot be had or does not take the model.
    """
    if device != "cpu":
        need_torch(f"device '{device}'")
        from fhash_codec.paper.engines.fused.engine import start_fused

        try:
            return start_fused(architecture, coreset, rates, seed=seed)
        except Unavailable as error:
            reason = f"kernels for CUDA cannot be had: {first_line(error)}"
            if device == "cuda":
                raise InputError(f"{reason}; use --device cpu") from error
        tell("engine", f"tables and network at their random start, on the CPU, as {reason}")
    from fhash_codec.paper.engines.native import NativeEngine

    return NativeEngine(architecture, coreset, rates, seed=seed)


def describe_engine(engine: Engine, threads: int) -> dict[str, str | int]:
    """Return what a file's header says of the engine that trained its model.

    The keys are `engine`, its name; `threads`; and for the native engine `path`, the name of the
    processor's instructions that it used.
    """
    said: dict[str, str | int] = {"engine": engine.name, "threads": threads}
    path = getattr(engine, "path", None)
    return said if path is None else said | {"path": path}
