"""Engine in fused CUDA kernels, evaluation at points, and their start."""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.fused import program
from fhash_codec.paper.engines.fused.declarations import ffi
from fhash_codec.paper.engines.fused.program import (
    DeviceLimits,
    Sizes,
    best_of,
    check_layers,
    kernel_sizes,
    missed_step_tables,
    with_files,
)
from fhash_codec.paper.engines.native import NativeEngine, refusal
from fhash_codec.paper.engines.parameters import (
    Chosen,
    Parameters,
    check_state,
    coarse_axes,
    coarse_levels,
    corrections,
    initial_parameters,
    used_numbers,
)
from fhash_codec.paper.model import Patch, PointSampler, PointTables, SparsePatch, nodes_of
from fhash_codec.paper.network import Architecture, Network, Resolution, parameter_count
from fhash_formats.errors import FhashWarning
from fhash_formats.support.values import Single

TRIAL_BRICKS = 4
"""Bricks of the trial of newly compiled kernels."""
TRIAL_ERROR = 1e-3
"""Relative difference of the squared errors of a trial that is no more than rounding."""
TRIAL_VALUE = 1e-4
"""Median difference of the values after a trial that is no more than rounding."""


STATE = ("fine", "fine_mean", "fine_square", "flat", "flat_mean", "flat_square")
"""Tensors that a checkpoint stores, by name, besides `visited` and the step."""


class FusedEngine:
    """An `Engine` that trains on bricks by fused kernels.

    The finest embeddings are stored for the samples alone, brick by brick. Adam visits just the
    bricks of a batch, yet gives what a dense Adam gives: a brick that was passed over catches up on
    its missing steps, whose gradient is zero, in closed form (`parameters.catch_up`). Samples
    between key frames lie on no vertex of the finest table: it is then one more coarse level, and
    no embedding is stored for the samples.

    Attributes:
        fine: finest embeddings (E or 0, samples) in the order of `Coreset.values`; `fine_mean` and
            `fine_square` are their moments of Adam.
        visited: number of the last training step that used each brick, 0 for none, int64 (bricks,)
            on the host.
        flat: the used numbers of the coarse tables, followed by the layers of the MLP, in one
            vector; `flat_mean` and `flat_square` are their moments, `gradient` is their gradient.
        coarse: number of the used numbers of the coarse tables.
    """

    name = "fused"

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device,
        kernels: program.CudaDevice,
    ) -> None:
        """Start from fresh parameters; arguments as in `make_engine`.

        The coreset is copied to the device. Newly compiled kernels are tried against the native
        engine's step on a few bricks.

        Raises:
            Unavailable: the kernels cannot do this model, cannot be compiled, or fail the trial.
        """
        self._sizes, axes = kernel_sizes(architecture, coreset, kernels.limits)
        self._program = kernels.load(self._sizes)
        self.architecture, self.coreset = architecture, coreset
        self.device, self._seed = device, seed
        self._counts = np.diff(coreset.offsets)

        def sent(array: npt.NDArray[Any]) -> Tensor:
            return torch.from_numpy(array).to(device, copy=True)

        start = initial_parameters(architecture, coreset, seed)
        self._numbers = parameter_count(
            coarse_levels(architecture, coreset), architecture.embedding_size
        )
        self._used, rank = used_numbers(coarse_axes(architecture, coreset), coreset, self._numbers)
        self.coarse = len(self._used)
        self.fine = sent(start.fine)
        self.flat = sent(np.concatenate([start.coarse[self._used], start.network]))
        self.fine_mean, self.fine_square = (torch.zeros_like(self.fine) for _ in range(2))
        self.flat_mean, self.flat_square, self.gradient = (
            torch.zeros_like(self.flat) for _ in range(3)
        )
        self.visited = np.zeros(len(coreset.bricks), dtype=np.int64)
        self.step = 0
        # The kernels read on the device what the host has in `visited`.
        self._arrays = {
            "bricks": sent(coreset.bricks.astype(np.int64)),
            "mask": sent(coreset.mask_bits),
            "values": sent(coreset.values),
            "offsets": sent(coreset.offsets),
            "rank": None if rank is None else sent(rank),
            "visited": sent(self.visited),
        }
        self._axes = [
            [sent(table) for table in (axis.start, axis.before, axis.after)] for axis in axes
        ]
        self.rates = rates
        limits = kernels.limits
        self._slots = self._sizes.slots(limits, 2)
        self._matrix_gradients = torch.empty(self._slots * self._sizes.matrices, device=device)
        self._errors = torch.empty(self._slots, dtype=torch.float64, device=device)
        if self._program.new:
            self._try_kernels()
            self._program.keep()

    @property
    def rates(self) -> npt.NDArray[np.float64]:
        """Learning rate of every training step, counted from 1."""
        return self._rates

    @rates.setter
    def rates(self, rates: npt.NDArray[np.float64]) -> None:
        self._rates = rates
        self._missed = [_sent(table, self.device) for table in missed_step_tables(rates)]
        self._record = self._model()

    @torch.no_grad()
    def train(self, chosen: Chosen) -> Tensor:
        """Do one training step on a batch; return the sum of squared errors before it."""
        ids = self._transferred(chosen)
        self.step += 1
        scale = 2.0 / max(int(self._counts[chosen].sum()), 1)
        rate = ffi.new("Rate *", corrections(self.step, float(self.rates[self.step])))
        # A batch of few bricks is cut into parts, so that all multiprocessors have work.
        parts = max(1, min(self._slots // len(chosen), self._sizes.tiles))
        items = len(chosen) * parts
        blocks = min(items, self._slots)
        places = entries = None
        if torch.are_deterministic_algorithms_enabled():
            shape = (items, self._sizes.lattice, 2)
            places = torch.empty(shape, dtype=torch.int32, device=self.device)
            entries = torch.empty(shape, device=self.device)
        model, step = self._record, ffi.new("long long *", self.step)
        self._program.launch(
            "train_bricks",
            blocks,
            self._sizes.shared_bytes,
            [
                model,
                _pointer(ids),
                ffi.new("int *", items),
                ffi.new("int *", parts),
                step,
                ffi.new("float *", scale),
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
                ffi.new("int *", len(chosen)),
                step,
                rate,
                _pointer(self._matrix_gradients),
                ffi.new("int *", blocks),
            ],
        )
        self.visited[chosen] = self.step
        return self._errors[:blocks].sum()

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> Single:
        """Return the values (n,) at the samples of some bricks."""
        ends = np.cumsum(self._counts[chosen])
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
                    ffi.new("int *", len(chosen)),
                    _pointer(first),
                    ffi.new("long long *", self.step),
                    _pointer(values),
                ],
            )
        return values.cpu().numpy()

    @torch.no_grad()
    def settle(self) -> None:
        """Let every brick catch up with the present step, so that evaluation is faster."""
        bricks = len(self.visited)
        self._program.launch(
            "settle_bricks",
            min(bricks, 8 * self._slots),
            4 * (self._sizes.threads + 16),
            [
                self._record,
                ffi.new("long long *", 0),
                ffi.new("int *", bricks),
                ffi.new("long long *", self.step),
            ],
        )
        self.visited[self.visited > 0] = self.step

    @torch.no_grad()
    def parameters(self) -> Parameters:
        """Return the trained numbers, on the CPU. Embeddings that no sample ever moved are 0."""
        self.settle()
        moved = (self.flat_mean != 0) | (self.flat_square != 0)
        used = torch.where(moved, self.flat, 0.0) if self.step else self.flat
        coarse = np.zeros(self._numbers, np.float32)
        coarse[self._used] = used[: self.coarse].cpu().numpy()
        trained = Parameters(
            fine=self.fine.cpu().numpy(),
            coarse=coarse,
            network=self.flat[self.coarse :].cpu().clone().numpy(),
        )
        return trained.as_stored(self.architecture, self.coreset)

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return parameters, Adam's moments and the step number as arrays."""
        tensors = {name: getattr(self, name).cpu().numpy() for name in STATE}
        return {"step": np.array(self.step), "visited": self.visited, **tensors}

    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`; raises KeyError or ValueError for one of another model."""
        check_state(state, {name: getattr(self, name).shape for name in (*STATE, "visited")})
        self.step = int(state["step"])
        self.visited[:] = state["visited"]
        for name in STATE:
            getattr(self, name).copy_(torch.from_numpy(state[name]))
        self._send_visited()

    def _send_visited(self) -> None:
        visited = self._arrays["visited"]
        assert visited is not None
        visited.copy_(torch.from_numpy(self.visited))

    def _add_in_order(self, model: Any, places: Tensor, entries: Tensor) -> None:
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
                ffi.new("long long *", len(order)),
            ],
        )

    def _try_kernels(self) -> None:
        """Compare a few steps with the native engine's and start again.

        Raises Unavailable where they differ, or there is no such engine.
        """
        reason = refusal(self.architecture)
        if reason is not None:
            raise Unavailable(f"the engine native cannot try the kernels: {reason}")
        # The first ones lie at a key frame, the last ones between two, if any do.
        last = len(self.visited) - 1
        bricks = np.unique(np.linspace(0, last, TRIAL_BRICKS, dtype=np.int64))
        # In the third step the first brick catches up.
        batches = [batch for batch in (bricks, bricks[1:], bricks) if len(batch)][
            : len(self.rates) - 1
        ]
        start = {name: np.array(array) for name, array in self.state().items()}
        native = NativeEngine(self.architecture, self.coreset, self.rates, seed=self._seed)
        results = []
        for engine in (self, native):
            steps = [float(engine.train(batch)) for batch in batches]
            results.append((np.array(steps), engine.infer(bricks)))
        self.restore(start)
        (errors, values), (native_errors, native_values) = results
        wrong_errors = not np.allclose(errors, native_errors, rtol=TRIAL_ERROR, atol=1e-9)
        difference = float(np.median(np.abs(values - native_values)))
        if wrong_errors or not difference <= TRIAL_VALUE:
            raise Unavailable(
                f"the kernels gave other results than native on this device: {errors.tolist()}"
                f" instead of {native_errors.tolist()}, values {difference:.2g} apart"
            )

    def _transferred(self, numbers: npt.NDArray[np.int64]) -> Tensor:
        """Return numbers on the device, without waiting for it."""
        tensor = torch.from_numpy(np.ascontiguousarray(numbers))
        if self.device.type == "cpu":
            return tensor
        return tensor.pin_memory().to(self.device, non_blocking=True)

    def _model(self) -> Any:
        """Return the arrays of the engine, whose memory never moves, as the kernels take them."""
        start, before, after = (
            [_address(axis[table]) for axis in self._axes] for table in range(3)
        )
        arrays = {
            **self._arrays,
            "powers": self._missed[0],
            "weights": self._missed[1],
            **{name: getattr(self, name) for name in (*STATE, "gradient")},
        }
        record = dict(
            start=start,
            before=before,
            after=after,
            fine_row=self.fine.stride(0),
            coarse=self.coarse,
            steps=len(self.rates),
            **{name: _address(array) for name, array in arrays.items()},
        )
        return ffi.new("Model *", record)


def _address(tensor: Tensor | None) -> Any:
    """Return the address of a tensor's numbers, null for none."""
    return ffi.cast("void *", 0 if tensor is None else tensor.data_ptr())


def _pointer(tensor: Tensor | None) -> Any:
    """Return the address of a tensor's numbers as an argument of a kernel."""
    return ffi.new("void **", _address(tensor))


FILES = ("records.h", "network.cuh", "levels.cuh", "points.cu")
"""The files of the kernels in the order in which they follow each other."""
MAX_BLOCKS = 8
"""Blocks at most for each multiprocessor."""
TRIAL_PLACES = 1000
"""Places of the trial of newly compiled kernels."""
POINTS_ERROR = 1e-4
"""Median difference, by the largest number, that is no more than rounding."""


@dataclass(frozen=True, kw_only=True)
class PointSizes(Sizes):
    """The sizes that the kernels of points are compiled for.

    Attributes:
        sparse: whether the levels hold some vertices only.
    """

    sparse: bool

    def text(self) -> str:
        """Return the whole text of the kernels."""
        return with_files(self._constants(), FILES)

    def _constants(self) -> Iterator[str]:
        """Yield the lines that define the constants."""
        yield from self.layer_constants()
        yield f"constexpr bool SPARSE = {str(self.sparse).lower()};"


class DeviceTables:
    """The time nodes of a network around a time on a device, for all times between them.

    Attributes:
        nodes: the time nodes of each level.
        records: the record of each level, without its table.
    """

    def __init__(self, network: Network, key: float, device: torch.device) -> None:
        """Read the nodes and take them to a device; DamagedFileError as in `FusedPoints`."""
        self.nodes, _ = nodes_of(network, key)
        patches = PointTables.of_box(network, key).patches
        self._values = [_sent(patch.values, device) for patch in patches]
        # The records hold addresses of these tensors.
        self._bits = [
            # Signed integers have the same bits, and every operation of torch.
            {
                "words": _sent(patch.bits.words.view(np.int64), device),
                "blocks": _sent(patch.bits.blocks.view(np.int32), device),
                "within": _sent(patch.bits.within, device),
            }
            if isinstance(patch, SparsePatch)
            else {}
            for patch in patches
        ]
        self.records = [
            _record(*level) for level in zip(patches, network.levels, self._bits, strict=True)
        ]

    def at(self, shares: Sequence[float]) -> list[Tensor]:
        """Return the table of each level at a time, given the share of its second node."""
        return [
            values[0] if len(values) == 1 else torch.lerp(values[0], values[1], share)
            for values, share in zip(self._values, shares, strict=True)
        ]


def _record(patch: Patch, resolution: Resolution, bits: Mapping[str, Tensor]) -> Any:
    """Return the record of a level's part without its table; `bits` are those of a sparse one."""
    axes = list(zip(resolution, patch.strides, strict=True))[:0:-1]
    record = dict(
        nothing=patch.bits.count if isinstance(patch, SparsePatch) else 0,
        # An axis of one vertex has no corner after it: both corners are the same.
        strides=[step if size > 1 else 0 for size, step in axes],
        scale=[size - 1 for size, _ in axes],
        **{name: _address(tensor) for name, tensor in bits.items()},
    )
    return ffi.new("Level *", record)


def _sent(array: npt.NDArray[Any], device: torch.device) -> Tensor:
    """Return an array on a device."""
    # A copy: torch would warn of numbers that must not be written.
    return torch.from_numpy(np.array(array, order="C")).to(device)


class PointKernels:
    """A device with the kernels that were loaded there, for many networks."""

    def __init__(self, device: program.CudaDevice) -> None:
        """Take over a device."""
        self.limits = device.limits
        self._tables: DeviceTables | None = None
        self._network: Callable[[], Network | None] = lambda: None
        self._device = device
        self._programs: dict[str, program.CudaProgram] = {}

    def load(self, sizes: PointSizes) -> program.CudaProgram:
        """Return the kernels for some sizes; Unavailable where they cannot be had."""
        text = sizes.text()
        if text not in self._programs:
            self._programs[text] = self._device.load(sizes)
        return self._programs[text]

    def tables(self, network: Network, key: float, device: torch.device) -> DeviceTables:
        """Return the tables around a time: of a film, often those of the picture before."""
        last = self._tables
        if (
            last is None
            or self._network() is not network
            or last.nodes != nodes_of(network, key)[0]
        ):
            # Both may not fit, and a closed file leaves nothing on the device.
            self._tables = last = None
            self._tables = last = DeviceTables(network, key, device)
            self._network = weakref.ref(network, self._forget)
        return last

    def _forget(self, network: Callable[[], Network | None]) -> None:
        if network is self._network:
            self._tables = None


class FusedPoints:
    """A network at one time on a device."""

    def __init__(
        self, network: Network, key: float, *, device: torch.device, kernels: PointKernels
    ) -> None:
        """Take the tables to a device, interpolated in time.

        Newly compiled kernels are tried at some places against those of the host.

        Args:
            network: the trained network.
            key: the key index, in [0, key_frames - 1].
            device: the device of the places.
            kernels: the same device with its kernels.

        Raises:
            Unavailable: the kernels cannot do this network, cannot be compiled, or fail the trial.
            DamagedFileError: numbers of a table are not finite.
        """
        self._sizes = point_sizes(architecture_of(network), network.sparse, kernels.limits)
        self._program = kernels.load(self._sizes)
        self._slots = self._sizes.slots(kernels.limits, MAX_BLOCKS)
        self._device = device
        self._spans = [float(max(size - 1, 1)) for size in reversed(network.box_size)]
        tables = kernels.tables(network, key, device)
        values = tables.at(nodes_of(network, key)[1])
        records = ffi.new("Level[]", [record[0] for record in tables.records])
        for record, table in zip(records, values, strict=True):
            record.table = _address(table)
        # The records hold addresses of these tensors.
        self._held = tables, values
        self._levels = _sent(np.frombuffer(ffi.buffer(records), np.uint8), device)
        self._layers = _sent(
            np.concatenate([np.column_stack(layer).reshape(-1) for layer in network.layers]), device
        )
        if self._program.new:
            self._try_kernels(PointTables.of_box(network, key).at(key))
            self._program.keep()
        else:
            # A kernel that cannot be launched is found before the first picture.
            nowhere = torch.empty((0, 3), dtype=torch.float64, device=device)
            self.values(nowhere)
            self.slopes(nowhere)

    def values(self, places: Tensor) -> Tensor:
        """Return the normalised values float32 (n,) at places.

        Args:
            places: float64 (n, 3) on the device: x, y and z in vertices of the box, in
                [0, size - 1].

        Raises:
            Unavailable: the driver refuses the launch.
        """
        return self._launched("values_at", places, (len(places),))

    def slopes(self, places: Tensor) -> Tensor:
        """Return the derivatives float32 (n, 3) of the values by x, y and z per vertex of the box.

        They are those of the model itself, as `sample_points` has them. Arguments and errors are
        those of `values`.
        """
        return self._launched("slopes_at", places, (len(places), 3))

    def _launched(self, kernel: str, places: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Return what a kernel writes at places."""
        assert places.dtype == torch.float64
        assert places.shape[1:] == (3,)
        places = places.contiguous()
        results = torch.empty(shape, dtype=torch.float32, device=self._device)
        inverse = [1.0 / span for span in self._spans]
        record = ffi.new("Places *", (_address(places), len(places), self._spans, inverse))
        tiles = -(-len(places) // self._sizes.columns)
        self._program.launch(
            kernel,
            max(1, min(tiles, self._slots)),
            self._sizes.shared_bytes,
            [
                _pointer(self._levels),
                _pointer(self._layers),
                record,
                _pointer(results),
            ],
        )
        return results

    def _try_kernels(self, tables: PointTables) -> None:
        """Compare with the host at some places; Unavailable where the kernels differ."""
        last = np.array(tables.sizes[:0:-1]) - 1.0
        places = np.random.default_rng(0).uniform(0.0, last, (TRIAL_PLACES, 3))
        values = np.empty(TRIAL_PLACES, np.float32)
        slopes = np.empty((TRIAL_PLACES, 4), np.float32)
        x, y, z = places.T
        PointSampler(tables).sample((np.zeros(1), z, y, x), values, slopes, 1)
        there = _sent(places, self._device)
        for name, ours, theirs in (
            ("values", self.values(there), values),
            ("slopes", self.slopes(there), slopes[:, :0:-1]),
        ):
            apart = float(np.median(np.abs(ours.cpu().numpy() - theirs)))
            if not apart <= POINTS_ERROR * float(np.abs(theirs).max()):
                raise Unavailable(f"the kernels gave other {name} than the host, {apart:.2g} apart")


def architecture_of(network: Network) -> Architecture:
    """Return the sizes of a network; Unavailable where its hidden layers differ in width."""
    widths = [len(bias) for _, bias in network.layers[:-1]]
    if len(set(widths)) > 1:
        raise Unavailable(f"the network has hidden layers of {', '.join(map(str, widths))}")
    return Architecture(
        levels=network.levels,
        embedding_size=network.embedding_size,
        hidden_layers=len(widths),
        width=widths[0] if widths else 1,
        box_size=network.box_size,
        key_frames=network.key_frames,
    )


def point_sizes(architecture: Architecture, sparse: bool, limits: DeviceLimits) -> PointSizes:
    """Return the sizes that suit a network and a device.

    Raises:
        Unavailable: the kernels cannot do this network on this device.
    """
    check_layers(architecture)
    fitting = [
        sizes
        for columns in limits.columns
        if (
            sizes := PointSizes(
                architecture=architecture, columns=columns, threads=limits.threads, sparse=sparse
            )
        ).shared_bytes
        <= limits.shared_per_block
    ]
    if not fitting:
        raise Unavailable(
            f"the network needs more shared memory than the {limits.shared_per_block} bytes of a"
            " block here"
        )
    return best_of(fitting, limits)


def start_fused(
    architecture: Architecture,
    coreset: Coreset,
    rates: npt.NDArray[np.float64],
    *,
    seed: int,
) -> FusedEngine:
    """Return a fused engine; arguments as in `make_engine`.

    Raises:
        Unavailable: kernels for CUDA cannot be had here, or cannot do the model.
    """
    if torch.version.cuda is None:
        raise Unavailable("torch is not built for CUDA")
    device = torch.device("cuda")
    kernels = program.CudaDevice(device)
    return FusedEngine(architecture, coreset, rates, seed=seed, device=device, kernels=kernels)


def start_points(network: Network, key: float, device: torch.device) -> FusedPoints | None:
    """Return a network at one time on a device, or None, with one FhashWarning for each reason.

    There is no warning on a processor or where torch is not built for CUDA.

    Args:
        network, key, device: as in `FusedPoints`.

    Raises:
        DamagedFileError: numbers of a table are not finite.
    """
    if device.type != "cuda" or torch.version.cuda is None:
        return None
    try:
        kernels = _point_kernels(program.CudaDevice, device)
        return FusedPoints(network, key, device=device, kernels=kernels)
    except Unavailable as error:
        _warn_once(
            f"the network is evaluated on the CPU, since kernels for it cannot be had: {error}"
        )
        return None


@cache
def _point_kernels(
    make: Callable[[torch.device], program.CudaDevice], device: torch.device
) -> PointKernels:
    """Return the kernels of points on a device, for all networks and key indices."""
    return PointKernels(make(device))


@cache
def _warn_once(message: str) -> None:
    """Warn that something is slower than it could be."""
    warnings.warn(message, FhashWarning, stacklevel=4)
