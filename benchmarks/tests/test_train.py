"""`fhash bench train`: engines are measured in turns, by clocks of the wall and of processors."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise, product
from math import prod
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from fhash_bench import train
from fhash_bench.engines import (
    GOALS,
    SHORTEST,
    CurvePoint,
    Peaks,
    Slices,
    Spent,
    Variant,
    now,
    seconds_to,
    wait,
)
from fhash_bench.rate import generated as made
from fhash_bench.train import DECODE_TURNS, TURNS, bench_decode, bench_points, bench_train, plot
from fhash_codec import EncodeConfig
from fhash_codec.features.bricks import build_coreset
from fhash_codec.features.features import FeatureChoice, Interval
from fhash_codec.features.occupancy import unpack
from fhash_codec.features.scan import scan
from fhash_codec.native.network import machine_paths
from fhash_codec.paper.network import Architecture
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


def test_seconds_add_up_by_each_clock() -> None:
    assert Spent(3.0, 2.0) - Spent(1.0, 0.5) + Spent(0.5, 0.5) == Spent(2.5, 2.0)


def test_processors_count_on_a_cpu_and_wall_time_elsewhere() -> None:
    spent = Spent(wall=3.0, cpu=2.0)
    assert (spent.on("cpu"), spent.on("cuda"), spent.on("wall")) == (2.0, 3.0, 3.0)
    assert Spent().on("cpu") == SHORTEST


def test_work_advances_the_clock_of_processors() -> None:
    begun = now()
    while (now() - begun).cpu == 0:
        sum(range(10_000))
    assert (now() - begun).wall > 0


def test_a_cpu_is_not_waited_for() -> None:
    wait(torch.device("cpu"))


def test_the_first_point_that_reaches_a_quality_counts() -> None:
    curve = [
        CurvePoint(seconds=2.0 * n, cpu_seconds=float(n), epochs=1.0, psnr=psnr)
        for n, psnr in enumerate((20.0, 41.0, 39.0, 45.0))
    ]
    reached = seconds_to(curve, 40.0)
    assert reached is curve[1]
    assert seconds_to(curve, 45.0) is curve[3]
    assert seconds_to(curve, 45.1) is None


def test_an_exact_model_reaches_every_quality() -> None:
    exact = CurvePoint(seconds=1.0, cpu_seconds=1.0, epochs=1.0, psnr=None)
    assert seconds_to([exact], 50.0) is exact


CPU = torch.device("cpu")


@pytest.mark.usefixtures("quick")
def test_multiply_adds_are_measured_for_all_instructions() -> None:
    peaks = Peaks(CPU)
    peaks.measure()
    *arithmetic, copy = peaks.to_json()
    assert [peak["path"] for peak in arithmetic] == machine_paths()
    for peak in arithmetic:
        assert (peak["what"], peak["precision"]) == ("multiply-adds", "float32")
        assert peak["gflops"] > 0
        assert peaks.flops(peak["path"]) == 1e9 * peak["gflops"]
    assert peaks.flops() == 1e9 * arithmetic[0]["gflops"]
    assert (copy["what"], copy["gflops"]) == ("copy", None)
    assert peaks.bytes == 1e9 * copy["gb_s"] > 0


@pytest.mark.usefixtures("quick")
def test_the_best_measurement_counts_and_threads_stay() -> None:
    before = torch.get_num_threads()
    peaks = Peaks(CPU)
    peaks.measure()
    first = peaks.bytes
    peaks.peaks[-1].gb_s = 1e6
    peaks.measure()
    assert peaks.bytes == 1e15 > first
    assert torch.get_num_threads() == before


def test_slices_count_by_both_clocks() -> None:
    slices = Slices()
    slices.add(100, Spent(wall=2.0, cpu=1.0))
    slices.add(0, Spent(wall=5.0, cpu=5.0))
    slices.add(300, Spent(wall=2.0, cpu=2.0))
    assert slices.wall == [50.0, 150.0]
    assert slices.cpu == [100.0, 150.0]
    assert slices.spent == Spent(wall=4.0, cpu=3.0)


@pytest.mark.parametrize(
    ("variant", "label"),
    [
        (Variant("fused", 1), "fused"),
        (Variant("fused", 2), "fused 2 threads"),
        (Variant("native", 1, "baseline"), "native baseline"),
    ],
)
def test_a_variant_has_a_short_name(variant: Variant, label: str) -> None:
    assert variant.label == label


def test_both_ways_decode_the_same_key_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock of one second a call to the decoder, two for the whole box."""
    values = np.zeros((7, 8, 40, 70), np.float32)
    values[:, 2:4, 3:5, 1:9] = 1.0
    values[:, 7, 39, 69] = 1.0
    series = ArraySeries(values)
    features = [Interval(0.5, 2.0)]
    coreset = build_coreset(series, scan(series, silent), FeatureChoice(range(7), features), silent)
    box = coreset.box.shape
    architecture = Architecture.for_box(box, 7, width=4)
    layers = [
        (np.ones((out, inputs), np.float32), np.ones(out, np.float32))
        for out, inputs in architecture.layer_shapes
    ]
    seen, now = [], [0.0]

    def decoded(network, key, region, *, requested):
        now[0] += 2.0 if requested.sum() > 33 else 1.0
        seen.append((key, requested))
        assert network.levels == architecture.levels

    monkeypatch.setattr(train, "decode_region", decoded)
    monkeypatch.setattr(train, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    figures = bench_decode(architecture, coreset, layers)
    assert figures["decode_ratio"] == 2.0
    assert figures["decode_msamples_s"] == pytest.approx(33e-6)
    keys = [0.0, 2.0, 4.0, 6.0]
    assert [key for key, _ in seen] == (keys + keys) * DECODE_TURNS
    mask, whole = seen[0][1], seen[4][1]
    np.testing.assert_array_equal(mask, unpack(coreset.occupancy[0], box))
    assert whole.all()


CONFIG = EncodeConfig(preset="published", tables="float16", width=4, hidden_layers=1)


@pytest.fixture
def series(quick: None) -> ArraySeries:
    """A smooth moving field, values -100 .. 200."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 8, 10, 18)), indexing="ij")
    return ArraySeries((100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(np.float32))


def test_every_engine_is_measured_in_turns(series: ArraySeries) -> None:
    calls: list[tuple[Any, ...]] = []
    report = bench_train(series, CONFIG, seconds=0.02, progress=lambda *words: calls.append(words))
    (entry,) = report["series"]
    assert entry["features"] == ["all"]
    engines = [run["engine"] for run in entry["engines"]]
    assert set(engines) == {"native"}
    assert {run["path"] for run in entry["engines"]} == set(machine_paths())
    measured = [words for words in calls if words[0] == "measuring"]
    assert len(measured) == TURNS * len(engines)
    assert [words[3] for words in measured[: len(engines)]] * TURNS == [w[3] for w in measured]
    assert all(later[1] == before[1] + 1 for before, later in pairwise(measured))
    for run in entry["engines"]:
        assert min(run["train_msamples_s"], run["train_msamples_cpu_s"]) > 0
        assert min(run["infer_msamples_s"], run["infer_msamples_cpu_s"]) > 0
        assert min(run["fraction_of_peak"], run["fraction_of_bandwidth"]) > 0
        assert run["epochs"] > 0
        assert np.isfinite(run["psnr"])
        assert len(run["curve"]) == TURNS
        assert run["curve"][-1]["psnr"] == run["psnr"]
        assert [goal["psnr"] for goal in run["seconds_to"]] == list(GOALS)
    assert 0 < entry["batch_samples"] <= entry["samples"] == series.values.size
    assert entry["float16_bytes"] == 2 * entry["parameters"]
    assert entry["sample_bytes"] == 4 * entry["samples"]
    assert min(entry["decode_msamples_s"], entry["decode_ratio"]) > 0
    assert {peak["what"] for peak in report["peaks"]} >= {"copy"}


def test_shares_are_of_the_peak_of_the_same_instructions(series: ArraySeries) -> None:
    report = bench_train(series, CONFIG, seconds=0.01)
    (entry,) = report["series"]
    rates = {peak["path"]: peak["gflops"] for peak in report["peaks"] if peak["gflops"]}
    copies = report["peaks"][-1]["gb_s"]
    levels = entry["engines"][0]["fraction_of_peak"] * 1e9 * next(iter(rates.values()))
    flops = levels / (entry["engines"][0]["train_msamples_cpu_s"] * 1e6)
    for run in entry["engines"]:
        peak = rates.get(run["path"], next(iter(rates.values())))
        rate = run["train_msamples_cpu_s"] * 1e6
        assert run["fraction_of_peak"] == pytest.approx(rate * flops / (peak * 1e9))
        assert run["fraction_of_bandwidth"] == pytest.approx(rate * 52 / (copies * 1e9))
    # Three passes of multiply-adds over weights of 4 neurons and of the output.
    inputs = round(flops) / 6 / 4 - 1
    assert inputs == int(inputs) > 0


def test_a_series_with_a_feature_is_measured_whole_too(series: ArraySeries) -> None:
    feature = f"interval:{np.median(series.values)}:{series.values.max()}"
    config = replace(CONFIG, features=(feature,), dilation=0)
    report = bench_train(series, config, engines=("native",), seconds=0.01)
    sparse, whole = report["series"]
    assert (sparse["features"], whole["features"]) == ([feature], ["all"])
    assert sparse["samples"] < whole["samples"] == series.values.size
    assert sparse["brick_fill"] < whole["brick_fill"]
    report = bench_train(series, config, engines=("native",), seconds=0.01, whole=False)
    assert [entry["features"] for entry in report["series"]] == [[feature]]


def test_bricks_of_a_step_are_measured_each(series: ArraySeries) -> None:
    report = bench_train(series, CONFIG, engines=("native",), seconds=0.01, bricks=(1, 3))
    one, three = report["series"]
    assert one["batch_bricks"] == 1
    assert 2 < three["batch_bricks"] < 4


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("name", [None, "generated:front", "generated:argon"])
def test_generated_series_are_measured(name: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = (2, 8, 16, 16)
    monkeypatch.setattr(
        made, "MADE", {key: replace(it, shape=shape) for key, it in made.MADE.items()}
    )
    entries = bench_train(name, CONFIG, engines=("native",), seconds=0.01)["series"]
    features = [["all"]] if name == "generated:argon" else [["interval:0.25:2"], ["all"]]
    assert [entry["features"] for entry in entries] == features
    assert entries[-1]["samples"] == prod(shape)


def test_several_threads_are_beside_one(
    series: ArraySeries, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train, "threads_for", lambda _: nullcontext_of(2))
    (entry,) = bench_train(series, CONFIG, engines=("native",), seconds=0.01)["series"]
    one, two = entry["engines"][:2]
    assert (one["threads"], two["threads"]) == (1, 2)
    assert one["thread_ratio"] is None
    assert two["thread_ratio"] == two["train_msamples_s"] / one["train_msamples_s"]
    assert {point["threads"] for point in entry["points"]} == {1, 2}


def nullcontext_of(number: int) -> Any:
    from contextlib import nullcontext

    return nullcontext(number)


@pytest.mark.parametrize(
    "request_", [{"seconds": 0.0}, {"engines": ("fast",)}, {"bricks": (64, 0)}], ids=str
)
def test_unsuitable_requests_are_refused(series: ArraySeries, request_: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        bench_train(series, CONFIG, **request_)


def test_a_machine_that_stalls_at_the_first_steps_is_measured_all_the_same(
    series: ArraySeries,
    ticking: Callable[[Iterator[float]], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The clock leaps while an engine warms up; later it crawls, and the schedule runs out."""

    def times() -> Iterator[float]:
        for tick in range(80):
            yield 1000.0 * tick
        tick = 0
        while True:
            tick += 1
            yield 1e6 + tick / 1e6

    ticking(times())
    monkeypatch.setattr(train, "INFER_SECONDS", 1e-5)
    report = bench_train(series, CONFIG, engines=("native",), seconds=0.01)
    run = report["series"][0]["engines"][0]
    assert run["train_msamples_s"] > 0


def test_it_runs_without_zarr() -> None:
    """Machines with a GPU may lack it."""
    code = (
        "import sys; sys.modules['zarr'] = None\n"
        "from fhash_codec import EncodeConfig\n"
        "from fhash_bench.rate import generated as made\n"
        "from fhash_bench.train import bench_train\n"
        "made.MADE = {'front': made.Made('front', (2, 8, 16, 16), '', False)}\n"
        "config = EncodeConfig(preset='published', tables='float16', width=4, hidden_layers=1)\n"
        "print(len(bench_train(None, config, engines=('native',), seconds=0.02)['series']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"]


def run(engine: str, path: str | None) -> dict[str, Any]:
    points = [
        {"seconds": 2.0 * n, "cpu_seconds": float(n), "epochs": 1.0, "psnr": psnr}
        for n, psnr in ((1, 30.0), (2, None), (3, 41.0))
    ]
    return {"engine": engine, "path": path, "threads": 1, "curve": points}


def test_each_entry_has_a_row_of_two_panels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import matplotlib.figure

    figures = []
    original = matplotlib.figure.Figure.savefig

    def savefig(self: Any, *given: Any, **more: Any) -> None:
        figures.append(self)
        original(self, *given, **more)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", savefig)
    entry = {
        "series": "a b", "features": ["all"], "batch_bricks": 64.0, "float16_bytes": 2_000_000,
        "engines": [run("native", "baseline"), run("native", "x86-64-v3"), run("fused", None)],
    }  # fmt: skip
    plot({"series": [entry, entry]}, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    (figure,) = figures
    cpu, wall, *_ = figure.axes
    assert len(figure.axes) == 4
    assert cpu.lines[0].get_xydata().tolist() == [[1, 30], [3, 41]]
    assert wall.lines[0].get_xydata().tolist() == [[2, 30], [6, 41]]
    labels = [line.get_label() for line in cpu.lines][:3]
    assert labels == ["native baseline x1", "native x86-64-v3 x1", "fused x1"]


@pytest.mark.usefixtures("quick")
def test_every_order_is_measured() -> None:
    architecture = Architecture.for_box((5, 6, 7), 3, width=4, hidden_layers=1)
    layers = [
        (np.ones((n, m), np.float32), np.zeros(n, np.float32)) for n, m in architecture.layer_shapes
    ]
    entries = bench_points(architecture, layers, (1, 2))
    assert [(e["order"], e["gradient"], e["threads"]) for e in entries] == list(
        product(("rays", "random"), (False, True), (1, 2))
    )
    assert all(min(e["mpoints_s"], e["mpoints_cpu_s"]) > 0 for e in entries)


def test_rays_are_straight_and_inside() -> None:
    box = (5, 6, 7)
    rays = train._rays(box).reshape(3, -1, train.RAY_POINTS)
    np.testing.assert_allclose(np.diff(rays, n=2, axis=2), 0, atol=1e-12)
    for places in (train._rays(box), train._random(box)):
        assert places.shape == (3, train.POINTS)
        assert (places >= 0).all()
        assert (places <= np.array(box)[:, None] - 1).all()
