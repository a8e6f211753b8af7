"""Cells joined over seeds."""

from __future__ import annotations

import math

from made_cells import cell

from fhash_codec.bench.paper.groups import by_data, groups, within


def test_cells_are_joined_over_seeds_in_the_papers_order() -> None:
    grouped = groups([cell(seed=1), cell(), cell("dense"), cell("hash", "published")])
    assert [(group.protocol, group.encoding) for group in grouped] == [
        ("published", "hash"),
        ("equal", "dense"),
        ("equal", "fhash"),
    ]
    assert [each.seed for each in grouped[-1].cells] == [0, 1]


def test_unknown_names_come_last() -> None:
    grouped = groups([cell(data_set="mine"), cell(), cell(feature="all", data_set="flame")])
    assert [group.data_set for group in grouped] == ["flame", "bubble", "mine"]
    assert list(by_data(grouped)) == [
        (("flame", "all"), {"fhash": grouped[0]}),
        (("bubble", "segmentation"), {"fhash": grouped[1]}),
        (("mine", "segmentation"), {"fhash": grouped[2]}),
    ]


def test_a_seed_that_does_not_reach_a_quality_counts_as_infinite() -> None:
    (group,) = groups([cell(rise=4.0), cell(seed=1, rise=0.1), cell(seed=2, rise=2.0)])
    epochs = group.reached(30, "coreset_psnr", "epoch")
    assert (epochs.median, epochs.low, epochs.high) == (10, 5, math.inf)
    assert group.after(10, "coreset_psnr").median == 30  # type: ignore[union-attr]
    assert group.spread(lambda cell: None) is None


def test_the_last_point_within_some_epochs() -> None:
    made = cell()
    assert within(made, 7).epoch == 7
    assert within(made, 1000).epoch == 40
