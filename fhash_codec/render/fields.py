"""Where streamed samples get their values from: a decoded frame, or the model itself at every point."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.network import Network, TableSource
from fhash_codec.paper import PaperModel
from fhash_codec.points import sample_points
from fhash_codec.render.bricks import Bricks
from fhash_codec.render.camera import Grid
from fhash_codec.render.plan import Units
from fhash_codec.render.task import Frame, Task
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError

__all__ = ["Field", "FrameField", "NetworkField"]

Floats = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Cells = npt.NDArray[np.int64]

BATCH = 1 << 15
"""Points that are looked up at a time: what they take stays in the processor's cache."""


class Field(Protocol):
    """Values anywhere in the domain; places (n, 3) are x, y, z in vertices of the domain."""

    @property
    def bounds(self) -> Floats:
        """The box (3, 2), x, y, z, beyond which nothing has a value."""
        ...

    @property
    def bricks(self) -> Bricks:
        """What its bricks hold, at most."""
        ...

    @property
    def first(self) -> Floats:
        """Where the first brick begins (x, y, z), and `stride` vertices of the domain make a cell's side."""
        ...

    @property
    def stride(self) -> float:
        """Vertices of the domain from one value to the next."""
        ...

    def visible(self, task: Task) -> npt.NDArray[np.bool_]:
        """Cells (z, y, x), the first at `first`, in which a sample could have an opacity; a few more may be among them."""
        ...

    def values(self, places: Floats) -> Floats:
        """Values (n,), NaN where there is none."""
        ...

    def slopes(self, places: Floats) -> Floats:
        """Derivatives (n, 3) by x, y and z per vertex, 0 where there are none."""
        ...


class FrameField:
    """Trilinear between decoded vertices; a place whose cell has a vertex of weight without a value has none."""

    def __init__(self, frame: Frame, grid: Grid, bricks: Bricks) -> None:
        self.bricks = bricks
        self._flat = bricks.values.reshape(-1)
        self.first = np.array(frame.first[::-1], dtype=np.float64)
        self.stride = float(frame.stride)
        self._counts = np.array(frame.values.shape[::-1])
        ends = self.first + self._counts * frame.stride
        # A frame reaches to the end of the domain if no more of its vertices would fit.
        low = np.where(self.first == 0, grid.bounds[:, 0], self.first)
        high = np.where(ends > np.array(grid.counts) - 1, grid.bounds[:, 1], ends - frame.stride)
        self.bounds: Floats = np.stack([low, high], axis=-1)
        self._jumps = np.array([1, self._counts[0], self._counts[0] * self._counts[1]])

    def visible(self, task: Task) -> npt.NDArray[np.bool_]:
        """As `Field` has it."""
        return np.concatenate(
            [
                Bricks(values=layers, low=_of_cells(layers, np.fmin), high=_of_cells(layers, np.fmax)).matters(task)
                for layers in _layers(self.bricks.values)
            ]
        )

    def values(self, places: Floats) -> Floats:
        """As `Field` has it."""
        result = np.empty(len(places))
        for start in range(0, len(places), BATCH):
            inside, low, share = self._located(places[start : start + BATCH])
            # The corner after counts only where it has weight, so that a missing one beyond a vertex does not matter.
            corners = self._corners(low, np.where(share > 0, self._jumps, 0))
            along = corners[:, :, 0] + share[:, 0] * (corners[:, :, 1] - corners[:, :, 0])
            across = along[:, 0] + share[:, 1] * (along[:, 1] - along[:, 0])
            found = across[0] + share[:, 2] * (across[1] - across[0])
            result[start : start + BATCH] = np.where(inside, found, np.nan)
        return result

    def slopes(self, places: Floats) -> Floats:
        """As `Field` has it; on the border of two cells those of the cell after it."""
        result = np.empty((len(places), 3))
        for start in range(0, len(places), BATCH):
            _, low, share = self._located(places[start : start + BATCH])
            corners = self._corners(low, np.where(self._counts > 1, self._jumps, 0)[None])
            x, y, z = share.T
            steps = corners[:, :, 1] - corners[:, :, 0]
            along = corners[:, :, 0] + x * steps
            across = along[:, 0] + y * (along[:, 1] - along[:, 0])
            part = steps[:, 0] + y * (steps[:, 1] - steps[:, 0])
            rise = along[:, 1] - along[:, 0]
            found = np.stack([part[0] + z * (part[1] - part[0]), rise[0] + z * (rise[1] - rise[0]), across[1] - across[0]], axis=-1)
            result[start : start + BATCH] = np.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0) / self.stride
        return result

    def _located(self, places: Floats) -> tuple[npt.NDArray[np.bool_], Cells, Floats]:
        inside = np.all((places >= self.bounds[:, 0]) & (places <= self.bounds[:, 1]), axis=1)
        last = self._counts - 1
        at = np.clip((places - self.first) / self.stride, 0.0, last)
        low = np.minimum(at.astype(np.int64), np.maximum(last - 1, 0))
        return inside, low, at - low

    def _corners(self, low: Cells, jumps: Cells) -> Floats:
        """Values (z 2, y 2, x 2, n) around places; jumps (n or 1, 3) to the corner after along x, y and z."""
        first = low @ self._jumps
        x, y, z = np.broadcast_to(jumps, low.shape).T
        found = np.empty((2, 2, 2, len(low)))
        for corner in np.ndindex(2, 2, 2):
            found[corner] = self._flat.take(first + corner[0] * z + corner[1] * y + corner[2] * x)
        return found


class NetworkField:
    """The network of a file of the profile paper at every point: between its vertices it has values of its own."""

    def __init__(self, volume: Volume, step: float, units: Units) -> None:
        model = volume._model
        if not isinstance(model, PaperModel):
            raise InputError(f"{volume.path}: a file of the profile {volume.profile} has no network")
        self._range, self._units = volume.value_range, units
        self._key = volume.key_times.key_index(step)
        network = model.network
        tables = [_Nodes(table, _nodes(network, level, self._key)) for level, table in enumerate(network.tables)]
        self._network = replace(network, tables=tables)
        self.first = np.array([low for low, _ in volume.box][::-1], dtype=np.float64)
        self.stride = 1.0
        self._counts = np.array([high - low for low, high in volume.box][::-1])
        self._flat_axes = np.array(volume.shape[:0:-1]) == 1
        self._occupied = np.ascontiguousarray(volume.occupancy(step, volume.box))
        self._jumps = np.array([1, self._counts[0], self._counts[0] * self._counts[1]])
        ends = np.stack([self.first, self.first + self._counts - 1], axis=-1)
        self.bounds: Floats = ends + np.where(self._flat_axes[:, None], [-0.5, 0.5], 0.0)
        self.bricks = self._possible()

    def _possible(self) -> Bricks:
        """What a brick of a network holds is not known before it is evaluated: any value, with a margin, where there is one at all."""
        found = Bricks.of(Frame(values=np.where(self._occupied, np.float32(1), np.float32(np.nan)), first=(0, 0, 0)))
        low, high = self._units.to([self._range.low, self._range.high])
        known = found.low <= found.high
        low, high = np.float32(2 * low - high), np.float32(2 * high - low)
        return replace(found, low=np.where(known, low, np.float32(np.inf)), high=np.where(known, high, np.float32(-np.inf)))

    def visible(self, task: Task) -> npt.NDArray[np.bool_]:
        """As `Field` has it: where there is a vertex of the coreset."""
        return np.concatenate([_of_cells(layers, np.logical_or) for layers in _layers(self._occupied)])

    def values(self, places: Floats) -> Floats:
        """As `Field` has it."""
        at, inside = self._inside(places)
        result = np.full(len(places), np.nan)
        if inside.any():
            unit = sample_points(self._network, self._key, *at[inside].T[::-1])
            result[inside] = self._units.to(self._range.from_unit(unit))
        return result

    def slopes(self, places: Floats) -> Floats:
        """As `Field` has it: analytic, through interpolation and network."""
        at, inside = self._inside(places)
        result = np.zeros((len(places), 3))
        if inside.any():
            _, slopes = sample_points(self._network, self._key, *at[inside].T[::-1], gradient=True)
            extent = (self._range.high - self._range.low) * self._units.factor
            result[inside] = np.nan_to_num(slopes[:, :0:-1].astype(np.float64) * extent, nan=0.0, posinf=0.0, neginf=0.0)
        return result

    def _inside(self, places: Floats) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """Places in vertices of the box, and whether all vertices of weight around them are in the coreset."""
        at = np.where(self._flat_axes, 0.0, places - self.first)
        last = self._counts - 1
        inside = np.all((at >= 0) & (at <= last), axis=1)
        at = np.clip(at, 0.0, last)
        low = at.astype(np.int64)
        first = low @ self._jumps
        x, y, z = np.where(at > low, self._jumps, 0).T
        flat = self._occupied.reshape(-1)
        for corner in np.ndindex(2, 2, 2):
            inside &= flat.take(first + corner[0] * z + corner[1] * y + corner[2] * x)
        return at, inside


class _Nodes:
    """The time nodes of a table between which one key index lies, in memory, so that a pass of samples does not read them again."""

    def __init__(self, table: TableSource, nodes: slice) -> None:
        self.shape = tuple(table.shape)
        self._first = nodes.start
        self._values = table.read((nodes, *(slice(0, length) for length in self.shape[1:])))

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Values of a region (t, z, y, x) whose times are among the nodes."""
        time = region[0]
        return self._values[(slice(time.start - self._first, time.stop - self._first), *region[1:])]


def _nodes(network: Network, level: int, key: float) -> slice:
    count = network.levels[level][0]
    first = min(int(key * (count - 1) / max(network.key_frames - 1, 1)), max(count - 2, 0))
    return slice(first, min(first + 2, count))


def _layers(values: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """The two vertices in z around each layer of cells."""
    return [values[z : z + 2] for z in range(max(len(values) - 1, 1))]


def _of_cells(values: npt.NDArray[Any], reduce: np.ufunc) -> npt.NDArray[Any]:
    """A ufunc over the eight vertices of each cell; an axis of one vertex has one cell."""
    for axis in range(3):
        if values.shape[axis] > 1:
            low, high = (np.take(values, range(side, values.shape[axis] - 1 + side), axis=axis) for side in (0, 1))
            values = reduce(low, high)
    return np.where(np.isnan(values), np.float32(np.inf if reduce is np.fmin else -np.inf), values) if values.dtype.kind == "f" else values
