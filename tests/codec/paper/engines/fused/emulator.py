"""A device that runs the kernels on the processor: g++ compiles their text with emulate.hpp."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cffi

from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.paper.engines.fused.program import DeviceLimits, Sizes
from fhash_codec.paper.network import ArrayTable, SparseFrame

HERE = Path(__file__).parent
FFI = cffi.FFI()
FFI.cdef("int launch(const char* name, unsigned blocks, size_t bytes, int order, void** given);")
LIMITS = DeviceLimits(
    multiprocessors=2,
    shared_per_block=160 << 10,
    shared_per_multiprocessor=400 << 10,
    threads=64,
    columns=(32,),
)
"""A small device: several bricks for each block, and few fibres."""
FAILURES = {1: "threads met at different barriers", 2: "unknown kernel", 3: "wild address"}
"""Meaning of the answers of `launch` in emulated.cpp."""


class EmulatedProgram:
    """Kernels in a shared library. Threads run in `order`: 0 up, 1 down, else shuffled."""

    new = False

    def __init__(self, library: Path, order: int) -> None:
        self.library = FFI.dlopen(str(library))
        self.order = order
        self.launched: list[str] = []
        self.forgotten = False

    def launch(self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[Any]) -> None:
        self.launched.append(kernel)
        given = (kernel.encode(), blocks, shared_bytes, self.order, list(arguments))
        answer = self.library.launch(*given)
        if answer:
            raise Unavailable(f"{kernel}: {FAILURES[answer]}")

    def forget(self) -> None:
        self.forgotten = True


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
        text = self._change(sizes.text())
        program = EmulatedProgram(compiled(text, self._folder, self._flags), self.order)
        program.new = self.new
        return program


class HeldTable(ArrayTable):
    """A table in memory that holds the vertices whose embeddings are not 0, at each time others."""

    def frame(self, node: int) -> SparseFrame:
        held = self.values[node].any(axis=-1)
        return SparseFrame.of(held, self.values[node][held])


def compiled(text: str, folder: Path, flags: Sequence[str] = ()) -> Path:
    """The library of some kernels' text, from `folder` where it was compiled before."""
    name = f"kernels_{abs(hash((text, tuple(flags)))):x}"
    library = folder / f"{name}.so"
    if not library.exists():
        source = folder / f"{name}.cu"
        source.write_text(text)
        kernels = re.findall(r'extern "C" __global__.*?(\w+)\(\n', text)
        subprocess.run(
            [
                "g++",
                "-std=c++17",
                "-O1",
                "-shared",
                "-fPIC",
                "-Wall",
                "-Wno-unknown-pragmas",
                "-Wno-unused-function",
                "-Wno-unused-variable",
                "-U_FORTIFY_SOURCE",
                f'-DKERNELS="{source}"',
                f"-DFHASH_KERNELS={','.join(f'FHASH_KERNEL({name})' for name in kernels)}",
                *flags,
                str(HERE / "emulated.cpp"),
                "-o",
                str(library),
            ],
            check=True,
        )
    return library
