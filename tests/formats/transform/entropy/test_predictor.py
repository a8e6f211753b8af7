"""Settings of a predictor: refusals, and the taps of its passes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from predictors import Four, predictor_of

from fhash_formats.errors import InputError
from fhash_formats.transform.entropy.predictor import pass_arrays, passes_of


@pytest.mark.parametrize(
    "change",
    [
        {"step": 0.0},
        {"step": "1"},
        {"origin": float("nan")},
        {"levels": (1, 2, 3)},
        {"levels": (1, 2, 3, 9)},
        {"levels": (1, 2, 3, True)},
        {"order": (0, 1, 2, 2)},
        {"reach": 3},
        {"reach": 1.0},
        {"weights": (1, 2)},
    ],
)
def test_a_bad_predictor_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        replace(predictor_of(), **change)


def test_taps_are_known_when_they_are_needed() -> None:
    """Within a pass, taps come before the vertex in C order."""
    settings: list[tuple[Four, Four]] = [
        ((2, 2, 2, 2), (0, 1, 2, 3)),
        ((1, 2, 0, 2), (3, 1, 2, 0)),
    ]
    for levels, order in settings:
        for a_pass in passes_of(levels, order, 2):
            assert len(set(a_pass.taps)) == len(a_pass.taps)
            for in_pass, *offset in a_pass.taps:
                assert not in_pass or tuple(offset) < (0, 0, 0, 0)
                assert in_pass or a_pass.axis >= 0


def test_the_arrays_hold_the_taps_of_each_pass() -> None:
    predictor = predictor_of((1, 2, 0, 2), (3, 1, 2, 0), 1)
    rows, taps, weights = pass_arrays(predictor)
    assert len(taps) == len(weights) == len(predictor.weights)
    for (axis, kind, first, count), a_pass in zip(rows, predictor.passes, strict=True):
        assert (axis, kind) == (a_pass.axis, a_pass.kind)
        assert [tuple(tap) for tap in taps[first : first + count].tolist()] == list(a_pass.taps)
