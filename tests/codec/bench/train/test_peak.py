"""Peaks of the machine, named by operation, instructions and precision."""

from __future__ import annotations

import pytest
import torch

from fhash_codec.bench.train.peak import Peaks
from fhash_codec.native.network import machine_paths

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
