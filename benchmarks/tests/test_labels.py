"""Made series of labels: the kinds are what their names say, and each call makes the same."""

from __future__ import annotations

import lzma

import numpy as np
import pytest

from fhash_bench.labels import KINDS, bench_labels
from fhash_formats.errors import InputError


@pytest.mark.parametrize(
    ("kind", "dtype", "at_least", "at_most"),
    [
        ("components", "int32", 10, 256),
        ("refinement levels", "int8", 5, 5),
        ("tiny grid", "int16", 8, 12),
        ("checkerboard", "uint8", 2, 2),
        ("filled", "int16", 6, 6),
        ("floats", "float32", 10, 26),
        ("ranks", "int32", 257, 400),
    ],
)
def test_a_kind_has_its_type_and_number_of_values(
    kind: str, dtype: str, at_least: int, at_most: int
) -> None:
    values = KINDS[kind]()
    assert values.dtype == dtype
    assert at_least <= np.unique(values).size <= at_most
    assert values.ndim == 4
    np.testing.assert_array_equal(KINDS[kind](), values)


def test_regions_of_a_kind_are_connected_and_basins_cover_all() -> None:
    components = KINDS["components"]()
    assert (components[:, :, :, 1:] == components[:, :, :, :-1]).mean() > 0.9
    basins = KINDS["basins"]()
    assert (basins[:, :, :, 1:] == basins[:, :, :, :-1]).mean() > 0.7


@pytest.mark.every
def test_sizes_of_made_series_come_with_the_worst_first() -> None:
    told: list[tuple[int, int]] = []

    def progress(stage: str, done: int, total: int, note: str) -> None:
        told.append((done, total))

    result = bench_labels(kinds=("thin", "tiny grid"), effort=1, progress=progress)
    ratios = [size.ratio for size in result.sizes]
    assert ratios == sorted(ratios, reverse=True)
    assert {size.kind for size in result.sizes} == {"thin", "tiny grid"}
    assert told == [(0, 2), (1, 2), (2, 2)]
    assert result.to_dict()["kinds"][0]["ratio"] == ratios[0]


def test_an_array_is_measured_as_it_is() -> None:
    values = (np.indices((2, 3, 20, 30))[3] // 7 * 3).astype("i2")
    (size,) = bench_labels(values, effort=1).sizes
    assert (size.dtype, size.shape, size.distinct) == ("int16", values.shape, 5)
    preset = 9 | lzma.PRESET_EXTREME
    assert size.xz_bytes == len(lzma.compress(values.tobytes(), preset=preset))
    assert 0 < size.codec_bytes < size.fhash_bytes < values.nbytes


def test_unknown_kinds_are_refused() -> None:
    with pytest.raises(InputError, match="kind is 'nothing'; allowed: components"):
        bench_labels(kinds=("nothing",))
    with pytest.raises(InputError, match="leave them out"):
        bench_labels(np.zeros((1, 2, 3, 4), "u1"), kinds=("thin",))
