"""A CUDA device on the processor: memory is NumPy's, and g++ compiles the kernels' text.

`emulate.hpp` runs the threads of a block one after another, from barrier to barrier.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cffi
import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.rendering.march_device import STANDARD

SOURCES = Path(__file__).parent / "paper" / "engines" / "fused"
"""Folder of emulate.hpp and emulated.cpp."""
FFI = cffi.FFI()
FFI.cdef(
    "int launch(const char* name, unsigned blocks, unsigned threads, size_t bytes, int order,"
    " void** given);"
)
FAILURES = {1: "threads met at different barriers", 2: "unknown kernel", 3: "wild address"}
"""Meaning of the answers of `launch` in emulated.cpp."""
KERNEL = re.compile(
    r'extern "C" __global__ (?:void|__launch_bounds__\((?:[^()]|\([^()]*\))*\)|\s)+(\w+)\('
)
"""Head of a kernel with its name."""
FLAGS = (
    "-std=c++17",
    "-O1",
    "-shared",
    "-fPIC",
    "-Wall",
    "-Wno-unknown-pragmas",
    "-Wno-unused-function",
    "-Wno-unused-variable",
    "-U_FORTIFY_SOURCE",
)
OF_NVRTC = {"--fmad=false": "-ffp-contract=off"}
"""Flags of g++ for options of NVRTC; others are left out."""


class EmulatedMemory:
    """`Memory` in an array of bytes, each 0xff at first: NaN."""

    def __init__(self, size: int) -> None:
        self.bytes = np.full(max(size, 1), 0xFF, np.uint8)
        self.address = self.bytes.ctypes.data

    def send(self, array: npt.NDArray[Any], offset: int = 0) -> None:
        data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        assert offset + len(data) <= len(self.bytes)
        self.bytes[offset : offset + len(data)] = data

    def receive(self, array: npt.NDArray[Any]) -> None:
        assert array.flags.c_contiguous
        array.reshape(-1).view(np.uint8)[:] = self.bytes[: array.nbytes]

    def clear(self, value: int = 0) -> None:
        self.bytes[:] = value


class EmulatedKernels:
    """`Kernels` in a shared library. Threads run in `order`: 0 up, 1 down, else shuffled.

    Attributes:
        launched: names of the kernels that were launched.
        kept: whether they were to be put into the cache.
    """

    def __init__(self, library: Path, order: int, *, new: bool = False) -> None:
        self._library, self._order, self.new = FFI.dlopen(str(library)), order, new
        self.launched: list[str] = []
        self.kept = False

    def launch(
        self,
        kernel: str,
        blocks: int,
        threads: int,
        shared_bytes: int,
        arguments: Sequence[Any],
        stream: int = 0,
    ) -> None:
        self.launched.append(kernel)
        given = (blocks, threads, shared_bytes, self._order, list(arguments))
        answer = self._library.launch(kernel.encode(), *given)
        if answer:
            raise Unavailable(f"{kernel}: {FAILURES[answer]}")

    def keep(self) -> None:
        self.kept, self.new = True, False


class EmulatedDevice:
    """A small `Device` without a GPU; the test is skipped without g++.

    Args:
        folder: of the libraries; a text that was compiled there before is not compiled again.
        order: of the threads, as `EmulatedKernels` has it.
        change: is applied to the text of the kernels.
        flags: of g++, besides FLAGS.
        new: whether the kernels say that they were compiled just now.
    """

    name = "emulated"
    multiprocessors = 2
    shared_per_block = 160 << 10
    shared_per_multiprocessor = 400 << 10

    def __init__(
        self,
        folder: Path,
        order: int = 0,
        *,
        change: Callable[[str], str] = str,
        flags: Sequence[str] = (),
        new: bool = False,
    ) -> None:
        if shutil.which("g++") is None:
            pytest.skip("g++ compiles the emulated kernels, and is not here")
        self._folder, self._order, self._new = folder, order, new
        self._change, self._flags = change, flags
        self._loaded: dict[Path, EmulatedKernels] = {}

    def memory(self, size: int) -> EmulatedMemory:
        return EmulatedMemory(size)

    def free(self) -> int:
        return 1 << 30

    def wait(self) -> None:
        pass

    def load(
        self, text: str, headers: Mapping[str, str] | None = None, options: Sequence[str] = ()
    ) -> EmulatedKernels:
        flags = (*self._flags, *(OF_NVRTC[each] for each in options if each in OF_NVRTC))
        library = compiled(self._change(text), self._folder, flags, headers)
        if library not in self._loaded:
            self._loaded[library] = EmulatedKernels(library, self._order, new=self._new)
        return self._loaded[library]


def compiled(
    text: str, folder: Path, flags: Sequence[str] = (), headers: Mapping[str, str] | None = None
) -> Path:
    """The library of some kernels' text, from `folder` where it was compiled before.

    headers: texts that the source includes, by name.
    """
    # g++ has the standard library's own headers.
    headers = {name: header for name, header in (headers or {}).items() if name not in STANDARD}
    ours = [path.read_text() for path in sorted(SOURCES.glob("emulate*.?pp"))]
    key = repr((text, tuple(flags), sorted(headers.items()), ours))
    place = folder / f"kernels_{hashlib.sha256(key.encode()).hexdigest()[:16]}"
    library = place.with_suffix(".so")
    if not library.exists():
        place.mkdir(exist_ok=True)
        for name, header in headers.items():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(header)
        source = place / "kernels.cu"
        source.write_text(text)
        kernels = ",".join(f"FHASH_KERNEL({name})" for name in KERNEL.findall(text))
        given = [f'-DKERNELS="{source}"', f"-DFHASH_KERNELS={kernels}", f"-I{place}", *flags]
        made = library.with_suffix(f".{os.getpid()}")  # other processes may make it, too
        subprocess.run(
            ["g++", *FLAGS, *given, str(SOURCES / "emulated.cpp"), "-o", str(made)], check=True
        )
        made.rename(library)
    return library
