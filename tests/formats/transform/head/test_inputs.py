"""The offsets to the neighbours that the head sees."""

from __future__ import annotations

from fhash_formats.transform.head.inputs import CROSS, INPUTS, OFFSETS


def test_neighbours_are_26_and_lie_in_opposite_pairs() -> None:
    assert len(OFFSETS) == len(set(OFFSETS)) == 26
    assert INPUTS == 28
    assert {tuple(-d for d in offset) for offset in OFFSETS} == set(OFFSETS)


def test_the_cross_is_the_voxel_and_one_step_either_way_along_each_axis() -> None:
    axes = [
        tuple(sign * (number == axis) for number in range(4))
        for axis in range(4)
        for sign in (-1, 1)
    ]
    assert ((0, 0, 0, 0), *axes) == CROSS
