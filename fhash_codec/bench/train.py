"""`fhash bench train`: engines on a series with a feature and whole, in turns.

A busy machine treats all of them alike.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from math import prod
from statistics import median
from typing import Any

import numpy as np
import torch

from fhash_codec.bench.decode import bench_decode
from fhash_codec.bench.machine import machine
from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.coreset.selection import Source, open_source
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import engines_on, make_engine
from fhash_codec.paper.selection import select
from fhash_codec.paper.training.probe import Probe
from fhash_codec.paper.training.train import TrainingPlan, plan_training
from fhash_codec.progress import Progress, silent
from fhash_codec.simulation.simulate import simulate
from fhash_codec.training.devices import choose_device
from fhash_codec.training.threads import threads_for
from fhash_formats.errors import InputError
from fhash_formats.series import Series

TURNS = 3
"""Turns over which each engine's time is spread."""
WARM_UP_STEPS = 4
"""First steps of an engine, whose fastest foretells the number of all steps."""
SHORTEST_STEP = 1e-6
"""Seconds of a step at least: a clock may stand still for a short one."""
MADE = "front"
"""Scene of the made series."""
MADE_SHAPE = (8, 32, 64, 64)
"""Shape (t, z, y, x) of the made series."""
INFER_SECONDS = 1.0
"""Seconds of evaluation in each turn."""


def bench_train(
    source: Source | None = None,
    config: EncodeConfig | None = None,
    *,
    engines: Sequence[str] | None = None,
    seconds: float = 12.0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure engines on the coreset of a series.

    A series with a feature is measured a second time without it: bricks around a feature are
    partly empty. Each engine trains for `seconds` in three turns, and evaluates samples in each.
    The result has the keys `series`, a list, and `machine`. An entry of `series` has `series` (its
    name), `features`, `samples`, `batch_samples`, `brick_fill`, the share of samples among the
    vertices of bricks, `decode_msamples_s` and `decode_ratio` (`bench_decode`), and `engines`. An
    entry of `engines`:

    - `train_msamples_s`, `infer_msamples_s`: coreset vertices, in 10^6 a second, medians over the
      turns.
    - `train_ratio`, `infer_ratio`: speeds over those of the naive engine in the same run.
    - `fraction_of_peak`: arithmetic of the MLP alone over the rate of a large float32 matrix
      product.
    - `psnr`: dB on the coreset after those seconds, of normalised values. The learning rate falls
      to zero over each engine's own seconds.
    - `epochs`, `seconds`: of training.

    Args:
        source: the series; None for a made one, a blast's shell.
        config: the settings; the made series has a feature of its own where they name none.
        engines: names of the engines; None for all that the device has.
        seconds: training of each engine.
        progress: called with each step of the work.

    Raises:
        InputError: an engine is unknown, or the seconds are not positive.
    """
    config = config or EncodeConfig(profile="paper")
    device = choose_device(config.device)
    engines = engines_on(device) if engines is None else engines
    if seconds <= 0 or not engines:
        raise InputError(
            f"seconds is {seconds:g} for {len(engines)} engines;"
            " a positive time and at least one engine are needed"
        )
    if source is None:
        scene = simulate(MADE, MADE_SHAPE)
        source = scene
        if config.features == ("all",):
            config = replace(config, features=(scene.scene.feature,))
    configs = [config]
    if config.features != ("all",):
        configs.append(replace(config, features=("all",)))
    with open_source(source) as series:
        results = [
            _measured(series, config, engines, seconds, device, progress) for config in configs
        ]
    return {"series": results, "machine": machine() | _torch_on(device)}


def _measured(
    series: Series,
    config: EncodeConfig,
    engines: Sequence[str],
    seconds: float,
    device: torch.device,
    progress: Progress,
) -> dict[str, Any]:
    """Return an entry of `series`; arguments as in `bench_train`."""
    selected = select(series, config, progress)
    coreset, architecture = selected.coreset, selected.architecture
    plan = plan_training(
        coreset,
        epochs=1,
        learning_rate=config.learning_rate,
        schedule="constant",
        batch=config.batch,
        seed=config.seed,
    )
    with threads_for(plan.batch_samples):
        runs = [_Run(engine, architecture, coreset, plan, seconds, device) for engine in engines]
        for turn in range(TURNS):
            for number, run in enumerate(runs):
                run.train(seconds / TURNS)
                run.infer(INFER_SECONDS)
                progress("measuring", turn * len(runs) + number + 1, TURNS * len(runs), run.name)
        peak = matrix_product_rate(device)
        flops = 3 * 2 * sum(outputs * inputs for outputs, inputs in architecture.layer_shapes)
        results = [run.result(flops, peak) for run in runs]
    naive = next((result for result in results if result["engine"] == "naive"), None)
    for result in results:
        for kind in ("train", "infer"):
            result[f"{kind}_ratio"] = (
                result[f"{kind}_msamples_s"] / naive[f"{kind}_msamples_s"] if naive else None
            )
    _, layers = runs[-1].engine.parameters().dense(architecture)
    return {
        "series": f"{series.source} {series.name}",
        "features": [str(feature) for feature in selected.features],
        "samples": len(coreset.values),
        "batch_samples": len(coreset.values) / plan.batches,
        "brick_fill": len(coreset.values) / (len(coreset.bricks) * prod(coreset.brick_shape)),
        "engines": results,
        "matrix_product_gflops": peak / 1e9,
        **bench_decode(
            architecture, coreset, [(weight.numpy(), bias.numpy()) for weight, bias in layers]
        ),
    }


def _torch_on(device: torch.device) -> dict[str, Any]:
    """Describe torch and the device that it computes on."""
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }


class _Run:
    """One engine under measurement."""

    def __init__(
        self,
        name: str,
        architecture: Architecture,
        coreset: Coreset,
        plan: TrainingPlan,
        seconds: float,
        device: torch.device,
    ) -> None:
        self.name, self.coreset, self.plan, self.device = name, coreset, plan, device
        self.counts = np.diff(coreset.offsets)
        # First steps, not counted, tell how many steps fit in the time; the schedule needs that.
        # The fastest counts: a step on which the machine stalled would foretell far too few.
        rate = float(plan.rates[-1])
        engine = make_engine(
            name,
            architecture,
            coreset,
            np.full(WARM_UP_STEPS + 1, rate),
            seed=plan.seed,
            device=device,
        )
        taken = []
        for chosen in self.plan.order(0)[:WARM_UP_STEPS]:
            begun = time.perf_counter()
            engine.train(chosen)
            self._wait()
            taken.append(time.perf_counter() - begun)
        steps = max(1, round(seconds / max(min(taken), SHORTEST_STEP)))
        # Longer than that, so that turns that run faster than the first step find a rate as well.
        self.rates = np.full(8 * steps + 1, 0.0)
        self.rates[: steps + 1] = rate * (0.5 + 0.5 * np.cos(np.pi * np.arange(steps + 1) / steps))
        self.engine = make_engine(
            name, architecture, coreset, self.rates, seed=plan.seed, device=device
        )
        self.train_speeds: list[float] = []
        self.infer_speeds: list[float] = []
        self.seconds = 0.0

    def train(self, seconds: float) -> None:
        """Go on with the training for some seconds."""
        samples, begun = 0, time.perf_counter()
        last = len(self.rates) - 1
        while (spent := time.perf_counter() - begun) < seconds and self.engine.step < last:
            epoch, batch = divmod(self.engine.step, self.plan.batches)
            if batch == 0 or samples == 0:
                batches = self.plan.order(epoch)
            self.engine.train(batches[batch])
            self._wait()
            samples += int(self.counts[batches[batch]].sum())
        if samples:  # none where the schedule has come to its end in an earlier turn
            self.seconds += spent
            self.train_speeds.append(samples / spent)

    def infer(self, seconds: float) -> None:
        """Evaluate batches of bricks for some seconds."""
        self.engine.settle()
        samples, begun, batches = 0, time.perf_counter(), self.plan.order(0)
        number = 0
        while (spent := time.perf_counter() - begun) < seconds or number == 0:
            chosen = batches[number % len(batches)]
            self.engine.infer(chosen)
            self._wait()
            samples, number = samples + int(self.counts[chosen].sum()), number + 1
        self.infer_speeds.append(samples / spent)

    def result(self, flops: int, peak: float) -> dict[str, Any]:
        train = median(self.train_speeds)
        return {
            "engine": self.name,
            "train_msamples_s": train / 1e6,
            "infer_msamples_s": median(self.infer_speeds) / 1e6,
            "fraction_of_peak": train * flops / peak,
            "psnr": Probe(self.coreset, 256).psnr(self.engine),
            "epochs": self.engine.step / self.plan.batches,
            "seconds": self.seconds,
        }

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def matrix_product_rate(device: torch.device, size: int = 1536) -> float:
    """Arithmetic operations a second of a float32 matrix product of `size`, the best of five."""
    a, b = torch.rand(size, size, device=device), torch.rand(size, size, device=device)
    best = float("inf")
    for _ in range(6):
        begun = time.perf_counter()
        float((a @ b)[0, 0])
        best = min(best, time.perf_counter() - begun)
    return 2 * size**3 / best
