"""The native engine: training and evaluation on a CPU by kernels in C++, a brick at a time.

A training sample is a lattice vertex. Its embedding at the finest level is therefore one entry of
the table, and every coarser level is a separable linear upsampling of a small sub-lattice; no 16
corners are looked up per sample. The unit of work is a brick of vertices of one key frame, and a
batch is a random set of bricks. What a brick needs stays in a core's cache from the upsampling to
Adam. Like the finest embeddings, the numbers of the largest coarse table take part in the steps
that need them alone, in blocks: they catch up on the steps between in closed form
(`parameters.catch_up`). This engine and the fused one go on from each other's state.

The bricks of a batch are divided among the threads in a fixed way. The same seed, number of
threads and instructions of the processor give the same bits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.features.bricks import Coreset
from fhash_codec.native.network import PATHS, ffi, library, machine_paths, pointer
from fhash_codec.paper.engines.parameters import (
    BETA1,
    BETA2,
    Chosen,
    LevelAxes,
    Parameters,
    check_state,
    coarse_axes,
    coarse_levels,
    initial_parameters,
    used_numbers,
)
from fhash_codec.paper.network import Architecture, parameter_count
from fhash_formats.errors import InputError
from fhash_formats.support.threads import usable_threads
from fhash_formats.support.values import Double, Longs, Single

GROUP: int = ffi.integer_const("FHASH_GROUP")
"""Vertices along x that are interpolated together."""
REACH: int = ffi.integer_const("FHASH_REACH")
"""Corners that they need at most, rounded up to whole vectors."""
BLOCK: int = ffi.integer_const("FHASH_BLOCK")
"""Numbers of the largest coarse table that Adam moves together."""
WIDEST: int = ffi.integer_const("FHASH_WIDEST")
"""Neurons of a hidden layer at most."""
MOST_HIDDEN = 2
"""Hidden layers at most."""
CATCH_UP, TRAIN, ADAM, INFER = range(4)
"""Parts of a step, and an evaluation, as train_bricks.cpp numbers them."""


class LevelTables:
    """The tables of the coarse levels, and the structures that point to them.

    Attributes:
        levels: one `FhashLevel` a level.
        arrays: everything that the structures point to.
    """

    def __init__(self, architecture: Architecture, coarse: Sequence[LevelAxes]) -> None:
        """Make the tables for every coordinate of a brick, axis by axis.

        coarse: the coarse levels (`coarse_axes`).
        """
        self.arrays: list[npt.NDArray[Any]] = []
        self.levels = ffi.new("FhashLevel[]", max(len(coarse), 1))
        numbers, size = 0, architecture.embedding_size
        for level, axes, resolution in zip(
            self.levels, coarse, architecture.levels[-len(coarse) :], strict=False
        ):
            stride = [prod(resolution[axis + 1 :]) * size for axis in range(4)]
            self._fill(level, axes.axes, stride, numbers)
            numbers += prod(resolution) * size

    def _fill(
        self,
        level: Any,
        axes: Sequence[tuple[Longs, Double]],
        stride: Sequence[int],
        numbers: int,
    ) -> None:
        """Fill the structure of a level, whose table begins behind some numbers."""
        weights = []
        for axis, (start, weight) in enumerate(axes):
            weights.append(weight)
            level.corners[axis], level.stride[axis] = weight.shape[2], stride[axis]
            level.start[axis] = self._held(start * stride[axis] + (numbers if axis == 0 else 0))
        of_time = np.zeros((len(weights[0]), 2), np.float32)
        of_time[:, : weights[0].shape[2]] = weights[0][:, 0]
        level.time = self._held(of_time)
        for number, weight in enumerate(weights[1:3]):
            first, two = two_corners(weight)
            level.first[number] = self._held(first)
            level.weight[number] = self._held(two)
        reach, spread = groups_of_corners(weights[3])
        level.reach = self._held(reach)
        level.spread = self._held(spread)
        level.gathered = self._held(np.ascontiguousarray(spread.swapaxes(2, 3)))

    def _held(self, array: npt.NDArray[Any]) -> Any:
        """Keep an array and return a pointer to its numbers."""
        self.arrays.append(array)
        return pointer(array)


def two_corners(
    weights: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Return the two corners between which each vertex lies.

    Args:
        weights: weights (coordinates, vertices, corners), not 0 at two neighbours at most.

    Returns:
        The first of the two (coordinates, vertices), and the weights of both (coordinates,
        vertices, 2).
    """
    first = (weights != 0).argmax(axis=2)
    padded = np.concatenate([weights, np.zeros((*weights.shape[:2], 1))], axis=2)
    places = first[..., None] + np.arange(2)
    return first.astype(np.int32), np.take_along_axis(padded, places, axis=2).astype(np.float32)


def groups_of_corners(
    weights: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Return the weights of every GROUP vertices that follow each other, by the corners they need.

    Args:
        weights: weights (coordinates, vertices, corners), not 0 at two neighbours at most.

    Returns:
        The first corner and the number of corners of each group (coordinates, groups, 2), and the
        weights (coordinates, groups, REACH, GROUP), 0 where there is no corner or vertex.
    """
    coordinates, vertices, corners = weights.shape
    groups = -(-vertices // GROUP)
    reach = np.zeros((coordinates, groups, 2), np.int32)
    spread = np.zeros((coordinates, groups, REACH, GROUP), np.float32)
    for group in range(groups):
        part = weights[:, group * GROUP : (group + 1) * GROUP]
        needed = (part != 0).any(axis=1)
        first = needed.argmax(axis=1)
        count = corners - needed[:, ::-1].argmax(axis=1) - first
        reach[:, group, 0], reach[:, group, 1] = first, count
        for corner in range(int(count.max())):
            rows = np.flatnonzero(corner < count)
            spread[rows, group, corner, : part.shape[1]] = part[rows, :, first[rows] + corner]
    return reach, spread


STATE = ("fine", "fine_mean", "fine_square", "visited", "flat", "flat_mean", "flat_square")
"""Arrays of the state of every engine."""
FLUSH = 1024
"""Bricks that are brought up to date at a time."""
PAD: int = ffi.integer_const("FHASH_PAD")
"""Numbers behind the flat ones that a vector may read or rewrite."""
RATES = {"x86-64-v4": 65e9, "x86-64-v3": 50e9, "baseline": 25e9}
"""Operations a second of a training in one thread, by the instructions (docs/results.md).

They are within a factor of 2 on three machines. No clock is read: where a series is trained must
not depend on the load of the machine, since each device has bits of its own.
"""


def cpu_seconds(architecture: Architecture, samples: int) -> float:
    """Return about how long a training takes on the CPU in the threads there are.

    Args:
        architecture: the sizes of the model.
        samples: samples that the training takes, those of all epochs.
    """
    # Forward, and backward to the inputs and to the weights: three products of 2 operations each.
    operations = 6 * sum(outputs * inputs for outputs, inputs in architecture.layer_shapes)
    rate = RATES[(machine_paths() or ["baseline"])[0]] * usable_threads()
    return samples * operations / rate


def refusal(architecture: Architecture) -> str | None:
    """Return why a model cannot be trained by the native engine here; None if it can."""
    if not machine_paths():
        return "the native library was built for none of this machine's instructions"
    if architecture.hidden_layers > MOST_HIDDEN:
        return f"it has {MOST_HIDDEN} hidden layers at most, not {architecture.hidden_layers}"
    if architecture.hidden_layers and architecture.width > WIDEST:
        return f"its hidden layers have {WIDEST} neurons at most, not {architecture.width}"
    return None


class NativeEngine:
    """An `Engine` on a CPU, in C++.

    Attributes:
        fine, fine_mean, fine_square, visited: as `FusedEngine` has them, on the host.
        flat, flat_mean, flat_square, coarse: as `FusedEngine` has them, but for the blocks of the
            largest coarse table: these are as they were after the step in `blocks`.
        lazy: numbers of that table, the first ones in `flat`.
        blocks: number of the last training step that used each block of BLOCK of them, 0 for none,
            int64.
        path: name of the instructions of the processor that the kernels use.
    """

    name = "native"

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        path: str = "auto",
    ) -> None:
        """Start from fresh parameters; arguments as in `make_engine`.

        Args:
            path: a name in `PATHS`, or auto for the fastest that there is.

        Raises:
            InputError: the engine does not take the model, or the machine lacks the instructions.
        """
        reason = refusal(architecture)
        if reason is not None:
            raise InputError(f"the engine 'native' does not take this model: {reason}")
        if path not in ("auto", *machine_paths()):
            raise InputError(f"path is '{path}'; here are: auto, {', '.join(machine_paths())}")
        self.architecture, self.coreset, self.rates = architecture, coreset, rates
        self.path = machine_paths()[0] if path == "auto" else path
        self._native = library()
        levels = coarse_axes(architecture, coreset)
        interpolated = coarse_levels(architecture, coreset)
        self._numbers = parameter_count(interpolated, architecture.embedding_size)
        self._used, self._rank = used_numbers(levels, coreset, self._numbers)
        self._tables = LevelTables(architecture, levels)
        self._coreset_arrays: dict[str, npt.NDArray[Any]] = {
            "bricks": np.ascontiguousarray(coreset.bricks, np.int32),
            "mask": np.ascontiguousarray(coreset.mask_bits),
            "values": np.ascontiguousarray(coreset.values, np.float32),
            "offsets": np.ascontiguousarray(coreset.offsets, np.int64),
        }
        start = initial_parameters(architecture, coreset, seed)
        self.fine = start.fine
        self.fine_mean, self.fine_square = np.zeros_like(self.fine), np.zeros_like(self.fine)
        self.visited = np.zeros(len(coreset.bricks), np.int64)
        self.step = 0
        self.coarse = len(self._used)
        self.flat = _padded(np.concatenate([start.coarse[self._used], start.network]))
        self.flat_mean, self.flat_square = np.zeros_like(self.flat), np.zeros_like(self.flat)
        largest = parameter_count(interpolated[:1], architecture.embedding_size)
        self.lazy = int(np.searchsorted(self._used, largest))
        self.blocks = np.zeros(-(-self.lazy // BLOCK), np.int64)
        self._stamps, self._touched = np.zeros_like(self.blocks), np.zeros_like(self.blocks)
        self._gaps: _GapTables | None = None
        self._current: tuple[int, list[Single]] | None = None
        self._memory: dict[str, npt.NDArray[Any]] = {}
        self._task = self._new_task()

    def train(self, chosen: Chosen) -> float:
        """Do one training step on a batch; return the sum of squared errors before it."""
        self._catch_up_gaps()
        self._current = None
        self.step += 1
        # In the order of their places, bricks of a thread share the numbers of the coarse tables.
        bricks = np.sort(chosen)
        samples = int((self.coreset.offsets[bricks + 1] - self.coreset.offsets[bricks]).sum())
        task, threads = self._task, self._threads(len(bricks))
        task.threads, task.step = threads, self.step
        task.rate, task.scale = float(self.rates[self.step]), 2.0 / max(samples, 1)
        task.chosen, task.count = pointer(bricks), len(bricks)
        errors = np.zeros(threads)
        task.error = pointer(errors)
        assert self._native is not None
        task.touches = self._native.fhash_bricks_touch(task)
        self._run(CATCH_UP, ADAM)
        return float(errors.sum())

    def infer(self, chosen: Chosen) -> Single:
        """Return the values (n,) at the samples of some bricks."""
        self._catch_up_gaps()
        offsets = self.coreset.offsets
        places = np.concatenate([[0], np.cumsum(offsets[chosen + 1] - offsets[chosen])])
        values = np.empty(int(places[-1]), np.float32)
        task, threads = self._task, self._threads(len(chosen))
        task.threads, task.step = threads, self.step
        task.chosen, task.count = pointer(chosen), len(chosen)
        task.out, task.places = pointer(values), pointer(places)
        task.current = pointer(self._settled_flat()[0])
        self._run(INFER, INFER)
        return values

    def settle(self) -> None:
        """Let every brick catch up with the present step, so that evaluation is faster."""
        self._catch_up_gaps()
        offsets = self.coreset.offsets
        for first in range(0, len(self.visited), FLUSH):
            visited = self.visited[first : first + FLUSH]
            ends = offsets[first : first + len(visited) + 1]
            part = slice(ends[0], ends[-1])
            self._gap_tables().settle(
                [array[:, part] for array in (self.fine, self.fine_mean, self.fine_square)],
                visited,
                self.step,
                np.diff(ends),
            )
        self.visited[self.visited > 0] = self.step

    def parameters(self) -> Parameters:
        """Return the trained numbers, on the CPU. Embeddings that no sample ever moved are 0.

        The finest embeddings are the engine's own memory, not a copy.
        """
        self.settle()
        flat, mean, square = self._settled_flat()
        moved = (mean != 0) | (square != 0)
        used = (np.where(moved, flat, np.float32(0)) if self.step else flat)[: self.coarse]
        coarse = np.zeros(self._numbers, np.float32)
        coarse[self._used] = used
        trained = Parameters(fine=self.fine, coarse=coarse, network=flat[self.coarse :].copy())
        return trained.as_stored(self.architecture, self.coreset)

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return parameters, Adam's moments and the step number as arrays.

        The arrays of STATE mean in every engine the same. The blocks that are behind are there
        as they are, too, so that this engine goes on with the same bits.
        """
        flat, mean, square = self._settled_flat()
        behind = np.stack([self.flat, self.flat_mean, self.flat_square])[:, : self.lazy]
        own = {"blocks": self.blocks, "behind": behind}
        settled = {"flat": flat, "flat_mean": mean, "flat_square": square}
        arrays = {name: getattr(self, name) for name in STATE} | settled | own
        return {"step": np.array(self.step)} | arrays

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`, also from one of the fused engine.

        Raises KeyError or ValueError for one of another model.
        """
        check_state(state, {name: getattr(self, name).shape for name in STATE})
        self.step, self._current, self._gaps = int(state["step"]), None, None
        for name in STATE:
            getattr(self, name)[...] = state[name]
        self._stamps[:] = 0
        self.blocks[:] = state.get("blocks", np.array(self.step))
        if "behind" in state:
            numbers = (self.flat, self.flat_mean, self.flat_square)
            for array, behind in zip(numbers, state["behind"], strict=True):
                array[: self.lazy] = behind

    def _new_task(self) -> Any:
        """Return the `FhashBricks` with all that stays as it is."""
        architecture, coreset = self.architecture, self.coreset
        fields = dict(
            path=PATHS[self.path],
            embedding=architecture.embedding_size,
            own=len(self.fine),
            levels=len(coarse_levels(architecture, coreset)),
            hidden=architecture.hidden_layers,
            width=architecture.width,
            shape=coreset.brick_shape,
            threads=1,
            mask_bytes=coreset.mask_bits.shape[1],
            samples=len(coreset.values),
            coarse=self.coarse,
            numbers=len(self.flat),
            lazy=self.lazy,
            rank=pointer(self._rank),
            level=self._tables.levels,
            stamps=pointer(self._stamps),
            touched=pointer(self._touched),
        )
        own = {name: getattr(self, name) for name in (*STATE, "blocks")}
        pointers = {name: pointer(array) for name, array in (self._coreset_arrays | own).items()}
        task = ffi.new("FhashBricks *", fields | pointers)
        assert self._native is not None
        task.work_size = self._native.fhash_bricks_work(task)
        assert task.work_size > 0
        return task

    def _threads(self, bricks: int) -> int:
        """Return the threads for some bricks; their memory is there."""
        threads = max(1, min(usable_threads(), bricks))
        if len(self._memory.get("gradient", ())) < threads:
            self._memory["gradient"] = _padded(np.zeros((threads, len(self.flat)), np.float32))
            # A cache line more, so that the memory can begin with one.
            work = np.zeros(threads * self._task.work_size + 16, np.float32)
            self._memory["work"] = work
            self._task.gradient = pointer(self._memory["gradient"])
            self._task.work = pointer(work[-work.ctypes.data % 64 // work.itemsize :])
        return threads

    def _run(self, first: int, last: int) -> None:
        """Let all threads do their shares in the parts `first` to `last` of the task."""
        assert self._native is not None
        result = self._native.fhash_bricks_run(self._task, first, last)
        assert not result, f"parts {first} to {last} of the native engine returned {result}"

    def _gap_tables(self) -> _GapTables:
        """Return the closed form of missed steps at the present learning rates."""
        if self._gaps is None or self._gaps.rates is not self.rates:
            self._gaps = _GapTables(self.rates)
            self._task.gaps = self._gaps.structure[0]
        return self._gaps

    def _catch_up_gaps(self) -> None:
        """Let the closed form know all steps up to the present one."""
        tables = self._gap_tables()
        if tables.step < self.step:
            assert self._native is not None
            self._native.fhash_bricks_gaps(self._task, tables.step + 1, self.step)
            tables.step = self.step

    def _settled_flat(self) -> list[Single]:
        """Return `flat` and its moments with all blocks caught up; the engine's own stay behind."""
        if self._current is None or self._current[0] != self.step:
            self._catch_up_gaps()
            arrays = [_padded(array) for array in (self.flat, self.flat_mean, self.flat_square)]
            behind = [array[: self.lazy] for array in arrays]
            self._gap_tables().settle(behind, self.blocks, self.step, BLOCK)
            self._current = (self.step, arrays)
        return self._current[1]


def _padded(numbers: Single) -> Single:
    """Return a copy of numbers with PAD more behind them in memory, for a last vector's sake."""
    memory = np.zeros(numbers.size + PAD, np.float32)
    copy = memory[: numbers.size].reshape(numbers.shape)
    copy[...] = numbers
    return copy


class _GapTables:
    """The closed form of Adam's steps without a gradient (`FhashGaps`).

    Attributes:
        rates: learning rate of every step, counted from 1.
        step: step up to which the sums are known.
        structure: pointers to the tables.
    """

    def __init__(self, rates: npt.NDArray[np.float64]) -> None:
        """Make the tables of a course of the learning rate."""
        self.rates, self.step = rates, 0
        steps = np.arange(len(rates))
        corrections = [-np.expm1(np.maximum(steps, 1) * np.log(beta)) for beta in (BETA1, BETA2)]
        self._tables: dict[str, npt.NDArray[Any]] = {
            "weight": rates * np.sqrt(corrections[1]) / corrections[0],
            "inverse": rates / corrections[0],
            "weight_sum": np.zeros(len(rates)),
            "inverse_sum": np.zeros(len(rates)),
            "factor": np.zeros(len(rates), np.float32),
            "epsilon": np.zeros(len(rates), np.float32),
            "mean_decay": (BETA1 ** steps.astype(np.float64)).astype(np.float32),
            "square_decay": (BETA2 ** steps.astype(np.float64)).astype(np.float32),
        }
        pointers = {name: pointer(array) for name, array in self._tables.items()}
        self.structure = ffi.new("FhashGaps *", pointers)

    def settle(
        self,
        arrays: list[Single],
        visited: npt.NDArray[np.int64],
        step: int,
        lengths: npt.NDArray[np.int64] | int,
    ) -> None:
        """Let numbers and their moments catch up, in place.

        Args:
            arrays: numbers (..., n), and the two moments of each.
            visited: last step with a gradient of each run of numbers (runs,), 0 for none.
            step: step up to which they catch up.
            lengths: numbers of each run; those of the last one may be fewer.
        """
        numbers, mean, square = arrays
        missed = np.where(visited > 0, step - visited, 0)
        at = np.where(missed > 0, visited, 0)
        of_gap = self._tables["epsilon"][at]
        columns = (
            np.where(missed > 0, self._tables["factor"][at], np.float32(0)),
            # Where nothing was missed nothing changes, and the root of 0 divides nothing.
            np.where(of_gap > 0, of_gap, np.float32(1)),
            self._tables["mean_decay"][missed],
            self._tables["square_decay"][missed],
        )
        factor, epsilon, mean_decay, square_decay = (
            np.repeat(column, lengths)[: numbers.shape[-1]] for column in columns
        )
        numbers -= factor * mean / (np.sqrt(square) + epsilon)
        mean *= mean_decay
        square *= square_decay
