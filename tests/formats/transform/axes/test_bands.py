"""The bands of a transformed tile: the coefficients they cover and the bands they refer to."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from specs import mixes_and_depths, spec_of

from fhash_formats.transform.axes.bands import band_table
from fhash_formats.transform.axes.spec import TransformSpec
from fhash_formats.transform.entropy.prior import KINDS
from fhash_formats.transform.entropy.table import COLUMNS, Table

SHAPES = [
    (1, 1, 1, 1),
    (2, 3, 5, 7),
    (4, 9, 17, 33),
    (16, 1, 2, 64),
    (1, 2, 1, 40),
    (2, 2, 40, 1),
    (7, 13, 31, 29),
    (5, 1, 6, 6),
]
MIXES = [
    ("none", "none", "none", "none"),
    ("haar", "5/3", "9/7", "9/7"),
    ("haar", "none", "haar", "haar"),
    ("9/7", "haar", "5/3", "9/7"),
    ("none", "9/7", "none", "5/3"),
    ("haar", "klt", "9/7", "klt"),
    ("klt", "haar", "5/3", "5/3"),
    ("klt", "klt", "klt", "klt"),
]


def box(row: Table) -> tuple[slice, ...]:
    return tuple(slice(int(low), int(high)) for low, high in zip(row[:4], row[4:8], strict=True))


CASES = [
    pytest.param(
        spec_of(kinds, depth, shape, 8.0),
        shape,
        id=f"{'-'.join(kinds)}-{depth}-{'x'.join(map(str, shape))}",
    )
    for (kinds, depth), shape in product(mixes_and_depths(MIXES, (1, 2, 10)), SHAPES)
]


@pytest.mark.parametrize(("spec", "shape"), CASES)
def test_each_coefficient_is_in_one_band(spec: TransformSpec, shape: tuple[int, ...]) -> None:
    covered = np.zeros(shape, dtype=int)
    for row in band_table(spec, shape):
        assert all(
            0 <= low < high <= n for low, high, n in zip(row[:4], row[4:8], shape, strict=True)
        )
        covered[box(row)] += 1
    kept = tuple(
        slice(n if axis.basis is None else axis.basis.rank)
        for axis, n in zip(spec.axes, shape, strict=True)
    )
    assert (covered[kept] == 1).all()
    assert covered.sum() == covered[kept].size


@pytest.mark.parametrize(("spec", "shape"), CASES)
def test_references_point_back_to_bands_that_lie_alike(
    spec: TransformSpec, shape: tuple[int, ...]
) -> None:
    table = band_table(spec, shape)
    sizes = table[:, 4:8] - table[:, :4]
    for number, row in enumerate(table):
        # Axes along which each reference stays in place: the parent and the sibling along t and
        # z, the band before along t along z, y, x, the band before along z along t, y, x.
        for reference, same in zip(
            row[9:].reshape(4, 5), ([0, 1], [1, 2, 3], [0, 2, 3], [0, 1]), strict=True
        ):
            to, shifts = int(reference[0]), reference[1:]
            if to < 0:
                assert to == -1
                continue
            assert to < number
            assert set(shifts) <= {0, 1}
            assert (sizes[to] > 0).all()
            assert (row[same] == table[to, same]).all()
            assert (row[np.add(same, 4)] == table[to, np.add(same, 4)]).all()
            for axis in range(4):
                places = np.minimum(
                    np.arange(sizes[number, axis]) >> shifts[axis], sizes[to, axis] - 1
                )
                assert places.min() >= 0
                # The other band is as long, or half as long, except for an odd end.
                if axis in same or shifts[axis]:
                    assert (sizes[number, axis] - 1) >> shifts[axis] <= sizes[to, axis]


def test_every_kind_of_reference_is_made() -> None:
    spec = spec_of(("haar", "5/3", "9/7", "9/7"), 3, (8, 8, 32, 32))
    references = band_table(spec, (8, 8, 32, 32))[:, 9:].reshape(-1, 4, 5)
    assert (references[:, :, 0] >= 0).any(axis=0).all()
    packets = spec_of(("haar", "5/3", "9/7", "5/3"), 3, (8, 8, 32, 32))
    seen = band_table(packets, (8, 8, 32, 32))[:, [9, 14, 19, 24]] >= 0
    assert seen.any(axis=0).tolist() == [True, True, True, False]


@pytest.mark.parametrize(("spec", "shape"), CASES)
def test_kinds_have_a_place_in_the_state(spec: TransformSpec, shape: tuple[int, ...]) -> None:
    kinds = band_table(spec, shape)[:, 8]
    assert ((kinds >= 0) & (kinds < KINDS)).all()


def test_kinds_tell_levels_and_orientations_apart() -> None:
    shape = (4, 4, 32, 32)
    table = band_table(spec_of(("haar", "haar", "9/7", "9/7"), 3, shape), shape)
    assert len({int(kind) // 4 for kind in table[:, 8]}) == 1 + 3 * 3
    for row in table:
        assert row[8] % 4 == 2 * (row[0] > 0) + (row[1] > 0)


def test_a_basis_of_rank_0_has_no_band() -> None:
    shape = (3, 4, 5, 6)
    spec = spec_of(("none", "klt", "9/7", "9/7"), 1, shape, 1e9)
    assert spec.axes[1].basis is not None
    assert spec.axes[1].basis.rank == 0
    assert band_table(spec, shape).shape == (0, COLUMNS)


def test_a_table_is_made_once_and_read_only() -> None:
    spec = spec_of(("haar", "none", "9/7", "9/7"), 2, (4, 4, 8, 8))
    table = band_table(spec, (4, 4, 8, 8))
    assert table is band_table(spec, (4, 4, 8, 8))
    assert table.dtype == np.int32
    assert table.flags.c_contiguous
    with pytest.raises(ValueError, match="read-only"):
        table[0, 0] = 1
