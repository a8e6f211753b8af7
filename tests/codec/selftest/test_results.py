"""Results name what does not hold, keep the worst figures, and survive JSON."""

from __future__ import annotations

import json

import numpy as np
import pytest

from fhash_codec.selftest.case import Finding
from fhash_codec.selftest.results import CaseResult, Summary, relative


def finding(name: str, worst: float, limit: float = 1.0) -> Finding:
    return Finding(name=name, worst=worst, limit=limit, unit="values", under="bound")


def result(name: str, *findings: Finding, group: str = "values", **rest: object) -> CaseResult:
    return CaseResult(name=name, group=group, about="", findings=findings, **rest)


@pytest.mark.parametrize(
    ("worst", "limit", "multiple"),
    [
        (0.5, 2.0, 0.25),
        (3.0, 2.0, 1.5),
        (-1.0, 2.0, 0.0),
        (0.0, 0.0, 0.0),
        (1.0, 0.0, np.inf),
        (np.nan, 1.0, np.inf),
    ],
)
def test_a_figure_is_a_multiple_of_its_limit(worst: float, limit: float, multiple: float) -> None:
    assert relative(finding("a", worst, limit)) == multiple


def test_errors_and_figures_beyond_their_limits_are_failures() -> None:
    broken = result("x", finding("a", 0.5), finding("b", 2.0), errors=("bound: ended",))
    assert not broken.holds
    assert broken.failures == ["bound: ended", "bound: b is 2 values, at most 1"]
    assert broken.worst == finding("b", 2.0)
    assert not result("y", errors=("bound: ended",)).holds
    assert result("z").worst is None
    summary = Summary(results=[result("y", finding("a", 0.25)), broken])
    assert not summary.holds
    assert summary.failures == ["x: bound: ended", "x: bound: b is 2 values, at most 1"]


def test_the_summary_keeps_the_worst_figure_of_every_property() -> None:
    first = result("first", finding("a", 0.5), finding("b", 0.1))
    second = result("second", finding("a", 0.75), finding("b", 0.05), group="rays")
    summary = Summary(results=[first, second])
    assert summary.holds
    assert summary.groups == {"values": [first], "rays": [second]}
    assert summary.worst() == {
        "a": (second, finding("a", 0.75)),
        "b": (first, finding("b", 0.1)),
    }


@pytest.mark.parametrize("worst", [0.25, np.inf, -np.inf])
def test_results_survive_json(worst: float) -> None:
    given = result("x", finding("a", worst), under=("bound",), errors=("ended",))
    values = json.loads(json.dumps(given.to_dict(), allow_nan=False))
    assert CaseResult.from_dict(values) == given
