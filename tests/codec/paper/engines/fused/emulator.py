"""A device that runs the kernels on the processor: see emulated_cuda.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from emulated_cuda import EmulatedKernels, compiled

from fhash_codec.paper.engines.fused.program import DeviceLimits, Sizes
from fhash_codec.paper.network import ArrayTable, SparseFrame

LIMITS = DeviceLimits(
    multiprocessors=2,
    shared_per_block=160 << 10,
    shared_per_multiprocessor=400 << 10,
    threads=64,
    columns=(32,),
)
"""A small device: several bricks for each block, and few fibres."""


class EmulatedProgram:
    """Kernels for some sizes, whose threads run in `order`."""

    def __init__(self, kernels: EmulatedKernels, threads: int) -> None:
        self.kernels, self._threads = kernels, threads

    @property
    def launched(self) -> list[str]:
        return self.kernels.launched

    @property
    def new(self) -> bool:
        return self.kernels.new

    @property
    def kept(self) -> bool:
        return self.kernels.kept

    def launch(self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[Any]) -> None:
        self.kernels.launch(kernel, blocks, self._threads, shared_bytes, arguments)

    def keep(self) -> None:
        self.kernels.keep()


class EmulatedDevice:
    """A device without a GPU.

    `change` is applied to the text of the kernels, `flags` go to the compiler, `limits` replace
    those of LIMITS.
    """

    def __init__(
        self,
        folder: Path,
        *,
        order: int = 0,
        change: Callable[[str], str] = str,
        flags: Sequence[str] = (),
        new: bool = False,
        **limits: Any,
    ) -> None:
        self.limits, self.order, self.new = replace(LIMITS, **limits), order, new
        self._folder, self._change, self._flags = folder, change, flags

    def load(self, sizes: Sizes) -> EmulatedProgram:
        library = compiled(self._change(sizes.text()), self._folder, self._flags)
        return EmulatedProgram(EmulatedKernels(library, self.order, new=self.new), sizes.threads)


class HeldTable(ArrayTable):
    """A table in memory that holds the vertices whose embeddings are not 0, at each time others."""

    def frame(self, node: int) -> SparseFrame:
        held = self.values[node].any(axis=-1)
        return SparseFrame.of(held, self.values[node][held])
