"""A device that runs the kernels on the processor: g++ compiles their text with emulate.hpp."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fhash_codec.paper.engines.fused.source import DeviceLimits, KernelSizes, Unavailable

HERE = Path(__file__).parent
LIMITS = DeviceLimits(
    multiprocessors=2, shared_per_block=96 << 10, shared_per_multiprocessor=200 << 10
)
"""A small device: several bricks for each block."""


class EmulatedProgram:
    """Kernels in a shared library. Threads run in `order`: 0 up, 1 down, else shuffled."""

    new = False

    def __init__(self, library: Path, order: int) -> None:
        self._launch = ctypes.CDLL(str(library)).launch
        self._launch.argtypes = [
            ctypes.c_char_p,
            ctypes.c_uint,
            ctypes.c_size_t,
            ctypes.c_int,
            ctypes.c_void_p,
        ]
        self.order = order
        self.launched: list[str] = []
        self.forgotten = False

    def launch(
        self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[ctypes._CDataType]
    ) -> None:
        self.launched.append(kernel)
        addresses = (ctypes.c_void_p * len(arguments))(*map(ctypes.addressof, arguments))
        answer = self._launch(kernel.encode(), blocks, shared_bytes, self.order, addresses)
        if answer:
            raise Unavailable(f"{kernel}: {('', 'barriers differ', 'unknown kernel')[answer]}")

    def forget(self) -> None:
        self.forgotten = True


class EmulatedDevice:
    """A device without a GPU.

    `change` is applied to the text of the kernels, `threads` and `columns` replace those of the
    sizes, `flags` go to the compiler.
    """

    def __init__(
        self,
        folder: Path,
        *,
        order: int = 0,
        threads: int = 64,
        columns: int = 32,
        change=str,
        flags: Sequence[str] = (),
        new: bool = False,
        limits: DeviceLimits = LIMITS,
    ) -> None:
        self.limits, self.order, self.new = limits, order, new
        self._folder, self._change, self._flags = folder, change, flags
        self._sizes = {"threads": threads, "columns": columns}
        self.programs: list[EmulatedProgram] = []

    def load(self, sizes: KernelSizes) -> EmulatedProgram:
        # The engine must see the replaced sizes as well, and it holds this very object.
        for name, value in self._sizes.items():
            object.__setattr__(sizes, name, value)
        sizes.__dict__.pop("places", None)
        text = self._change(sizes.text())
        program = EmulatedProgram(compiled(text, self._folder, self._flags), self.order)
        program.new = self.new
        self.programs.append(program)
        return program


def compiled(text: str, folder: Path, flags: Sequence[str] = ()) -> Path:
    """The library of some kernels' text, from `folder` where it was compiled before."""
    name = f"kernels_{abs(hash((text, tuple(flags)))):x}"
    library = folder / f"{name}.so"
    if not library.exists():
        source = folder / f"{name}.cu"
        source.write_text(text)
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
                *flags,
                str(HERE / "emulated.cpp"),
                "-o",
                str(library),
            ],
            check=True,
        )
    return library
