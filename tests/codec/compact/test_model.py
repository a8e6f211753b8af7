"""Reads of a compact file: regions, samples, gradients and levels of detail agree."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import DamagedFileError, EncodeConfig, InputError, RegionError
from fhash_codec.boxes import Box
from fhash_codec.compact.model import (
    CompactModel,
    PlainArray,
    head_of,
)
from fhash_formats.container import Container
from fhash_formats.errors import DamagedFileError as DamagedFileError_plain

Series = npt.NDArray[Any]
Field = Callable[..., Series]
Feature = tuple[Series, Path]
"""A series, and a container of it with vertices outside the coreset."""


def record_decoded_tiles(
    monkeypatch: pytest.MonkeyPatch, table: Any
) -> list[tuple[int, int, int, int]]:
    """Return a list that takes up the index of each tile of a table that is decoded."""
    decode, indices = type(table)._decode, []

    def recorded(array: Any, index: Any, *rest: Any) -> Any:
        if array.name == table.name:
            indices.append(index)
        return decode(array, index, *rest)

    monkeypatch.setattr(type(table), "_decode", recorded)
    return indices


def test_a_region_of_a_feature_reads_its_tiles_alone(feature: Feature) -> None:
    """Mask and values come from the same bytes: those of the tiles that the region touches."""
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["tables/level_1"]
        before = volume.container.bytes_read
        (z, _), (y, _), (x, _) = volume.box
        region = ((z, z + 3), (y, y + 4), (x, x + 7))
        values = volume.read(2, region)
        read = volume.container.bytes_read - before
        assert read < table.nbytes_stored / 4
        np.testing.assert_array_equal(
            volume.occupancy(2)[tuple(slice(*span) for span in region)], np.isfinite(values)
        )


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_series_bit_for_bit(feature: Feature, index: Any) -> None:
    with fhash_codec.open(feature[1]) as volume:
        series = volume[...]
    with fhash_codec.open(feature[1]) as volume:
        np.testing.assert_array_equal(volume[index], series[index])


def test_samples_at_vertices_are_what_is_read(feature: Feature) -> None:
    z, y, x = np.meshgrid(range(9), range(12), range(20), indexing="ij")
    with fhash_codec.open(feature[1]) as volume:
        for t in (0, 1, 4):
            np.testing.assert_array_equal(volume.sample(t=t, z=z, y=y, x=x), volume.read(t))
        np.testing.assert_allclose(
            volume.sample(t=2.25, z=z, y=y, x=x), volume.read(2.25), rtol=1e-6, atol=1e-5
        )
        between = 0.75 * volume.read(2).astype(np.float64) + 0.25 * volume.read(3)
        both = np.isfinite(between)
        np.testing.assert_allclose(volume.read(2.25)[both], between[both], rtol=1e-6, atol=1e-5)


def test_gradients_are_differences_of_the_vertices(feature: Feature) -> None:
    random = np.random.default_rng(0)
    with fhash_codec.open(feature[1]) as volume:
        cells = [random.integers(0, n - 1, 300) for n in volume.shape]
        for axis, name in enumerate("tzyx"):
            at = {other: cell + 0.0 for other, cell in zip("tzyx", cells, strict=True)}
            ends = [
                volume.sample(**{**at, name: cells[axis] + side}).astype(np.float64)
                for side in (0.0, 1.0)
            ]
            _, gradient = volume.sample(**{**at, name: cells[axis] + 0.4}, gradient=True)
            # Between steps a vertex counts that counts at either of them. What it decodes to at
            # the other step is open.
            finite = np.isfinite(gradient[:, axis]) & np.isfinite(ends[0]) & np.isfinite(ends[1])
            assert finite.sum() > 30
            np.testing.assert_allclose(
                gradient[finite, axis], (ends[1] - ends[0])[finite], rtol=1e-5, atol=1e-4
            )


def test_levels_of_detail_are_subsampled_and_near(
    tmp_path: Path, field: Field, feature: Feature
) -> None:
    source = field((3, 16, 24, 32))
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=2, tile="3x8x8x16"))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        np.testing.assert_array_equal(volume.read_lod(1, 0), volume.read(1))
        for lod in (1, 2):
            coarse = volume.read_lod(1, lod)
            every = source[1, :: 1 << lod, :: 1 << lod, :: 1 << lod]
            assert coarse.shape == every.shape
            assert np.sqrt(((coarse - every) ** 2).mean()) < 0.1 * np.ptp(source)
        assert volume.read_lod(0, 10).shape == (1, 1, 1)
        for lod in (-1, 11, 1.5):
            with pytest.raises(InputError, match="allowed: 0 to 10"):
                volume.read_lod(0, lod)
        with pytest.raises(InputError, match="between two"):
            volume.read_lod(0.5, 1)
        with pytest.raises(RegionError):
            volume.read_lod(3, 1)
    with fhash_codec.open(feature[1]) as volume:
        every = tuple(slice(low, high, 2) for low, high in volume.box)
        np.testing.assert_array_equal(
            np.isfinite(volume.read_lod(2, 1)), volume.occupancy(2)[every]
        )


@pytest.mark.parametrize("lod", [0, 1, 2, 3])
@pytest.mark.parametrize(
    "region",
    [
        ((0, 9), (0, 12), (0, 20)),
        ((2, 9), (3, 9), (7, 19)),
        ((8, 9), (8, 10), (15, 17)),
        ((0, 1), (0, 1), (0, 1)),
    ],
)
def test_a_region_of_a_level_of_detail_is_that_part_of_the_level(
    feature: Feature, lod: int, region: tuple[tuple[int, int], ...]
) -> None:
    with fhash_codec.open(feature[1]) as volume:
        level = np.full(volume.shape[1:], -1.0, np.float32)
        level[tuple(slice(low, high, 1 << lod) for low, high in volume.box)] = volume.read_lod(
            3, lod
        )
        vertices = [
            [n for n in range(low, high) if first <= n < end and (n - first) % (1 << lod) == 0]
            for (low, high), (first, end) in zip(region, volume.box, strict=True)
        ]
        if not all(vertices):
            with pytest.raises(RegionError, match=f"holds no vertex of level of detail {lod}"):
                volume.read_lod(3, lod, region)
            return
        assert [list(axis) for axis in volume.lod_vertices(lod, region)] == vertices
        np.testing.assert_array_equal(volume.read_lod(3, lod, region), level[np.ix_(*vertices)])


def test_a_region_of_a_level_of_detail_decodes_the_tiles_that_it_touches(
    feature: Feature, monkeypatch: pytest.MonkeyPatch
) -> None:
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["tables/level_1"]
        indices = record_decoded_tiles(monkeypatch, table)
        (z, _), (y, _), (x, _) = volume.box
        volume.read_lod(2, 1, ((z + 4, z + 7), (y, y + 5), (x + 8, x + 9)))
        assert set(indices) == {(1, 1, 0, 1)}
        with pytest.raises(RegionError, match="region 3:3 of axis y is empty"):
            volume.read_lod(2, 1, ((0, 1), (3, 3), (0, 1)))
        with pytest.raises(RegionError, match="outside 0:9"):
            volume.lod_vertices(1, ((0, 10), (0, 1), (0, 1)))


HEADER = {"required_features": ["transform"]}
"""The part of a header, of a file that is not plain, that a model needs."""


class Table:
    """A stored array of two steps, one tile each, that holds an infinity and a NaN."""

    shape, chunk_shape = (2, 2, 3, 4), (1, 2, 3, 4)
    dtype = np.dtype(np.float32)
    masked = False

    def __init__(self) -> None:
        self.values = np.arange(48, dtype=np.float32).reshape(self.shape)
        self.values[1, 1, 2, 3], self.values[1, 0, 0, 0] = -np.inf, np.nan

    def read(self, region: tuple[slice, ...]) -> Series:
        return self.values[region].copy()

    def prefetch(self, spans: object, lod: int) -> None:
        """All is here."""

    def decode_chunk(self, index: tuple[int, ...], lod: int) -> Series:
        every = slice(None, None, 1 << lod)
        return self.values[index[0] : index[0] + 1, every, every, every].copy()


WHOLE = Box.of([(0, 2), (0, 3), (0, 4)])


def model_of(arrays: dict[str, Table]) -> CompactModel:
    """Return the model of a container that holds these arrays alone."""
    return CompactModel(cast(Container, SimpleNamespace(arrays=arrays, header=HEADER)))


def reads(model: CompactModel) -> list[Callable[[], Any]]:
    """The ways to read the second step of a table, with its last vertex among those read."""
    end = [np.array([0.9]), np.array([1.9]), np.array([2.9])]
    return [
        lambda: model.read(1, WHOLE, np.ones((2, 3, 4), bool)),
        lambda: model.read(0.5, WHOLE, np.ones((2, 3, 4), bool)),
        lambda: model.read_lod(1, 0, WHOLE),
        lambda: model.sample(np.array([1.0]), end),
        lambda: model.sample_with_gradient(np.array([1.0]), end)[1],
    ]


@pytest.mark.parametrize("way", range(5))
def test_infinities_in_a_table_are_damage(way: int) -> None:
    model = model_of({"tables/level_1": Table()})
    with pytest.raises(DamagedFileError, match="the table holds infinities"):
        reads(model)[way]()
    assert np.isnan(model.read(1, ((0, 1), (0, 3), (0, 4)), np.ones((1, 3, 4), bool))).sum() == 1


def test_coarse_levels_of_labels_have_every_vertex_of_the_coreset(tmp_path: Path) -> None:
    """Tiles of odd lengths begin between the coarse vertices; their labels lie beside these."""
    t, z, y, x = np.indices((4, 9, 10, 11))
    values = np.rint(5 * np.sin(x / 2 + t) * np.cos(y / 2) + z / 3).astype(np.float32)
    config = EncodeConfig(effort=1, tile="2x3x4x5", features=("isosurface:2.5",), dilation=0)
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.container.arrays["tables/level_1"].settings.labels
        box = volume.box.slices()
        for step, lod in product(range(4), (1, 2)):
            coarse = volume.read_lod(step, lod)
            every = (slice(None, None, 1 << lod),) * 3
            occupied = volume.occupancy(step)[box][every]
            assert 0 < occupied.sum() < occupied.size
            np.testing.assert_array_equal(np.isfinite(coarse), occupied)


def test_parts_of_tables_are_parts_of_the_whole_and_integers_are_not_rounded(
    tmp_path: Path,
) -> None:
    t, _, y, x = np.meshgrid(*(np.arange(n) for n in (3, 5, 13, 17)), indexing="ij")
    values = (40 + 30 * np.sin(x / 3 + t) * np.cos(y / 4)).astype(np.int16)
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(effort=2, tile="2x5x6x8", psnr=45))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.dtype == np.int16
        for table in volume.tables:
            whole = np.asarray(table)
            assert whole.dtype == np.float32
            part = (slice(1, 3), slice(0, 1), slice(1, None), slice(0, 2))
            np.testing.assert_array_equal(table[part], whole[part])
        lattice = volume.tables[0][..., 0]
        assert not np.array_equal(lattice, np.rint(lattice))
        np.testing.assert_array_equal(np.rint(lattice), volume[...])


def test_a_head_that_is_no_head_is_damage() -> None:
    model = {"head": {"hidden": [1], "cross": False, "sigma": 1.0, "low": 0.0, "high": 1.0}}
    assert head_of({"head": None}, {}) is None

    def array(name: str, values: object, scale: float) -> SimpleNamespace:
        read = np.asarray(values, np.float32)
        return SimpleNamespace(name=name, attributes={"scale": scale}, read=lambda: read)

    arrays = {
        "mlp/weight_1": array("mlp/weight_1", np.full((1, 28), 0.5), 0.25),
        "mlp/bias_1": array("mlp/bias_1", [0.5], 0.25),
        "mlp/weight_2": array("mlp/weight_2", [[0.5]], 0.25),
        "mlp/bias_2": array("mlp/bias_2", [0.5], 0.25),
    }
    head = head_of(model, arrays)  # type: ignore[arg-type]
    assert head is not None
    assert head.layers[0].weights.tolist() == [[2] * 28]
    for scale, value in ((0.1, 0.55), (0.25, 100.0), (0.25, np.nan), (1e-300, 0.5), (0.2, 0.5)):
        wrong = {**arrays, "mlp/weight_2": array("mlp/weight_2", [[value]], scale)}
        with pytest.raises(DamagedFileError_plain, match=r"head|scale"):
            head_of(model, wrong)  # type: ignore[arg-type]


def plain_array(corrections: object, dtype: str, *, tile: int = 2) -> PlainArray:
    """A plain array of the values 0 to 3 along x, without a head."""
    table = np.arange(4, dtype=np.float32).reshape(1, 1, 1, 4, 1)
    added = np.asarray(corrections, np.float64).reshape(1, 1, 1, 4)
    arrays = {
        "tables/level_1": SimpleNamespace(shape=table.shape, read=lambda region: table[region]),
        "corrections": SimpleNamespace(read=lambda region: added[region]),
    }
    model = {"tile": [1, 1, 1, tile], "values": dtype, "head": None, "levels": [[1, 1, 1, 4]]}
    return PlainArray(model, arrays)  # type: ignore[arg-type]


ALL = (*[slice(0, 1)] * 3, slice(0, 4))


@pytest.mark.parametrize("dtype", ["int16", "float64"])
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_corrections_that_are_not_finite_are_damage(dtype: str, wrong: float) -> None:
    with pytest.raises(DamagedFileError_plain, match="corrections has numbers beyond"):
        plain_array([0, wrong, 0, 0], dtype).read(ALL)
