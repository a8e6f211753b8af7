"""NVRTC, NVIDIA's compiler of CUDA C++, which compiles kernels on the machine where they run."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from fhash_codec.cuda.declarations import ffi
from fhash_formats.errors import FhashError
from fhash_formats.support.files import replacing


class Unavailable(Exception):
    """Kernels cannot be had here, or cannot do what is asked of them; the message says why."""


LOWEST = 70
"""Lowest architecture that the kernels run on."""
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
            opened(str(other))
        self._library = opened(str(path))

    @cached_property
    def version(self) -> tuple[int, int]:
        """The version, major and minor."""
        major, minor = ffi.new("int *"), ffi.new("int *")
        self._call("nvrtcVersion", major, minor)
        return major[0], minor[0]

    @cached_property
    def architectures(self) -> list[int]:
        """The architectures that it compiles for, as in 90 for sm_90."""
        count = ffi.new("int *")
        self._call("nvrtcGetNumSupportedArchs", count)
        numbers = ffi.new("int[]", count[0])
        self._call("nvrtcGetSupportedArchs", numbers)
        return list(numbers)

    def compile(
        self,
        text: str,
        architecture: int,
        headers: Mapping[str, str] | None = None,
        options: Sequence[str] = (),
    ) -> tuple[bytes, str]:
        """Compile CUDA C++ to machine code.

        Args:
            text: the source.
            architecture: one of `architectures`.
            headers: texts that the source includes, by name.
            options: of the compiler, besides OPTIONS.

        Returns:
            The module for the driver (a cubin), and the compiler's messages.

        Raises:
            Unavailable: the text cannot be compiled.
        """
        program, headers = ffi.new("nvrtcProgram *"), headers or {}
        held = [
            [ffi.new("char[]", each.encode()) for each in words]
            for words in (headers.values(), headers, (*OPTIONS, *options))
        ]
        target = ffi.new("char[]", f"--gpu-architecture=sm_{architecture}".encode())
        texts, names, words = held
        self._call(
            "nvrtcCreateProgram", program, text.encode(), b"fhash.cu", len(names), texts, names
        )
        try:
            words = [target, *words]
            answer = self._library.nvrtcCompileProgram(program[0], len(words), words)
            log = self._bytes(program[0], "ProgramLog").rstrip(b"\0").decode(errors="replace")
            if answer:
                raise Unavailable(f"NVRTC {self._error(answer)}:\n{log}")
            return self._bytes(program[0], "CUBIN"), log
        finally:
            self._library.nvrtcDestroyProgram(program)

    def _bytes(self, program: Any, name: str) -> bytes:
        """Return what nvrtcGetNAME has for a program."""
        size = ffi.new("size_t *")
        self._call(f"nvrtcGet{name}Size", program, size)
        data = ffi.new("char[]", size[0])
        self._call(f"nvrtcGet{name}", program, data)
        return bytes(ffi.buffer(data))

    def _call(self, name: str, *arguments: Any) -> None:
        """Call a function; Unavailable where it fails or the library is too old to have it."""
        function = getattr(self._library, name, None)
        if function is None:
            raise Unavailable(f"NVRTC {self.path} is too old: it has no {name}")
        if answer := function(*arguments):
            raise Unavailable(f"NVRTC {self._error(answer)}")

    def _error(self, answer: int) -> str:
        return str(ffi.string(self._library.nvrtcGetErrorString(answer)).decode())


def find_nvrtc(newest: int | None = None) -> Nvrtc:
    """Return the first NVRTC that loads; Unavailable where there is none.

    newest: its largest major version: a driver of an older one does not load what it compiles.
    """
    failures = []
    for path in _candidates():
        try:
            found = Nvrtc(path)
        except OSError as error:
            failures.append(f"{path}: {error}")
            continue
        if newest is None or found.version[0] <= newest:
            return found
        failures.append(f"{path} is of CUDA {found.version[0]}, and the driver of CUDA {newest}")
    reason = "; ".join(failures) or "pip install nvidia-cuda-nvrtc, or a CUDA build of torch"
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


def compiled(
    text: str,
    architecture: int,
    folder: Path,
    *,
    headers: Mapping[str, str] | None = None,
    options: Sequence[str] = (),
    anew: bool = False,
    newest: int | None = None,
) -> tuple[bytes, Path, bool]:
    """Return machine code for a text, from the cache where it was compiled before.

    What the cache has is found without NVRTC, which takes time to load.

    Args:
        text, headers, options: as in `Nvrtc.compile`.
        architecture: of the device, as in 90 for sm_90.
        folder: the cache.
        anew: whether to compile even if the cache has the machine code.
        newest: major version of CUDA that the driver has; None for any.

    Returns:
        The machine code, its file in the cache, which `kept` writes, and whether it is new.

    Raises:
        Unavailable: there is no NVRTC, it does not know the architecture, or the text is wrong.
    """
    whole = "\0".join([text, *OPTIONS, *options, *(headers or {}).values()])
    digest = hashlib.sha256(whole.encode()).hexdigest()
    file = folder / f"{digest[:32]}-sm_{architecture}.cubin"
    if not anew:
        try:
            return file.read_bytes(), file, False
        except OSError:
            pass
    nvrtc = find_nvrtc(newest)
    # Machine code runs on later devices of the same generation.
    known = [number for number in nvrtc.architectures if number <= architecture]
    if not known or max(known) // 10 != architecture // 10 or architecture < LOWEST:
        raise Unavailable(f"NVRTC {nvrtc.path} cannot compile for sm_{architecture}")
    cubin, _ = nvrtc.compile(text, max(known), headers, options)
    return cubin, file, True


def kept(cubin: bytes, file: Path) -> None:
    """Write machine code into the cache; where it cannot be written, each process compiles."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with replacing(file, force=True) as temporary:
            temporary.write_bytes(cubin)
    except (OSError, FhashError):
        pass


def cache_folder() -> Path:
    """Return the folder for compiled kernels, in the user's folder for caches."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "fhash" / "kernels"


@cache
def loaded(names: Sequence[str]) -> Any:
    """Return the first library of some names that loads; Unavailable where none does."""
    for name in names:
        try:
            return opened(name)
        except OSError:
            continue
    raise Unavailable(f"the CUDA driver's library is not here ({' or '.join(names)})")


@cache
def opened(name: str) -> Any:
    """Return a library, which stays loaded; OSError where it does not load."""
    return ffi.dlopen(name)
