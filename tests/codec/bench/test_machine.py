"""The machine that a benchmark ran on."""

from __future__ import annotations

import json
import os

import torch

from fhash_codec.bench.machine import machine


def test_the_machine_is_described_by_json_values() -> None:
    described = machine(torch.device("cpu"))
    assert described["device"] == "cpu"
    assert described["processor"]
    assert described["cores"] == os.cpu_count()
    assert described["threads"] == torch.get_num_threads()
    assert json.loads(json.dumps(described)) == described
