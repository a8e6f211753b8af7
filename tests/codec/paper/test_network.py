"""Networks refuse parts that do not fit, and numbers that are not finite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.paper.network import ArrayTable
from fhash_codec.paper.points import decode_region, sample_points
from fhash_formats.errors import DamagedFileError, InputError


def test_a_network_whose_parts_do_not_fit_is_refused(networks) -> None:
    net = networks.random((4, 5, 6), 2, 2, 2, 1)
    weight, bias = net.layers[0]
    cases = [
        ({"tables": net.tables[:-1]}, "tables for"),
        ({"tables": [net.tables[1], *net.tables[1:]]}, "table of level 1 has shape"),
        ({"tables": [*net.tables[:2], net.tables[0]]}, "table of level 3 has shape"),
        ({"embedding_size": 3}, "table of level 1 has shape"),
        ({"key_frames": 0}, "at least 1"),
        ({"layers": net.layers[:1]}, "one output"),
        ({"layers": ()}, "one output"),
        ({"layers": ((weight[:, 1:], bias), net.layers[1])}, "layer 1 has weight"),
        ({"layers": ((weight, bias[1:]), net.layers[1])}, "layer 1 has weight"),
        ({"layers": (net.layers[0], net.layers[0])}, "layer 2 has weight"),
        ({"layers": ((weight * np.float32(np.nan), bias), net.layers[1])}, "not finite"),
    ]
    for change, message in cases:
        with pytest.raises(InputError, match=message):
            replace(net, **change)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_table_that_is_not_finite_is_refused_not_decoded(networks, bad) -> None:
    """Messages count levels from 1, as the arrays of the file do."""
    net = networks.random((4, 5, 6), 2, 2, 2, 1)
    net.tables[1].values[0, 0, 0, 0, 1] = bad
    with pytest.raises(DamagedFileError, match="level 2 holds"):
        decode_region(net, 0, networks.box(net))
    with pytest.raises(DamagedFileError, match="level 2 holds"):
        sample_points(net, 0, 0, 0, 0)


@pytest.mark.parametrize("gradient", [False, True])
def test_weights_that_overflow_give_no_warning(networks, gradient) -> None:
    """Hostile files may hold such weights."""
    net = networks.random((2, 3, 4), 2, 2, 2, 2)
    huge = np.float32(3e38)
    mixed = tuple((np.where(weight > 0, huge, -huge), bias) for weight, bias in net.layers)
    positive = tuple((np.full_like(weight, huge), bias) for weight, bias in net.layers)
    tables = [ArrayTable(np.abs(table.values) + 1) for table in net.tables]
    points = np.full((4, 3), 0.5)
    for hostile in (replace(net, layers=mixed), replace(net, layers=positive, tables=tables)):
        result = sample_points(hostile, *points, gradient=gradient)
        frame = decode_region(hostile, 0.5, ((0, 2), (0, 3), (0, 4)))
    values = result[0] if gradient else result
    assert not np.isfinite(values).any()
    assert not np.isfinite(frame).any()
