"""Generated series: the same for a seed, each of its kind."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_bench.rate.generated import (
    DEFAULT,
    GENERATED,
    MADE,
    PREFIX,
    generated,
    is_generated,
    is_made,
    made_series,
)
from fhash_formats.errors import InputError


@pytest.mark.parametrize("kind", GENERATED)
def test_a_series_is_the_same_for_a_seed(kind: str) -> None:
    series, again = generated(PREFIX + kind), generated(PREFIX + kind)
    other = generated(PREFIX + kind, seed=1)
    assert series.source == PREFIX + kind
    assert series.dtype == np.float32
    np.testing.assert_array_equal(series.values, again.values)
    assert not np.array_equal(series.values, other.values)
    assert np.isfinite(series.values).all()
    assert 100_000 <= series.values.size <= 12_000_000
    times = series.coords["t"].values
    assert (np.diff(times) > 0).all()
    assert times.size == series.shape[0]


def test_kinds_are_what_they_say() -> None:
    plateau = generated("generated:plateau")
    assert plateau.shape == (21, 80, 80, 80)
    assert np.ptp(plateau.values[0]) == 0
    assert (plateau.values[10] == 1).mean() > 0.3
    assert np.ptp(np.diff(plateau.coords["t"].values)) > 0.01
    assert np.unique(generated("generated:labels").values).size <= 40
    assert min(generated("generated:thin").shape[1:]) == 3
    assert generated("generated:long").shape[0] == 600
    assert generated("generated:short").shape[0] == 2


def test_an_unknown_kind_is_refused() -> None:
    assert is_generated("generated:x")
    assert not is_generated("x.h5")
    with pytest.raises(InputError, match="did you mean 'generated:plateau'"):
        generated("generated:plateu")


def test_every_name_gives_a_series_of_its_shape() -> None:
    for name, made in MADE.items():
        series, described = made_series(f"generated:{name}")
        assert described is made
        assert tuple(series.shape) == made.shape
    assert DEFAULT.removeprefix("generated:") in MADE


def test_the_argon_box_has_the_papers_size() -> None:
    assert sorted(MADE["argon"].shape) == [9, 80, 83, 204]


def test_other_names_are_none() -> None:
    assert not is_made("data.npy")
    assert not is_made(None)
    assert is_made("generated:argon")
    with pytest.raises(InputError, match="generated:argon"):
        made_series("generated:argn")
