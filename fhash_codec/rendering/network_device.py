"""The published network on a CUDA device, for the marcher (cuda/march_network.cuh)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fhash_codec.cuda.device import Device, Kernels, Memory, sent
from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.paper.engines.fused import MAX_LAYERS, MAX_WIDTH
from fhash_codec.paper.engines.fused.declarations import ffi
from fhash_codec.paper.model import Patch, PointTables, SparsePatch, nodes_of
from fhash_codec.paper.network import Network, Resolution
from fhash_formats.support.values import Single

THREADS = 256
"""Threads of a block that mixes tables."""
MIXED = 16
"""Numbers of a table that a thread mixes, about."""


def constants_of(network: Network) -> dict[str, int]:
    """The constants of the kernel for a network; Unavailable for one that it cannot do."""
    widths = {len(bias) for _, bias in network.layers[:-1]}
    layers = len(network.layers) - 1
    if layers > MAX_LAYERS or len(widths) > 1 or max(widths, default=1) > MAX_WIDTH:
        each = " and ".join(map(str, sorted(widths)))
        raise Unavailable(
            f"the network has {layers} hidden layers of {each}; a GPU draws"
            f" {MAX_LAYERS} of {MAX_WIDTH} at most, all as wide"
        )
    return {
        "LEVELS": len(network.levels),
        "SIZE": network.embedding_size,
        "WIDTH": max(widths, default=1),
        "LAYERS": layers,
        "SPARSE": int(network.sparse),
    }


class NetworkNodes:
    """The tables of a network at the time nodes around a time, on a device.

    Attributes:
        nodes: the time nodes of each level.
    """

    def __init__(self, network: Network, key: float, device: Device) -> None:
        """Read the nodes; DamagedFileError where numbers of a table are not finite."""
        self.nodes = nodes_of(network, key)[0]
        patches = PointTables.of_box(network, key).patches
        self._values = [[sent(device, node) for node in patch.values] for patch in patches]
        self._sizes = [patch.values[0].nbytes for patch in patches]
        self._bits = [_bits(patch, device) for patch in patches]
        self._facts = [
            _facts(patch, level) for patch, level in zip(patches, network.levels, strict=True)
        ]

    def at(
        self, shares: Sequence[float], device: Device, kernels: Kernels
    ) -> tuple[Memory, list[Any]]:
        """The records of the levels at a time, and what they point to.

        shares: of the second node of each level. kernels: those that mix tables.
        """
        held: list[Any] = [self._values, self._bits]
        records = ffi.new("Level[]", len(self.nodes))
        for number, (record, nodes) in enumerate(zip(records, self._values, strict=True)):
            table = nodes[0]
            if len(nodes) > 1:
                table = device.memory(self._sizes[number])
                count = self._sizes[number] // 4
                arguments = [
                    *(ffi.new("uintptr_t *", node.address) for node in nodes),
                    ffi.new("float *", shares[number]),
                    ffi.new("uintptr_t *", table.address),
                    ffi.new("long long *", count),
                ]
                blocks = max(1, -(-count // (THREADS * MIXED)))
                kernels.launch("mix_tables", blocks, THREADS, 0, arguments)
            held.append(table)
            record.table = ffi.cast("float *", table.address)
            for name, bits in self._bits[number].items():
                setattr(record, name, ffi.cast(ffi.typeof(getattr(record, name)), bits.address))
            record.nothing, record.strides, record.scale = self._facts[number]
        return sent(device, np.frombuffer(ffi.buffer(records), np.uint8)), held


def _bits(patch: Patch, device: Device) -> dict[str, Memory]:
    """The bitmap of a part of a level that holds some vertices only."""
    if not isinstance(patch, SparsePatch):
        return {}
    names = ("words", "blocks", "within")
    return {name: sent(device, getattr(patch.bits, name)) for name in names}


def _facts(patch: Patch, resolution: Resolution) -> tuple[int, list[int], list[float]]:
    """`nothing`, `strides` and `scale` of a level's record."""
    axes = list(zip(resolution, patch.strides, strict=True))[:0:-1]
    # An axis of one vertex has no corner after it: both corners are the same.
    strides = [step if size > 1 else 0 for size, step in axes]
    nothing = patch.bits.count if isinstance(patch, SparsePatch) else 0
    return nothing, strides, [float(size - 1) for size, _ in axes]


def rows_of(network: Network) -> Single:
    """The numbers of all layers: for each output weights, bias and zeros, a multiple of four."""
    rows = []
    for weights, bias in network.layers:
        outputs, inputs = weights.shape
        padded = np.zeros((outputs, (inputs + 4) // 4 * 4), np.float32)
        padded[:, :inputs], padded[:, inputs] = weights, bias
        rows.append(padded.reshape(-1))
    return np.concatenate(rows)


def spans_of(network: Network) -> np.ndarray:
    """Spans of the box along x, y and z, and their inverses, float64 (6,)."""
    spans = [float(max(size - 1, 1)) for size in reversed(network.box_size)]
    return np.array([*spans, *(1 / span for span in spans)])
