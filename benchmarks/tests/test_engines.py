"""The two clocks of a measurement."""

from __future__ import annotations

import pytest
import torch

from fhash_bench.engines import (
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
from fhash_codec.native.network import machine_paths


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
        (Variant("slab", 1), "slab"),
        (Variant("slab", 2), "slab 2 threads"),
        (Variant("native", 1, "baseline"), "native baseline"),
    ],
)
def test_a_variant_has_a_short_name(variant: Variant, label: str) -> None:
    assert variant.label == label
