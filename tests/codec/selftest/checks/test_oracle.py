"""The float64 network against its definition, and errors that its checks see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.paper.model import sample_points
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases import networks
from fhash_codec.selftest.checks import oracle
from fhash_codec.selftest.checks.oracle import Oracle
from fhash_codec.selftest.runner import run_case


@pytest.fixture(scope="module")
def layers() -> Case:
    """A network of one hidden layer, hardly trained."""
    case = next(case for case in networks.CASES if case.name == "layers")
    config = replace(case.settings["hidden-layers-1"], epochs=5)
    return replace(case, settings={"hidden-layers-1": config})


def broken(case: Case) -> set[str]:
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
    assert broken(layers) == set()


def test_an_error_beyond_the_bound_of_rounding_is_seen(
    layers: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        oracle,
        "sample_points",
        lambda *given, **more: sample_points(*given, **more) + np.float32(1e-3),
    )
    case = replace(layers, checks=(oracle.agrees,))
    assert broken(case) == {"float64 oracle", "float64 oracle, error"}


def turned(sample: Callable[..., object]) -> Callable[..., object]:
    """`sample_points` with the derivatives by other coordinates."""

    def other(*given: object, gradient: bool) -> object:
        values, slopes = sample(*given, gradient=gradient)
        return values, slopes[:, ::-1]

    return other


def test_wrong_gradients_are_seen(layers: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oracle, "sample_points", turned(sample_points))
    case = replace(layers, checks=(oracle.gradients,))
    assert broken(case) == {"gradient = differences"}
