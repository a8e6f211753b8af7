"""Tables in parts: the numbers are those of a table that has its head and masks itself."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from table_files import HEAD, SHAPE, table_parts, write_table

from fhash_formats.container import Container, ContainerWriter, sharding
from fhash_formats.container.table_parts import TableParts


@pytest.mark.parametrize(("head", "mask"), list(product([True, False], repeat=2)))
def test_parts_give_the_numbers_of_the_whole(tmp_path, samples, head, mask) -> None:
    parts = table_parts(head=head, mask=mask)
    header = samples.compact_header()
    paths = [
        write_table(tmp_path / f"{apart}.fhz", header, parts, apart=apart)
        for apart in (True, False)
    ]
    with Container.open(paths[0]) as container, Container.open(paths[1]) as whole:
        names = ["mlp/parameters"] * head + ["occupancy/mask"] * mask
        assert sorted({*container.arrays} - {*whole.arrays}) == names
        assert ("apart" in container.header["required_features"]) == (head or mask)
        table, other = container.arrays["tables/level_1"], whole.arrays["tables/level_1"]
        assert table.masked == other.masked == mask
        region = tuple(slice(1, n) for n in SHAPE)
        for there in (None, region):
            np.testing.assert_array_equal(table.read(there), other.read(there))
            np.testing.assert_array_equal(table.read_mask(there), other.read_mask(there))
        for index, lod in product(np.ndindex(table.grid), (0, 1, 2)):
            np.testing.assert_array_equal(
                table.decode_chunk(index, lod), other.decode_chunk(index, lod)
            )
            np.testing.assert_array_equal(
                table.decode_table(index, lod), other.decode_table(index, lod)
            )
        assert container.verify() == 1 + head + mask
        if mask:
            assert not table.read_mask().all()
            assert container.arrays["occupancy/mask"].grid == table.grid


def test_the_parameters_are_those_of_the_head(tmp_path, samples) -> None:
    path = write_table(tmp_path / "a.fhz", samples.compact_header(), table_parts(), apart=True)
    with Container.open(path) as container:
        parameters = container.arrays["mlp/parameters"].read()
    expected = np.concatenate(
        [
            part.ravel() * scale
            for layer in HEAD.layers
            for part, scale in (
                (layer.weights, layer.weight_scale),
                (layer.biases, layer.bias_scale),
            )
        ]
    )
    np.testing.assert_array_equal(parameters, expected.astype(np.float32))


def test_masks_that_say_nothing_take_no_array(tmp_path, samples) -> None:
    parts = table_parts(head=False)
    full = [parts.streams[1]] * 2
    whole = type(parts)(**{**vars_of(parts), "streams": full})
    assert whole.features == ["transform", "mask"]
    path = write_table(tmp_path / "a.fhz", samples.compact_header(), whole, apart=True)
    with Container.open(path) as container:
        assert list(container.arrays) == ["tables/level_1"]
        assert container.arrays["tables/level_1"].read_mask().all()


def vars_of(parts):
    return {name: getattr(parts, name) for name in ("shape", "dtype", "tile", "settings")}


def test_a_table_keeps_its_parts_itself(tmp_path, samples) -> None:
    parts = table_parts()
    assert parts.features == ["transform", "mask"]
    header = samples.compact_header()
    with ContainerWriter(tmp_path / "whole.fhz") as writer:
        parts.write(writer)
        whole = writer.commit({**header, "required_features": parts.features})
    apart = write_table(tmp_path / "apart.fhz", header, parts, apart=True).stat().st_size
    assert whole < apart - 1000
    with Container.open(tmp_path / "whole.fhz") as container:
        assert set(container.arrays) == {"tables/level_1"}
        table = container.arrays["tables/level_1"]
        values, masks = table.read(), table.read_mask()
    with Container.open(tmp_path / "apart.fhz") as container:
        table = container.arrays["tables/level_1"]
        np.testing.assert_array_equal(values, table.read())
        np.testing.assert_array_equal(masks, table.read_mask())


@pytest.mark.parametrize("most", [1, 200])
def test_a_table_beyond_a_member_is_cut_into_shards(tmp_path, samples, monkeypatch, most) -> None:
    parts, header = table_parts(), samples.compact_header()

    def written(name: str, parts: TableParts) -> Path:
        with ContainerWriter(tmp_path / name) as writer:
            parts.write(writer)
            writer.commit({**header, "required_features": parts.features})
        return tmp_path / name

    whole = written("whole.fhz", parts)
    monkeypatch.setattr(sharding, "MAX_MEMBER", most)
    known = replace(parts, sizes=np.array([len(stream) for stream in parts.streams]))
    paths = [written(f"{number}.fhz", each) for number, each in enumerate((parts, known))]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with Container.open(whole) as container, Container.open(paths[0]) as cut:
        table, other = container.arrays["tables/level_1"], cut.arrays["tables/level_1"]
        assert len(other.chunks) > len(table.chunks)
        np.testing.assert_array_equal(table.read(), other.read())
        for index in np.ndindex(table.grid):
            assert table.coded_bytes(index) == other.coded_bytes(index) == len(other.coded(index))
        assert cut.verify()
