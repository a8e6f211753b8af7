"""The environment is put back, and the machine is described in one line."""

from __future__ import annotations

import os
from importlib.metadata import version

import pytest

from fhash_codec.selftest.environment import describe_machine, environment


def test_the_environment_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    monkeypatch.delenv("OMP_TEST", raising=False)
    seen = []

    def within() -> None:
        with environment(FHASH_THREADS="2", OMP_TEST="0"):
            seen.append((os.environ["FHASH_THREADS"], os.environ["OMP_TEST"]))
            raise ValueError("out")

    with pytest.raises(ValueError, match="out"):
        within()
    assert seen == [("2", "0")]
    assert os.environ["FHASH_THREADS"] == "3"
    assert "OMP_TEST" not in os.environ


def test_the_machine_is_described_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_THREADS", "3")
    facts = describe_machine().split(", ")
    assert facts[0] == f"fhash {version('fhash')}"
    assert f"numpy {version('numpy')}" in facts
    assert "3 processors" in facts
    assert facts[-1] in ("CUDA", "no CUDA")
