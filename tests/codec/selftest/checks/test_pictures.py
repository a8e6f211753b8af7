"""Pictures with wrong pixels, or that depend on the march, are seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fhash_codec.selftest.case import Check, Run
from fhash_codec.selftest.checks import pictures

MARCHES = {"cache = stream", "cache = arm"}


def drawn(cached: float, others: float) -> Callable[[Run, str], np.ndarray]:
    """Pictures of one value for the cache, and of another one for all other marches."""
    return lambda run, mode: np.full((4, 4, 4), cached if mode == "cache" else others, np.float32)


@pytest.mark.parametrize(
    ("cached", "others", "properties"),
    [
        (0.5, 0.5, set()),
        (0.5, 0.502, MARCHES),
        (1.001, 1.001, {"pixels in 0..1"}),
        (-0.001, -0.001, {"pixels in 0..1"}),
        (0.5, np.nan, MARCHES),
    ],
)
def test_wrong_pixels_are_seen(
    compact_run: Run,
    broken: Callable[[Run, Check], set[str]],
    monkeypatch: pytest.MonkeyPatch,
    cached: float,
    others: float,
    properties: set[str],
) -> None:
    monkeypatch.setattr(pictures, "_rendered", drawn(cached, others))
    assert broken(compact_run, pictures.picture) == properties


def test_the_easy_case_is_drawn_alike_by_every_march(
    run: Run, broken: Callable[[Run, Check], set[str]]
) -> None:
    assert broken(run, pictures.picture) == set()
