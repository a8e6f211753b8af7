"""Figures that only a machine with a GPU can give: `python tests/device/run.py FOLDER`.

It takes at most 8 minutes and needs no network. Each part writes FOLDER/figures.json anew, with the
parts before it, so that a run that is cut off leaves what it has. A part that fails is recorded
with its error, and makes the exit code 1. Pictures and selftest need zarr and its requirements and
are left out, with the reason, where they are missing; wheels in a folder on PYTHONPATH will do.

Parts: oracle (gradients and values of fused and slab against the naive engine in float64), speed
(steps one after another, without waiting for each), points (places in a network by fused kernels
and on the host: how far apart, and how many a second), bench (`fhash bench train`), curve (PSNR
against seconds of training), pictures (adaptive ray marching through the network), selftest.

`--device cpu --quick` tries the script itself without a GPU; its figures mean nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import tomllib
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / name) for name in ("", "formats", "cli", "benchmarks", "tests/device")]
sys.path.append(str(ROOT / "tests" / "codec"))  # the readable paper
NEEDED = ("zarr", "numcodecs")
"""Packages without which no file can be written."""
FHASH = "import sys; from fhash_cli.main import main; sys.argv[0] = 'fhash'; sys.exit(main())"
"""Program of the command line, which need not be installed."""
TOTAL_SECONDS = 460.0
"""Seconds after which no further part begins."""


class Sizes:
    """Sizes of a run."""

    def __init__(self, quick: bool) -> None:
        self.shape = (2, 12, 16, 20) if quick else (8, 96, 128, 128)
        self.batches = (1 << 12,) if quick else (1 << 16, 1 << 18, 1 << 20)
        self.seconds = 0.2 if quick else 4.0
        self.curve_seconds = 0.5 if quick else 15.0
        self.pixels = 32 if quick else 1024
        self.epochs = 1 if quick else 20
        self.side = 16 if quick else 160


def main() -> int:
    """Run the parts; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="tiny sizes: tries the script")
    parser.add_argument("--parts", help="only these, separated by commas")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    try:
        version("fhash")
    except PackageNotFoundError:
        sys.path.append(str(described(options.folder / "site")))
    parts: dict[str, Callable[..., Any]] = {
        "oracle": oracle,
        "speed": speed,
        "points": points,
        "bench": bench,
        "curve": curve,
        "pictures": pictures,
        "selftest": selftest,
    }
    chosen = options.parts.split(",") if options.parts else list(parts)
    begun, failed = time.monotonic(), False
    figures: dict[str, Any] = {"machine": machine(options.device)}
    for name in chosen:
        part_begun = time.monotonic()
        left = TOTAL_SECONDS - (part_begun - begun)
        try:
            if left < 0:
                raise TimeoutError(f"not begun: {TOTAL_SECONDS:.0f} seconds are over")
            result = parts[name](options.device, Sizes(options.quick), options.folder, left)
        except Exception as error:
            traceback.print_exc()
            result, failed = {"error": f"{type(error).__name__}: {error}"}, True
        figures[name] = {"figures": result, "seconds": time.monotonic() - part_begun}
        print(name, json.dumps(figures[name]), flush=True)
        (options.folder / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return int(failed)


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


def machine(device: str) -> dict[str, Any]:
    """Describe the device and the software."""
    import torch

    found = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": sys.version.split()[0],
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
    }
    if device == "cuda":
        from fhash_codec.paper.engines.fused.program import Unavailable, find_nvrtc

        try:
            nvrtc = find_nvrtc()
            compiler = f"{nvrtc.path} {nvrtc.version}"
        except Unavailable as error:
            compiler = str(error)
        found |= {"nvrtc": compiler, "cuda": str(torch.version.cuda)}
    return found


def engine_names(device: str) -> tuple[str, ...]:
    """Return the engines that are measured."""
    return ("fused", "slab") if device == "cuda" else ("slab",)


def gather(series: Any, feature: str = "all", **model: int) -> tuple[Any, Any]:
    """Return coreset and architecture of all key frames of a series."""
    from fhash_codec.config import EncodeConfig
    from fhash_codec.paper.encode import select
    from fhash_codec.progress import silent

    config = EncodeConfig(profile="paper", features=(feature,), **model)
    selected = select(series, config, silent)
    return selected.coreset, selected.architecture


def oracle(device: str, sizes: Sizes, folder: Path, left: float) -> list[dict[str, Any]]:
    """Compare a step and the values of each engine with the naive engine in float64, on the CPU.

    The mean of the gradients after the first step is a tenth of the gradient.
    """
    import torch
    from readable_paper import NaiveEngine

    from fhash_codec.paper.engines import make_engine
    from fhash_formats.series import ArraySeries

    noise = ArraySeries(np.random.default_rng(3).random((3, 9, 20, 35), dtype=np.float32))
    results = []
    for width, layers in ((64, 1), (64, 2), (128, 2), (16, 1), (64, 0)):
        coreset, architecture = gather(
            noise, "interval:0.3:1", width=width, hidden_layers=layers, dilation=0
        )
        every, rates = np.arange(len(coreset.bricks)), np.full(9, 0.01)
        naive = NaiveEngine(architecture, coreset, rates, seed=1)
        naive.train(every)
        layer_gradients = [
            torch.column_stack([weight.grad, bias.grad]).flatten()
            for weight, bias in zip(naive.model.weights, naive.model.biases, strict=True)
        ]
        tables = torch.cat([table.grad.flatten() for table in list(naive.model.tables)[1:]])
        for name in engine_names(device):
            engine: Any = make_engine(
                name, architecture, coreset, rates, seed=1, device=torch.device(device)
            )
            engine.train(every)
            used = engine.upsampling.used.cpu()
            expected = torch.cat([tables[used], *layer_gradients]).numpy()
            apart = np.abs(10 * engine.flat_mean.cpu().numpy() - expected) / np.abs(expected).max()
            values = np.abs(engine.infer(every).cpu().numpy() - naive.infer(every).numpy())
            results.append(
                {
                    "engine": name,
                    "model": f"{width}x{layers}",
                    "gradient_median": float(np.median(apart)),
                    "gradient_beyond_1e-5": float((apart > 1e-5).mean()),
                    "value_median": float(np.median(values)),
                    "value_beyond_1e-3": float((values > 1e-3).mean()),
                }
            )
    wrong = [r for r in results if r["gradient_median"] > 1e-7 or r["gradient_beyond_1e-5"] > 1e-3]
    if wrong:
        raise AssertionError(f"gradients differ from the oracle's: {wrong}")
    return results


def speed(device: str, sizes: Sizes, folder: Path, left: float) -> list[dict[str, Any]]:
    """Measure training and evaluation, steps one after another, without waiting for each."""
    import torch

    from fhash_codec.paper.engines import make_engine
    from fhash_codec.paper.train import plan_training
    from fhash_codec.simulation.simulate import simulate

    series, results = simulate("front", sizes.shape), []
    wait = torch.cuda.synchronize if device == "cuda" else (lambda: None)

    def measured(do: Callable[[Any], Any], batches: list[Any], counts: Any) -> float:
        for chosen in batches[:4]:
            do(chosen)
        wait()
        begun, samples = time.perf_counter(), 0
        while time.perf_counter() - begun < sizes.seconds / 4:
            for chosen in batches[:64]:
                do(chosen)
                samples += int(counts[chosen].sum())
            wait()
        return samples / (time.perf_counter() - begun) / 1e6

    for layers in (1, 2):
        coreset, architecture = gather(series, hidden_layers=layers, width=64)
        counts = np.diff(coreset.offsets)
        for batch in sizes.batches:
            plan = plan_training(
                coreset, epochs=1, learning_rate=0.01, schedule="constant", batch=batch, seed=0
            )
            for name in engine_names(device):
                engine = make_engine(
                    name,
                    architecture,
                    coreset,
                    np.full(1 << 20, 0.001),
                    seed=0,
                    device=torch.device(device),
                )
                batches = plan.order(0)
                train = measured(engine.train, batches, counts)
                engine.settle()
                results.append(
                    {
                        "engine": name,
                        "model": f"64x{layers}",
                        "batch": plan.batch_samples,
                        "train_msamples_s": train,
                        "infer_msamples_s": measured(engine.infer, batches, counts),
                    }
                )
    return results


def points(device: str, sizes: Sizes, folder: Path, left: float) -> list[dict[str, Any]]:
    """Measure places in networks, in the order of rays and at random; compare the kernels."""
    from network_points import measured_points

    return measured_points(device, sizes.shape, sizes.side, sizes.seconds / 8)


def bench(device: str, sizes: Sizes, folder: Path, left: float) -> Any:
    """Return what `fhash bench train` prints as JSON."""
    words = ["bench", "train", "--device", device, "--json", "-q"]
    words += ["--seconds", "0.2" if sizes.pixels < 100 else "6"]
    words += ["--engines", ",".join(engine_names(device))]
    return json.loads(fhash(words, left))


def curve(device: str, sizes: Sizes, folder: Path, left: float) -> list[dict[str, Any]]:
    """Train for some seconds with each engine; the history has PSNR against seconds."""
    import torch

    from fhash_codec.paper.engines import make_engine
    from fhash_codec.paper.train import Breaks, TrainingProgress, plan_training, train
    from fhash_codec.simulation.simulate import simulate

    series, results = simulate("front", sizes.shape), []
    for layers in (1, 2):
        coreset, architecture = gather(series, hidden_layers=layers, width=64)
        plan = plan_training(
            coreset, epochs=sizes.epochs, learning_rate=0.01, schedule="cosine", batch=0, seed=0
        )
        for name in engine_names(device):
            begun = time.perf_counter()
            engine = make_engine(
                name, architecture, coreset, plan.rates, seed=0, device=torch.device(device)
            )
            ready, reached = time.perf_counter() - begun, TrainingProgress()
            train(engine, plan, coreset, reached, Breaks(budget_seconds=sizes.curve_seconds))
            results.append(
                {
                    "engine": name,
                    "model": f"64x{layers}",
                    "samples": len(coreset.values),
                    "seconds_to_start": ready,
                    "history": reached.history,
                    "seconds_to": {
                        level: next(
                            (p["seconds"] for p in reached.history if (p["psnr"] or 200) >= level),
                            None,
                        )
                        for level in (30, 40, 50)
                    },
                }
            )
    return results


def pictures(device: str, sizes: Sizes, folder: Path, left: float) -> Any:
    """Encode a made series and march through its network on the device."""
    if missing := missing_packages():
        return {"left_out": f"missing: {missing}"}
    begun = time.monotonic()
    data, run = folder / "front.npy", folder / "front.fhz"
    from fhash_codec.simulation.simulate import simulate

    series = simulate("front", sizes.shape)
    np.save(data, np.stack([series.read(step) for step in range(2)]))
    words = [
        "encode",
        str(data),
        "-o",
        str(run),
        "--profile",
        "paper",
        "--device",
        device,
        "--force",
    ]
    fhash([*words, "-q", "--epochs", str(min(sizes.epochs, 5)), "--hidden-layers", "1"], left)
    results = {}
    for march in ("arm", "stream"):
        words = ["render", str(run), "-o", str(folder / f"{march}.png"), "--force", "-q", "--json"]
        words += ["--march", march, "--device", device, "--explain"]
        words += ["--size", f"{sizes.pixels}x{sizes.pixels}"]
        left_now = left - (time.monotonic() - begun)
        results[march] = json.loads(fhash(words, left_now))
    data.unlink()
    return results


def selftest(device: str, sizes: Sizes, folder: Path, left: float) -> Any:
    """Return what does not hold in `fhash selftest`, whose trainings choose the device."""
    if missing := missing_packages():
        return {"left_out": f"missing: {missing}"}
    words = ["selftest", "--json", "-q"]
    if sizes.pixels < 100:
        words += ["--case", "layers"]
    found = json.loads(fhash(words, left))
    failed = [
        {"case": case["name"], **finding}
        for case in found["cases"]
        for finding in case["findings"]
        if not finding["holds"]
    ]
    return {"holds": found["holds"], "cases": len(found["cases"]), "failed": failed}


def missing_packages() -> str:
    """Return the packages that writing files needs and that are not here."""
    return ", ".join(name for name in NEEDED if find_spec(name) is None)


def fhash(words: list[str], seconds: float) -> str:
    """Run the command line; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-c", FHASH, *words],
        capture_output=True,
        text=True,
        timeout=max(seconds, 1),
        env={**os.environ, "PYTHONPATH": ":".join(sys.path)},
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"fhash {' '.join(words)}: exit {done.returncode}: {done.stderr[-800:]}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
