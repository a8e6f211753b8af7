"""The fused engine: slab's state, trained and evaluated by one kernel launch a batch.

The arrays are those of `SlabEngine`, so each engine resumes the other's checkpoint. A training step
is two launches and one transfer. Where torch's deterministic algorithms are on, coarse gradients
are sorted and added in a fixed order, by three launches more; else they are added by atomics, whose
order differs from run to run.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import Chosen
from fhash_codec.paper.engines.fused.axes import missed_step_tables
from fhash_codec.paper.engines.fused.source import (
    DeviceLimits,
    Sizes,
    Unavailable,
    kernel_sizes,
)
from fhash_codec.paper.engines.slab import SlabEngine
from fhash_codec.training.adam import corrections

TRIAL_BRICKS = 4
"""Bricks of the trial of newly compiled kernels."""
TRIAL_ERROR = 1e-3
"""Relative difference of the squared errors of a trial that is no more than rounding."""
TRIAL_VALUE = 1e-4
"""Median difference of the values after a trial that is no more than rounding."""


class Program(Protocol):
    """Compiled kernels on a device.

    Attributes:
        new: whether the kernels were compiled just now, and never ran here before.
    """

    new: bool

    def launch(
        self, kernel: str, blocks: int, shared_bytes: int, arguments: Sequence[ctypes._CDataType]
    ) -> None:
        """Launch a kernel after the work that torch has queued; Unavailable where that fails."""

    def forget(self) -> None:
        """Remove the kernels from the cache."""


class Device(Protocol):
    """A device that runs the kernels.

    Attributes:
        limits: its limits.
    """

    limits: DeviceLimits

    def load(self, sizes: Sizes) -> Program:
        """Compile the kernels for some sizes, or find them compiled; Unavailable if neither."""


class ModelRecord(ctypes.Structure):
    """The record `Model` of kernels/model.cuh."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("bricks", "mask", "values", "offsets", "rank")),
        *((name, ctypes.c_void_p * 4) for name in ("start", "before", "after")),
        *((name, ctypes.c_void_p) for name in ("powers", "weights")),
        *((name, ctypes.c_void_p) for name in ("fine", "fine_mean", "fine_square", "visited")),
        *((name, ctypes.c_void_p) for name in ("flat", "flat_mean", "flat_square", "gradient")),
        ("fine_row", ctypes.c_longlong),
        ("coarse", ctypes.c_longlong),
        ("steps", ctypes.c_int),
    )


class RateRecord(ctypes.Structure):
    """The record `Rate` of kernels/model.cuh."""

    _fields_ = (("root", ctypes.c_float), ("pace", ctypes.c_float))


class FusedEngine(SlabEngine):
    """An `Engine` that trains on bricks by fused kernels."""

    name = "fused"

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device,
        kernels: Device,
    ) -> None:
        """Start from fresh parameters; arguments as in `make_engine`.

        Newly compiled kernels are tried against slab's step on a few bricks.

        Raises:
            Unavailable: the kernels cannot do this model, cannot be compiled, or fail the trial.
        """
        self._sizes, axes = kernel_sizes(architecture, coreset, kernels.limits)
        self._program = kernels.load(self._sizes)
        super().__init__(architecture, coreset, rates, seed=seed, device=device)
        self._axes = [
            [torch.from_numpy(table).to(device) for table in (axis.start, axis.before, axis.after)]
            for axis in axes
        ]
        self._missed = [torch.from_numpy(table).to(device) for table in missed_step_tables(rates)]
        # The kernels read on the device what slab keeps on the host.
        self._visited = torch.from_numpy(self.visited).to(device, copy=True)
        limits = kernels.limits
        self._slots = self._sizes.slots(limits, 2)
        self._matrix_gradients = torch.empty(self._slots * self._sizes.matrices, device=device)
        self._errors = torch.empty(self._slots, dtype=torch.float64, device=device)
        self._record = self._model()
        if self._program.new:
            self._try_kernels()

    @torch.no_grad()
    def train(self, chosen: Chosen) -> Tensor:
        """Do one training step on a batch; return the sum of squared errors before it."""
        ids = self._transferred(chosen)
        self.step += 1
        scale = 2.0 / max(int(self.counts[chosen].sum()), 1)
        rate = RateRecord(*corrections(self.step, float(self.rates[self.step])))
        # A batch of few bricks is cut into parts, so that all multiprocessors have work.
        parts = max(1, min(self._slots // len(chosen), self._sizes.tiles))
        items = len(chosen) * parts
        blocks = min(items, self._slots)
        places = entries = None
        if torch.are_deterministic_algorithms_enabled():
            shape = (items, self._sizes.lattice, 2)
            places = torch.empty(shape, dtype=torch.int32, device=self.device)
            entries = torch.empty(shape, device=self.device)
        model, step = self._record, ctypes.c_longlong(self.step)
        self._program.launch(
            "train_bricks",
            blocks,
            self._sizes.shared_bytes,
            [
                model,
                _pointer(ids),
                ctypes.c_int(items),
                ctypes.c_int(parts),
                step,
                ctypes.c_float(scale),
                rate,
                _pointer(self._matrix_gradients),
                _pointer(self._errors),
                _pointer(places),
                _pointer(entries),
            ],
        )
        if places is not None and entries is not None:
            self._add_in_order(model, places, entries)
        self._program.launch(
            "move_flat",
            -(-max(len(self.flat), len(chosen)) // self._sizes.threads),
            0,
            [
                model,
                _pointer(ids),
                ctypes.c_int(len(chosen)),
                step,
                rate,
                _pointer(self._matrix_gradients),
                ctypes.c_int(blocks),
            ],
        )
        self.visited[chosen] = self.step
        return self._errors[:blocks].sum()

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> Tensor:
        """Return the values (n,) at the samples of some bricks."""
        ends = np.cumsum(self.counts[chosen])
        values = torch.empty(int(ends[-1]) if len(ends) else 0, device=self.device)
        ids, first = self._transferred(np.stack([chosen, np.concatenate([[0], ends[:-1]])]))
        if len(values):
            self._program.launch(
                "infer_bricks",
                min(len(chosen), self._slots),
                self._sizes.shared_bytes,
                [
                    self._record,
                    _pointer(ids),
                    ctypes.c_int(len(chosen)),
                    _pointer(first),
                    ctypes.c_longlong(self.step),
                    _pointer(values),
                ],
            )
        return values

    @torch.no_grad()
    def settle(self) -> None:
        """Let every brick catch up with the present step, so that evaluation is faster."""
        bricks = len(self.bricks)
        self._program.launch(
            "settle_bricks",
            min(bricks, 8 * self._slots),
            4 * (self._sizes.threads + 16),
            [
                self._record,
                ctypes.c_longlong(0),
                ctypes.c_int(bricks),
                ctypes.c_longlong(self.step),
            ],
        )
        self.visited[self.visited > 0] = self.step
        self.settled = self.step

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`; raises KeyError or ValueError for one of another model."""
        super().restore(state)
        self._visited.copy_(torch.from_numpy(self.visited))

    def _add_in_order(self, model: ModelRecord, places: Tensor, entries: Tensor) -> None:
        """Add coarse gradients, of each number in the order of the bricks.

        Args:
            model: the arrays of the engine.
            places: places of the numbers, of any shape; below 0 for none.
            entries: what is to be added there, of the same shape.
        """
        ordered, order = torch.sort(places.view(-1), stable=True)
        self._program.launch(
            "sum_entries",
            -(-len(order) // self._sizes.threads),
            0,
            [
                model,
                _pointer(ordered),
                _pointer(order),
                _pointer(entries),
                ctypes.c_longlong(len(order)),
            ],
        )

    def _try_kernels(self) -> None:
        """Compare a few steps with slab's and start again; Unavailable where they differ."""
        bricks = np.arange(min(TRIAL_BRICKS, len(self.bricks)))
        # In the third step the first brick catches up.
        batches = [batch for batch in (bricks, bricks[1:], bricks) if len(batch)][
            : len(self.rates) - 1
        ]
        samples = int(self.coreset.offsets[len(bricks)])
        start = [tensor.clone() for tensor in (self.fine[:, :samples], self.flat)]
        results = []
        for engine in (FusedEngine, SlabEngine):
            steps = [float(engine.train(self, batch)) for batch in batches]
            results.append((np.array(steps), engine.infer(self, bricks).cpu().numpy()))
            self._start_again(*start)
        (errors, values), (slab_errors, slab_values) = results
        wrong_errors = not np.allclose(errors, slab_errors, rtol=TRIAL_ERROR, atol=1e-9)
        difference = float(np.median(np.abs(values - slab_values)))
        if wrong_errors or not difference <= TRIAL_VALUE:
            self._program.forget()
            raise Unavailable(
                f"the kernels gave other results than slab on this device: errors {errors.tolist()}"
                f" instead of {slab_errors.tolist()}, values {difference:.2g} apart"
            )

    def _start_again(self, fine: Tensor, flat: Tensor) -> None:
        """Return to the start after a trial on the first samples, given the initial numbers."""
        samples = fine.shape[1]
        self.fine[:, :samples], self.flat[:] = fine, flat
        for tensor in (
            self.fine_mean[:, :samples],
            self.fine_square[:, :samples],
            self._visited,
            self.flat_mean,
            self.flat_square,
            self.gradient,
        ):
            tensor.zero_()
        self.visited[:] = 0
        self.step = self.settled = 0

    def _transferred(self, numbers: npt.NDArray[np.int64]) -> Tensor:
        """Return numbers on the device, without waiting for it."""
        tensor = torch.from_numpy(np.ascontiguousarray(numbers))
        if self.on_cpu:
            return tensor
        return tensor.pin_memory().to(self.device, non_blocking=True)

    def _model(self) -> ModelRecord:
        """Return the arrays of the engine, whose memory never moves, as the kernels take them."""
        start, before, after = (
            (ctypes.c_void_p * 4)(*(axis[table].data_ptr() for axis in self._axes))
            for table in range(3)
        )
        arrays = {
            "bricks": self.bricks,
            "mask": self.mask_bits,
            "values": self.values,
            "offsets": self.offsets,
            "rank": self.upsampling.rank,
            "powers": self._missed[0],
            "weights": self._missed[1],
            **{name: getattr(self, name) for name in ("fine", "fine_mean", "fine_square")},
            "visited": self._visited,
            **{name: getattr(self, name) for name in ("flat", "flat_mean", "flat_square")},
            "gradient": self.gradient,
        }
        return ModelRecord(
            start=start,
            before=before,
            after=after,
            fine_row=self.fine.stride(0),
            coarse=self.coarse,
            steps=len(self.rates),
            **{name: _pointer(array) for name, array in arrays.items()},
        )


def _pointer(tensor: Tensor | None) -> ctypes.c_void_p:
    """Return the address of a tensor's numbers, null for none."""
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())
