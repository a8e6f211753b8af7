"""Training engines on a series in turns, beside what the machine can do: `fhash bench train`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from math import prod
from pathlib import Path
from statistics import median
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt
import torch

from fhash_bench.engines import GOALS, EngineFigures, EngineRun, Peak, Peaks, Variant, now
from fhash_bench.rate.generated import DEFAULT, is_made, made_series
from fhash_codec.boxes import Box, Sizes
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.report import require_matplotlib
from fhash_codec.devices import choose_device, machine, threads_for
from fhash_codec.features.bricks import Coreset
from fhash_codec.features.occupancy import unpack
from fhash_codec.features.selection import Source, open_source
from fhash_codec.native.network import machine_paths
from fhash_codec.paper.encode import select
from fhash_codec.paper.engines import ENGINES
from fhash_codec.paper.engines.native import refusal
from fhash_codec.paper.model import decode_region, sample_points
from fhash_codec.paper.network import Architecture, ArrayTable, Layer, Network
from fhash_codec.paper.train import plan_training
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.series import Series
from fhash_formats.support.values import Mask

POINTS = 1 << 19
"""Points of a measurement."""
RAY_POINTS = 128
"""Points of a ray."""
POINT_TURNS = 2
"""Turns of which the best counts."""

Points = npt.NDArray[np.float64]


class PointRate(TypedDict):
    """Rate of queries at points of one time, the tables read included."""

    order: Annotated[str, "`rays`, one after the other, or `random`"]
    gradient: Annotated[bool, "whether the derivatives were computed too"]
    threads: Annotated[int, "threads"]
    mpoints_s: Annotated[float, "10^6 points a second that passed"]
    mpoints_cpu_s: Annotated[float, "the same, a second of processors"]


def bench_points(
    architecture: Architecture, layers: Sequence[Layer], threads: Sequence[int]
) -> list[PointRate]:
    """Measure `sample_points` at one time between two key frames, reading the tables included.

    The embeddings are random: the time does not depend on them.

    Args:
        architecture: the sizes of the network.
        layers: its layers.
        threads: numbers of threads to measure with.
    """
    random = np.random.default_rng(0)
    size = architecture.embedding_size
    tables = [
        ArrayTable(random.random((*level, size), dtype=np.float32)) for level in architecture.levels
    ]
    network = Network.of(architecture, tables, layers)
    time = 0.37 * (network.key_frames - 1)
    box = architecture.box_size
    results: list[PointRate] = []
    for order, places in (("rays", _rays(box)), ("random", _random(box))):
        for gradient in (False, True):
            for number in threads:
                spent = []
                for _ in range(POINT_TURNS):
                    begun = now()
                    # The two overloads of the function differ in a constant.
                    if gradient:
                        sample_points(network, time, *places, gradient=True, threads=number)
                    else:
                        sample_points(network, time, *places, threads=number)
                    spent.append(now() - begun)
                best = min(spent, key=lambda seconds: seconds.cpu)
                results.append(
                    {
                        "order": order,
                        "gradient": gradient,
                        "threads": number,
                        "mpoints_s": POINTS / best.on("wall") / 1e6,
                        "mpoints_cpu_s": POINTS / best.on("cpu") / 1e6,
                    }
                )
    return results


def _rays(box: Sizes) -> Points:
    """Points (3, n) along straight lines through the box, one line after the other."""
    random = np.random.default_rng(1)
    ends = random.random((2, POINTS // RAY_POINTS, 1, 3))
    along = np.linspace(0, 1, RAY_POINTS)[:, None]
    places = (1 - along) * ends[0] + along * ends[1]
    return np.ascontiguousarray(places.reshape(-1, 3).T) * _last(box)


def _random(box: Sizes) -> Points:
    """Points (3, n) anywhere in the box."""
    return np.random.default_rng(2).random((3, POINTS)) * _last(box)


def _last(box: Sizes) -> Points:
    return np.array(box, np.float64)[:, None] - 1


DECODE_TURNS = 5
"""Turns in which both ways decode."""
KEY_FRAMES = 4
"""Largest number of key frames that are decoded in a turn."""


class _ZeroTable:
    """A `TableSource` of zeros: the time of decoding does not depend on the embeddings."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        """Return zeros float32 in the shape of a region."""
        return np.zeros([axis.stop - axis.start for axis in region], np.float32)


class DecodeRate(TypedDict):
    """Rate of decoding the coreset; medians over the turns."""

    decode_msamples_s: Annotated[float, "decoding of the coreset, 10^6 vertices a second"]
    decode_ratio: Annotated[float, "times as fast as the whole box, evaluated in the same run"]


def bench_decode(
    architecture: Architecture, coreset: Coreset, layers: Sequence[Layer]
) -> DecodeRate:
    """Measure the decoding of key frames: of their coreset alone, and of the whole box, in turns.

    Args:
        architecture: the sizes of the model.
        coreset: the coreset, whose occupancy is decoded.
        layers: weight and bias of each layer.
    """
    size = architecture.embedding_size
    tables = [_ZeroTable((*level, size)) for level in architecture.levels]
    network = Network.of(architecture, tables, layers)
    every = -(-architecture.key_frames // KEY_FRAMES)
    keys = range(0, architecture.key_frames, every)
    masks = [unpack(coreset.occupancy[key], coreset.box.shape) for key in keys]
    boxes = [np.ones_like(mask) for mask in masks]
    vertices = sum(int(np.count_nonzero(mask)) for mask in masks)
    speeds, ratios = [], []
    for _ in range(DECODE_TURNS):
        alone, whole = (_seconds(network, keys, requested) for requested in (masks, boxes))
        speeds.append(vertices / alone)
        ratios.append(whole / alone)
    return {"decode_msamples_s": median(speeds) / 1e6, "decode_ratio": median(ratios)}


def _seconds(network: Network, keys: Sequence[int], requested: Sequence[Mask]) -> float:
    """Return the time of decoding the requested vertices of some key frames."""
    box = Box.of((0, n) for n in network.box_size)
    begun = time.perf_counter()
    for key, mask in zip(keys, requested, strict=True):
        decode_region(network, float(key), box, requested=mask)
    return time.perf_counter() - begun


TURNS = 10
"""Turns over which each engine's time is spread, and points of its curve."""
INFER_SECONDS = 0.12
"""Seconds of evaluation in each turn."""


class TrainSeries(DecodeRate):
    """Figures of a series."""

    series: Annotated[str, "source and variable"]
    features: Annotated[list[str], "the features"]
    samples: Annotated[int, "vertices of the coreset"]
    sample_bytes: Annotated[int, "size of their values"]
    parameters: Annotated[int, "trained numbers of the model"]
    float16_bytes: Annotated[int, "their size as float16, without further coding"]
    batch_samples: Annotated[float, "samples of a batch, the mean"]
    batch_bricks: Annotated[float, "bricks of a batch, the mean"]
    brick_fill: Annotated[float, "share of samples among the vertices of bricks, 0 to 1"]
    engines: Annotated[list[dict[str, Any]], list[EngineFigures], "each engine"]
    points: Annotated[list[PointRate], "queries at points of one time, the tables read included"]


class TrainBench(TypedDict):
    """Figures of engines.

    Seconds of processors are those of all threads of the program together. On a GPU, rates and
    shares are by the time that passes, and peaks by events of the device.
    """

    machine: Annotated[dict[str, Any], "date, command line, processor, load, versions and more"]
    peaks: Annotated[list[dict[str, Any]], list[Peak], "of one thread"]
    series: Annotated[list[TrainSeries], "with features and whole, for each number of bricks"]


def bench_train(
    source: Source | None = None,
    config: EncodeConfig | None = None,
    *,
    engines: Sequence[str] = (),
    seconds: float = 12.0,
    bricks: Sequence[int] = (),
    whole: bool = True,
    progress: Progress = silent,
) -> TrainBench:
    """Measure engines on the coreset of a series.

    A series with a feature is measured a second time without it: bricks around a feature are
    partly empty. Each engine trains for `seconds` in turns with the others, evaluates samples in
    each turn, and its quality is measured after each. It does so in one thread, and in as many as
    there are; the native engine in one thread for each of the processor's instructions, too. The
    learning rate falls to zero over each engine's own seconds.

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
    config = config or EncodeConfig(preset="published", tables="float16")
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
            _measured(series, each, engines, seconds, number, peaks, progress)
            for each in configs
            for number in bricks or (0,)
        ]
    return {
        "series": results,
        "peaks": peaks.to_json(),
        "machine": machine(device) | {"threads": torch.get_num_threads()},
    }


def _measured(
    series: Series,
    config: EncodeConfig,
    engines: Sequence[str],
    seconds: float,
    bricks: int,
    peaks: Peaks,
    progress: Progress,
) -> TrainSeries:
    """Return an entry of `series`; arguments as in `bench_train`, `bricks` of one step."""
    device, selected = peaks.device, select(series, config, progress)
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
    return {
        "series": f"{series.source} {series.name}",
        "features": [str(feature) for feature in selected.features],
        "samples": samples,
        "batch_samples": samples / plan.batches,
        "batch_bricks": len(coreset.bricks) / plan.batches,
        "brick_fill": samples / (len(coreset.bricks) * prod(coreset.brick_shape)),
        "sample_bytes": coreset.values.nbytes,
        "parameters": architecture.parameters,
        "float16_bytes": 2 * architecture.parameters,
        "engines": results,
        "points": bench_points(architecture, layers, threads),
        **bench_decode(architecture, coreset, layers),
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
    reason = refusal(architecture)
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
    """Add ratios over one thread of the same engine."""
    for result in results:
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


COLOURS = {"native": "#d1604b", "fused": "#4a86c0"}
"""Colours by engine."""
STYLES = ("-", "--", ":", "-.")
"""Line styles of an engine's variants."""
CLOCKS = {"cpu_seconds": "seconds of processors", "seconds": "seconds that passed"}
"""Axes of time, by the key of a curve's points."""


def plot(result: TrainBench, path: Path) -> None:
    """Draw a result of `bench_train` as a PNG at `path`: a row for each entry, a panel a clock."""
    figure_module = require_matplotlib()
    entries = result["series"]
    size = (11, 0.6 + 4 * len(entries))
    figure = figure_module.Figure(figsize=size, layout="constrained", dpi=120)
    rows = figure.subplots(len(entries), len(CLOCKS), squeeze=False)
    for row, entry in zip(rows, entries, strict=True):
        for panel, (clock, label) in zip(row, CLOCKS.items(), strict=True):
            _curves(panel, entry, clock)
            panel.set_xlabel(label)
        row[0].set_ylabel("PSNR in the coreset, dB")
        row[0].legend(frameon=False, fontsize=7)
        row[0].set_title(
            f"{', '.join(entry['features'])}, {entry['batch_bricks']:.0f} bricks a step,"
            f" {entry['float16_bytes'] / 1e6:.1f} MB as float16",
            fontsize=9,
            loc="left",
        )
    figure.suptitle(entries[0]["series"], fontsize=10)
    figure.savefig(path, format="png")


def _curves(panel: Any, entry: TrainSeries, clock: str) -> None:
    """Draw a line for each engine that was measured."""
    drawn: dict[str, int] = {}
    for run in entry["engines"]:
        name = run["engine"]
        number = drawn.get(name, 0)
        drawn[name] = number + 1
        points = [point for point in run["curve"] if point["psnr"] is not None]
        panel.plot(
            [point[clock] for point in points],
            [point["psnr"] for point in points],
            color=COLOURS.get(name, "#3b3f46"),
            linestyle=STYLES[number % len(STYLES)],
            marker="o",
            markersize=3,
            label=" ".join(filter(None, [name, run["path"], f"x{run['threads']}"])),
        )
    for goal in GOALS:
        panel.axhline(goal, color="#c9cbd1", linewidth=0.8)
    panel.grid(True, color="#e3e4e8", linewidth=0.8)
    panel.set_axisbelow(True)
