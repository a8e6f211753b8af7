"""Figures of steps in a file: never better than they are, in the header and in an array."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec import step_figures
from fhash_codec.step_figures import read_steps, write_steps

RMSE = [0.001, 0.0, None, 0.00123456, 0.5]
LARGEST = [0.004, 0.0, None, 0.0041999, 1.9]


class Arrays:
    """Takes arrays as a writer does, and gives them as a container does."""

    def __init__(self) -> None:
        self.stored: dict[str, Any] = {}

    def add_whole(self, name: str, array: np.ndarray, attributes: dict[str, Any]) -> None:
        self.stored[name] = self
        self.values, self.attributes = array, attributes

    def read(self) -> np.ndarray:
        return self.values


def back(
    rmse: list[float | None], largest: list[float | None], ends: tuple[float, float]
) -> tuple[list[dict[str, float | None]], Arrays]:
    """The figures as they are read again, and the arrays that were written."""
    writer: Any = Arrays()
    figures = {"rmse": rmse, "max_abs_error": largest}
    steps = write_steps(writer, figures, ends[1] - ends[0])
    known = [value for value in largest if value is not None]
    quality = {"max_abs_error": max(known), **({"steps": steps} if steps else {})}
    return read_steps({"value_range": ends, "quality": quality}, writer.stored), writer


@pytest.mark.parametrize("most", [512, 2])
def test_figures_are_never_better_than_they_are(most: int, monkeypatch: Any) -> None:
    monkeypatch.setattr(step_figures, "MAX_LISTED", most)
    steps, writer = back(RMSE, LARGEST, (-1.0, 3.0))
    assert bool(writer.stored) == (most == 2)
    for name, figures in (("rmse", RMSE), ("max_abs_error", LARGEST)):
        for step, old in zip(steps, figures, strict=True):
            new = step[name]
            assert new == old if not old else old * (1 - 1e-12) <= new <= old * 1.00125
    assert steps[4]["max_abs_error"] == 1.9


@pytest.mark.parametrize("ends", [(2.0, 2.0), (0.0, 1e-300), (-1e308, 1e307), (-1.7e308, 1.7e308)])
def test_figures_of_any_range(ends: tuple[float, float]) -> None:
    steps, _ = back([1e-300, 3.0], [1e-299, 1e300], ends)
    assert steps[0]["rmse"] == pytest.approx(1e-300, rel=2e-3)
    assert steps[1]["rmse"] == pytest.approx(3.0, rel=2e-3)
    assert steps[1]["max_abs_error"] == 1e300


def test_levels_beyond_float64_have_no_figure() -> None:
    steps = {"rmse": [-(10**6), 0, 10**6], "max_abs_error": [10**6, 0, 5]}
    header = {"value_range": [0, 1], "quality": {"steps": steps}}
    assert read_steps(header, {})[0] == {"rmse": None, "max_abs_error": None}
    assert read_steps({"value_range": [0, 1], "quality": {}}, {}) == []
