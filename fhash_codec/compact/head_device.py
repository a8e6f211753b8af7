"""Training of a head on a CUDA device: the numbers of native/train_head.cpp, bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from functools import cache, partial
from pathlib import Path

import numpy as np

from fhash_codec.compact.head_training import (
    BLOCK_VOXELS,
    ERROR_UNIT,
    Batches,
    Learn,
    Network,
    native_learner,
)
from fhash_codec.cuda.declarations import ffi
from fhash_codec.cuda.device import Device, Memory, first_device, sent
from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.devices import first_line
from fhash_formats.errors import InputError
from fhash_formats.support.values import Double
from fhash_formats.transform.head import INPUTS

KERNELS = Path(__file__).parents[1] / "cuda" / "head.cu"
"""File of the kernels."""
EACH_ROUNDED = ("--fmad=false",)
"""Options of their compiler."""
# head.cu has the same numbers.
THREADS = 256
"""Threads of a block."""
VOXELS = 32
"""Voxels of a block."""
GROUPS = 6
"""Weights and biases of each layer."""


def learner_on(device: str) -> Callable[[Batches], Learn]:
    """Return the learner of `train_head` on a device, 'cpu' or 'cuda', with the same bits.

    It, and what it returns, raise InputError where the kernels cannot run on CUDA.
    """
    if device == "cpu":
        return native_learner
    with _needed():
        return partial(device_learner, first_device())


def device_learner(device: Device, voxels: Batches) -> Learn:
    """Return what learns from some batches by the kernels of a device.

    The host queues two launches for each update, and waits once for all. The first updates of new
    kernels are done by the CPU, too, and compared.
    """
    with _needed():
        kernels = device.load(KERNELS.read_text(encoding="utf-8"), options=EACH_ROUNDED)
    arrays = voxels.inputs, voxels.targets, voxels.lowest, voxels.highest, voxels.weights
    on_device = [sent(device, array) for array in arrays]
    batches, blocks = voxels.inputs.shape[:2]

    @cache
    def held(number: int) -> tuple[Memory, Memory]:
        """The state of a network with some parameters, and the sums of its slopes."""
        return device.memory(24 * number), device.memory(16 * number)

    def learn(network: Network, first: int, rates: Double, roots: Double, rounded: bool) -> None:
        number, expected = len(network.parameters), None
        if kernels.new:
            expected = deepcopy(network)
            native_learner(voxels)(expected, first, rates, roots, rounded)
        numbers = np.stack([network.parameters, network.means, network.squares])
        state, sums = held(number)
        state.send(numbers)
        sums.clear()
        voxels_at = [ffi.new("CUdeviceptr *", memory.address) for memory in on_device]
        state_at, sums_at = (ffi.new("CUdeviceptr *", memory.address) for memory in (state, sums))
        widths = [ffi.new("int *", width) for width in network.widths]
        count, as_in_file, update = (ffi.new("int *", n) for n in (batches, rounded, first))
        per_voxel = ffi.new("double *", 2 / (ERROR_UNIT * blocks * BLOCK_VOXELS))
        rate, root = ffi.new("double *"), ffi.new("double *")
        slopes = (*voxels_at, state_at, sums_at, count, *widths, as_in_file, update)
        step = (state_at, sums_at, *widths, update, per_voxel, rate, root)
        tiles, tile_bytes = blocks * BLOCK_VOXELS // VOXELS, _tile_bytes(network.widths)
        parts, norm_bytes = -(-number // THREADS), 8 * (number + THREADS)
        for update[0], (rate[0], root[0]) in enumerate(zip(rates, roots, strict=True), first):
            kernels.launch("head_slopes", tiles, THREADS, tile_bytes, slopes)
            kernels.launch("head_step", parts, THREADS, norm_bytes, step)
        state.receive(numbers)
        network.parameters[:], network.means[:], network.squares[:] = numbers
        if expected is not None:
            ours = expected.parameters, expected.means, expected.squares
            if not all(map(np.array_equal, numbers, ours)):
                raise Unavailable("its kernels have trained another MLP than the CPU")
            kernels.keep()

    return _needed()(learn)


@contextmanager
def _needed() -> Iterator[None]:
    """Raise InputError where CUDA fails while the context lasts."""
    try:
        yield
    except Unavailable as error:
        raise InputError(f"device is 'cuda', but {first_line(error)}; use --device cpu") from error


def _tile_bytes(widths: tuple[int, int]) -> int:
    """Return the bytes of `Tile` in head.cu."""
    first, second = widths
    quads = [-(-width // 4) for width in widths]
    weights = INPUTS * quads[0] + first * quads[1] + second * quads[0]
    doubles = first + second + 1 + GROUPS + GROUPS * 32
    rows = INPUTS + 1 + first + 1 + second + 1 + first + second + 1
    return 16 * weights + 8 * doubles + 4 * (second + rows * (VOXELS + 1))
