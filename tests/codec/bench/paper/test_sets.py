"""Parameters to the unit at the paper's configurations."""

from __future__ import annotations

import pytest

from fhash_codec.bench.paper.sets import (
    SETS,
    dense_levels,
    hash_resolutions,
    hash_table,
    paper_parameters,
    paper_set,
    scaled,
    tcnn_network,
)
from fhash_formats.errors import InputError

COUNTS = {
    "flame": {
        "hash": 125_829_120,
        "tcnn": 47_994_880,
        "dense": 47_185_920,
        "fhash": 25_374_176,
    },
    "bubble": {"hash": 264_241_152, "tcnn": 80_945_280, "dense": 75_497_472},
    "shell": {
        "hash": 1_174_405_120,
        "tcnn": 215_768_320,
        "dense": 141_557_760,
        "fhash": 112_857_968,
    },
}


@pytest.mark.parametrize("name", SETS)
def test_parameters_to_the_unit(name: str) -> None:
    counts = paper_parameters(name)
    assert {key: counts[key] for key in COUNTS[name]} == COUNTS[name]
    assert counts["dense-multi"] == pytest.approx(8 / 7 * counts["dense"], rel=2e-6)


def test_hash_configurations_are_the_papers() -> None:
    found = {
        name: (hash_table(s.frame), hash_resolutions(s.frame, s.coarsest))
        for name, s in SETS.items()
    }
    assert {name: table for name, (table, _) in found.items()} == {
        "flame": 2**20,
        "bubble": 2**21,
        "shell": 2**23,
    }
    assert [len(resolutions) for _, resolutions in found.values()] == [6, 7, 7]
    assert {resolutions[0] for _, resolutions in found.values()} == {256}


def test_a_quarter_of_the_papers_lengths() -> None:
    assert [scaled(s.frame, 4) for s in SETS.values()] == [
        (14, 43, 50),
        (64, 32, 32),
        (54, 54, 54),
    ]


def test_dense_levels_halve_down_to_two_corners() -> None:
    assert dense_levels((5, 3, 1)) == [(5, 3, 1), (3, 2, 1), (2, 1, 1)]


def test_tcnn_pads_its_network() -> None:
    assert tcnn_network(6, 1) == 16 * 64 + 64 * 64 + 64 * 16 == 6144
    assert tcnn_network(9, 2) == 2 * (32 * 64 + 64 * 64 + 64 * 16)


def test_an_unknown_set_is_refused() -> None:
    with pytest.raises(InputError, match="bubbel"):
        paper_set("bubbel")
