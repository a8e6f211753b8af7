"""Tables as stored numbers: what does not fit in their type is refused, and nothing becomes an infinity on the way."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

from fhash_codec.coreset.bricks import Coreset, build_coreset
from fhash_codec.coreset.features import Everything
from fhash_codec.coreset.scan import scan
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.storage import StoredTable, write_tables
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


@pytest.fixture(scope="module")
def coreset() -> Coreset:
    series = ArraySeries(np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5))
    return build_coreset(series, scan(series, silent), range(2), [Everything()], 0, silent)


class Stored:
    """Stands for a writer, and for the last array that was written."""

    def add_array(self, name, *, shape, dtype, chunk_shape, chunks, dimension_names, attributes):
        self.values = np.concatenate([chunk.reshape(-1) for chunk in chunks])
        self.shape, self.dtype, self.attributes = shape, dtype, attributes or {}

    def read(self, region):
        return self.values


def written(coreset: Coreset, kind: str, values: list[float]) -> np.ndarray:
    """The coarsest table, as it is read back, of a model whose every level holds `values` and else 0."""
    architecture = Architecture.for_box(coreset.box.shape, 2, embedding_size=1)
    fine = np.zeros((len(coreset.bricks), 1, prod(coreset.brick_shape)), np.float32)
    tables = [np.zeros((prod(level), 1), np.float32) for level in architecture.levels[1:]]
    for table in (fine, *tables):
        table.reshape(-1)[: len(values)] = values
    stored = Stored()
    write_tables(stored, architecture, coreset, fine, tables, kind)
    return StoredTable(stored).read(())


@pytest.mark.parametrize("kind", ["float32", "float16", "uint8"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(coreset, kind, value):
    with pytest.raises(InputError, match="not finite"):
        written(coreset, kind, [0.5, value])


@pytest.mark.parametrize("value", [65505.0, -65536.0, 1e9])
def test_what_half_precision_does_not_hold_is_refused(coreset, value):
    with pytest.raises(InputError, match=r"more than float16 holds; use --tables float32"):
        written(coreset, "float16", [value])


def test_a_range_that_eight_bits_cannot_give_back_is_refused(coreset):
    with pytest.raises(InputError, match=r"more than uint8 holds; use --tables float32"):
        written(coreset, "uint8", [-3e38, 3e38])


@pytest.mark.parametrize(
    ("kind", "values", "within"),
    [
        ("float32", [-3e38, 1e-45, 3e38], 0.0),
        ("float16", [-65504.0, 65504.0, 6e-8], 1e-8),
        ("float16", [1e-9, -1e-9], 1e-9),
        ("uint8", [-1e38, 2e38], 3e38 / 255),
        ("uint8", [7.5], 7.5 / 255),
        ("uint8", [-1e-40, 1e-45], 6e-39),
        ("uint8", [1e-45], 6e-39),
        ("uint8", [0.0], 0.0),
    ],
)
def test_what_fits_comes_back_within_the_step_of_its_type(coreset, kind, values, within):
    back = written(coreset, kind, values).astype(np.float64)
    assert np.all(np.isfinite(back))
    exact = np.zeros(len(back), np.float32)
    exact[: len(values)] = values
    assert np.abs(back - exact.astype(np.float64)).max() <= within
