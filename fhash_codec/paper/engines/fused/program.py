"""CUDA program of the fused engine: its source, for the sizes of one model and one device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.cuda.device import Device, Kernels, first_device
from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.fused import refusal
from fhash_codec.paper.engines.parameters import BETA1, BETA2, WINDOW, coarse_axes
from fhash_codec.paper.network import Architecture
from fhash_formats.support.values import Double, Longs


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
    """Return the tables of the axes t, z, y and x. A step is a run of one vertex along t."""
    levels = coarse_axes(architecture, coreset)
    lengths, counts = (1, *coreset.brick_shape), (len(coreset.key_places), *coreset.brick_grid)
    return [
        _axis_tables([level.axes[axis] for level in levels], length, count)
        for axis, (length, count) in enumerate(zip(lengths, counts, strict=True))
    ]


def _axis_tables(levels: list[tuple[Longs, Double]], length: int, count: int) -> AxisTables:
    """Return the tables of one axis from its `axis_matrices` for each level."""
    corners = []
    start = np.empty((count, len(levels)), np.int32)
    before = np.empty((count, len(levels), length), np.int32)
    after = np.zeros((count, len(levels), length), np.float32)
    for level, (starts, weights) in enumerate(levels):
        start[:, level] = starts
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
        corners: corners (t, z, y, x) of a brick's sub-lattice of each interpolated level
            (`coarse_levels`).
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
        model = self.architecture
        levels = model.levels[len(model.levels) - len(self.corners) :]
        z, y, x = self.brick_shape
        yield from self.layer_constants()
        numbers = {
            "COARSE": len(levels),
            "BRICK_Z": z,
            "BRICK_Y": y,
            "BRICK_X": x,
            "LATTICE": self.lattice,
            "ROW": sum(self.row_sizes),
        }
        yield from (f"constexpr int {name} = {number};" for name, number in numbers.items())
        yield f"constexpr bool SUMS_IN_SHARED = {str(self.sums_in_shared).lower()};"
        tables = [prod(level) * model.embedding_size for level in levels]
        yield _table("int", "TIME_CORNERS", [corners[0] for corners in self.corners])
        yield _table("int", "LATTICE_AT", _starts(self.lattice_sizes))
        yield _table("int", "ROW_AT", _starts(self.row_sizes))
        yield _table("long long", "TABLE_AT", _starts(tables))
        yield _rows("LATTICE_SHAPE", 3, [corners[1:] for corners in self.corners])
        yield _rows("RESOLUTION", 4, levels)


def kernel_sizes(
    architecture: Architecture, coreset: Coreset, limits: DeviceLimits
) -> tuple[KernelSizes, list[AxisTables]]:
    """Return the sizes that suit a model and a device, and the tables of the axes (t, z, y, x).

    Raises:
        Unavailable: the kernels cannot do this model on this device.
    """
    check_layers(architecture)
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
    if reason := refusal(architecture):
        raise Unavailable(reason)


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


class CudaProgram:
    """Kernels that are launched after the work that torch has queued.

    Attributes:
        keep: as `Kernels` has it.
    """

    def __init__(self, kernels: Kernels, device: torch.device, threads: int) -> None:
        """Take over the kernels of a device; threads: of a block."""
        self._kernels, self._device, self._threads = kernels, device, threads
        self.keep = kernels.keep

    @property
    def new(self) -> bool:
        """Whether the kernels are new, as `Kernels` has it."""
        return self._kernels.new

    def launch(self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[Any]) -> None:
        """Launch a kernel; arguments and errors as in `Kernels.launch`."""
        stream = torch.cuda.current_stream(self._device).cuda_stream
        self._kernels.launch(kernel, blocks, self._threads, shared_bytes, arguments, stream)


class CudaDevice:
    """The first CUDA device, with torch beside it.

    Attributes:
        limits: its limits.
    """

    def __init__(self, device: torch.device) -> None:
        """Look at the device; Unavailable where the driver cannot be called."""
        torch.cuda.init()
        self._device, self._cuda = device, first_device()
        self.limits = limits_of(self._cuda)

    def load(self, sizes: Sizes) -> CudaProgram:
        """Compile the kernels for some sizes, or find them in the cache."""
        return CudaProgram(self._cuda.load(sizes.text()), self._device, sizes.threads)


def limits_of(device: Device) -> DeviceLimits:
    """Return the limits of a device."""
    return DeviceLimits(
        multiprocessors=device.multiprocessors,
        shared_per_block=device.shared_per_block,
        shared_per_multiprocessor=device.shared_per_multiprocessor,
    )
