"""Figures that only a machine with a GPU gives: `make device`, or run.py FOLDER (see the GPU page).

It takes at most 8 minutes and needs no network; selftest needs zarr, for which wheels in a folder
on PYTHONPATH will do. Each part is a process of its own with a limit in seconds, so that one that
hangs or breaks the device leaves time to the others, and keeps what it has. FOLDER/figures.json is
written anew after each part. Whatever fails or is left out makes the exit code 1.

Parts, the most important first:
- machine: device, software, seconds to start CUDA with and without torch, peaks
- pictures: the marcher's kernels against the CPU's pictures, milliseconds, and a film, of a default
  and a published file of 256^3
- oracle: gradients, values and bits of fused and native, against the naive engine in float64, also
  between sparse key frames
- head: updates of the default's MLP, by kernels and by the CPU, and whether their bits are the same
- speed: training and evaluation by model and batch, steps one after another, and memory
- curve: PSNR against seconds of training
- card: the commands encode, diff and render (pictures and a film), on the device
- selftest: `fhash selftest`, whose trainings choose the device and whose pictures it draws

`--device cpu --quick` tries the script itself without a GPU; its figures mean nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / name) for name in ("", "formats", "cli", "benchmarks")]
sys.path.append(str(ROOT / "tests" / "codec"))  # the readable paper
FHASH = "import sys; from fhash_cli.main import main; sys.argv[0] = 'fhash'; sys.exit(main())"
"""Program of the command line, which need not be installed."""
START = """
import json, time
begun = time.perf_counter()
from fhash_codec.cuda.device import first_device
imported = time.perf_counter()
device = first_device()
device.memory(1 << 20).clear()
device.wait()
started = time.perf_counter()
print(json.dumps({"import_ours_s": imported - begun, "start_ours_s": started - imported}))
"""
"""Program that starts CUDA as a picture does, without torch."""
TOTAL_SECONDS = 470.0
"""Seconds of all parts."""
MODELS = ((64, 1), (64, 2), (16, 1), (128, 2))
"""Width and hidden layers of the measured models."""

Result = dict[str, Any]
"""A result of a part; the key `failed` says what is wrong with it."""


class Run:
    """The settings of a run, and the folders that it writes to."""

    def __init__(self, options: argparse.Namespace, work: Path) -> None:
        quick = options.quick
        self.device, self.folder, self.work = options.device, options.folder, work
        self.on_cuda = self.device == "cuda"
        self.engines = ("fused", "native") if self.on_cuda else ("native",)
        self.shape = (2, 12, 16, 20) if quick else (8, 96, 128, 128)
        self.batches = (1 << 12,) if quick else (1 << 16, 1 << 14, 1 << 18, 1 << 20)
        self.seconds = 0.05 if quick else 0.5
        self.curve_seconds = 0.5 if quick else 15.0
        self.pixels = 32 if quick else 1024
        self.epochs = 1 if quick else 20
        self.side = 24 if quick else 256
        self.frames = 3 if quick else 24
        self.cases = ["--case", "layers"] if quick else []

    @property
    def data(self) -> Path:
        """A made series, which takes seconds to simulate and is kept for all parts."""
        from fhash_codec.simulation.simulate import simulate

        path = self.work / "front.npy"
        if not path.exists():
            series = simulate("front", self.shape)
            np.save(path, np.stack([series.read(step) for step in range(self.shape[0])]))
        return path

    def device_of(self, engine: str) -> str:
        """Return the device of an engine: the native one computes on the CPU."""

        return "cpu" if engine == "native" else self.device

    def wait(self) -> None:
        """Wait until the device has done its work."""
        import torch

        if self.on_cuda:
            torch.cuda.synchronize()


def main() -> int:
    """Run the parts, or one of them in this process; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="tiny sizes: tries the script")
    parser.add_argument("--parts", default=",".join(PARTS), help="only these, with commas between")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        return run_part(options.parts, Run(options, options.work))
    options.folder.mkdir(parents=True, exist_ok=True)
    begun, failed, figures = time.monotonic(), False, {}
    with tempfile.TemporaryDirectory() as work:
        for name in options.parts.split(","):
            part_begun = time.monotonic()
            limit = min(PARTS[name][1], TOTAL_SECONDS - (part_begun - begun))
            results = results_of(name, limit, Path(work))
            failed |= any("failed" in result for result in results)
            seconds = round(time.monotonic() - part_begun, 1)
            figures[name] = {"seconds": seconds, "figures": results}
            (options.folder / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    # Whoever reads the end of a long log sees what counts most.
    for name, part in reversed(figures.items()):
        print(f"== {name}, {part['seconds']} s")
        for result in part["figures"]:
            print(json.dumps(rounded(result)))
    print("FAILED" if failed else "all parts did well")
    return int(failed)


def results_of(name: str, limit: float, work: Path) -> list[Result]:
    """Run a part in a process group of its own; return what it has written until its end."""
    if limit <= 0:
        return [{"failed": f"left out: {TOTAL_SECONDS:.0f} seconds are over"}]
    words = [*sys.argv[1:], "--parts", name, "--work", str(work)]
    child = subprocess.Popen([sys.executable, __file__, *words], process_group=0)
    wrong = ""
    try:
        if code := child.wait(limit):
            wrong = f"exit code {code}"
    except subprocess.TimeoutExpired:
        wrong = f"stopped after {limit:.0f} seconds"
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
    lines = work / f"{name}.jsonl"
    results = (
        [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    )
    if wrong and not any("failed" in result for result in results):
        results.append({"failed": wrong})
    return results


def run_part(name: str, run: Run) -> int:
    """Write the results of a part, each at once; return the exit code."""
    try:
        version("fhash")
    except PackageNotFoundError:
        sys.path.append(str(described(run.work / "site")))
    failed = False
    with (run.work / f"{name}.jsonl").open("w") as lines:

        def write(result: Result) -> None:
            print(name, json.dumps(rounded(result)), flush=True)
            print(json.dumps(result), file=lines, flush=True)

        try:
            for result in PARTS[name][0](run):
                failed |= "failed" in result
                write(result)
        except Exception as error:
            traceback.print_exc()
            write({"failed": short(error)})
            return 1
    return int(failed)


def short(error: Exception) -> str:
    """Return an error in one line."""
    return f"{type(error).__name__}: {error}"[-800:]


def rounded(value: Any) -> Any:
    """Return a result with three digits of each number, and without long lists."""
    if isinstance(value, dict):
        return {name: rounded(inner) for name, inner in value.items() if name != "history"}
    return float(f"{value:.3g}") if isinstance(value, float) else value


def described(folder: Path) -> Path:
    """Write what installations would say of the packages, whose versions are asked for; return it.

    The working tree alone, which is all that a lent machine has, says nothing.
    """
    for file in (ROOT / "pyproject.toml", ROOT / "benchmarks" / "pyproject.toml"):
        project = tomllib.loads(file.read_text())["project"]
        name, number = project["name"], project["version"]
        info = folder / f"{name.replace('-', '_')}-{number}.dist-info"
        info.mkdir(parents=True, exist_ok=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {number}\n")
        points = "".join(
            f"[{group}]\n" + "".join(f"{name} = {place}\n" for name, place in entries.items())
            for group, entries in project["entry-points"].items()
        )
        (info / "entry_points.txt").write_text(points)
    return folder


def machine(run: Run) -> Iterator[Result]:
    """Describe the device and the software; measure the start of CUDA and its peaks."""
    begun = time.perf_counter()
    import torch

    imported = time.perf_counter()
    torch.zeros(1, device=run.device).cpu()
    started = time.perf_counter()
    found = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": sys.version.split()[0],
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name() if run.on_cuda else "cpu",
        "import_torch_s": imported - begun,
        "start_device_s": started - imported,
    }
    if run.on_cuda:
        from fhash_codec.cuda.device import driver
        from fhash_codec.cuda.nvrtc import find_nvrtc

        nvrtc = find_nvrtc(driver().version())
        found |= {"nvrtc": f"{nvrtc.path} {nvrtc.version}", "cuda": str(torch.version.cuda)}
        words = [sys.executable, "-c", START]
        done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment())
        found |= json.loads(done.stdout)
    yield found
    from fhash_bench.engines import Peaks

    for kind in dict.fromkeys(("cpu", run.device)):
        peaks = Peaks(torch.device(kind))
        peaks.measure()
        yield {
            f"{kind} {peak['what']} {peak['path'] or peak['precision']}": peak["gflops"]
            or peak["gb_s"]
            for peak in peaks.to_json()
        }


def coreset_of(series: Any, feature: str, dilation: int = 1, key_frames: str = "all") -> Any:
    """Return the coreset of a series: all steps, or the key frames and samples between them."""
    from fhash_codec.config import EncodeConfig
    from fhash_codec.paper.encode import select
    from fhash_codec.progress import silent

    config = EncodeConfig(
        preset="published",
        tables="float16",
        features=(feature,),
        dilation=dilation,
        key_frames=key_frames,
    )
    return select(series, config, silent).coreset


@cache
def made_coreset(data: Path, feature: str) -> Any:
    """Return the coreset of all steps of the made series."""
    from fhash_formats.series import ArraySeries

    return coreset_of(ArraySeries(np.load(data)), feature)


def architecture_of(coreset: Any, width: int, layers: int) -> Any:
    """Return a model of a coreset with the usual levels."""
    from fhash_codec.paper.network import Architecture

    shape, steps = coreset.box.shape, len(coreset.key_frames)
    return Architecture.for_box(shape, steps, hidden_layers=layers, width=width)


def pictures(run: Run) -> Iterator[Result]:
    """Draw files of a front by kernels and by the CPU: how far apart, how fast, in what memory."""
    from fhash_codec import EncodeConfig, Renderer, Scene, encode, open
    from fhash_codec.simulation.simulate import simulate

    series = simulate("front", (3, *(run.side,) * 3))
    values = np.stack([series.read(step) for step in range(3)])
    published = dict(preset="published", tables="float16", epochs=2, features=("interval:0.05:2",))
    kinds = {"default": EncodeConfig(effort=1), "published": EncodeConfig(**published)}
    surfaces = {"isosurfaces": [{"value": 0.4, "opacity": 0.6}, {"value": 0.7}]}
    lit = {"shading": True, "shadows": True, "ambient_occlusion": True}
    scenes = {"usual": {"shading": True}, "bare": {}, "surfaces": surfaces}
    scenes |= {"light": lit, "maximum": {"maximum_intensity": True}}
    for kind, config in kinds.items():
        path = run.work / f"{kind}.fhz"
        encode(values, path, config)
        for (name, effects), mode in product(scenes.items(), ("cache", "arm")):
            result: Result = {"file": kind, "scene": name, "march": mode}
            drawn = {}
            try:
                for device in dict.fromkeys(("cpu", run.device)):
                    march = {"mode": mode, "device": device, "lod": 0}
                    scene = Scene.from_dict(
                        {"size": [512, 512], "effects": effects, "march": march}
                    )
                    with open(path) as volume:
                        renderer = Renderer(volume)
                        times = {}
                        for turn, step in (("first", 0), ("again", 0), ("third", 0), ("next", 1)):
                            begun = time.perf_counter()
                            image = renderer.render(replace(scene, step=step))
                            times[turn] = round(1000 * (time.perf_counter() - begun), 1)
                    drawn[device], result[f"{device}_ms"] = image.rgba, times
                    result[f"{device}_samples"] = image.counters["samples"]
                    result[f"{device}_evaluations"] = image.counters["evaluations"]
                apart = np.abs(drawn[run.device] - drawn["cpu"])
                result |= {"apart": float(apart.max()), "apart_mean": float(apart.mean())}
                if float(np.quantile(apart, 0.999)) > 5e-4:
                    result["failed"] = "another picture than the CPU's"
            except Exception as error:
                traceback.print_exc()
                result["failed"] = short(error)
            yield result
        yield film_of(run, kind, path)


def film_of(run: Run, kind: str, path: Path) -> Result:
    """Turn the camera around a file: pictures a second, the first left out, and memory."""
    from fhash_codec import Renderer, Scene, open

    with open(path) as volume:
        renderer = Renderer(volume, pictures=run.frames)
        march = {"device": run.device, "mode": "arm" if kind == "published" else "cache", "lod": 0}
        times = []
        for number in range(run.frames):
            camera = {"azimuth": 360 * number / run.frames}
            given = {"size": [512, 512], "step": 0, "camera": camera, "march": march}
            begun = time.perf_counter()
            renderer.render(Scene.from_dict({**given, "effects": {"shading": True}}))
            times.append(time.perf_counter() - begun)
    result = {"file": kind, "film_pictures_s": (run.frames - 1) / sum(times[1:])}
    if run.on_cuda:
        from fhash_codec.cuda.device import first_device

        result["free_mb"] = first_device().free() / 1e6
    return result


def head(run: Run) -> Iterator[Result]:
    """Train MLPs of the default's sizes by kernels and by the CPU."""
    from fhash_codec.compact.head_device import device_learner
    from fhash_codec.compact.head_training import (
        BATCH_VOXELS,
        Batches,
        Network,
        adam_factors,
        native_learner,
    )
    from fhash_formats.transform.head import INPUTS

    random, batches = np.random.default_rng(0), 20
    blocks = BATCH_VOXELS // 64
    voxels = Batches(
        inputs=random.integers(-1024, 1024, (batches, blocks, INPUTS, 64)).astype(np.int16),
        targets=random.integers(-50_000, 50_000, (batches, BATCH_VOXELS)).astype(np.int32),
        lowest=np.full((batches, BATCH_VOXELS), -(1 << 20), np.int32),
        highest=np.full((batches, BATCH_VOXELS), 1 << 20, np.int32),
        weights=random.random((batches, BATCH_VOXELS), np.float32),
    )
    learners = {"cpu": native_learner(voxels)}
    if run.on_cuda:
        from fhash_codec.cuda.device import first_device

        learners["cuda"] = device_learner(first_device(), voxels)
    updates = 40 if run.seconds < 0.1 else 1000
    rates, roots = adam_factors(np.full(updates + 20, 0.01))
    for widths in ((12, 8), (24, 16), (48, 16)):
        result: Result = {"widths": f"{widths[0]}x{widths[1]}"}
        parameters = {}
        for device, learn in learners.items():
            network = Network(widths, np.random.default_rng(1))
            learn(network, 0, rates[:20], roots[:20], False)
            begun = time.perf_counter()
            learn(network, 20, rates[20:], roots[20:], False)
            result[f"{device}_updates_s"] = updates / (time.perf_counter() - begun)
            parameters[device] = network.parameters
        if not all(np.array_equal(each, parameters["cpu"]) for each in parameters.values()):
            result["failed"] = "other bits than the CPU's"
        yield result


def oracle(run: Run) -> Iterator[Result]:
    """Compare a step and the values of each engine with the naive engine in float64, on the CPU.

    The mean of the gradients after the first step is a tenth of the gradient. Two trainings that
    are to have the same bits are compared, too.
    """
    import torch
    from readable_paper import NaiveEngine

    from fhash_codec.devices import same_bits
    from fhash_codec.paper.engines import make_engine
    from fhash_codec.paper.engines.parameters import coarse_axes, used_numbers
    from fhash_formats.series import ArraySeries

    noise = ArraySeries(np.random.default_rng(3).random((4, 9, 20, 35), dtype=np.float32))
    coresets = {
        keys: coreset_of(noise, "interval:0.3:1", dilation=0, key_frames=keys)
        for keys in ("all", "0,3")
    }
    rates = np.full(9, 0.01)
    for (width, layers), (keys, coreset) in product((*MODELS, (64, 0)), coresets.items()):
        every, model = np.arange(len(coreset.bricks)), architecture_of(coreset, width, layers)
        naive = NaiveEngine(model, coreset, rates, seed=1)
        naive.train(every)
        layer_gradients = [
            torch.column_stack([weight.grad, bias.grad]).flatten()
            for weight, bias in zip(naive.model.weights, naive.model.biases, strict=True)
        ]
        coarse = list(naive.model.tables)[coreset.lattice is None :]
        tables = torch.cat([table.grad.flatten() for table in coarse])
        for name in run.engines:
            make = partial(make_engine, model, coreset, rates, seed=1, device=run.device_of(name))
            result: Result = {"engine": name, "model": f"{width}x{layers}", "keys": keys}
            try:
                engine: Any = make()
                engine.train(every)
                used = used_numbers(coarse_axes(model, coreset), coreset, len(tables))[0]
                expected = torch.cat([tables[used], *layer_gradients]).numpy()
                apart = np.abs(10 * engine.state()["flat_mean"] - expected)
                apart /= np.abs(expected).max()
                values = np.abs(engine.infer(every) - naive.infer(every))
                trained = []
                for _ in range(2):
                    with same_bits(run.device, True):
                        engine = make()
                        for _ in range(4):
                            engine.train(every)
                        trained.append(engine.state()["flat"])
                result |= {
                    "gradient_median": float(np.median(apart)),
                    "gradient_beyond_1e-5": float((apart > 1e-5).mean()),
                    "value_median": float(np.median(values)),
                    "value_beyond_1e-3": float((values > 1e-3).mean()),
                    "same_bits": bool(np.array_equal(*trained)),
                }
                if result["gradient_median"] > 1e-7 or result["gradient_beyond_1e-5"] > 1e-3:
                    result["failed"] = "gradients differ from the oracle's"
                elif not result["same_bits"]:
                    result["failed"] = "two trainings differ"
            except Exception as error:
                traceback.print_exc()
                result["failed"] = short(error)
            yield result


def speed(run: Run) -> Iterator[Result]:
    """Measure training and evaluation by model and batch, and what an engine takes of the device.

    An engine that hangs leaves the figures of those before it.
    """
    for name in run.engines:
        for width, layers in MODELS:
            yield measured(run, name, "all", width, layers)
        yield measured(run, name, "interval:0.25:2", 64, 1)


def measured(run: Run, name: str, feature: str, width: int, layers: int) -> Result:
    """Return rates of an engine, 10^6 samples a second by the samples of a batch."""
    import torch

    from fhash_codec.devices import threads_for
    from fhash_codec.paper.engines import make_engine
    from fhash_codec.paper.engines.parameters import needed_bytes
    from fhash_codec.paper.train import plan_training

    coreset = made_coreset(run.data, feature)
    architecture, counts = architecture_of(coreset, width, layers), np.diff(coreset.offsets)
    result: Result = {"engine": name, "model": f"{width}x{layers}", "of": feature}
    result |= {"train": {}, "infer": {}}

    def rate(do: Callable[[Any], Any], batches: list[Any], seconds: float) -> float:
        """Return the rate after a time without measurement, in which graphs are captured."""
        samples, begun, done = 0, 0.0, 0
        for limit in (seconds / 2, seconds):
            samples, begun = 0, time.perf_counter()
            while time.perf_counter() - begun < limit:
                for _ in range(16):
                    chosen, count = batches[done % len(batches)]
                    do(chosen)
                    samples, done = samples + count, done + 1
                run.wait()
        return float(f"{samples / (time.perf_counter() - begun) / 1e6:.4g}")

    try:
        begun = time.perf_counter()
        rates, device = np.full(1 << 18, 0.001), run.device_of(name)
        engine = make_engine(architecture, coreset, rates, seed=0, device=device)
        run.wait()
        result["start_s"] = time.perf_counter() - begun
        for batch in run.batches:
            plan = plan_training(
                coreset, epochs=1, learning_rate=0.001, schedule="constant", batch=batch, seed=0
            )
            # Several epochs: in training, too, few batches are of the same shape as others.
            batches = [
                (chosen, int(counts[chosen].sum()))
                for epoch in range(8)
                for chosen in plan.order(epoch)
            ]
            with threads_for(plan.batch_samples):
                trained = rate(engine.train, batches, run.seconds)
                engine.settle()
                result["train"][plan.batch_samples] = trained
                result["infer"][plan.batch_samples] = rate(engine.infer, batches, run.seconds / 2)
            if device == "cuda" and "device_mb" not in result:
                result["device_mb"] = torch.cuda.max_memory_allocated() / 1e6
                result["expected_mb"] = needed_bytes(architecture, coreset) / 1e6
                if result["device_mb"] > result["expected_mb"]:
                    result["failed"] = "takes more memory than a training is said to need"
    except Exception as error:
        traceback.print_exc()
        result["failed"] = short(error)
    if run.on_cuda:
        torch.cuda.reset_peak_memory_stats()
    return result


def curve(run: Run) -> Iterator[Result]:
    """Train for some seconds with each engine; the history has PSNR against seconds."""
    from fhash_codec.devices import threads_for
    from fhash_codec.paper.engines import make_engine
    from fhash_codec.paper.train import Breaks, TrainingProgress, plan_training, train

    coreset = made_coreset(run.data, "all")
    plan = plan_training(
        coreset, epochs=run.epochs, learning_rate=0.01, schedule="cosine", batch=0, seed=0
    )
    for name, (width, layers) in product(run.engines, MODELS[:2]):
        result: Result = {"engine": name, "model": f"{width}x{layers}"}
        try:
            begun, model = time.perf_counter(), architecture_of(coreset, width, layers)
            engine = make_engine(model, coreset, plan.rates, seed=0, device=run.device_of(name))
            ready, reached = time.perf_counter() - begun, TrainingProgress()
            with threads_for(plan.batch_samples):
                train(engine, plan, coreset, reached, Breaks(budget_seconds=run.curve_seconds))
            history = reached.history
            result |= {"start_s": ready, "seconds": reached.seconds, "epochs": reached.epoch}
            for level in (30, 40, 50):
                result[f"to_{level}_db"] = next(
                    (p["seconds"] for p in history if (p["psnr"] or 200) >= level), None
                )
            result |= {"psnr": history[-1]["psnr"], "history": history}
        except Exception as error:
            traceback.print_exc()
            result["failed"] = short(error)
        yield result


def card(run: Run) -> Iterator[Result]:
    """Encode the made series, decode it, and draw it, as a user does."""
    from PIL import Image

    path, data = run.work / "front.fhz", run.data
    published = ["--preset=published", "--tables=float16"]
    for name, options in (
        ("default", ["--effort=1"]),
        ("sparse keys", [*published, "--key-frames=every:4", "--epochs=2"]),
    ):
        other = run.work / f"{name}.fhz"
        words = ["encode", str(data), "-o", str(other), "-v", "--force", "--device", run.device]
        encoded = fhash([*words, *options])
        trained = fhash(["info", str(other)])["training"]
        result = {"command": f"encode, {name}", "device": trained["device"]}
        result |= {name: encoded[name] for name in ("call_s", "seconds", "psnr", "bytes")}
        result["stages"] = {each["stage"]: each["seconds"] for each in encoded["stages"]}
        if trained["device"] not in (run.device, "none"):
            result["failed"] = f"trained on {trained['device']}"
        yield result
    options = [*published, "-v"]
    words = ["encode", str(data), "-o", str(path), *options]
    encoded = fhash([*words, "--device", run.device, "--epochs", str(run.epochs)])
    trained = fhash(["info", str(path)])["training"]
    result = {
        "command": "encode",
        **{name: trained[name] for name in ("engine", "device")},
        **{name: encoded[name] for name in ("call_s", "seconds", "psnr", "bytes")},
        "stages": {each["stage"]: each["seconds"] for each in encoded["stages"]},
    }
    expected = run.device, "fused" if run.on_cuda else "native"
    if (trained["device"], trained["engine"]) != expected:
        result["failed"] = f"{expected[1]} on {expected[0]} is expected"
    yield result
    compared = fhash(["diff", str(data), str(path)])
    result = {"command": "diff", **{name: compared[name] for name in ("call_s", "seconds", "psnr")}}
    if not abs(compared["psnr"] - encoded["psnr"]) < 0.01:
        result["failed"] = "another PSNR than that of encode"
    yield result
    size = f"{run.pixels}x{run.pixels}"
    drawn = {}
    for march, device in (("arm", run.device), ("stream", run.device), ("arm", "cpu")):
        picture = run.folder / f"{march}-{device}.png"
        words = ["render", str(path), "-o", str(picture), "--force", "--size", size, "--explain"]
        found = fhash([*words, "--march", march, "--device", device])
        result = {"command": march, "device": device}
        result |= {name: found[name] for name in ("call_s", "seconds", "counters")}
        drawn[march] = np.asarray(Image.open(picture).convert("RGB"), np.float64) / 255
        result["mean"] = float(drawn[march].mean())
        first = drawn.setdefault("first", drawn[march])
        result["rms_from_first"] = float(np.sqrt(np.square(drawn[march] - first).mean()))
        if (march, device) == ("arm", "cpu") and result["rms_from_first"] > 0.002:
            result["failed"] = "another picture than on the device"
        yield result
    film, size = run.folder / "film.gif", f"{run.pixels // 2}x{run.pixels // 2}"
    words = ["render", str(path), "-o", str(film), "--force", "--size", size, "--march", "arm"]
    found = fhash([*words, "--device", run.device, "--animate", "time", "--frames", "24"])
    yield {"command": "film", **{name: found[name] for name in ("call_s", "seconds")}}


def selftest(run: Run) -> Iterator[Result]:
    """Return what does not hold in `fhash selftest`; a device draws its pictures, too."""
    program = f"import fhash_codec.rendering.plan as p; p.CUDA_START = -1.0; {FHASH}"
    found = fhash(["selftest", "--processes", "1", *run.cases], allowed=(0, 1), program=program)
    wrong = [
        {"case": case["name"], **finding}
        for case in found["cases"]
        for finding in case["findings"]
        if not finding["holds"]
    ]
    result = {"cases": len(found["cases"]), "call_s": found["call_s"]}
    yield result if found["holds"] else result | {"failed": wrong}


def environment() -> dict[str, str]:
    """Return the environment of a program that imports what this one does."""
    return {**os.environ, "PYTHONPATH": ":".join(sys.path)}


def fhash(
    words: list[str], allowed: tuple[int, ...] = (0,), program: str = FHASH
) -> dict[str, Any]:
    """Run the command line; return what it prints as JSON, and `call_s`, its seconds in all."""
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", program, *words, "--json"],
        capture_output=True,
        text=True,
        env=environment(),
        check=False,
    )
    # Warnings say that a device cannot draw, or a training begin there, which a user may overlook.
    missing = "cannot be had" in done.stderr or "the CPU draws" in done.stderr
    if done.returncode not in allowed or missing:
        raise RuntimeError(f"fhash {' '.join(words)}: exit {done.returncode}: {done.stderr[-800:]}")
    print(done.stderr, end="", file=sys.stderr)
    return {**json.loads(done.stdout), "call_s": time.perf_counter() - begun}


PARTS: dict[str, tuple[Callable[[Run], Iterator[Result]], float]] = {
    "machine": (machine, 60.0),
    "pictures": (pictures, 150.0),
    "oracle": (oracle, 120.0),
    "head": (head, 30.0),
    "speed": (speed, 150.0),
    "curve": (curve, 90.0),
    "card": (card, 120.0),
    "selftest": (selftest, 150.0),
}
"""The parts and their limits in seconds."""


if __name__ == "__main__":
    sys.exit(main())
