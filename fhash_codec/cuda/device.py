"""CUDA devices: their memory and kernels."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.cuda.declarations import ffi
from fhash_codec.cuda.nvrtc import Unavailable, cache_folder, compiled, kept, loaded

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
OUT_OF_MEMORY = 2
"""Answer of the driver where the device has too little memory."""


class Memory(Protocol):
    """Bytes on a device, freed with the object.

    Attributes:
        address: of the first one on the device.
    """

    address: int

    def send(self, array: npt.NDArray[Any], offset: int = 0) -> None:
        """Write an array, from a byte on."""

    def receive(self, array: npt.NDArray[Any]) -> None:
        """Fill an array, which is contiguous, with the first bytes; waits for the kernels."""

    def clear(self, value: int = 0) -> None:
        """Set every byte."""


class Kernels(Protocol):
    """Kernels that a device has loaded.

    Attributes:
        new: whether they never did well here before: `keep` says that they do.
    """

    new: bool

    def launch(
        self,
        kernel: str,
        blocks: int,
        threads: int,
        shared_bytes: int,
        arguments: Sequence[Any],
        stream: int = 0,
    ) -> None:
        """Launch a kernel after what its stream has queued; Unavailable where that fails.

        arguments: pointers to them.
        """

    def keep(self) -> None:
        """Put new kernels into the cache, after a trial."""


class Device(Protocol):
    """A device that memory and kernels are had of.

    Attributes:
        name: for people.
        multiprocessors: their number.
        shared_per_block: bytes of shared memory that a block can have.
        shared_per_multiprocessor: bytes of shared memory of a multiprocessor.
    """

    name: str
    multiprocessors: int
    shared_per_block: int
    shared_per_multiprocessor: int

    def memory(self, size: int) -> Memory:
        """Bytes of no values; MemoryError where the device has not so many."""

    def free(self) -> int:
        """Bytes that are free."""

    def wait(self) -> None:
        """Wait until all kernels have ended; Unavailable where one failed."""

    def load(
        self, text: str, headers: Mapping[str, str] | None = None, options: Sequence[str] = ()
    ) -> Kernels:
        """Compile kernels as `Nvrtc.compile` does, or find them in the cache; Unavailable where
        they cannot be had.
        """


class Driver:
    """The driver's library; its calls raise Unavailable where they fail."""

    def __init__(self) -> None:
        """Load and initialise the library."""
        self._library = loaded(LIBRARIES)
        self.call("cuInit", 0)

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function of the library."""
        function = getattr(self._library, name, None)
        if function is None:
            raise Unavailable(f"the CUDA driver is too old: it has no {name}")
        if answer := function(*arguments):
            text = ffi.new("char **")
            self._library.cuGetErrorString(answer, text)
            reason = ffi.string(text[0]).decode() if text[0] else f"error {answer}"
            kind = MemoryError if answer == OUT_OF_MEMORY else Unavailable
            raise kind(f"{name} of the CUDA driver failed: {reason}")

    def version(self) -> int:
        """The major version of CUDA that the driver has."""
        version = ffi.new("int *")
        self.call("cuDriverGetVersion", version)
        return int(version[0]) // 1000

    def count(self) -> int:
        """The number of devices."""
        count = ffi.new("int *")
        self.call("cuDeviceGetCount", count)
        return int(count[0])

    def attribute(self, device: int, number: int) -> int:
        """An attribute of a device."""
        value = ffi.new("int *")
        self.call("cuDeviceGetAttribute", value, number, device)
        return int(value[0])


class CudaMemory:
    """`Memory` of a CUDA device."""

    def __init__(self, device: CudaDevice, size: int) -> None:
        """Ask for some bytes; MemoryError where there are not so many."""
        self._device, self.size = device, size
        address = ffi.new("CUdeviceptr *")
        device.call("cuMemAlloc_v2", address, max(size, 1))
        self.address = int(address[0])

    def send(self, array: npt.NDArray[Any], offset: int = 0) -> None:
        array = np.ascontiguousarray(array)
        assert offset + array.nbytes <= self.size
        if array.nbytes:
            source = ffi.cast("void *", array.ctypes.data)
            self._device.call("cuMemcpyHtoD_v2", self.address + offset, source, array.nbytes)

    def receive(self, array: npt.NDArray[Any]) -> None:
        assert array.flags.c_contiguous
        assert array.nbytes <= self.size
        if array.nbytes:
            to = ffi.cast("void *", array.ctypes.data)
            self._device.call("cuMemcpyDtoH_v2", to, self.address, array.nbytes)

    def clear(self, value: int = 0) -> None:
        self._device.call("cuMemsetD8_v2", self.address, value, max(self.size, 1))

    def __del__(self) -> None:
        if hasattr(self, "address") and not sys.is_finalizing():
            # Behind a kernel that failed, every call does.
            with suppress(Unavailable, MemoryError):
                self._device.call("cuMemFree_v2", self.address)


class CudaKernels:
    """`Kernels` of a CUDA device."""

    def __init__(self, device: CudaDevice, cubin: bytes, file: Path, *, new: bool) -> None:
        """Load a module; `file` is that of the cache."""
        self._device, self._cubin, self._file, self.new = device, cubin, file, new
        self._module = ffi.new("CUmodule *")
        self._kernels: dict[str, tuple[Any, int]] = {}
        device.call("cuModuleLoadData", self._module, cubin)

    def launch(
        self,
        kernel: str,
        blocks: int,
        threads: int,
        shared_bytes: int,
        arguments: Sequence[Any],
        stream: int = 0,
    ) -> None:
        self._device.call(
            "cuLaunchKernel",
            self._kernel(kernel, shared_bytes),
            *(blocks, 1, 1, threads, 1, 1, shared_bytes),
            ffi.cast("CUstream", stream),
            list(arguments),
            ffi.NULL,
        )

    def keep(self) -> None:
        if self.new:
            kept(self._cubin, self._file)
            self.new = False

    def _kernel(self, name: str, shared_bytes: int) -> Any:
        """A kernel that may have some bytes of shared memory."""
        call = self._device.call
        if name not in self._kernels:
            found = ffi.new("CUfunction *")
            call("cuModuleGetFunction", found, self._module[0], name.encode())
            self._kernels[name] = found[0], -1
        kernel, most = self._kernels[name]
        if shared_bytes > most:
            call("cuFuncSetAttribute", kernel, DYNAMIC_SHARED, shared_bytes)
            self._kernels[name] = kernel, shared_bytes
        return kernel


class CudaDevice:
    """A `Device`: one of the driver's, in its primary context, which torch computes in, too."""

    def __init__(self, index: int = 0) -> None:
        """Look at a device; Unavailable where the driver cannot be called or has none."""
        self._driver = driver()
        if index >= self._driver.count():
            raise Unavailable("the CUDA driver knows no device")
        name = ffi.new("char[]", 256)
        self._driver.call("cuDeviceGetName", name, len(name), index)
        self.name = ffi.string(name).decode(errors="replace")
        self._context = ffi.new("CUcontext *")
        self._driver.call("cuDevicePrimaryCtxRetain", self._context, index)
        self._loaded: dict[tuple[str, ...], CudaKernels] = {}
        of = self._driver.attribute
        self._architecture = 10 * of(index, CAPABILITY_MAJOR) + of(index, CAPABILITY_MINOR)
        self.multiprocessors = of(index, MULTIPROCESSORS)
        self.shared_per_block = of(index, SHARED_PER_BLOCK)
        self.shared_per_multiprocessor = of(index, SHARED_PER_MULTIPROCESSOR)

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function of the driver in the device's context."""
        with self._current():
            self._driver.call(name, *arguments)

    def memory(self, size: int) -> CudaMemory:
        return CudaMemory(self, size)

    def free(self) -> int:
        free, total = ffi.new("size_t *"), ffi.new("size_t *")
        self.call("cuMemGetInfo_v2", free, total)
        return int(free[0])

    def load(
        self, text: str, headers: Mapping[str, str] | None = None, options: Sequence[str] = ()
    ) -> CudaKernels:
        key = text, *(headers or {}).values(), *options
        if key not in self._loaded:
            self._loaded[key] = self._load(text, headers, options, anew=False)
        return self._loaded[key]

    def _load(
        self, text: str, headers: Mapping[str, str] | None, options: Sequence[str], *, anew: bool
    ) -> CudaKernels:
        cubin, file, new = compiled(
            text,
            self._architecture,
            cache_folder(),
            headers=headers,
            options=options,
            anew=anew,
            newest=self._driver.version(),
        )
        try:
            return CudaKernels(self, cubin, file, new=new)
        except Unavailable:
            if new:
                raise
        # The file in the cache is damaged.
        return self._load(text, headers, options, anew=True)

    def wait(self) -> None:
        """Wait until all kernels have ended; Unavailable where one failed."""
        self.call("cuCtxSynchronize")

    @contextmanager
    def _current(self) -> Iterator[None]:
        """Make the device's context that of the thread."""
        self._driver.call("cuCtxPushCurrent_v2", self._context[0])
        try:
            yield
        finally:
            self._driver.call("cuCtxPopCurrent_v2", ffi.new("CUcontext *"))


@cache
def driver() -> Driver:
    """The driver; Unavailable where there is none."""
    return Driver()


@cache
def first_device() -> Device:
    """The first device, for all that ask; Unavailable where there is none."""
    return CudaDevice()


def has_device() -> bool:
    """Whether there is a CUDA device, without touching it."""
    try:
        return driver().count() > 0
    except Unavailable:
        return False


def sent(device: Device, array: npt.NDArray[Any]) -> Memory:
    """A copy of an array on a device."""
    array = np.ascontiguousarray(array)
    memory = device.memory(array.nbytes)
    memory.send(array)
    return memory
