"""The peaks of the machine: arithmetic and copies of memory, by the clocks of the engines.

The arithmetic of a CPU is that of fused multiply-adds in registers, by the native library, for each
of the machine's instructions. That of a GPU is torch's matrix product, timed by its events.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from fhash_codec.bench.train.clock import now
from fhash_codec.native import network as native

__all__ = ["Peak", "Peaks"]

FMA_ROUNDS = 400_000
"""Rounds of multiply-adds of a measurement, some tens of milliseconds."""
COPY_BYTES = 1 << 27
"""Bytes that are copied in a measurement, more than a cache holds."""
GPU_SIZE = 8192
"""Side of the matrices multiplied on a GPU: smaller ones do not keep it busy."""
PRECISIONS = ("float32", "tf32")
"""Precisions of matrix products on a GPU."""
GPU_PRODUCTS = 10
"""Products of a measurement on a GPU."""


@dataclass(kw_only=True)
class Peak:
    """The best of several measurements of a rate.

    Attributes:
        what: `multiply-adds`, `matrix product` or `copy`.
        path: instructions of the processor; None where a library chooses them.
        precision: number type; None for copies.
        clock: `cpu`, seconds of one thread's processor, or `events`, seconds of the GPU.
        gflops: 10^9 floating-point operations a second, two for a multiply-add; None for copies.
        gb_s: 10^9 bytes a second, read and written; None for arithmetic.
    """

    what: str
    path: str | None
    precision: str | None
    clock: str
    gflops: float | None = None
    gb_s: float | None = None


class Peaks:
    """The peaks of a device, measured a little at a time, in turns with what is held to them."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._paths = native.machine_paths() if device.type == "cpu" else []
        self.peaks = [_multiply_adds(name) for name in self._paths]
        if device.type == "cuda":
            self.peaks += [_product(name) for name in PRECISIONS]
        self.peaks.append(
            Peak(
                what="copy", path=None, precision=None, gb_s=0.0,
                clock="cpu" if device.type == "cpu" else "events",
            )
        )  # fmt: skip
        numbers = COPY_BYTES // 8
        self._from = torch.ones(numbers, dtype=torch.float32, device=device)
        self._to = torch.zeros_like(self._from)

    def measure(self) -> None:
        """Measure every rate once more, in one thread; the best counts."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            for number, path in enumerate(self._paths):
                self._raise(number, "gflops", self._fma(path))
            if self._device.type == "cuda":
                for number, precision in enumerate(PRECISIONS):
                    self._raise(number, "gflops", self._matrix_product(precision))
            self._raise(len(self.peaks) - 1, "gb_s", self._copy())
        finally:
            torch.set_num_threads(threads)

    def flops(self, path: str | None = None) -> float:
        """Operations a second of some instructions of the processor; None for the best."""
        peak = next((peak for peak in self.peaks if path and peak.path == path), self.peaks[0])
        assert peak.gflops is not None
        return 1e9 * peak.gflops

    @property
    def bytes(self) -> float:
        """Bytes a second of a copy, read and written."""
        rate = self.peaks[-1].gb_s
        assert rate is not None
        return 1e9 * rate

    def to_json(self) -> list[dict[str, Any]]:
        """Return the peaks as records."""
        return [asdict(peak) for peak in self.peaks]

    def _raise(self, number: int, name: str, rate: float) -> None:
        peak = self.peaks[number]
        setattr(peak, name, max(getattr(peak, name), rate / 1e9))

    def _fma(self, path: str) -> float:
        begun = now()
        done = native.library().fhash_network_fma(native.PATHS[path], FMA_ROUNDS)
        return float(done) / (now() - begun).on("cpu")

    def _matrix_product(self, precision: str) -> float:
        """Operations a second of torch's matrix product."""
        size = GPU_SIZE
        a, b = (torch.rand(size, size, device=self._device) for _ in range(2))
        allowed = torch.backends.cuda.matmul.allow_tf32
        torch.backends.cuda.matmul.allow_tf32 = precision == "tf32"
        try:
            torch.mm(a, b)
            seconds = _device_seconds(lambda: [torch.mm(a, b) for _ in range(GPU_PRODUCTS)])
        finally:
            torch.backends.cuda.matmul.allow_tf32 = allowed
        return GPU_PRODUCTS * 2 * size**3 / seconds

    def _copy(self) -> float:
        """Bytes a second of a copy, read and written."""
        moved = 2 * self._from.element_size() * self._from.numel()
        if self._device.type == "cpu":
            begun = now()
            np.copyto(self._to.numpy(), self._from.numpy())
            return moved / (now() - begun).on("cpu")
        return moved / _device_seconds(lambda: self._to.copy_(self._from))


def _multiply_adds(path: str) -> Peak:
    return Peak(what="multiply-adds", path=path, precision="float32", clock="cpu", gflops=0.0)


def _product(precision: str) -> Peak:
    return Peak(what="matrix product", path=None, precision=precision, clock="events", gflops=0.0)


def _device_seconds(work: Any) -> float:
    """Seconds of some work on the current CUDA device."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))  # type: ignore[no-untyped-call]
    begin.record()
    work()
    end.record()
    torch.cuda.synchronize()
    return float(begin.elapsed_time(end)) / 1e3
