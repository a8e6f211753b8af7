"""Pictures with wrong pixels are seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.checks import pictures, ray_checks


def drawn(cached: float, others: float) -> Callable[[Run, str], np.ndarray]:
    """Pictures of one value for the cache, and of another one for all other marches."""
    return lambda run, mode: np.full((4, 4, 4), cached if mode == "cache" else others, np.float32)


@pytest.mark.parametrize(
    ("cached", "others", "properties"),
    [
        (0.5, 0.5, set()),
        (1.001, 0.5, {"pixels in 0..1"}),
        (-0.001, 0.5, {"pixels in 0..1"}),
        (0.5, np.nan, {"finite pixels, stream", "finite pixels, arm"}),
    ],
)
def test_wrong_pixels_are_seen(
    paper_run: Run,
    broken: Callable[[Run, Check], set[str]],
    monkeypatch: pytest.MonkeyPatch,
    cached: float,
    others: float,
    properties: set[str],
) -> None:
    monkeypatch.setattr(pictures, "_rendered", drawn(cached, others))
    assert broken(paper_run, pictures.picture) == properties


def test_a_picture_that_differs_from_that_of_float64_is_seen(
    compact_run: Run,
    broken: Callable[[Run, Check], set[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reference = ray_checks.reference_picture
    monkeypatch.setattr(ray_checks, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(compact_run, pictures.picture) == {"float64 picture"}


def test_the_easy_case_keeps_every_property(
    run: Run, broken: Callable[[Run, Check], set[str]]
) -> None:
    assert broken(run, pictures.picture) == set()
