"""Marching on a CUDA device: the marcher's own source, compiled for a GPU (cuda/march.cu).

A thread marches a ray, a warp 8 x 4 pixels in step. The input is that of the native marcher with
addresses of the device in place of the host's. Frames stay on the device for the next pictures, as
many as fit.
"""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
from fhash_codec.paper.model import nodes_of
from fhash_codec.paper.network import Network
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.march_task import Marched
from fhash_codec.rendering.network_device import (
    NetworkNodes,
    constants_of,
    rows_of,
    spans_of,
)
from fhash_codec.rendering.tiled_frame import Fetching
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
SAMPLES = 1 << 28
"""Samples of a launch, about; through a network an eighth. A slow device takes less than a second:
one with a display ends what takes two.
"""
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


@dataclass(kw_only=True, eq=False)
class _Copy:
    """A copy of an array on the device.

    Attributes:
        of: the array; when it is gone, the copy is forgotten.
        memory: of the copy.
        decoded: blocks that were decoded when it was made, of a frame that is decoded bit by bit.
    """

    of: weakref.ref[npt.NDArray[Any]]
    memory: Memory
    size: int
    decoded: Mask | None = None


class UntriedError(Exception):
    """The kernels never did well here before, and are to be tried first (`DeviceMarcher.trial`)."""


class DeviceMarcher:
    """A device that draws, and what it keeps of earlier pictures.

    Attributes:
        device: the device.
    """

    def __init__(self, device: Device, threads: int = THREADS) -> None:
        """Take over a device; threads: of a block, whole warps."""
        self.device, self._threads = device, threads
        self._limit = int(FREE * device.free())
        self._kept: OrderedDict[int, _Copy] = OrderedDict()
        self._nodes: tuple[Callable[[], Network | None], NetworkNodes] | None = None
        self._trying: list[Kernels] | None = None

    def network(self, network: Network, key: float) -> DeviceNetwork:
        """A network at one time on the device; Unavailable for one that the kernels cannot do."""
        constants = constants_of(network)
        last, (nodes, shares) = self._nodes, nodes_of(network, key)
        if last is None or last[0]() is not network or last[1].nodes != nodes:
            # Both may not fit, and a closed file leaves nothing on the device.
            self._nodes = last = None
            held = weakref.ref(network, self._forget)
            self._nodes = last = held, NetworkNodes(network, key, self.device)
        return DeviceNetwork(self.device, network, last[1], shares, constants)

    def _forget(self, network: Callable[[], Network | None]) -> None:
        if self._nodes is not None and self._nodes[0] is network:
            self._nodes = None

    def trial(self, draw: Callable[[], Marched], expected: Marched) -> None:
        """Draw a picture by kernels that are new; Unavailable where another one is expected."""
        self._trying = []
        try:
            ours = draw()
            tried = self._trying
        finally:
            self._trying = None
        apart = float(np.quantile(np.abs(ours.rgba - expected.rgba), 1 - TRIAL_RARE))
        if not apart <= TRIAL_ERROR:
            raise Unavailable(f"its kernels drew another picture than the CPU, {apart:.2g} apart")
        for kernels in tried:
            kernels.keep()

    def kernels(
        self, flags: int, fields: Mapping[str, Any], network: Mapping[str, int] | None = None
    ) -> Kernels:
        """The kernels for an input; Unavailable where they cannot be had.

        Raises UntriedError for new ones, but in a trial.
        """
        text = kernel_text(flags, fields, network, self._threads)
        kernels = self.device.load(text, headers(), OPTIONS)
        if self._trying is not None:
            self._trying.append(kernels)
        elif kernels.new:
            raise UntriedError
        return kernels

    def march(
        self,
        fields: Mapping[str, Any],
        flags: int,
        *,
        fetching: Fetching | None = None,
        network: DeviceNetwork | None = None,
        progress: Progress = silent,
    ) -> npt.NDArray[np.int64]:
        """Draw into the pictures of an input (`FhashMarch`, by name); the counters.

        fetching: decodes what rays come to; None where all is there.
        network: that the rays march through, if they do.
        progress: is told of the parts of the picture that are done.

        Raises:
            Unavailable: the kernels cannot be had.
            MemoryError: the device has too little memory.
            UntriedError: as in `kernels`.
        """
        constants = None if network is None else network.constants
        kernels = self.kernels(flags, fields, constants)
        if network is not None:
            fields = {**fields, **network.fields(kernels)}
        pictures = {name: fields[name] for name in PICTURES if fields[name] is not None}
        held = {name: self._made(array.nbytes) for name, array in pictures.items()}
        sent_at: dict[str, _Copy] = {}
        parts = _bands(fields, network is not None)
        while True:
            for name, array in fields.items():
                if isinstance(array, np.ndarray) and _is_pointer(name) and name not in pictures:
                    held[name] = self._sent(name, array, fetching, sent_at)
            counters = sent(self.device, np.zeros(6, np.int64))
            missing = np.zeros(0 if fetching is None else fields["ready"].size, np.int32)
            if fetching is not None:
                held["fetch"] = sent(self.device, missing)
            addresses = {name: memory.address for name, memory in held.items()}
            given = {
                name: _addressed(name, addresses.get(name, field))
                for name, field in fields.items()
                if field is not None
            }
            self._launch(kernels, ffi.new("FhashMarch *", given), counters, parts, progress)
            if fetching is not None:
                held["fetch"].receive(missing)
                if missing.any():
                    # Rays ended where something was missing: the picture is drawn anew with it.
                    fetching.fetch(np.flatnonzero(missing))
                    if fetching.error is None:
                        continue
            for name, array in pictures.items():
                held[name].receive(array)
            counted = np.empty(6, np.int64)
            counters.receive(counted)
            return counted

    def _launch(
        self,
        kernels: Kernels,
        march: Any,
        counters: Memory,
        parts: list[tuple[int, int]],
        progress: Progress,
    ) -> None:
        """Draw part by part: a display's device, and Ctrl-C, wait for the end of each."""
        at = ffi.new("uint64_t *", counters.address)
        for number, (first, stop) in enumerate(parts):
            progress("marching", number, len(parts), "")
            ends = ffi.new("int64_t *", first), ffi.new("int64_t *", stop)
            blocks = -(-(stop - first) * 32 // self._threads)
            kernels.launch("march_pixels", blocks, self._threads, 0, [march, at, *ends])
            self.device.wait()

    def _sent(
        self,
        name: str,
        array: npt.NDArray[Any],
        fetching: Fetching | None,
        before: dict[str, _Copy],
    ) -> Memory:
        """A copy of an array on the device: one that was made before, if it may be.

        before: copies that this picture has sent already, by name.
        """
        changes = fetching is not None and name in fetching.fields
        decoded = None
        if fetching is not None and name in ("values", "smooth"):
            decoded = fetching.tiles.decoded.copy()
        copy = before.get(name)
        if copy is None and name in KEPT and not changes:
            copy = self._kept.pop(id(array), None)
        if copy is None:
            copy = _Copy(
                of=weakref.ref(array, self._dropped(id(array))),
                memory=self._made(array.nbytes),
                size=array.nbytes,
            )
            copy.memory.send(array)
        elif fetching is not None and copy.decoded is not None and decoded is not None:
            reach = fetching.reach if name == "smooth" else 0
            for first, stop in fetching.tiles.layers(decoded & ~copy.decoded):
                layers = slice(max(first - reach, 0), stop + reach)
                copy.memory.send(array[layers], offset=layers.start * array.strides[0])
        elif changes or (copy.decoded is not None and not copy.decoded.all()):
            copy.memory.send(array)
        copy.decoded, before[name] = decoded, copy
        if name in KEPT and not changes:
            self._kept[id(array)] = copy
        return copy.memory

    def _dropped(self, key: int) -> Callable[[Any], None]:
        """A function that forgets a copy when its array is gone."""

        def forget(_: Any) -> None:
            self._kept.pop(key, None)

        return forget

    def _made(self, size: int) -> Memory:
        """Memory of the device, for which the arrays leave that were used least recently."""
        while True:
            held = sum(copy.size for copy in list(self._kept.values()))
            try:
                if not self._kept or held + size <= self._limit:
                    return self.device.memory(size)
            except MemoryError:
                if not self._kept:
                    raise
            self._kept.popitem(last=False)


def _bands(fields: Mapping[str, Any], network: bool) -> list[tuple[int, int]]:
    """Warps of a picture in parts, (first, stop), each of about SAMPLES samples at most."""
    across, down = (-(-int(fields[name]) // side) for name, side in TILE.items())
    box, spacing = np.asarray(fields["box"]), np.abs(np.asarray(fields["spacing"]))
    longest = float(np.linalg.norm((box[:, 1] - box[:, 0]) * spacing)) / float(fields["step"])
    most = SAMPLES / (32 * int(fields["rays"]) ** 2 * max(longest, 1.0) * (8 if network else 1))
    each, warps = max(1, int(min(most, across * down))), across * down
    return [(first, min(first + each, warps)) for first in range(0, warps, each)]


class DeviceNetwork:
    """A network at one time on a device.

    Attributes:
        constants: of the kernels.
    """

    def __init__(
        self,
        device: Device,
        network: Network,
        nodes: NetworkNodes,
        shares: Sequence[float],
        constants: Mapping[str, int],
    ) -> None:
        """Take over the tables around the time; shares: of the second node of each level."""
        self.constants, self._nodes, self._device = constants, nodes, device
        self._shares = shares
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
