"""NVRTC, NVIDIA's compiler at run time: where its library is found, and the calls that are needed.

CUDA builds of torch bring the library. It needs neither a GPU nor a driver.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from fhash_codec.paper.engines.fused.source import Unavailable

NAMES = ("libnvrtc.so*", "nvrtc64_*.dll")
"""Patterns of the library's file name."""
OPTIONS = ("--std=c++17", "--ptxas-options=-v")
"""Options of each compilation; the last one has the resources of the kernels reported."""


class Nvrtc:
    """A loaded library.

    Attributes:
        path: the library's file.
    """

    def __init__(self, path: Path) -> None:
        """Load a library; raises OSError where that fails."""
        self.path = path
        # NVRTC loads its other library by name, which finds it only where it is loaded already.
        for other in sorted(path.parent.glob("libnvrtc-builtins.so*")):
            ctypes.CDLL(str(other))
        self._library = ctypes.CDLL(str(path))

    @cached_property
    def version(self) -> tuple[int, int]:
        """The version, major and minor."""
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._call("nvrtcVersion", ctypes.byref(major), ctypes.byref(minor))
        return major.value, minor.value

    @cached_property
    def architectures(self) -> list[int]:
        """The architectures that it compiles for, as in 90 for sm_90."""
        count = ctypes.c_int()
        self._call("nvrtcGetNumSupportedArchs", ctypes.byref(count))
        numbers = (ctypes.c_int * count.value)()
        self._call("nvrtcGetSupportedArchs", numbers)
        return list(numbers)

    def compile(self, text: str, architecture: int) -> tuple[bytes, str]:
        """Compile CUDA C++ to machine code.

        Args:
            text: the whole source.
            architecture: one of `architectures`.

        Returns:
            The module for the driver (a cubin), and the compiler's messages.

        Raises:
            Unavailable: the text cannot be compiled.
        """
        program = ctypes.c_void_p()
        name = b"fhash.cu"
        self._call("nvrtcCreateProgram", ctypes.byref(program), text.encode(), name, 0, None, None)
        try:
            options = [f"--gpu-architecture=sm_{architecture}", *OPTIONS]
            array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
            answer = self._library.nvrtcCompileProgram(program, len(options), array)
            log = self._bytes(program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
            if answer:
                raise Unavailable(f"NVRTC {self._error(answer)}:\n{log}")
            return self._bytes(program, "CUBIN"), log
        finally:
            self._library.nvrtcDestroyProgram(ctypes.byref(program))

    def _bytes(self, program: ctypes.c_void_p, name: str) -> bytes:
        """Return what nvrtcGetNAME has for a program."""
        size = ctypes.c_size_t()
        self._call(f"nvrtcGet{name}Size", program, ctypes.byref(size))
        data = ctypes.create_string_buffer(size.value)
        self._call(f"nvrtcGet{name}", program, data)
        return data.raw

    def _call(self, name: str, *arguments: Any) -> None:
        """Call a function; Unavailable where it fails or the library is too old to have it."""
        function = getattr(self._library, name, None)
        if function is None:
            raise Unavailable(f"NVRTC {self.path} is too old: it has no {name}")
        if answer := function(*arguments):
            raise Unavailable(f"NVRTC {self._error(answer)}")

    def _error(self, answer: int) -> str:
        text = self._library.nvrtcGetErrorString
        text.restype = ctypes.c_char_p
        return str(text(answer).decode())


def find_nvrtc() -> Nvrtc:
    """Return the first NVRTC that loads; Unavailable where there is none."""
    failures = []
    for path in _candidates():
        try:
            return Nvrtc(path)
        except OSError as error:
            failures.append(f"{path}: {error}")
    reason = "; ".join(failures) or "CUDA builds of torch bring it (libnvrtc)"
    raise Unavailable(f"no NVRTC was found here: {reason}")


def _candidates() -> Iterator[Path]:
    """Yield files of the library, of a folder the newest first."""
    for folder in _folders():
        for pattern in NAMES:
            found = [path for path in folder.glob(pattern) if "builtins" not in path.name]
            yield from sorted(found, key=_number, reverse=True)


def _folders() -> list[Path]:
    """Return where the library may be: NVIDIA's packages, torch, a toolkit, the loader's path."""
    folders = []
    for package, inner in (("nvidia", ("cu*/lib", "cuda_nvrtc/lib", "*/bin")), ("torch", ("lib",))):
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or ()) if spec else ():
            folders += [folder for pattern in inner for folder in sorted(Path(root).glob(pattern))]
    toolkits = [os.environ.get("CUDA_HOME"), os.environ.get("CUDA_PATH"), "/usr/local/cuda"]
    for toolkit in filter(None, toolkits):
        folders += [Path(toolkit) / "lib64", Path(toolkit) / "bin"]
    paths = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    return folders + [Path(path) for path in paths if path]


def _number(path: Path) -> list[int]:
    """Return the numbers in a file's name, to find the newest."""
    return [int(number) for number in re.findall(r"\d+", path.name)]
