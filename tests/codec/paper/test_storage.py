"""The fringe in the finest table: rounded alone, and to a step that follows from its numbers."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, Interval
from fhash_codec.features.occupancy import unpack
from fhash_codec.features.scan import scan
from fhash_codec.paper.network import Architecture
from fhash_codec.paper.storage import (
    StoredTable,
    fringe_step,
    round_fringe,
    table_chunk,
    write_tables,
)
from fhash_codec.progress import silent
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.series import ArraySeries


def coreset_of(fringe: bool) -> Coreset:
    """A plane that moves through the box from one key frame to the next."""
    values = np.zeros((3, 6, 5, 7), np.float32)
    for step in range(3):
        values[step, 2 * step : 2 * step + 2] = 1.0
    series = ArraySeries(values)
    scanned = scan(series, silent)
    return build_coreset(series, scanned, range(3), [Interval(0.5, 2.0)], 0, silent, fringe=fringe)


@pytest.fixture
def coreset() -> Coreset:
    return coreset_of(fringe=True)


def finest(scale: float = 1.0):
    frames = np.random.default_rng(0).standard_normal((3, 6, 5, 7, 2)).astype(np.float32)
    frames[0, 4:] = 0.0  # in no coreset beside this key frame: no samples
    frames[2, :2] = 0.0
    return lambda key: frames[key] * np.float32(scale)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1.7, 300.0])
def test_only_the_fringe_is_rounded_and_by_half_a_step_at_most(coreset, scale) -> None:
    table = finest(scale)
    step = fringe_step(coreset, 3, table)
    for key in range(3):
        rounded = round_fringe(coreset, key, table(key), step)
        inside = unpack(coreset.occupancy[key], coreset.box.shape)
        np.testing.assert_array_equal(rounded[inside], table(key)[inside])
        assert np.abs(rounded - table(key)).max() <= step / 2
        assert not np.array_equal(rounded, table(key))
        multiples = rounded[~inside] / step
        np.testing.assert_array_equal(multiples, np.rint(multiples))
        assert not np.signbit(rounded[~inside][rounded[~inside] == 0]).any()


def test_the_step_is_a_power_of_two_below_half_of_the_root_mean_square(coreset) -> None:
    table = finest()
    outside = np.concatenate(
        [table(key)[~unpack(coreset.occupancy[key], coreset.box.shape)].ravel() for key in range(3)]
    )
    root = np.sqrt(np.mean(outside[outside != 0].astype(float) ** 2))
    step = fringe_step(coreset, 3, table)
    assert np.log2(step) == np.floor(np.log2(step))
    assert step <= root / 2 < 2 * step


def test_without_a_fringe_nothing_is_rounded(coreset) -> None:
    assert fringe_step(coreset, 3, lambda key: np.zeros((6, 5, 7, 2), np.float32)) is None
    table = finest()
    np.testing.assert_array_equal(round_fringe(coreset, 0, table(0), None), table(0))


@pytest.fixture(scope="module")
def coreset_storage() -> Coreset:
    series = ArraySeries(np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5))
    return build_coreset(series, scan(series, silent), range(2), [Everything()], 0, silent)


class Stored:
    """Stands for a writer, and for the last array that was written."""

    def add_array(self, name, *, shape, dtype, chunk_shape, chunks, dimension_names, attributes):
        self.values = np.concatenate([chunk.reshape(-1) for chunk in chunks])
        self.shape, self.dtype, self.attributes = shape, dtype, attributes or {}

    def read(self, region):
        return self.values


def written(coreset_storage: Coreset, kind: str, values: list[float]) -> np.ndarray:
    """The coarsest table as it is read back, of a model with `values` first in every level."""
    architecture = Architecture.for_box(coreset_storage.box.shape, 2, embedding_size=1)
    fine = np.zeros((1, len(coreset_storage.values)), np.float32)
    tables = [np.zeros((prod(level), 1), np.float32) for level in architecture.levels[1:]]
    for table in (fine, *tables):
        table.reshape(-1)[: len(values)] = values
    stored = Stored()
    write_tables(stored, architecture, coreset_storage, fine, tables, kind)
    return StoredTable(stored).read(())


@pytest.mark.parametrize("kind", ["float32", "float16", "uint8"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(coreset_storage, kind, value) -> None:
    with pytest.raises(InputError, match="not finite"):
        written(coreset_storage, kind, [0.5, value])


def test_a_range_that_eight_bits_cannot_give_back_is_refused(coreset_storage) -> None:
    with pytest.raises(InputError, match=r"more than uint8 holds; use --tables float32"):
        written(coreset_storage, "uint8", [-3e38, 3e38])


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
def test_what_fits_comes_back_within_the_step_of_its_type(
    coreset_storage, kind, values, within
) -> None:
    back = written(coreset_storage, kind, values).astype(np.float64)
    assert np.all(np.isfinite(back))
    exact = np.zeros(len(back), np.float32)
    exact[: len(values)] = values
    assert np.abs(back - exact.astype(np.float64)).max() <= within


@pytest.mark.parametrize("shape", [(3, 1, 1, 1, 2), (2, 300, 200, 100, 2), (9, 1, 1, 10**7, 4)])
def test_chunks_are_one_time_node_of_bounded_size(shape) -> None:
    chunk = table_chunk(shape, 4)
    assert (chunk[0], chunk[-1]) == (1, shape[-1])
    assert prod(chunk) * 4 <= 2 << 20
    assert all(1 <= n <= length for n, length in zip(chunk, shape, strict=True))


def rewritten(path, target, mixing) -> None:
    """Write the same arrays, not coded, with other attributes of a component of level 1."""
    with Container.open(path) as container, ContainerWriter(target) as writer:
        for name, array in container.arrays.items():
            attributes = mixing if name == "tables/level_1/component_2" else dict(array.attributes)
            writer.add_whole(name, array.read(), attributes=attributes)
        writer.commit(container.header)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A small file with coded tables of two components."""
    path = tmp_path_factory.mktemp("small") / "a.fhz"
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 4, 5, 6)), indexing="ij")
    field = (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(np.float32)
    config = EncodeConfig(profile="paper", epochs=2, width=16, embedding_size=2, tables="transform")
    fhash_codec.encode(field, path, config)
    return path


@pytest.mark.parametrize(
    "mixing",
    [{}, {"mixing": 1.0}, {"mixing": [1.0]}, {"mixing": [1.0, "2"]}, {"mixing": [1.0, 2.0, 3.0]}],
    ids=str,
)
def test_a_mixing_of_other_numbers_is_refused(tmp_path, small, mixing) -> None:
    with pytest.raises(InputError, match="array tables/level_1/component_2 attribute mixing"):
        rewritten(small, tmp_path / "a.fhz", mixing)


def test_a_mixing_beyond_float32_is_damage(tmp_path, small) -> None:
    rewritten(small, tmp_path / "a.fhz", {"mixing": [1e308, 0.0]})
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        pytest.raises(DamagedFileError, match="not finite"),
    ):
        volume.read(0)
