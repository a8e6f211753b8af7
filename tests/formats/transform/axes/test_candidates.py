"""Transforms to try: each once, none that fits no axis, and no deeper than the axes allow."""

from __future__ import annotations

import pytest

from fhash_formats.transform.axes.candidates import NO_TRANSFORM, candidates


def test_one_vertex_has_nothing_to_transform() -> None:
    assert candidates((1, 1, 1, 1)) == (NO_TRANSFORM,)


@pytest.mark.parametrize("shape", [(8, 16, 32, 48), (1, 1, 1, 3), (1, 5, 40, 40), (2, 1, 1, 1)])
def test_each_is_tried_once_and_fits_the_axes(shape: tuple[int, int, int, int]) -> None:
    specs = candidates(shape)
    assert len(set(specs)) == len(specs) > 0
    for spec in specs:
        for axis, length in zip(spec.axes, shape, strict=True):
            assert axis.kind == "none" or 1 <= axis.depth < length.bit_length() + 1


def test_the_first_axis_is_also_tried_with_haar_and_without() -> None:
    kinds = [spec.axes[0].kind for spec in candidates((8, 16, 32, 48))]
    assert kinds == ["9/7", "haar", "none", "haar"]
