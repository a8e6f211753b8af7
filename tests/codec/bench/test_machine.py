"""The machine that a benchmark ran on."""

from __future__ import annotations

import json
import os

import pytest

from fhash_codec.bench.machine import machine


def test_the_machine_is_described_by_json_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    described = machine()
    assert described["device"] == "cpu"
    assert described["processor"]
    assert described["cores"] == os.cpu_count()
    assert described["threads"] == 3
    assert json.loads(json.dumps(described)) == described
