"""`fhash bench train`: engines on a series with a feature and whole, in turns.

A busy machine treats all of them alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from math import prod
from typing import Any

import torch

from fhash_codec.bench.decode import bench_decode
from fhash_codec.bench.machine import machine
from fhash_codec.bench.train.made import DEFAULT, is_made, made_series
from fhash_codec.bench.train.peak import Peaks
from fhash_codec.bench.train.points import bench_points
from fhash_codec.bench.train.run import EngineRun, Variant
from fhash_codec.config import ENGINES, EncodeConfig
from fhash_codec.devices import choose_device, threads_for
from fhash_codec.features.bricks import Coreset
from fhash_codec.features.selection import Source, open_source
from fhash_codec.native.network import machine_paths
from fhash_codec.paper.encode import select
from fhash_codec.paper.engines.native import refusal
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.train import plan_training
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.series import Series

__all__ = ["bench_train"]

TURNS = 10
"""Turns over which each engine's time is spread, and points of its curve."""
INFER_SECONDS = 0.12
"""Seconds of evaluation in each turn."""


def bench_train(
    source: Source | None = None,
    config: EncodeConfig | None = None,
    *,
    engines: Sequence[str] = (),
    seconds: float = 12.0,
    bricks: Sequence[int] = (),
    whole: bool = True,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure engines on the coreset of a series.

    A series with a feature is measured a second time without it: bricks around a feature are
    partly empty. Each engine trains for `seconds` in turns with the others, evaluates samples in
    each turn, and its quality is measured after each. It does so in one thread, and in as many as
    there are; the native engine in one thread for each of the processor's instructions, too. The
    learning rate falls to zero over each engine's own seconds. docs/json.md says what the result
    holds.

    Args:
        source: the series, or `generated:NAME` for one of `MADE`; None for a blast's shell.
        config: the settings; a made series has a feature of its own where they name none.
        engines: names of the engines; all that take the model if empty.
        seconds: training of each engine: seconds of processors, on a GPU those that pass.
        bricks: bricks of a training step, each measured; empty for the batch of `config`.
        whole: whether a series with a feature is measured without it, too.
        progress: called with each step of the work.

    Raises:
        InputError: an engine is unknown or does not take the model, or the seconds or bricks are
            not positive.
    """
    config = config or EncodeConfig(profile="paper")
    if seconds <= 0 or min(bricks, default=1) < 1:
        raise InputError(
            f"seconds is {seconds:g}, bricks are {list(bricks)}; positive numbers are needed"
        )
    device = choose_device(config.device)
    peaks = Peaks(device)
    peaks.measure()
    name = DEFAULT if source is None else source
    if is_made(name):
        scene, made = made_series(str(name))
        if made.feature and config.features == ("all",):
            config = replace(config, features=(scene.scene.feature,))
        opened: AbstractContextManager[Series] = nullcontext(scene)
    else:
        opened = open_source(name)
    configs = [config]
    if whole and config.features != ("all",):
        configs.append(replace(config, features=("all",)))
    with opened as series:
        results = [
            _measured(series, each, engines, seconds, number, peaks, device, progress)
            for each in configs
            for number in bricks or (0,)
        ]
    return {
        "series": results,
        "peaks": peaks.to_json(),
        "machine": machine() | _torch_on(device),
    }


def _measured(
    series: Series,
    config: EncodeConfig,
    engines: Sequence[str],
    seconds: float,
    bricks: int,
    peaks: Peaks,
    device: torch.device,
    progress: Progress,
) -> dict[str, Any]:
    """Return an entry of `series`; arguments as in `bench_train`, `bricks` of one step."""
    selected = select(series, config, progress)
    coreset, architecture = selected.coreset, selected.architecture
    samples = len(coreset.values)
    plan = plan_training(
        coreset,
        epochs=1,
        learning_rate=config.learning_rate,
        schedule="constant",
        batch=round(bricks * samples / len(coreset.bricks)) or config.batch,
        seed=config.seed,
    )
    with threads_for(plan.batch_samples) as most:
        threads = sorted({1, most}) if device.type == "cpu" else [most]
        runs = [
            EngineRun(variant, architecture, coreset, plan, seconds, device)
            for variant in _variants(engines, architecture, threads, device)
        ]
        for turn in range(TURNS):
            peaks.measure()
            for number, run in enumerate(runs):
                run.train(seconds / TURNS)
                run.infer(INFER_SECONDS)
                label = run.variant.label
                progress("measuring", turn * len(runs) + number + 1, TURNS * len(runs), label)
        results = [run.result(architecture, peaks) for run in runs]
    _compare(results)
    _, layers = runs[0].engine.parameters().dense(architecture)
    numpy_layers = [(weight.numpy(), bias.numpy()) for weight, bias in layers]
    return {
        "series": f"{series.source} {series.name}",
        "features": [str(feature) for feature in selected.features],
        "samples": samples,
        "batch_samples": samples / plan.batches,
        "batch_bricks": len(coreset.bricks) / plan.batches,
        "brick_fill": samples / (len(coreset.bricks) * prod(coreset.brick_shape)),
        **_sizes(coreset, architecture),
        "engines": results,
        "points": bench_points(architecture, numpy_layers, threads),
        **bench_decode(architecture, coreset, numpy_layers),
    }


def _sizes(coreset: Coreset, architecture: Architecture) -> dict[str, int]:
    """Return bytes: those of the samples, and of the model as float16 without further coding."""
    return {
        "sample_bytes": coreset.values.nbytes,
        "parameters": architecture.parameters,
        "float16_bytes": 2 * architecture.parameters,
    }


def _variants(
    engines: Sequence[str],
    architecture: Architecture,
    threads: Sequence[int],
    device: torch.device,
) -> list[Variant]:
    """Return the engines to measure, in the order of their names."""
    unknown = sorted(set(engines) - set(ENGINES))
    if unknown:
        raise InputError(f"unknown engine '{unknown[0]}'; known: {', '.join(ENGINES)}")
    reason = refusal(architecture, device)
    if reason is not None and "native" in engines:
        raise InputError(f"the engine 'native' does not take this model: {reason}")
    variants = []
    for name in engines or ENGINES:
        if name == "fused" and not engines and device.type != "cuda":
            continue
        if name != "native":
            variants += [Variant(name, number) for number in threads]
        elif reason is None:
            best, *others = machine_paths()
            variants += [Variant(name, number, best) for number in threads]
            variants += [Variant(name, 1, path) for path in others]
    return variants


def _compare(results: list[dict[str, Any]]) -> None:
    """Add ratios over the slab engine in as many threads, and over one thread of the same engine.

    Those over the slab engine are of seconds of processors; None without it.
    """
    for result in results:
        slab = _first(results, engine="slab", threads=result["threads"]) or _first(
            results, engine="slab"
        )
        for kind in ("train", "infer"):
            rate = f"{kind}_msamples_cpu_s"
            result[f"{kind}_ratio"] = result[rate] / slab[rate] if slab else None
        one = _first(results, engine=result["engine"], path=result["path"], threads=1)
        result["thread_ratio"] = (
            result["train_msamples_s"] / one["train_msamples_s"]
            if one and one is not result
            else None
        )


def _first(results: list[dict[str, Any]], **facts: Any) -> dict[str, Any] | None:
    """Return the first result with some facts; None where there is none."""
    return next(
        (result for result in results if all(result[key] == fact for key, fact in facts.items())),
        None,
    )


def _torch_on(device: torch.device) -> dict[str, Any]:
    """Describe torch and the device that it computes on."""
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
