"""Plans: estimates at effort 1, and tiles without loss where squares of values overflow."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec import EncodeConfig
from fhash_codec.compact.goal import goal_of
from fhash_codec.compact.plan import CodingPlan, plan
from fhash_codec.compact.tiles import Blocks
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries

Field = Callable[..., npt.NDArray[Any]]


def plan_of(source: npt.NDArray[Any], config: EncodeConfig) -> tuple[CodingPlan, list[int]]:
    """Return the plan of a series, and the progress on the way."""
    series, done = ArraySeries(source), []
    selection = select_features(series, config, silent)
    value_range = selection.scanned.value_range
    integers = source.dtype.kind in "iu"
    goal = goal_of(config, value_range, source.nbytes, 3000, integers=integers)
    blocks = Blocks(series, selection.extent, series.shape)

    def progress(_what: str, part: int, of: int, _detail: str) -> None:
        assert of == 7
        if not done or part != done[-1]:
            done.append(part)

    with ThreadPoolExecutor(2) as workers:
        features = selection.features
        return plan(blocks, value_range, config, goal, 3000, workers, progress, features), done


def test_effort_1_codes_no_sample_for_a_psnr(field: Field) -> None:
    quick, done = plan_of(field(), EncodeConfig(effort=1, tile="2x4x5x8"))
    assert quick.sample is None
    assert quick.gains == []
    assert quick.blocks.tile == (2, 4, 5, 8)
    assert done == [0, 7]


@pytest.mark.parametrize("factor", [1e200, 1e-200])
def test_values_whose_squares_overflow_are_stored_without_loss(field: Field, factor: float) -> None:
    exact, done = plan_of(field(dtype=np.float64) * factor, EncodeConfig(effort=2))
    assert exact.coding.exact
    assert exact.settings.double
    assert done == []


def counts() -> npt.NDArray[np.int16]:
    """Counted events (6, 8, 24, 24) on a background of 50: smooth means, random numbers."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (6, 8, 24, 24)), indexing="ij")
    means = 4000 * np.exp(-8 * ((x - 0.3 - 0.3 * t) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2))
    return (50 + np.random.default_rng(0).poisson(means)).astype(np.int16)


@pytest.mark.parametrize(("psnr", "exact"), [(90.0, True), (60.0, False)])
def test_integers_are_exact_where_a_psnr_leaves_hardly_any_error(psnr: float, exact: bool) -> None:
    """A transform with a step that is finer than the integers takes more bytes than all of them."""
    found, _ = plan_of(counts(), EncodeConfig(psnr=psnr, effort=2))
    assert found.goal.lossless is exact
    if exact:
        asked, _ = plan_of(counts(), EncodeConfig(max_error=0.0, effort=2))
        assert found.settings == asked.settings
        assert found.size == asked.size
