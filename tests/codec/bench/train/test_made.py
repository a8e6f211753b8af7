"""Generated series by name."""

from __future__ import annotations

import pytest

from fhash_codec.bench.train.made import DEFAULT, MADE, is_made, made_series
from fhash_formats.errors import InputError


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
