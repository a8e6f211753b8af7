"""The text of the kernels for one model: its sizes as constants, in front of the files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import Path
from typing import TypeVar

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused.axes import AxisTables, axis_tables

KERNELS = Path(__file__).parent / "kernels"
"""Folder of the kernels' files."""
FILES = ("model.cuh", "network.cuh", "brick.cuh", "bricks.cu")
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
    def places(self) -> dict[str, int]:
        """Places in shared memory, in numbers of 4 bytes, and their END."""
        places, end = {}, 0
        for name, size in self.arrays.items():
            places[name] = end
            end += -(-size // 4) * 4
        return places | {"END": end}

    @property
    def shared_bytes(self) -> int:
        """Bytes of shared memory that a block needs."""
        return 4 * self.places["END"]

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
        } | {f"AT_{name}": place for name, place in self.places.items()}
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
