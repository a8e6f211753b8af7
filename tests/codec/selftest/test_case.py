"""A finding holds up to its limit; a run decodes its file once."""

from __future__ import annotations

import os
from importlib.metadata import version

import numpy as np
import pytest

from fhash_codec.selftest.case import Finding, Run, describe_machine, environment


@pytest.mark.parametrize(
    ("worst", "holds"),
    [(0.5, True), (1.0, True), (np.nextafter(1.0, 2.0), False), (np.inf, False), (np.nan, False)],
)
def test_a_finding_holds_up_to_its_limit(worst: float, holds: bool) -> None:
    assert Finding(name="a", worst=worst, limit=1.0, unit="").holds is holds


def test_a_run_decodes_its_file_once(run: Run) -> None:
    assert run.decoded.shape == run.values.shape
    assert run.decoded is run.decoded
    assert run.data_range == float(run.values.max()) - float(run.values.min())


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
