"""One engine under measurement: slices of training and evaluation, and its quality between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any

import numpy as np
import torch

from fhash_codec.bench.train.clock import Spent, now, wait
from fhash_codec.bench.train.curves import GOALS, CurvePoint, seconds_to
from fhash_codec.bench.train.peak import Peaks
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines import Engine, make_engine
from fhash_codec.paper.engines.native import NativeEngine
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import Probe, TrainingPlan

__all__ = ["EngineRun", "Variant"]

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
            return NativeEngine(
                architecture, coreset, rates, seed=seed, device=device, path=self.path
            )
        return make_engine(self.engine, architecture, coreset, rates, seed=seed, device=device)


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
        with self._threads():
            for chosen in self.plan.order(0)[:WARM_UP_STEPS]:
                begun = now()
                first.train(chosen)
                wait(self.device)
                taken.append((now() - begun).on(self.device.type))
        return max(min(taken), SHORTEST_STEP)

    def train(self, seconds: float) -> None:
        """Go on with the training for some seconds, and measure the quality then."""
        samples, begun, spent = 0, now(), Spent()
        with self._threads():
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
        with self._threads():
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

    def _threads(self) -> _Threads:
        return _Threads(self.variant.threads)


class _Threads:
    """A context in which torch computes with a number of threads."""

    def __init__(self, threads: int) -> None:
        self._threads, self._before = threads, torch.get_num_threads()

    def __enter__(self) -> None:
        torch.set_num_threads(self._threads)

    def __exit__(self, *_: object) -> None:
        torch.set_num_threads(self._before)


def _reached(curve: list[CurvePoint], goal: float) -> dict[str, float | None]:
    """Return when a curve reached a quality in dB."""
    point = seconds_to(curve, goal)
    return {
        "psnr": goal,
        "seconds": None if point is None else point.seconds,
        "cpu_seconds": None if point is None else point.cpu_seconds,
    }
