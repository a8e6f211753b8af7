"""Figures of a growing file: those of a comparison, before and after they were in a header."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.appending.figures import Figures
from fhash_codec.header import full_header
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import ContainerWriter
from fhash_formats.errors import InputError

WRITER = ContainerWriter("unused.fhz")
"""A writer that gets nothing: few steps have their figures in the header."""


def measured(count: int = 3) -> tuple[Figures, np.ndarray]:
    errors = np.random.default_rng(0).normal(0, 0.01, (count, 2, 3, 4))
    figures = Figures(Figures.scale_of(ValueRange(0.0, 5.0)))
    for error in errors:
        figures.steps.append(figures.measure(np.zeros(error.shape), error))
    return figures, errors


def test_figures_are_those_of_the_errors_rounded_to_the_worse_side() -> None:
    figures, errors = measured()
    quality = figures.header(WRITER, 5.0)
    rmse = np.sqrt(np.mean(errors**2))
    assert rmse <= quality["rmse"] <= rmse * (1 + 1e-5)
    assert np.abs(errors).max() <= quality["max_abs_error"] <= np.abs(errors).max() * (1 + 1e-5)
    assert quality["psnr"] == pytest.approx(20 * np.log10(5.0 / rmse), abs=1e-3)
    assert len(quality["steps"]["rmse"]) == 4


def test_what_a_header_tells_is_taken_up_again() -> None:
    figures, _ = measured()
    told = figures.header(WRITER, 5.0)
    header = {
        "domain": {"shape": [3, 2, 3, 4]},
        "value_range": [0.0, 5.0],
        "model": {},
        "history": {},
        "quality": told,
    }
    full = full_header(header, {})
    again = Figures.of_header(full, figures.scale).header(WRITER, 5.0)
    # Figures of steps are rounded to hundredths of a dB.
    assert again["rmse"] == pytest.approx(told["rmse"], rel=2e-3)
    assert again["rmse"] >= told["rmse"]
    assert again["max_abs_error"] == told["max_abs_error"]
    steps = full["quality"]["per_step"]
    for wrong in (steps[:2], [*steps[:2], {"rmse": None, "max_abs_error": 1.0}]):
        with pytest.raises(InputError, match="does not tell the errors of step 2"):
            Figures.of_header({**header, "quality": {"per_step": wrong}}, 1.0)


def test_a_range_of_one_value_has_a_scale() -> None:
    for value in (0.0, 3.0, -1e-300):
        assert Figures.scale_of(ValueRange(value, value)) > 0
