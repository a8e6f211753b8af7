"""Training steps as captured CUDA graphs: one launch for all kernels of a step."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

import torch
from torch import Tensor

from fhash_codec.training.devices import first_line
from fhash_formats.errors import FhashWarning

WARM_UPS = 2
"""Steps of a shape that run kernel by kernel before one is captured: libraries start up in them."""
MAX_GRAPHS = 64
"""Shapes that are captured, at most; each holds the memory of a step's results."""


class StepGraphs:
    """The captured steps by their shape.

    A step must read whatever changes from one step to the next from the same memory at each call,
    and write to the same memory, but for its result.
    """

    def __init__(self) -> None:
        self._captured: dict[Hashable, tuple[Any, Tensor]] = {}
        self._seen: Counter[Hashable] = Counter()
        self._failed = False

    def run(self, shape: Hashable, step: Callable[[], Tensor]) -> Tensor:
        """Do a step and return its result, a tensor of its own.

        The third step of a shape is captured. Where that fails, this and all later steps run kernel
        by kernel, with one FhashWarning.
        """
        if shape not in self._captured:
            self._seen[shape] += 1
            early = self._seen[shape] <= WARM_UPS
            if early or self._failed or len(self._captured) == MAX_GRAPHS:
                return step()
            try:
                self._captured[shape] = self._capture(step)
            except RuntimeError as error:
                self._failed = True
                warnings.warn(
                    f"no CUDA graph of a training step ({first_line(error)}); training goes on "
                    "kernel by kernel, which is slower",
                    FhashWarning,
                    stacklevel=3,
                )
                return step()
        graph, result = self._captured[shape]
        graph.replay()
        return result.clone()

    def _capture(self, step: Callable[[], Tensor]) -> tuple[Any, Tensor]:
        """Return the graph of a step, and where its result lies after each replay."""
        graph = torch.cuda.CUDAGraph()
        # Graphs share their memory: one runs after the other, and each result is copied at once.
        pool = next(iter(self._captured.values()))[0].pool() if self._captured else None
        with torch.cuda.graph(graph, pool=pool):
            result = step()
        return graph, result
