"""A network at free places of one time, for marching rays: values and slopes by fused kernels.

A call is one launch, and no wait. A place has the same bits whatever other places are given.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.paper.architecture import Architecture, Resolution
from fhash_codec.paper.engines.fused.engine import Device, Program
from fhash_codec.paper.engines.fused.source import (
    DeviceLimits,
    Sizes,
    Unavailable,
    best_of,
    check_layers,
    with_files,
)
from fhash_codec.paper.network import Network
from fhash_codec.paper.points import Patch, PointSampler, PointTables, SparsePatch

FILES = ("network.cuh", "points.cu")
"""The files of the kernels in the order in which they follow each other."""
MAX_BLOCKS = 8
"""Blocks at most for each multiprocessor."""
TRIAL_PLACES = 1000
"""Places of the trial of newly compiled kernels."""
TRIAL_ERROR = 1e-4
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


class PointKernels:
    """A device with the kernels that were loaded there, for many networks."""

    def __init__(self, device: Device) -> None:
        """Take over a device."""
        self.limits = device.limits
        self._device = device
        self._programs: dict[str, Program] = {}

    def load(self, sizes: PointSizes) -> Program:
        """Return the kernels for some sizes; Unavailable where they cannot be had."""
        text = sizes.text()
        if text not in self._programs:
            self._programs[text] = self._device.load(sizes)
        return self._programs[text]


class LevelRecord(ctypes.Structure):
    """The record `Level` of kernels/points.cu."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("table", "words", "blocks", "within")),
        ("nothing", ctypes.c_longlong),
        ("strides", ctypes.c_longlong * 3),
        ("scale", ctypes.c_double * 3),
    )


class PlacesRecord(ctypes.Structure):
    """The record `Places` of kernels/points.cu."""

    _fields_ = (
        ("at", ctypes.c_void_p),
        ("count", ctypes.c_longlong),
        ("span", ctypes.c_double * 3),
        ("inverse", ctypes.c_double * 3),
    )


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
        tables = PointTables.of_box(network, key).at(key)
        # The records hold addresses of these tensors.
        self._held: list[Tensor] = []
        records = [
            self._record(patch, level)
            for patch, level in zip(tables.patches, tables.levels, strict=True)
        ]
        self._levels = self._sent(
            np.frombuffer(bytes((LevelRecord * len(records))(*records)), np.uint8)
        )
        self._layers = self._sent(
            np.concatenate([np.column_stack(layer).reshape(-1) for layer in network.layers])
        )
        if self._program.new:
            self._try_kernels(tables)
            self._program.new = False
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
        record = PlacesRecord(
            at=places.data_ptr(),
            count=len(places),
            span=(ctypes.c_double * 3)(*self._spans),
            inverse=(ctypes.c_double * 3)(*(1.0 / span for span in self._spans)),
        )
        tiles = -(-len(places) // self._sizes.columns)
        self._program.launch(
            kernel,
            max(1, min(tiles, self._slots)),
            self._sizes.shared_bytes,
            [
                ctypes.c_void_p(self._levels.data_ptr()),
                ctypes.c_void_p(self._layers.data_ptr()),
                record,
                ctypes.c_void_p(results.data_ptr()),
            ],
        )
        return results

    def _record(self, patch: Patch, resolution: Resolution) -> LevelRecord:
        """Return the record of a level's part of one time, with its arrays on the device."""
        arrays: dict[str, npt.NDArray[Any]] = {"table": patch.values.astype(np.float32, copy=False)}
        nothing = 0
        if isinstance(patch, SparsePatch):
            bits = patch.bits
            # Signed integers have the same bits, and every operation of torch.
            arrays |= {
                "words": bits.words.view(np.int64),
                "blocks": bits.blocks.view(np.int32),
                "within": bits.within,
            }
            nothing = bits.count
        addresses = {name: self._sent(array).data_ptr() for name, array in arrays.items()}
        axes = list(zip(resolution, patch.strides, strict=True))[:0:-1]
        return LevelRecord(
            nothing=nothing,
            # An axis of one vertex has no corner after it: both corners are the same.
            strides=(ctypes.c_longlong * 3)(*(step if size > 1 else 0 for size, step in axes)),
            scale=(ctypes.c_double * 3)(*(size - 1 for size, _ in axes)),
            **addresses,
        )

    def _sent(self, array: npt.NDArray[Any]) -> Tensor:
        """Return an array on the device, where it stays."""
        # A copy: torch would warn of numbers that must not be written.
        tensor = torch.from_numpy(np.array(array, order="C")).to(self._device)
        self._held.append(tensor)
        return tensor

    def _try_kernels(self, tables: PointTables) -> None:
        """Compare with the host at some places; Unavailable where the kernels differ."""
        last = np.array(tables.sizes[:0:-1]) - 1.0
        places = np.random.default_rng(0).uniform(0.0, last, (TRIAL_PLACES, 3))
        values = np.empty(TRIAL_PLACES, np.float32)
        slopes = np.empty((TRIAL_PLACES, 4), np.float32)
        x, y, z = places.T
        PointSampler(tables).sample((np.zeros(1), z, y, x), values, slopes, 1)
        there = self._sent(places)
        for name, ours, theirs in (
            ("values", self.values(there), values),
            ("slopes", self.slopes(there), slopes[:, :0:-1]),
        ):
            apart = float(np.median(np.abs(ours.cpu().numpy() - theirs)))
            if not apart <= TRIAL_ERROR * float(np.abs(theirs).max()):
                self._program.forget()
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
