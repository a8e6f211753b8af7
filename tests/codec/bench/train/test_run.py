"""One engine under measurement: slices, and the names of variants."""

from __future__ import annotations

import pytest

from fhash_codec.bench.train.clock import Spent
from fhash_codec.bench.train.run import Slices, Variant


def test_slices_count_by_both_clocks() -> None:
    slices = Slices()
    slices.add(100, Spent(wall=2.0, cpu=1.0))
    slices.add(0, Spent(wall=5.0, cpu=5.0))
    slices.add(300, Spent(wall=2.0, cpu=2.0))
    assert slices.wall == [50.0, 150.0]
    assert slices.cpu == [100.0, 150.0]
    assert slices.spent == Spent(wall=4.0, cpu=3.0)


@pytest.mark.parametrize(
    ("variant", "label"),
    [
        (Variant("slab", 1), "slab"),
        (Variant("slab", 2), "slab 2 threads"),
        (Variant("native", 1, "baseline"), "native baseline"),
    ],
)
def test_a_variant_has_a_short_name(variant: Variant, label: str) -> None:
    assert variant.label == label
