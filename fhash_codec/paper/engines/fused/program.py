"""CUDA program of the fused engine: its source, its compilation and the calls of its kernels."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from math import prod
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.fused.declarations import ffi
from fhash_codec.paper.engines.parameters import BETA1, BETA2, WINDOW, axis_matrices
from fhash_codec.paper.network import Architecture
from fhash_formats.errors import FhashError
from fhash_formats.support.files import replacing


@dataclass(frozen=True, kw_only=True)
class AxisTables:
    """The sub-lattices along an axis, for each coordinate of a brick and each coarse level.

    Attributes:
        corners: corners of a sub-lattice of each level.
        start: first corner of each sub-lattice, int32 (coordinates, levels).
        before: corner of the sub-lattice at or before each vertex, int32 (coordinates, levels,
            vertices).
        after: weight of the corner after that one, float32 of the same shape.
    """

    corners: tuple[int, ...]
    start: npt.NDArray[np.int32]
    before: npt.NDArray[np.int32]
    after: npt.NDArray[np.float32]


def axis_tables(architecture: Architecture, coreset: Coreset) -> list[AxisTables]:
    """Return the tables of the axes t, z, y and x. A key frame is a run of one vertex along t."""
    lengths, counts = (1, *coreset.brick_shape), (architecture.key_frames, *coreset.brick_grid)
    return [
        _axis_tables(size, [level[axis] for level in architecture.levels[1:]], length, count)
        for axis, (size, length, count) in enumerate(
            zip(architecture.sizes, lengths, counts, strict=True)
        )
    ]


def _axis_tables(size: int, resolutions: list[int], length: int, count: int) -> AxisTables:
    """Return the tables of one axis; arguments as in `upsampling.axis_matrices`."""
    corners = []
    start = np.empty((count, len(resolutions)), np.int32)
    before = np.empty((count, len(resolutions), length), np.int32)
    after = np.zeros((count, len(resolutions), length), np.float32)
    for level, resolution in enumerate(resolutions):
        start[:, level], weights = axis_matrices(size, resolution, length, count)
        corners.append(weights.shape[2])
        first = (weights != 0).argmax(axis=2)
        second = np.minimum(first + 1, weights.shape[2] - 1)
        weight = np.take_along_axis(weights, second[..., None], axis=2)[..., 0]
        before[:, level] = first
        after[:, level] = np.where(second > first, weight, 0.0)
    return AxisTables(corners=tuple(corners), start=start, before=before, after=after)


def missed_step_tables(
    rates: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return the two tables by which a kernel sums what `parameters.catch_up` sums.

    A step i after the last one with a gradient, step j in all, moves a number by
    r^i rate_j c_j m / (sqrt(v) + eps ...), as said there; the sum for eps has b1^i rate_j / (1 -
    b1^j) in place of r^i rate_j c_j.

    Args:
        rates: learning rate of every step, counted from 1.

    Returns:
        r^i and b1^i (WINDOW + 1, 2), and the factors of the steps j (steps, 2), both float32.
    """
    i, j = np.arange(WINDOW + 1)[:, None], np.arange(1, len(rates))
    powers = np.array([BETA1 / BETA2**0.5, BETA1]) ** i
    weights = np.zeros((len(rates), 2))
    weights[1:, 1] = rates[1:] / -np.expm1(j * np.log(BETA1))
    weights[1:, 0] = weights[1:, 1] * np.sqrt(-np.expm1(j * np.log(BETA2)))
    return powers.astype(np.float32), weights.astype(np.float32)


KERNELS = Path(__file__).parent / "kernels"
"""Folder of the kernels' files."""
FILES = ("records.h", "model.cuh", "network.cuh", "brick.cuh", "bricks.cu")
"""The files in the order in which they follow each other."""
THREADS = 256
"""Threads of a block."""
COLUMNS = (128, 64, 32)
"""Vertices of a tile at most, in the order in which they are tried."""
DRIVER_BYTES = 1024
"""Bytes of shared memory that the driver keeps of each block."""
MAX_WIDTH = 128
"""Largest width of a hidden layer."""
MAX_INPUTS = 64
"""Largest number of inputs of the layers."""
MAX_LAYERS = 2
"""Largest number of hidden layers."""


class Unavailable(Exception):
    """The fused kernels cannot do a model, or cannot be had here; the message says why."""


@dataclass(frozen=True, kw_only=True)
class DeviceLimits:
    """The limits of a device, and the sizes that are tried on it.

    Attributes:
        multiprocessors: number of multiprocessors.
        shared_per_block: bytes of shared memory that a block can have.
        shared_per_multiprocessor: bytes of shared memory of a multiprocessor.
        threads: threads of a block.
        columns: vertices of a tile at most, in the order in which they are tried.
    """

    multiprocessors: int
    shared_per_block: int
    shared_per_multiprocessor: int
    threads: int = THREADS
    columns: tuple[int, ...] = COLUMNS


@dataclass(frozen=True, kw_only=True)
class Sizes(ABC):
    """The sizes that kernels are compiled for: those of the layers on a tile.

    Attributes:
        architecture: the sizes of the model.
        columns: vertices or points of a tile at most, a multiple of 4.
        threads: threads of a block.
    """

    architecture: Architecture
    columns: int
    threads: int

    @property
    def stride(self) -> int:
        """Numbers of a row of a layer's matrix."""
        return -(-self.architecture.width // 8) * 8

    @property
    def matrices(self) -> int:
        """Numbers of the matrices of all layers."""
        *hidden, (_, last) = self.architecture.layer_shapes
        return sum((inputs + 1) * self.stride for _, inputs in hidden) + last + 1

    @property
    def layer_arrays(self) -> dict[str, int]:
        """Numbers of the arrays in shared memory that the layers need, by name."""
        model, pitch = self.architecture, self.columns + 4
        hidden = (model.width + 1) * pitch
        return {
            "INPUTS": (model.inputs + 1) * pitch,
            "HIDDEN_1": hidden if model.hidden_layers > 0 else 0,
            "HIDDEN_2": hidden if model.hidden_layers > 1 else 0,
            "MATRICES": self.matrices,
            "PARTS": 4 * self.threads,
        }

    @property
    def arrays(self) -> dict[str, int]:
        """Numbers of all arrays in shared memory, by name."""
        return self.layer_arrays

    @cached_property
    def offsets(self) -> dict[str, int]:
        """Places in shared memory, in numbers of 4 bytes, and their END."""
        places, end = {}, 0
        for name, size in self.arrays.items():
            places[name] = end
            end += -(-size // 4) * 4
        return places | {"END": end}

    @property
    def shared_bytes(self) -> int:
        """Bytes of shared memory that a block needs."""
        return 4 * self.offsets["END"]

    def slots(self, limits: DeviceLimits, most: int) -> int:
        """Return the blocks that are on a device at once, on a multiprocessor 1 to `most`."""
        resident = limits.shared_per_multiprocessor // (self.shared_bytes + DRIVER_BYTES)
        return limits.multiprocessors * max(1, min(most, resident))

    def layer_constants(self) -> Iterator[str]:
        """Yield the lines that define the constants of the layers and the places."""
        model = self.architecture
        numbers = {
            "LEVELS": len(model.levels),
            "SIZE": model.embedding_size,
            "WIDTH": model.width,
            "LAYERS": model.hidden_layers,
            "THREADS": self.threads,
            "COLUMNS": self.columns,
            "PITCH": self.columns + 4,
            "STRIDE": self.stride,
            "MATRICES": self.matrices,
        } | {f"AT_{name}": place for name, place in self.offsets.items()}
        yield from (f"constexpr int {name} = {number};" for name, number in numbers.items())

    @abstractmethod
    def text(self) -> str:
        """Return the whole text of the kernels."""


SomeSizes = TypeVar("SomeSizes", bound=Sizes)


@dataclass(frozen=True, kw_only=True)
class KernelSizes(Sizes):
    """The sizes that the kernels of training are compiled for.

    Attributes:
        brick_shape: vertices of a brick (z, y, x).
        corners: corners (t, z, y, x) of a brick's sub-lattice of each coarse level.
        sums_in_shared: whether the gradient by the layers is summed in shared memory.
    """

    brick_shape: tuple[int, int, int]
    corners: tuple[tuple[int, int, int, int], ...]
    sums_in_shared: bool

    @property
    def tile_rows(self) -> int:
        """Rows of vertices along x in a tile."""
        return self.columns // self.brick_shape[2]

    @property
    def tiles(self) -> int:
        """Tiles of a brick."""
        return -(-self.brick_shape[0] * self.brick_shape[1] // self.tile_rows)

    @cached_property
    def lattice_sizes(self) -> list[int]:
        """Numbers of a sub-lattice of each coarse level, after interpolation in time."""
        return [prod(corners[1:]) * self.architecture.embedding_size for corners in self.corners]

    @property
    def lattice(self) -> int:
        """Numbers of the sub-lattices of all levels, after interpolation in time."""
        return sum(self.lattice_sizes)

    @cached_property
    def row_sizes(self) -> list[int]:
        """Numbers of a row that is interpolated along z and y, for each coarse level."""
        return [corners[3] * self.architecture.embedding_size for corners in self.corners]

    @property
    def arrays(self) -> dict[str, int]:
        """Numbers of all arrays in shared memory, by name."""
        coarse = len(self.corners)
        return self.layer_arrays | {
            "SUMS": self.matrices if self.sums_in_shared else 0,
            "RESIDUAL": self.columns,
            "LATTICE": self.lattice,
            "SLOPES": self.lattice,
            "ROWS": self.tile_rows * sum(self.row_sizes),
            "AFTER": coarse * (1 + sum(self.brick_shape)),
            "BEFORE": coarse * (1 + sum(self.brick_shape)),
            "START": 4 * coarse,
            "SAMPLES": -(-prod(self.brick_shape) // 8) + 1,
        }

    def text(self) -> str:
        """Return the whole text of the kernels."""
        return with_files(self._constants(), FILES)

    def _constants(self) -> Iterator[str]:
        """Yield the lines that define the constants."""
        model, levels = self.architecture, self.architecture.levels
        z, y, x = self.brick_shape
        yield from self.layer_constants()
        numbers = {
            "COARSE": len(levels) - 1,
            "BRICK_Z": z,
            "BRICK_Y": y,
            "BRICK_X": x,
            "LATTICE": self.lattice,
            "ROW": sum(self.row_sizes),
        }
        yield from (f"constexpr int {name} = {number};" for name, number in numbers.items())
        yield f"constexpr bool SUMS_IN_SHARED = {str(self.sums_in_shared).lower()};"
        tables = [prod(level) * model.embedding_size for level in levels[1:]]
        yield _table("int", "TIME_CORNERS", [corners[0] for corners in self.corners])
        yield _table("int", "LATTICE_AT", _starts(self.lattice_sizes))
        yield _table("int", "ROW_AT", _starts(self.row_sizes))
        yield _table("long long", "TABLE_AT", _starts(tables))
        yield _rows("LATTICE_SHAPE", 3, [corners[1:] for corners in self.corners])
        yield _rows("RESOLUTION", 4, levels[1:])


def kernel_sizes(
    architecture: Architecture, coreset: Coreset, limits: DeviceLimits
) -> tuple[KernelSizes, list[AxisTables]]:
    """Return the sizes that suit a model and a device, and the tables of the axes (t, z, y, x).

    Raises:
        Unavailable: the kernels cannot do this model on this device.
    """
    check_layers(architecture)
    if coreset.lattice is not None:
        raise Unavailable("samples between key frames lie on no vertex of the finest table")
    axes = axis_tables(architecture, coreset)
    corners = tuple(zip(*(axis.corners for axis in axes), strict=True))
    fitting = [
        sizes
        for sums_in_shared in (True, False)
        for columns in limits.columns
        if columns >= coreset.brick_shape[2]
        and (
            sizes := KernelSizes(
                architecture=architecture,
                brick_shape=coreset.brick_shape,
                corners=corners,
                columns=columns,
                threads=limits.threads,
                sums_in_shared=sums_in_shared,
            )
        ).shared_bytes
        <= limits.shared_per_block
    ]
    if not fitting:
        z, y, x = coreset.brick_shape
        raise Unavailable(
            f"a brick of {z} x {y} x {x} vertices and this network need more shared memory than the"
            f" {limits.shared_per_block} bytes of a block here"
        )
    return best_of(fitting, limits), axes


def check_layers(architecture: Architecture) -> None:
    """Raise Unavailable for layers that the kernels cannot do."""
    if architecture.width > MAX_WIDTH or architecture.hidden_layers > MAX_LAYERS:
        raise Unavailable(
            f"the network has {architecture.hidden_layers} hidden layers of {architecture.width};"
            f" the kernels do {MAX_LAYERS} of {MAX_WIDTH} at most"
        )
    if architecture.inputs > MAX_INPUTS:
        raise Unavailable(
            f"the network has {architecture.inputs} inputs; the kernels do {MAX_INPUTS} at most"
        )


def best_of(fitting: Sequence[SomeSizes], limits: DeviceLimits) -> SomeSizes:
    """Return the best of some sizes that fit on a device, the preferred ones first.

    Two blocks on a multiprocessor hide each other's waiting, so the first that allow two are taken,
    and else the first of all.
    """
    half = limits.shared_per_multiprocessor // 2 - DRIVER_BYTES
    return next((sizes for sizes in fitting if sizes.shared_bytes <= half), fitting[0])


def with_files(constants: Iterable[str], files: Iterable[str]) -> str:
    """Return the text of some lines with constants, followed by files of kernels."""
    texts = ((KERNELS / name).read_text(encoding="utf-8") for name in files)
    return "\n".join([*constants, *texts])


def _starts(sizes: Sequence[int]) -> list[int]:
    """Return where arrays of some sizes begin that lie one after another."""
    return [sum(sizes[:number]) for number in range(len(sizes))]


def _table(kind: str, name: str, numbers: Sequence[int]) -> str:
    """Return the line of a table of constants. An empty table has one entry, never read."""
    values = ", ".join(map(str, numbers)) or "0"
    return f"__constant__ {kind} {name}[{max(len(numbers), 1)}] = {{{values}}};"


def _rows(name: str, columns: int, rows: Sequence[Sequence[int]]) -> str:
    """Return the line of a table of constants with rows."""
    values = ", ".join(f"{{{', '.join(map(str, row))}}}" for row in rows) or "{0}"
    return f"__constant__ int {name}[{max(len(rows), 1)}][{columns}] = {{{values}}};"


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
            _opened(str(other))
        self._library = _opened(str(path))

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
        program = ffi.new("nvrtcProgram *")
        files = (text.encode(), b"fhash.cu", 0, ffi.NULL, ffi.NULL)
        self._call("nvrtcCreateProgram", program, *files)
        try:
            options = [f"--gpu-architecture=sm_{architecture}", *OPTIONS]
            array = [ffi.new("char[]", option.encode()) for option in options]
            answer = self._library.nvrtcCompileProgram(program[0], len(options), array)
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
            raise Unavailable(f"{name} of the CUDA driver failed: {reason}")

    def attribute(self, device: int, number: int) -> int:
        """Return an attribute of a device."""
        value = ffi.new("int *")
        self.call("cuDeviceGetAttribute", value, number, device)
        return int(value[0])


class CudaProgram:
    """Kernels on a CUDA device.

    Attributes:
        new: whether the kernels were compiled just now, and never ran here before.
    """

    def __init__(
        self, driver: Driver, cubin: bytes, device: torch.device, threads: int, cached: Path | None
    ) -> None:
        """Load a module into the device's primary context; `cached` is its file, if it is new."""
        self._driver, self._device, self._threads = driver, device, threads
        self._cached, self.new = cached, cached is not None
        self._module = ffi.new("CUmodule *")
        self._kernels: dict[tuple[str, int], Any] = {}
        self._in_context(driver.call, "cuModuleLoadData", self._module, cubin)

    def launch(self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[Any]) -> None:
        """Launch a kernel after the work that torch has queued; Unavailable where that fails.

        arguments: pointers to them.
        """
        self._in_context(self._launch, kernel, blocks, shared_bytes, arguments)

    def forget(self) -> None:
        """Remove the kernels from the cache."""
        if self._cached is not None:
            self._cached.unlink(missing_ok=True)

    def _launch(
        self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[Any]
    ) -> None:
        """Do what `launch` does, in the device's context."""
        self._driver.call(
            "cuLaunchKernel",
            self._kernel(kernel, shared_bytes),
            *(blocks, 1, 1, self._threads, 1, 1, shared_bytes),
            ffi.cast("CUstream", torch.cuda.current_stream(self._device).cuda_stream),
            list(arguments),
            ffi.NULL,
        )

    def _kernel(self, name: str, shared_bytes: int) -> Any:
        """Return a kernel that may have some bytes of shared memory."""
        kernel = self._kernels.get((name, shared_bytes))
        if kernel is None:
            found, call = ffi.new("CUfunction *"), self._driver.call
            call("cuModuleGetFunction", found, self._module[0], name.encode())
            kernel = found[0]
            call("cuFuncSetAttribute", kernel, DYNAMIC_SHARED, shared_bytes)
            self._kernels[name, shared_bytes] = kernel
        return kernel

    def _in_context(self, call: Callable[..., None], *arguments: Any) -> None:
        """Call a function while the device's primary context is the thread's context."""
        with torch.cuda.device(self._device):
            call(*arguments)


class CudaDevice:
    """A CUDA device of torch.

    Attributes:
        limits: its limits.
    """

    def __init__(self, device: torch.device) -> None:
        """Look at a device; Unavailable where the driver cannot be called."""
        self._driver = Driver()
        torch.cuda.init()
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
def _loaded(names: Sequence[str]) -> Any:
    """Return the first library of some names that loads; Unavailable where none does."""
    for name in names:
        try:
            return _opened(name)
        except OSError:
            continue
    raise Unavailable(f"the CUDA driver's library is not here ({' or '.join(names)})")


@cache
def _opened(name: str) -> Any:
    """Return a library, which stays loaded; OSError where it does not load."""
    return ffi.dlopen(name)
