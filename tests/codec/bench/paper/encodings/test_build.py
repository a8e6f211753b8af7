"""Encodings by name: their levels at the sizes of samples."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.data import Data, gather_data
from fhash_codec.bench.paper.encodings.build import build, levels_of, paper_grid
from fhash_codec.bench.paper.encodings.corners import GridLevel, HashLevel
from fhash_codec.bench.paper.encodings.gather import GatherModel
from fhash_codec.bench.paper.protocols import Arrangement, arrangement
from fhash_formats.series import ArraySeries


def test_levels_cover_the_box(data: Data) -> None:
    box, keys = data.coreset.box.shape, len(data.key_frames)
    arranged = arrangement("equal", "dense", data)
    (dense,) = levels_of("dense", data, data.coreset, arranged)
    assert dense == GridLevel((keys, *box), (keys, *box), True)
    multi = levels_of("dense-multi", data, data.coreset, arranged)
    assert multi[0] == dense
    assert [level.resolution[0] for level in multi if isinstance(level, GridLevel)] == [keys] * len(
        multi
    )
    hashed = levels_of("hash", data, data.coreset, arranged)
    assert all(isinstance(level, HashLevel) for level in hashed)
    assert len({level.size for level in hashed}) == 1
    assert hashed[0].size < keys * box[0] * box[1] * box[2]


def test_the_same_batches_in_the_protocol_equal(data: Data) -> None:
    orders = []
    for name in ("dense", "hash", "fhash"):
        arranged = arrangement("equal", name, data)
        encoding = build(
            name, data, arranged, steps=4, epochs=1, seed=5, device=torch.device("cpu")
        )
        (part,) = encoding.parts
        orders.append([chosen.tolist() for chosen in part.plan.order(0)])
    assert orders[0] == orders[1] == orders[2]


def test_the_rate_of_the_protocol_best_falls_to_zero(data: Data) -> None:
    rates = {}
    for protocol in ("equal", "best"):
        arranged = arrangement(protocol, "dense", data)
        encoding = build(
            "dense", data, arranged, steps=2, epochs=3, seed=1, device=torch.device("cpu")
        )
        rates[protocol] = encoding.parts[0].plan.rates[1:]
    assert (rates["equal"] == 0.01).all()
    assert (rates["best"][1:] < rates["best"][:-1]).all()
    assert rates["best"][0] < 0.01
    assert abs(rates["best"][-1]) < 1e-12


def test_released_has_the_levels_of_the_shortest_axis(data: Data) -> None:
    arranged = arrangement("released", "fhash", data)
    found = levels_of("fhash", data, data.boxes, arranged)
    assert [level.resolution for level in found if isinstance(level, GridLevel)] == [
        (3, 7, 9, 12),
        (2, 4, 5, 6),
        (2, 2, 3, 3),
    ]
    published = levels_of("fhash", data, data.boxes, arrangement("published", "fhash", data))
    assert len(published) == 4


def test_released_values_are_from_0_to_1_over_the_key_frames(series: ArraySeries) -> None:
    values = np.stack([series.read(step) for step in range(5)])
    values[1] *= 2  # no key frame
    data = gather_data("blob", ArraySeries(values), "interval:0.2:2", "0,2,4")
    arranged = arrangement("released", "fhash", data)
    encoding = build("fhash", data, arranged, steps=1, epochs=1, seed=1, device=torch.device("cpu"))
    (part,) = encoding.parts
    assert float(part.coreset.values.max()) == 1
    assert data.boxes.values.max() == pytest.approx(0.5, abs=0.01)
    at = torch.from_numpy(np.argwhere(data.masks[0]))
    inner = part.model.sample(torch.cat([torch.zeros(len(at), 1), at], 1).double())
    low, high = data.key_range
    torch.testing.assert_close(encoding.sample(0, at), low + (high - low) * inner)


def test_key_frames_start_apart(data: Data) -> None:
    arranged = Arrangement(joint=False, samples="everything", steps=(1,), engine="gather")
    encoding = build("dense", data, arranged, steps=1, epochs=1, seed=1, device=torch.device("cpu"))
    assert [part.plan.seed for part in encoding.parts] == [3, 4, 5]
    first, second, _ = (part.model for part in encoding.parts)
    assert isinstance(first, GatherModel)
    assert isinstance(second, GatherModel)
    assert first.places is second.places  # every vertex is a sample at every key frame
    assert not torch.equal(first.table, second.table)


@pytest.mark.parametrize(
    ("name", "frame", "grid"),
    [
        ("flame", (14, 43, 50), (16, 48, 48)),
        ("shell", (108, 108, 108), (96, 96, 96)),
        ("mine", (10, 20, 30), (10, 20, 30)),
    ],
)
def test_the_papers_grid_at_a_scale(
    name: str, frame: tuple[int, int, int], grid: tuple[int, int, int], data: Data
) -> None:
    empty = ArraySeries(np.zeros((1, *frame), np.float32))
    assert paper_grid(dataclasses.replace(data, name=name, series=empty)) == grid
