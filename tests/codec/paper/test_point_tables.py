"""Parts of tables around points: what is read, and interpolation in time once."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.paper.point_tables import PointTables, locate


def test_a_part_holds_the_corners_of_all_points(networks, network) -> None:
    recording = networks.recording(network)
    points = np.array(networks.points(network, 7))
    tables = PointTables.read(recording, points.min(axis=1), points.max(axis=1))
    for level, patch in zip(network.levels, tables.patches, strict=True):
        before, after_weight, _ = locate(tables.sizes, level, points)
        last = np.minimum(before + 1, np.array(level)[:, None] - 1)
        assert (before.min(axis=1) == patch.first).all()
        assert (last.max(axis=1) < np.add(patch.first, patch.values.shape[:4])).all()
        assert ((after_weight >= 0) & (after_weight <= 1)).all()
    assert all(len(table.regions) == 1 for table in recording.tables)


def test_tables_at_one_time_are_those_between_its_nodes(networks) -> None:
    network = networks.random((4, 5, 6), 5, 2, 2, 1, dtype=np.float16)
    tables = PointTables.of_box(network, 1.7)
    still = tables.at(1.7)
    assert (still.still, tables.still) == (True, False)
    assert still.at(0.0) is still
    for level, patch, table in zip(network.levels, still.patches, network.tables, strict=True):
        position = 1.7 * (level[0] - 1) / 4
        node = int(position)
        low, high = table.values[node].astype(float), table.values[node + 1].astype(float)
        expected = low + (position - node) * (high - low)
        np.testing.assert_allclose(patch.values[0], expected, rtol=1e-6, atol=1e-6)
        assert patch.values.dtype == np.float32


@pytest.mark.parametrize("size", [1, 2, 7, 64])
def test_a_vertex_on_a_corner_lies_in_the_cell_that_begins_there(size: int) -> None:
    vertices = np.tile(np.arange(size, dtype=float), (4, 1))
    before, after_weight, pace = locate((size,) * 4, (size,) * 4, vertices)
    np.testing.assert_array_equal(before[0] + after_weight[0], np.arange(size))
    assert pace.tolist() == [1.0 if size > 1 else 0.0] * 4
