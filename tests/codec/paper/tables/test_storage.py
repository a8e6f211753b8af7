"""The vertices of a level that samples need, from the occupancy alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.features import occupancy
from fhash_codec.paper.model import (
    PointSampler,
    PointTables,
    SparsePatch,
    decode_region,
)
from fhash_codec.paper.network import Network, level_resolutions
from fhash_codec.paper.storage import Needed, SparseTable, corners, needed_by, spread
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import DamagedFileError, InputError


@pytest.mark.parametrize(("length", "resolution"), [(1, 1), (5, 3), (5, 5), (9, 2), (20, 7)])
def test_corners_are_those_of_the_interpolation(length, resolution) -> None:
    position = np.arange(length) * (resolution - 1) / max(length - 1, 1)
    first, last = corners(length, resolution)
    np.testing.assert_array_equal(first, np.floor(position + 1e-12))
    np.testing.assert_array_equal(last, np.ceil(position - 1e-12))
    weighs = np.zeros((length, resolution), bool)
    weighs[np.arange(length), first] = weighs[np.arange(length), last] = True
    for seed in range(5):
        mask = np.random.default_rng(seed).random((2, length)) < 0.3
        np.testing.assert_array_equal(
            spread(mask, 1, resolution), (weighs.T[None] & mask[:, None]).any(axis=2)
        )


@pytest.mark.parametrize("fringe", [False, True])
@pytest.mark.parametrize(
    ("box", "keys", "fold"), [((5, 6, 7), 5, 2), ((1, 9, 4), 1, 2), ((4, 3, 11), 7, 3)]
)
def test_needed_are_the_corners_around_samples(box, keys, fold, fringe) -> None:
    """The law in words: every corner with a weight, of every sample, and nothing else."""
    random = np.random.default_rng(0)
    masks = random.random((keys, *box)) < 0.04
    levels = level_resolutions(box, keys, fold)
    packed = [occupancy.pack(mask) for mask in masks]
    needed = Needed(levels, packed.__getitem__, fringe=fringe)
    samples = masks.copy()
    if fringe:
        samples[1:] |= masks[:-1]
        samples[:-1] |= masks[1:]
    for number, level in enumerate(levels):
        expected = np.zeros(level, np.bool_)
        sizes = (keys, *box)
        for sample in np.argwhere(samples):
            around = [
                {p * (r - 1) // max(n - 1, 1), -(-p * (r - 1) // max(n - 1, 1))}
                for p, r, n in zip(sample.tolist(), level, sizes, strict=True)
            ]
            for corner in product(*around):
                expected[corner] = True
        found = np.stack([needed.mask(number, node) for node in range(level[0])])
        np.testing.assert_array_equal(found, expected)
        assert needed.counts(number) == expected.sum(axis=(1, 2, 3)).tolist()


FEATURE = EncodeConfig(
    profile="paper",
    epochs=2,
    width=8,
    features=("interval:80:120",),
    dilation=0,
    key_frames="0,2,4",
    timings=False,
)


def sparse(network: Network, model: Any) -> Network:
    """The network with tables that hold the needed vertices of a random model alone."""
    needed = needed_by(model.selection.architecture, model.selection.coreset)
    tables = []
    for level, table in enumerate(network.tables):
        values = table.read(tuple(slice(0, n) for n in table.shape))
        masks = np.stack([needed.mask(level, node) for node in range(len(values))])
        held = values[masks]
        tables.append(
            SparseTable(
                values.shape,
                masks.sum(axis=(1, 2, 3)).tolist(),
                lambda first, end, held=held: held[first:end],
                lambda node, masks=masks: masks[node],
                f"level {level + 1}",
            )
        )
    return replace(network, tables=tables)


def test_regions_of_a_table_are_those_of_a_dense_one(random_model) -> None:
    dense = random_model.network(fill=0.0)
    chance = np.random.default_rng(0)
    for table, other in zip(sparse(dense, random_model).tables, dense.tables, strict=True):
        assert tuple(table.shape) == tuple(other.shape)
        for _ in range(20):
            spans = [sorted(chance.choice(n + 1, 2, replace=False)) for n in table.shape]
            region = tuple(slice(int(start), int(stop)) for start, stop in spans)
            np.testing.assert_array_equal(table.read(region), other.read(region))


@pytest.mark.parametrize("small", [0, 200, 10**6])
@pytest.mark.parametrize("key", [0.0, 0.4, 2.0, 3.75, 4.0])
def test_a_decoded_region_has_the_bits_of_a_dense_one(
    random_model, monkeypatch, key, small
) -> None:
    """Whichever levels get all their vertices first."""
    monkeypatch.setattr("fhash_codec.paper.model.SMALL_NUMBERS", small)
    dense = random_model.network(fill=0.0)
    network = sparse(dense, random_model)
    whole = tuple((0, n) for n in dense.box_size)
    for region in (whole, ((2, 7), (0, 12), (3, 17)), tuple((n - 1, n) for n in dense.box_size)):
        np.testing.assert_array_equal(
            decode_region(network, key, region), decode_region(dense, key, region)
        )
    requested = np.random.default_rng(1).random(dense.box_size) < 0.1
    np.testing.assert_array_equal(
        decode_region(network, key, whole, requested=requested)[requested],
        decode_region(dense, key, whole, requested=requested)[requested],
    )


@pytest.mark.parametrize("key", [0.0, 1.3, 4.0])
def test_points_of_one_time_are_found_by_ranks(random_model, key) -> None:
    """Pictures through the network do so."""
    dense = random_model.network(fill=0.0)
    network = sparse(dense, random_model)
    tables = PointTables.of_box(network, key)
    assert all(isinstance(patch, SparsePatch) for patch in tables.patches)
    chance = np.random.default_rng(3)
    places = [np.zeros(1), *(chance.random(300) * (n - 1) for n in dense.box_size)]
    for column, size in zip(places[1:], dense.box_size, strict=True):
        column[:20] = chance.integers(0, size, 20)
    read = []
    for box in (tables, PointTables.of_box(dense, key)):
        values, slopes = np.empty(300, np.float32), np.empty((300, 4), np.float32)
        PointSampler(box, key).sample(places, values, slopes, 1)
        read.append((values, slopes))
    np.testing.assert_array_equal(read[0][0], read[1][0])
    np.testing.assert_array_equal(read[0][1], read[1][1])


def test_sparse_parts_of_two_times_are_not_read_by_rank(random_model) -> None:
    tables = PointTables.of_box(sparse(random_model.network(fill=0.0), random_model), 1.3)
    with pytest.raises(AssertionError, match="at several times"):
        PointSampler(tables)
    PointSampler(tables, 1.3)


def test_numbers_that_are_not_finite_are_damage(random_model) -> None:
    network = sparse(random_model.network(fill=0.0), random_model)
    frame = network.tables[1].frame(0)
    frame.values[0, 0] = np.nan
    with pytest.raises(DamagedFileError, match="level 2 holds numbers that are not finite"):
        decode_region(network, 0.0, tuple((0, n) for n in network.box_size))


@pytest.fixture(scope="module", params=["float16", "float32", "uint8"])
def files(request, tmp_path_factory, waves) -> tuple[Path, Path]:
    """The files of one training: with all vertices, and with the needed ones alone."""
    folder = tmp_path_factory.mktemp("sparse")
    config = replace(FEATURE, tables=request.param)
    for name, share in {"dense": 0.0, "sparse": 2.0}.items():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("fhash_codec.paper.encode.SPARSE_BELOW", share)
            fhash_codec.encode(waves(), folder / f"{name}.fhz", config)
    return folder / "dense.fhz", folder / "sparse.fhz"


def test_both_files_decode_to_the_same_bits(files) -> None:
    with fhash_codec.open(files[0]) as dense, fhash_codec.open(files[1]) as other:
        assert "sparse" not in dense.info["model"]
        assert other.info["model"]["sparse"] == "fringe"
        assert other.info["required_features"] == ["sparse-tables"]
        for t in (0, 0.7, 1, 2, 3.5, 4):
            np.testing.assert_array_equal(dense.read(t), other.read(t))
        points = np.random.default_rng(0).random((2000, 4)) * [4, 8, 11, 19]
        np.testing.assert_array_equal(dense.model(points), other.model(points))
        assert np.isfinite(other.model(points)).sum() > 20


def rewritten(source: Path, target: Path, changes: dict[str, Any]) -> None:
    """Write the same arrays, some of them replaced by (values, attributes)."""
    with Container.open(source) as container, ContainerWriter(target) as writer:
        for name, array in container.arrays.items():
            values, attributes = changes.get(name, (array.read(), dict(array.attributes)))
            writer.add_whole(name, values, attributes=attributes)
        writer.commit(container.header)


def test_counts_that_are_not_those_of_the_occupancy_are_damage(files, tmp_path) -> None:
    with Container.open(files[1]) as container:
        table = container.arrays["tables/level_1"]
        values, attributes = table.read(), dict(table.attributes)
        bits = container.arrays["occupancy/bits"].read()
    first, *others = attributes["counts"]
    moved = {**attributes, "counts": [first - 1, others[0] + 1, *others[1:]]}
    rewritten(files[1], tmp_path / "a.fhz", {"tables/level_1": (values, moved)})
    message = rf"a.fhz: array tables/level_1 has {first - 1} vertices at time node 0; .* {first}$"
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        pytest.raises(DamagedFileError, match=message),
    ):
        volume.read(0)
    everywhere = np.full_like(bits, 255)
    rewritten(files[1], tmp_path / "b.fhz", {"occupancy/bits": (everywhere, {})})
    with (
        fhash_codec.open(tmp_path / "b.fhz") as volume,
        pytest.raises(DamagedFileError, match="the occupancy asks for"),
    ):
        volume.read(0)


def test_a_table_of_other_rows_is_refused(files, tmp_path) -> None:
    with Container.open(files[1]) as container:
        table = container.arrays["tables/level_2"]
        values, attributes = table.read(), dict(table.attributes)
    with pytest.raises(InputError, match=r"array tables/level_2 is .* asks for"):
        rewritten(files[1], tmp_path / "a.fhz", {"tables/level_2": (values[1:], attributes)})
