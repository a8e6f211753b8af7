"""The kernels on a CUDA device: compiled by NVRTC, cached, and launched by the driver's library.

Launches go to torch's current stream, in the device's primary context, which torch uses as well.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import torch

from fhash_codec.paper.engines.fused.nvrtc import find_nvrtc
from fhash_codec.paper.engines.fused.source import DeviceLimits, Sizes, Unavailable
from fhash_formats.errors import FhashError
from fhash_formats.support.atomic import replacing

LIBRARIES = ("libcuda.so.1", "nvcuda.dll")
"""Names of the driver's library."""
MULTIPROCESSORS = 16
"""Number of the attribute: multiprocessors of a device."""
CAPABILITY_MAJOR = 75
"""Number of the attribute: first number of the compute capability."""
CAPABILITY_MINOR = 76
"""Number of the attribute: second number of the compute capability."""
SHARED_PER_MULTIPROCESSOR = 81
"""Number of the attribute: bytes of shared memory of a multiprocessor."""
SHARED_PER_BLOCK = 97
"""Number of the attribute: bytes of shared memory that a block can ask for."""
DYNAMIC_SHARED = 8
"""Number of the kernel's attribute: bytes of shared memory that a launch may ask for."""
LOWEST = 70
"""Lowest architecture that the kernels run on."""


class Driver:
    """The driver's library; its calls raise Unavailable where they fail."""

    def __init__(self) -> None:
        """Load and initialise the library."""
        self._library = _loaded(LIBRARIES)
        self.call("cuInit", ctypes.c_uint(0))

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function of the library."""
        function = getattr(self._library, name, None)
        if function is None:
            raise Unavailable(f"the CUDA driver is too old: it has no {name}")
        if answer := function(*arguments):
            text = ctypes.c_char_p()
            self._library.cuGetErrorString(answer, ctypes.byref(text))
            reason = text.value.decode() if text.value else f"error {answer}"
            raise Unavailable(f"{name} of the CUDA driver failed: {reason}")

    def attribute(self, device: int, number: int) -> int:
        """Return an attribute of a device."""
        value = ctypes.c_int()
        self.call("cuDeviceGetAttribute", ctypes.byref(value), number, device)
        return value.value


class CudaProgram:
    """Kernels on a CUDA device, a `Program` of engine.py.

    Attributes:
        new: whether the kernels were compiled just now.
    """

    def __init__(
        self, driver: Driver, cubin: bytes, device: torch.device, threads: int, cached: Path | None
    ) -> None:
        """Load a module into the device's primary context; `cached` is its file, if it is new."""
        self._driver, self._device, self._threads = driver, device, threads
        self._cached, self.new = cached, cached is not None
        self._module = ctypes.c_void_p()
        self._kernels: dict[tuple[str, int], ctypes.c_void_p] = {}
        self._in_context(driver.call, "cuModuleLoadData", ctypes.byref(self._module), cubin)

    def launch(
        self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[ctypes._CDataType]
    ) -> None:
        """Launch a kernel after the work that torch has queued; Unavailable where that fails."""
        self._in_context(self._launch, kernel, blocks, shared_bytes, arguments)

    def forget(self) -> None:
        """Remove the kernels from the cache."""
        if self._cached is not None:
            self._cached.unlink(missing_ok=True)

    def _launch(
        self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[ctypes._CDataType]
    ) -> None:
        """Do what `launch` does, in the device's context."""
        addresses = (ctypes.c_void_p * len(arguments))(*map(ctypes.addressof, arguments))
        self._driver.call(
            "cuLaunchKernel",
            self._kernel(kernel, shared_bytes),
            *map(ctypes.c_uint, (blocks, 1, 1, self._threads, 1, 1, shared_bytes)),
            ctypes.c_void_p(torch.cuda.current_stream(self._device).cuda_stream),
            addresses,
            None,
        )

    def _kernel(self, name: str, shared_bytes: int) -> ctypes.c_void_p:
        """Return a kernel that may have some bytes of shared memory."""
        kernel = self._kernels.get((name, shared_bytes))
        if kernel is None:
            kernel = ctypes.c_void_p()
            call = self._driver.call
            call("cuModuleGetFunction", ctypes.byref(kernel), self._module, name.encode())
            call("cuFuncSetAttribute", kernel, DYNAMIC_SHARED, ctypes.c_int(shared_bytes))
            self._kernels[name, shared_bytes] = kernel
        return kernel

    def _in_context(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call a function while the device's primary context is the thread's context."""
        with torch.cuda.device(self._device):
            call(*arguments)


class CudaDevice:
    """A CUDA device of torch, a `Device` of engine.py.

    Attributes:
        limits: its limits.
    """

    def __init__(self, device: torch.device) -> None:
        """Look at a device; Unavailable where the driver cannot be called."""
        self._driver = Driver()
        torch.cuda.init()  # type: ignore[no-untyped-call]
        index = torch.cuda.current_device() if device.index is None else device.index
        self._device = torch.device("cuda", index)
        # The first tensor makes the primary context.
        torch.empty(1, device=self._device)
        of = self._driver.attribute
        self._architecture = 10 * of(index, CAPABILITY_MAJOR) + of(index, CAPABILITY_MINOR)
        self.limits = DeviceLimits(
            multiprocessors=of(index, MULTIPROCESSORS),
            shared_per_block=of(index, SHARED_PER_BLOCK),
            shared_per_multiprocessor=of(index, SHARED_PER_MULTIPROCESSOR),
        )

    def load(self, sizes: Sizes) -> CudaProgram:
        """Compile the kernels for some sizes, or find them in the cache."""
        text, folder = sizes.text(), cache_folder()
        cubin, file = compiled(text, self._architecture, folder)
        try:
            return CudaProgram(self._driver, cubin, self._device, sizes.threads, file)
        except Unavailable:
            if file is not None:
                raise
        # The file in the cache is damaged.
        cubin, file = compiled(text, self._architecture, folder, anew=True)
        return CudaProgram(self._driver, cubin, self._device, sizes.threads, file)


def compiled(
    text: str, architecture: int, folder: Path, *, anew: bool = False
) -> tuple[bytes, Path | None]:
    """Return machine code for a text, from the cache where it was compiled before.

    The name in the cache holds for one text, architecture and version of NVRTC. Where the cache
    cannot be read or written, each process compiles.

    Args:
        text: CUDA C++.
        architecture: as in 90 for sm_90.
        folder: the cache.
        anew: whether to compile even if the cache has the machine code.

    Returns:
        The machine code, and its file in the cache if it was compiled just now.

    Raises:
        Unavailable: there is no NVRTC, it does not know the architecture, or the text is wrong.
    """
    nvrtc = find_nvrtc()
    # Machine code runs on later devices of the same generation.
    known = [number for number in nvrtc.architectures if number <= architecture]
    if not known or max(known) // 10 != architecture // 10 or architecture < LOWEST:
        raise Unavailable(f"NVRTC {nvrtc.path} cannot compile for sm_{architecture}")
    target = max(known)
    major, minor = nvrtc.version
    digest = hashlib.sha256(text.encode()).hexdigest()
    file = folder / f"{digest[:32]}-sm_{target}-nvrtc_{major}.{minor}.cubin"
    if not anew:
        try:
            return file.read_bytes(), None
        except OSError:
            pass
    cubin, _ = nvrtc.compile(text, target)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(file, force=True) as temporary:
            temporary.write_bytes(cubin)
    except (OSError, FhashError):
        pass
    return cubin, file


def cache_folder() -> Path:
    """Return the folder for compiled kernels, in the user's folder for caches."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "fhash" / "kernels"


@cache
def _loaded(names: Sequence[str]) -> ctypes.CDLL:
    """Return the first library of some names that loads; Unavailable where none does."""
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise Unavailable(f"the CUDA driver's library is not here ({' or '.join(names)})")
