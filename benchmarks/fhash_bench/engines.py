"""Training engines under measurement: clocks, peaks of the machine, and slices of training."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Annotated, Any, TypedDict

import numpy as np
import torch

from fhash_codec.devices import computing_threads
from fhash_codec.features.bricks import Coreset
from fhash_codec.native import network as native
from fhash_codec.paper.engines import ENGINES, Engine, make_engine
from fhash_codec.paper.engines.native import NativeEngine
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import Probe, TrainingPlan

SHORTEST = 1e-9
"""Seconds that a measured piece of work takes at least: a clock may stand still for a short one."""


@dataclass(frozen=True)
class Spent:
    """Seconds of a piece of work.

    Attributes:
        wall: seconds that passed.
        cpu: seconds that processors worked for this process.
    """

    wall: float = 0.0
    cpu: float = 0.0

    def __add__(self, other: Spent) -> Spent:
        return Spent(self.wall + other.wall, self.cpu + other.cpu)

    def __sub__(self, other: Spent) -> Spent:
        return Spent(self.wall - other.wall, self.cpu - other.cpu)

    def on(self, device: str) -> float:
        """Seconds that count on a type of device: those of processors, but on a GPU wall time."""
        return max(self.cpu if device == "cpu" else self.wall, SHORTEST)


def now() -> Spent:
    """Return both clocks."""
    return Spent(time.perf_counter(), time.process_time())


def wait(device: torch.device) -> None:
    """Wait until a device has done its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


GOALS = (40.0, 50.0)
"""Qualities in dB whose seconds are told."""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """The quality of a model in training."""

    seconds: Annotated[float, "of training until then"]
    cpu_seconds: Annotated[float, "of training until then"]
    epochs: Annotated[float, "passes over the coreset until then"]
    psnr: Annotated[float | None, "dB on bricks of the coreset; null for an exact model"]


def seconds_to(curve: Sequence[CurvePoint], psnr: float) -> CurvePoint | None:
    """Return the first point of a curve that reaches a quality in dB; None if none does."""
    return next((point for point in curve if point.psnr is None or point.psnr >= psnr), None)


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
    """The best of several measurements of a rate."""

    what: Annotated[str, "`multiply-adds`, `matrix product` or `copy`"]
    path: Annotated[str | None, "instructions of the processor; null where a library chooses them"]
    precision: Annotated[str | None, "number type; null for copies"]
    clock: Annotated[str, "`cpu`, seconds of a processor, or `events`, of the GPU"]
    gflops: Annotated[float | None, "10^9 operations a second; null for copies"] = None
    gb_s: Annotated[float | None, "10^9 bytes a second, both ways; null for arithmetic"] = None


class Peaks:
    """The peaks of a `device`, measured a little at a time, in turns with what is held to them."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._paths = native.machine_paths() if device.type == "cpu" else []
        self.peaks = [
            Peak(what="multiply-adds", path=name, precision="float32", clock="cpu", gflops=0.0)
            for name in self._paths
        ]
        clock = "cpu" if device.type == "cpu" else "events"
        if device.type == "cuda":
            self.peaks += [
                Peak(what="matrix product", path=None, precision=name, clock=clock, gflops=0.0)
                for name in PRECISIONS
            ]
        self.peaks.append(Peak(what="copy", path=None, precision=None, clock=clock, gb_s=0.0))
        numbers = COPY_BYTES // 8
        self._from = torch.ones(numbers, dtype=torch.float32, device=device)
        self._to = torch.zeros_like(self._from)

    def measure(self) -> None:
        """Measure every rate once more, in one thread; the best counts."""
        with computing_threads(1):
            for number, path in enumerate(self._paths):
                self._raise(number, "gflops", self._fma(path))
            if self.device.type == "cuda":
                for number, precision in enumerate(PRECISIONS):
                    self._raise(number, "gflops", self._matrix_product(precision))
            self._raise(len(self.peaks) - 1, "gb_s", self._copy())

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
        a, b = (torch.rand(size, size, device=self.device) for _ in range(2))
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
        if self.device.type == "cpu":
            begun = now()
            np.copyto(self._to.numpy(), self._from.numpy())
            return moved / (now() - begun).on("cpu")
        return moved / _device_seconds(lambda: self._to.copy_(self._from))


def _device_seconds(work: Any) -> float:
    """Seconds of some work on the current CUDA device."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    work()
    end.record()
    torch.cuda.synchronize()
    return float(begin.elapsed_time(end)) / 1e3


WARM_UP_STEPS = 4
"""First steps of an engine, whose fastest foretells the number of all steps."""
SHORTEST_STEP = 1e-6
"""Seconds of a step at least: a clock may stand still for a short one."""
PROBE_BRICKS = 128
"""Bricks on which the quality is measured."""
ADAM_BYTES = 6 * 4
"""Bytes that a step of Adam moves for a number: itself and two moments, read and written."""


@dataclass(frozen=True)
class Variant:
    """An engine as it is measured.

    Attributes:
        engine: its name.
        threads: threads that it computes with.
        path: instructions of the processor; None where the engine does not choose.
    """

    engine: str
    threads: int
    path: str | None = None

    @property
    def label(self) -> str:
        """A short name."""
        words = [self.engine, self.path or "", f"{self.threads} threads" * (self.threads > 1)]
        return " ".join(filter(None, words))

    def make(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: np.ndarray[Any, np.dtype[np.float64]],
        *,
        seed: int,
        device: torch.device,
    ) -> Engine:
        """Return a new engine; arguments as in `make_engine`."""
        if self.path is not None:
            return NativeEngine(architecture, coreset, rates, seed=seed, path=self.path)
        return make_engine(architecture, coreset, rates, seed=seed, device=ENGINES[self.engine])


@dataclass
class Slices:
    """Work of one kind in slices of time.

    Attributes:
        spent: seconds of all slices.
        wall: samples a second that passed, of each slice.
        cpu: samples a second of processors, of each slice.
    """

    spent: Spent = field(default_factory=Spent)
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)

    def add(self, samples: int, spent: Spent) -> None:
        """Count a slice; one without samples does not count."""
        if samples:
            self.spent = self.spent + spent
            self.wall.append(samples / spent.on("wall"))
            self.cpu.append(samples / spent.on("cpu"))


class Reached(TypedDict):
    """When a training first reached a quality."""

    psnr: Annotated[float, "dB"]
    seconds: Annotated[float | None, "that passed; null where it was not reached"]
    cpu_seconds: Annotated[float | None, "of processors"]


class EngineFigures(TypedDict):
    """Figures of an engine, medians over the turns."""

    engine: Annotated[str, "its name"]
    threads: Annotated[int, "threads that it computed with"]
    path: Annotated[str | None, "instructions that the native engine used; null for the others"]
    train_msamples_s: Annotated[float, "training, 10^6 samples a second that passed"]
    train_msamples_cpu_s: Annotated[float, "the same, a second of processors"]
    infer_msamples_s: Annotated[float, "evaluation, 10^6 samples a second that passed"]
    infer_msamples_cpu_s: Annotated[float, "the same, a second of processors"]
    thread_ratio: Annotated[float | None, "training, over that of one thread"]
    fraction_of_peak: Annotated[float, "three products of the network over the peak"]
    infer_fraction_of_peak: Annotated[float, "one product, in evaluation"]
    fraction_of_bandwidth: Annotated[float, "bytes that training moves at least, over a copy"]
    psnr: Annotated[float | None, "dB on some bricks of the coreset; null for an exact model"]
    epochs: Annotated[float, "that it reached"]
    seconds: Annotated[float, "of training that passed"]
    cpu_seconds: Annotated[float, "of training, of processors"]
    seconds_to: Annotated[list[Reached], "when it first reached a quality"]
    curve: Annotated[list[dict[str, Any]], list[CurvePoint], "its quality after each turn"]


class EngineRun:
    """One engine in training on a coreset.

    Attributes:
        variant: the engine.
        engine: its state.
        training, evaluation: what was measured.
        curve: its quality over the seconds of the training.
    """

    def __init__(
        self,
        variant: Variant,
        architecture: Architecture,
        coreset: Coreset,
        plan: TrainingPlan,
        seconds: float,
        device: torch.device,
    ) -> None:
        self.variant, self.coreset, self.plan, self.device = variant, coreset, plan, device
        self.training, self.evaluation = Slices(), Slices()
        self.curve: list[CurvePoint] = []
        self._probe = Probe(coreset, PROBE_BRICKS)
        self._counts = np.diff(coreset.offsets)

        def engine(rates: np.ndarray[Any, np.dtype[np.float64]]) -> Engine:
            return variant.make(architecture, coreset, rates, seed=plan.seed, device=device)

        rate = float(plan.rates[-1])
        steps = max(1, round(seconds / self._step_seconds(engine, rate)))
        # Longer than that, so that turns that run faster than the first step find a rate as well.
        rates = np.full(8 * steps + 1, 0.0)
        rates[: steps + 1] = rate * (0.5 + 0.5 * np.cos(np.pi * np.arange(steps + 1) / steps))
        self.engine = engine(rates)
        self._last = len(rates) - 1

    def _step_seconds(self, engine: Callable[..., Engine], rate: float) -> float:
        """Seconds of a step: the schedule needs the number of steps that fit in the time.

        First steps, not counted, tell. The fastest counts: a step on which the machine stalled
        would foretell far too few.
        """
        first = engine(np.full(WARM_UP_STEPS + 1, rate))
        taken = []
        with computing_threads(self.variant.threads):
            for chosen in self.plan.order(0)[:WARM_UP_STEPS]:
                begun = now()
                first.train(chosen)
                wait(self.device)
                taken.append((now() - begun).on(self.device.type))
        return max(min(taken), SHORTEST_STEP)

    def train(self, seconds: float) -> None:
        """Go on with the training for some seconds, and measure the quality then."""
        samples, begun, spent = 0, now(), Spent()
        with computing_threads(self.variant.threads):
            while spent.on(self.device.type) < seconds and self.engine.step < self._last:
                epoch, batch = divmod(self.engine.step, self.plan.batches)
                if batch == 0 or samples == 0:
                    batches = self.plan.order(epoch)
                self.engine.train(batches[batch])
                wait(self.device)
                samples += int(self._counts[batches[batch]].sum())
                spent = now() - begun
        self.training.add(samples, spent)  # none where the schedule ended in an earlier turn
        self.curve.append(
            CurvePoint(
                seconds=self.training.spent.wall,
                cpu_seconds=self.training.spent.cpu,
                epochs=self.engine.step / self.plan.batches,
                psnr=self._probe.psnr(self.engine),
            )
        )

    def infer(self, seconds: float) -> None:
        """Evaluate batches of bricks for some seconds."""
        self.engine.settle()
        batches = self.plan.order(0)
        samples, number, begun, spent = 0, 0, now(), Spent()
        with computing_threads(self.variant.threads):
            while spent.on(self.device.type) < seconds or number == 0:
                chosen = batches[number % len(batches)]
                self.engine.infer(chosen)
                wait(self.device)
                samples, number = samples + int(self._counts[chosen].sum()), number + 1
                spent = now() - begun
        self.evaluation.add(samples, spent)

    def result(self, architecture: Architecture, peaks: Peaks) -> dict[str, Any]:
        """Return the figures of the engine; those beside other engines are added later."""
        flops = 2 * sum(outputs * inputs for outputs, inputs in architecture.layer_shapes)
        moved = ADAM_BYTES * architecture.embedding_size + 4
        on_cpu = self.device.type == "cpu"
        train, infer = (
            median(slices.cpu if on_cpu else slices.wall)
            for slices in (self.training, self.evaluation)
        )
        peak, last = peaks.flops(self.variant.path), self.curve[-1]
        return {
            **asdict(self.variant),
            "train_msamples_s": median(self.training.wall) / 1e6,
            "train_msamples_cpu_s": median(self.training.cpu) / 1e6,
            "infer_msamples_s": median(self.evaluation.wall) / 1e6,
            "infer_msamples_cpu_s": median(self.evaluation.cpu) / 1e6,
            "fraction_of_peak": train * 3 * flops / peak,
            "infer_fraction_of_peak": infer * flops / peak,
            "fraction_of_bandwidth": train * moved / peaks.bytes,
            "psnr": last.psnr,
            "epochs": last.epochs,
            "seconds": last.seconds,
            "cpu_seconds": last.cpu_seconds,
            "seconds_to": [_reached(self.curve, goal) for goal in GOALS],
            "curve": [asdict(point) for point in self.curve],
        }


def _reached(curve: list[CurvePoint], goal: float) -> Reached:
    """Return when a curve reached a quality in dB."""
    point = seconds_to(curve, goal)
    return {
        "psnr": goal,
        "seconds": None if point is None else point.seconds,
        "cpu_seconds": None if point is None else point.cpu_seconds,
    }
