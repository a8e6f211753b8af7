"""Checks of networks hold for sound networks and see the errors that are planted here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.checks import network_checks
from fhash_codec.selftest.checks.network_checks import (
    constant_tables,
    diverged,
    ends_of_half_precision,
    engines,
    kinks,
    large_tables,
    recovered,
)

Broken = Callable[[Run, Check], set[str]]
ALONE = (constant_tables, ends_of_half_precision, kinks, large_tables)
"""Checks that make networks of their own and do not look at the run."""


@pytest.mark.parametrize("check", ALONE)
def test_sound_networks_keep_every_property(broken: Broken, check: Check) -> None:
    assert broken(None, check) == set()


def shifted(value: float, slope: float) -> Callable[..., object]:
    """`sample_points` with an error in values and slopes."""
    sample_points = network_checks.sample_points

    def sample(*given: object, gradient: bool = False) -> object:
        if not gradient:
            return sample_points(*given) + np.float32(value)
        values, slopes = sample_points(*given, gradient=True)
        return values + np.float32(value), slopes + np.float32(slope)

    return sample


@pytest.mark.parametrize(
    ("check", "value", "slope", "properties"),
    [
        (constant_tables, 1e-6, 0.0, {"constant tables"}),
        (constant_tables, 0.0, 1e-6, {"constant tables, slopes"}),
        (kinks, 0.0, 1e-6, {"derivatives about kinks"}),
        (kinks, 1e-5, 0.0, {"derivatives about kinks, differences"}),
        (large_tables, 1e-3, 0.0, {"large tables"}),
    ],
)
def test_wrong_values_and_slopes_are_seen(
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    check: Check,
    value: float,
    slope: float,
    properties: set[str],
) -> None:
    monkeypatch.setattr(network_checks, "sample_points", shifted(value, slope))
    assert broken(None, check) >= properties


def test_a_number_type_that_accepts_too_much_is_seen(
    broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Careless:
        @classmethod
        def of(cls, table: np.ndarray, kind: str) -> Careless:
            return cls()

        def stored(self, table: np.ndarray) -> np.ndarray:
            return np.minimum(table, 65_000)

    monkeypatch.setattr(network_checks, "NumberType", Careless)
    assert broken(None, ends_of_half_precision) == {"too large for float16", "largest of float16"}


def trained(run: Run, **training: object) -> Run:
    """The run as if its header said this of the training."""
    volume = SimpleNamespace(container=SimpleNamespace(header={"training": training}))
    return replace(run, volume=volume)


def test_a_training_that_does_not_tell_its_restarts_is_seen(
    compact_run: Run, broken: Broken, spoiled: Callable[..., Run]
) -> None:
    rate = compact_run.config.learning_rate
    true = compact_run.decoded
    mean = np.full_like(true, compact_run.values.mean())
    told = trained(compact_run, learning_rate=rate / 16, restarts=2)
    assert broken(spoiled(told, true), recovered) == set()
    assert broken(spoiled(told, mean), recovered) == {"better than a constant"}
    untold = trained(compact_run, learning_rate=rate / 16)
    assert broken(spoiled(untold, true), recovered) == {"rate and restarts told"}
    assert broken(told, diverged) == set()
    assert broken(untold, diverged) == {"divergence not found"}


def test_an_engine_that_trains_another_network_is_seen(
    paper_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another seed stands for another engine."""
    encode = network_checks.encode

    def other(source: object, path: object, config: object, **rest: object) -> object:
        assert config.engine == "slab"
        return encode(source, path, replace(config, seed=1), **rest)

    assert [finding.holds for finding in engines(paper_run)] == [True]
    monkeypatch.setattr(network_checks, "encode", other)
    assert [finding.holds for finding in engines(paper_run)] == [False]
