"""Tables in parts: the numbers are those of a table that has its head and masks itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from table_files import table_parts

from fhash_formats.container import Container, ContainerWriter, sharding
from fhash_formats.container.table_parts import TableParts


@pytest.mark.parametrize("most", [1, 200])
def test_a_table_beyond_a_member_is_cut_into_shards(tmp_path, samples, monkeypatch, most) -> None:
    parts, header = table_parts(), samples.compact_header()

    def written(name: str, parts: TableParts) -> Path:
        with ContainerWriter(tmp_path / name) as writer:
            parts.write(writer)
            writer.commit({**header, "required_features": ["transform"]})
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
