"""Marching on a CUDA device: the marcher's own source, compiled for a GPU (cuda/march.cu).

A thread marches a ray, a warp 8 x 4 pixels in step. The input is that of the native marcher with
addresses of the device in place of the host's. Frames stay on the device for the next pictures, as
many as fit.
"""

from __future__ import annotations

import math
import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec import native
from fhash_codec.cuda.device import Device, Kernels, Memory, sent
from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.native import ffi
from fhash_codec.paper.engines import fused
from fhash_codec.paper.network import Network
from fhash_codec.rendering.march_task import Marched
from fhash_codec.rendering.network_device import (
    NetworkNodes,
    constants_of,
    nodes_of,
    rows_of,
    spans_of,
)
from fhash_codec.rendering.tiled_frame import Fetching, TiledFrame
from fhash_formats.support.values import Mask

SOURCES = Path(native.__file__).parent
"""Folder of the marcher's source."""
OURS = Path(native.__file__).parents[1] / "cuda"
"""Folder of the kernel, and of the headers that stand for those of a processor."""
NETWORK = Path(fused.__file__).parent / "kernels"
"""Folder of what the kernels of networks share."""
STANDARD = ("cmath", "cstdint", "cstring", "limits", "stdint.h")
"""Headers of the standard library that the source includes."""
OPTIONS = ("--device-as-default-execution-space", "-diag-suppress=161,177,20044")
"""Options of the compiler: functions are the device's; pragmas of other compilers and functions
that a kernel does not call are no news."""
THREADS = 64
"""Threads of a block."""
TILE = {"width": 8, "height": 4}
"""Pixels of a warp."""
PICTURES = ("out", "depth", "normal")
"""Arrays of the input that are drawn into."""
KEPT = ("values", "smooth", "distance", "cells")
"""Arrays of the input that stay on the device for the next picture."""
OPTIONAL = ("surfaces", "network", "ready", "smooth", "central", "normal")
"""Parts of the input whose code is left out of the kernel where they are absent."""
TRIAL_ERROR = 5e-4
"""Difference of pictures, in colours and opacity up to 1, that is no more than rounding."""
TRIAL_RARE = 1e-3
"""Share of a picture in which rounding may decide on more: a surface that a ray touches or not."""
FREE = 0.75
"""Share of the memory that is free at the start that frames may take."""


@cache
def headers() -> dict[str, str]:
    """Texts that the kernel includes, by name."""
    texts = {path.name: path.read_text("utf-8") for path in SOURCES.glob("march*.hpp")}
    texts["codec.h"] = (SOURCES / "codec.h").read_text("utf-8")
    ours = [*OURS.glob("*.hpp"), *OURS.glob("*.cuh"), NETWORK / "records.h", NETWORK / "levels.cuh"]
    texts |= {path.name: path.read_text("utf-8") for path in ours}
    return texts | dict.fromkeys(STANDARD, '#include "standard.hpp"\n') | {"target.hpp": ""}


def kernel_text(
    flags: int,
    fields: Mapping[str, Any],
    network: Mapping[str, int] | None = None,
    threads: int = THREADS,
) -> str:
    """The kernel's text for an input (`FhashMarch`, by name) and its flags.

    network: constants of a network.
    """
    absent = [name.upper() for name in OPTIONAL if not _is_there(fields.get(name))]
    constants = {"FLAGS": flags, "THREADS": threads, **{f"NO_{name}": 1 for name in absent}}
    lines = [f"#define FHASH_{name} {value}" for name, value in constants.items()]
    lines += [f"constexpr int {name} = {value};" for name, value in (network or {}).items()]
    return "\n".join([*lines, (OURS / "march.cu").read_text("utf-8")])


def _is_there(field: Any) -> bool:
    return field is not None and (not isinstance(field, int | float) or bool(field))


Kept = tuple[npt.NDArray[Any], Memory, Mask | None]
"""An array, its copy on the device, and the blocks that were decoded when it was made."""


class DeviceMarcher:
    """A device that draws, and what it keeps of earlier pictures.

    Attributes:
        device: the device.
        new: whether the kernels of the last picture never ran here before.
    """

    def __init__(self, device: Device, threads: int = THREADS) -> None:
        """Take over a device; threads: of a block, whole warps."""
        self.device, self._threads = device, threads
        self._limit = int(FREE * device.free())
        self._last: Kernels | None = None
        self._kept: OrderedDict[int, Kept] = OrderedDict()
        self._programs: dict[str, Kernels] = {}
        self._nodes: tuple[Callable[[], Network | None], NetworkNodes] | None = None

    def network(self, network: Network, key: float) -> DeviceNetwork:
        """A network at one time on the device; Unavailable for one that the kernels cannot do."""
        constants = constants_of(network)
        last, nodes = self._nodes, nodes_of(network, key)[0]
        if last is None or last[0]() is not network or last[1].nodes != nodes:
            # Both may not fit, and a closed file leaves nothing on the device.
            self._nodes = last = None
            held = weakref.ref(network, self._forget)
            self._nodes = last = held, NetworkNodes(network, key, self.device)
        return DeviceNetwork(self, network, key, last[1], constants)

    def _forget(self, network: Callable[[], Network | None]) -> None:
        if self._nodes is not None and self._nodes[0] is network:
            self._nodes = None

    @property
    def new(self) -> bool:
        return self._last is not None and self._last.new

    def judge(self, ours: Marched, theirs: Marched) -> None:
        """Compare a picture by the last kernels with the CPU's; Unavailable if they differ."""
        assert self._last is not None
        apart = float(np.quantile(np.abs(ours.rgba - theirs.rgba), 1 - TRIAL_RARE))
        if not apart <= TRIAL_ERROR:
            self._last.forget()
            raise Unavailable(f"its kernels drew another picture than the CPU, {apart:.2g} apart")
        self._last.new = False

    def kernels(
        self, flags: int, fields: Mapping[str, Any], network: Mapping[str, int] | None = None
    ) -> Kernels:
        """The kernels for an input; Unavailable where they cannot be had."""
        text = kernel_text(flags, fields, network, self._threads)
        if text not in self._programs:
            self._programs[text] = self.device.load(text, headers(), OPTIONS)
        return self._programs[text]

    def march(
        self,
        fields: Mapping[str, Any],
        flags: int,
        *,
        fetching: Fetching | None = None,
        network: DeviceNetwork | None = None,
    ) -> npt.NDArray[np.int64]:
        """Draw into the pictures of an input (`FhashMarch`, by name); the counters.

        fetching: decodes what rays come to; None where all is there.
        network: that the rays march through, if they do.

        Raises:
            Unavailable: the kernels cannot be had.
            MemoryError: the device has too little memory.
        """
        constants = None if network is None else network.constants
        self._last = kernels = self.kernels(flags, fields, constants)
        if network is not None:
            fields = {**fields, **network.fields(kernels)}
        while True:
            counters, missing = self._launched(kernels, fields, fetching)
            if fetching is None or not missing.any():
                return counters
            # Rays ended where something was missing: the picture is drawn anew with it.
            fetching.fetch(np.flatnonzero(missing))
            if fetching.error is not None:
                return counters

    def _launched(
        self, kernels: Kernels, fields: Mapping[str, Any], fetching: Fetching | None
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
        """Draw once; the counters, and by brick whether something of it was missing."""
        pictures = {name: fields[name] for name in PICTURES if fields[name] is not None}
        made = {name: self._made(array.nbytes) for name, array in pictures.items()}
        held: dict[str, Memory] = dict(made)
        for name, array in fields.items():
            if isinstance(array, np.ndarray) and _is_pointer(name) and name not in made:
                # What is fetched while it is marched changes.
                keep = name in KEPT and (fetching is None or name not in fetching.fields)
                tiles = fetching.tiles if fetching is not None and name == "values" else None
                held[name] = self._sent(array, tiles, keep=keep)
        counters = sent(self.device, np.zeros(6, np.int64))
        missing = np.zeros(0 if fetching is None else fields["ready"].size, np.int32)
        if fetching is not None:
            held["fetch"] = sent(self.device, missing)
        given = {
            name: _addressed(name, held[name].address if name in held else field)
            for name, field in fields.items()
            if field is not None
        }
        warps = math.prod(-(-int(fields[name]) // side) for name, side in TILE.items())
        kernels.launch(
            "march_pixels",
            -(-warps * 32 // self._threads),
            self._threads,
            0,
            [ffi.new("FhashMarch *", given), ffi.new("uint64_t *", counters.address)],
        )
        for name, memory in made.items():
            memory.receive(pictures[name])
        counted = np.empty(6, np.int64)
        counters.receive(counted)
        if fetching is not None:
            held["fetch"].receive(missing)
        return counted, missing

    def _sent(self, array: npt.NDArray[Any], tiles: TiledFrame | None, *, keep: bool) -> Memory:
        """A copy of an array on the device, kept from an earlier picture if it may be.

        tiles: the frame whose values these are, where it is decoded as it is marched.
        """
        decoded = None if tiles is None else tiles.decoded.copy()
        kept = self._kept.pop(id(array), None)
        if kept is None:
            memory = self._made(array.nbytes)
            memory.send(array)
        else:
            _, memory, before = kept
            if tiles is not None and before is not None:
                for first, stop in tiles.layers(tiles.decoded & ~before):
                    memory.send(array[first:stop], offset=first * array.strides[0])
            elif before is not None and not before.all():
                memory.send(array)  # all is decoded by now
        if keep:
            self._kept[id(array)] = array, memory, decoded
        return memory

    def _made(self, size: int) -> Memory:
        """Memory of the device, for which the arrays leave that were used least recently."""
        while True:
            held = sum(array.nbytes for array, *_ in self._kept.values())
            try:
                if not self._kept or held + size <= self._limit:
                    return self.device.memory(size)
            except MemoryError:
                if not self._kept:
                    raise
            self._kept.popitem(last=False)


class DeviceNetwork:
    """A network at one time on a device.

    Attributes:
        constants: of the kernels.
    """

    def __init__(
        self,
        marcher: DeviceMarcher,
        network: Network,
        key: float,
        nodes: NetworkNodes,
        constants: Mapping[str, int],
    ) -> None:
        """Take over the tables around the time."""
        self.constants, self._nodes, self._device = constants, nodes, marcher.device
        self._shares = nodes_of(network, key)[1]
        self._layers = sent(self._device, rows_of(network))
        self._spans = sent(self._device, spans_of(network))
        self._levels: tuple[Memory, list[Any]] | None = None

    def fields(self, kernels: Kernels) -> dict[str, int]:
        """Fields of `FhashMarch`: addresses on the device."""
        if self._levels is None:
            self._levels = self._nodes.at(self._shares, self._device, kernels)
        return {
            "network": 1,  # there is one
            "network_sizes": self._spans.address,
            "network_levels": self._levels[0].address,
            "network_layers": self._layers.address,
        }


@cache
def _kinds() -> dict[str, Any]:
    return {name: field.type for name, field in ffi.typeof("FhashMarch").fields}


def _is_pointer(name: str) -> bool:
    return _kinds()[name].kind in ("pointer", "function")


def _addressed(name: str, field: Any) -> Any:
    """A field of the structure: an address as a pointer, an array as a list."""
    if _is_pointer(name):
        return ffi.cast(_kinds()[name], field)
    return field.tolist() if isinstance(field, np.ndarray) else field
