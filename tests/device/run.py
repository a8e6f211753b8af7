"""Figures that only a machine with a GPU gives: `make device`, or run.py FOLDER (see the GPU page).

It takes at most 7 minutes and needs no network; selftest needs zarr, for which wheels in a folder
on PYTHONPATH will do. Each part is a process of its own with a limit in seconds, so that one that
hangs or breaks the device leaves time to the others, and keeps what it has. FOLDER/figures.json is
written anew after each part. Whatever fails or is left out makes the exit code 1.

Parts, the most important first:
- machine: device, software, peaks, seconds to start CUDA
- oracle: gradients, values and bits of fused and native, against the naive engine in float64
- speed: training and evaluation by model and batch, steps one after another, and memory
- curve: PSNR against seconds of training
- card: the commands encode, diff and render (pictures and a film), on the device
- points: places in a network by fused kernels and on the host
- selftest: `fhash selftest`, whose trainings choose the device

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
from datetime import UTC, datetime
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / name) for name in ("", "formats", "cli", "benchmarks", "tests/device")]
sys.path.append(str(ROOT / "tests" / "codec"))  # the readable paper
FHASH = "import sys; from fhash_cli.main import main; sys.argv[0] = 'fhash'; sys.exit(main())"
"""Program of the command line, which need not be installed."""
TOTAL_SECONDS = 410.0
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
        self.side = 16 if quick else 160
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
        from fhash_codec.cuda.nvrtc import find_nvrtc

        nvrtc = find_nvrtc()
        found |= {"nvrtc": f"{nvrtc.path} {nvrtc.version}", "cuda": str(torch.version.cuda)}
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


def coreset_of(series: Any, feature: str, dilation: int = 1) -> Any:
    """Return the coreset of all steps of a series."""
    from fhash_codec.config import EncodeConfig
    from fhash_codec.paper.encode import select
    from fhash_codec.progress import silent

    config = EncodeConfig(
        preset="published", tables="float16", features=(feature,), dilation=dilation
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

    noise = ArraySeries(np.random.default_rng(3).random((3, 9, 20, 35), dtype=np.float32))
    coreset = coreset_of(noise, "interval:0.3:1", dilation=0)
    every, rates = np.arange(len(coreset.bricks)), np.full(9, 0.01)
    for width, layers in (*MODELS, (64, 0)):
        model = architecture_of(coreset, width, layers)
        naive = NaiveEngine(model, coreset, rates, seed=1)
        naive.train(every)
        layer_gradients = [
            torch.column_stack([weight.grad, bias.grad]).flatten()
            for weight, bias in zip(naive.model.weights, naive.model.biases, strict=True)
        ]
        tables = torch.cat([table.grad.flatten() for table in list(naive.model.tables)[1:]])
        for name in run.engines:
            make = partial(make_engine, model, coreset, rates, seed=1, device=run.device_of(name))
            result: Result = {"engine": name, "model": f"{width}x{layers}"}
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
    options = ["--preset=published", "--tables=float16", "-v"]
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


def points(run: Run) -> Iterator[Result]:
    """Measure places in networks, in the order of rays and at random; compare the kernels."""
    from network_points import measured_points

    yield from measured_points(run.device, run.shape, run.side, run.seconds / 2)


def selftest(run: Run) -> Iterator[Result]:
    """Return what does not hold in `fhash selftest`, whose trainings choose the device."""
    found = fhash(["selftest", *run.cases], allowed=(0, 1))
    wrong = [
        {"case": case["name"], **finding}
        for case in found["cases"]
        for finding in case["findings"]
        if not finding["holds"]
    ]
    result = {"cases": len(found["cases"]), "call_s": found["call_s"]}
    yield result if found["holds"] else result | {"failed": wrong}


def fhash(words: list[str], allowed: tuple[int, ...] = (0,)) -> dict[str, Any]:
    """Run the command line; return what it prints as JSON, and `call_s`, its seconds in all."""
    begun = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", FHASH, *words, "--json"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": ":".join(sys.path)},
        check=False,
    )
    # A warning says that kernels cannot be had, which a user may overlook.
    if done.returncode not in allowed or "cannot be had" in done.stderr:
        raise RuntimeError(f"fhash {' '.join(words)}: exit {done.returncode}: {done.stderr[-800:]}")
    print(done.stderr, end="", file=sys.stderr)
    return {**json.loads(done.stdout), "call_s": time.perf_counter() - begun}


PARTS: dict[str, tuple[Callable[[Run], Iterator[Result]], float]] = {
    "machine": (machine, 60.0),
    "oracle": (oracle, 100.0),
    "speed": (speed, 170.0),
    "curve": (curve, 90.0),
    "card": (card, 120.0),
    "points": (points, 40.0),
    "selftest": (selftest, 150.0),
}
"""The parts and their limits in seconds."""


if __name__ == "__main__":
    sys.exit(main())
