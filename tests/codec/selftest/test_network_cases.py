"""Checks of networks see wrong values, slopes and trainings; the oracle is the definition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fhash_codec.paper.model import sample_points
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.selftest import network_cases
from fhash_codec.selftest.case import Case, Check, Run
from fhash_codec.selftest.network_cases import (
    Oracle,
    constant_tables,
    diverged,
    ends_of_half_precision,
    engines,
    kinks,
    large_tables,
    recovered,
)
from fhash_codec.selftest.run import run_case

Broken = Callable[[Run, Check], set[str]]
ALONE = (constant_tables, ends_of_half_precision, kinks, large_tables)
"""Checks that make networks of their own and do not look at the run."""


@pytest.mark.parametrize("check", ALONE)
def test_sound_networks_keep_every_property(broken: Broken, check: Check) -> None:
    assert broken(None, check) == set()


def shifted(value: float, slope: float) -> Callable[..., object]:
    """`sample_points` with an error in values and slopes."""
    sample_points = network_cases.sample_points

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
    monkeypatch.setattr(network_cases, "sample_points", shifted(value, slope))
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

    monkeypatch.setattr(network_cases, "NumberType", Careless)
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
    encode = network_cases.encode

    def other(source: object, path: object, config: object, **rest: object) -> object:
        assert config.engine == "slab"
        return encode(source, path, replace(config, seed=1), **rest)

    assert [finding.holds for finding in engines(paper_run)] == [True]
    monkeypatch.setattr(network_cases, "encode", other)
    assert [finding.holds for finding in engines(paper_run)] == [False]


@pytest.fixture(scope="module")
def layers() -> Case:
    """A network of one hidden layer, hardly trained."""
    case = next(case for case in network_cases.NETWORK_CASES if case.name == "layers")
    config = replace(case.settings["hidden-layers-1"], epochs=5)
    return replace(case, settings={"hidden-layers-1": config})


def broken_of(case: Case) -> set[str]:
    result = run_case(case, checks=())
    assert not result.errors
    return {finding.name for finding in result.findings if not finding.holds}


def small_network() -> Network:
    """One level of 2 x 2 x 2 x 3 corners with the value t + 10 z + 100 y + 1000 x.

    A ReLU lets values above 500 through; the readout doubles them and adds 0.25.
    """
    t, z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (2, 2, 2, 3)), indexing="ij")
    table = ArrayTable((t + 10 * z + 100 * y + 1000 * x)[..., None])
    first = (np.ones((1, 1), np.float32), np.array([-500.0], np.float32))
    last = (np.full((1, 1), 2.0, np.float32), np.array([0.25], np.float32))
    return Network(
        levels=((2, 2, 2, 3),),
        embedding_size=1,
        tables=[table],
        layers=(first, last),
        box_size=(3, 3, 3),
        key_frames=5,
    )


@pytest.mark.parametrize(
    ("point", "table_value"),
    [
        ((0, 0, 0, 0), 0.0),
        ((4, 2, 2, 2), 2111.0),
        ((2, 0, 0, 1), 1000.5),
        ((1, 1, 0.5, 1.75), 0.25 + 5 + 25 + 1750),
    ],
)
def test_the_oracle_is_the_definition(point: tuple[float, ...], table_value: float) -> None:
    answer = Oracle(small_network()).at(point)
    assert answer.value == pytest.approx(2 * max(0.0, table_value - 500) + 0.25, rel=1e-14)
    assert answer.active == (table_value > 500,)
    sampled = sample_points(small_network(), *point)
    assert abs(float(sampled[0]) - answer.value) <= answer.rounding
    assert answer.rounding < 1e-2


def test_a_sound_network_keeps_the_bounds(layers: Case) -> None:
    assert broken_of(layers) == set()


def test_an_error_beyond_the_bound_of_rounding_is_seen(
    layers: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        network_cases,
        "sample_points",
        lambda *given, **more: sample_points(*given, **more) + np.float32(1e-3),
    )
    case = replace(layers, checks=(network_cases.agrees,))
    assert broken_of(case) == {"float64 oracle", "float64 oracle, error"}


def turned(sample: Callable[..., object]) -> Callable[..., object]:
    """`sample_points` with the derivatives by other coordinates."""

    def other(*given: object, gradient: bool) -> object:
        values, slopes = sample(*given, gradient=gradient)
        return values, slopes[:, ::-1]

    return other


def test_wrong_gradients_are_seen(layers: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_cases, "sample_points", turned(sample_points))
    case = replace(layers, checks=(network_cases.gradients,))
    assert broken_of(case) == {"gradient = differences"}
