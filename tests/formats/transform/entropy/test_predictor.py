"""Settings of a predictor: JSON and back, refusals, and the taps of its passes."""

from __future__ import annotations

from typing import Any

import pytest
from predictors import Four, predictor_of

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.entropy.predictor import Predictor, pass_arrays, passes_of


def test_a_predictor_survives_json() -> None:
    predictor = predictor_of((0, 3, 2, 1), (3, 0, 2, 1), 2, step=0.25, origin=-3.5)
    assert Predictor.from_dict(predictor.to_dict()) == predictor


@pytest.mark.parametrize(
    "change",
    [
        {"step": 0.0},
        {"step": "1"},
        {"origin": float("nan")},
        {"levels": [1, 2, 3]},
        {"levels": [1, 2, 3, 9]},
        {"levels": [1, 2, 3, True]},
        {"order": [0, 1, 2, 2]},
        {"order": None},
        {"reach": 3},
        {"reach": 1.0},
        {"weights": "@"},
        {"weights": "AAAA"},
        {"weights": 3},
        {"more": 1},
    ],
)
def test_a_bad_predictor_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises((InputError, DamagedFileError)):
        Predictor.from_dict({**predictor_of().to_dict(), **change})


def test_a_missing_key_is_named() -> None:
    values = predictor_of().to_dict()
    del values["reach"]
    with pytest.raises(InputError, match="missing key 'reach'"):
        Predictor.from_dict(values)


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
