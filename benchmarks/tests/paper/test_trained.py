"""Encodings by name: their levels at the sizes of samples."""

from __future__ import annotations

import dataclasses
import sys
import types
from typing import Any

import numpy as np
import pytest
import torch

from fhash_bench.paper import trained as tcnn
from fhash_bench.paper.data import (
    Arrangement,
    Data,
    arrangement,
    gather_data,
    hash_resolutions,
    tcnn_network,
    tcnn_tables,
)
from fhash_bench.paper.encodings import GatherModel, GridLevel, HashLevel, of_key_frame
from fhash_bench.paper.trained import TrainedEncoding, build, levels_of, paper_grid
from fhash_formats.errors import MissingDependencyError
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


class StandIn(torch.nn.Module):
    """Stand-in for tiny-cuda-nn's module: the same arguments, the same number of parameters."""

    made: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, inputs: int, outputs: int, encoding: dict, network: dict, seed: int) -> None:
        super().__init__()
        self.made.append(encoding | network | {"inputs": inputs, "outputs": outputs, "seed": seed})
        self.params = torch.nn.Parameter(torch.zeros(COUNT[0]))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return (points @ self.params[:3] + self.params[3])[:, None].half()


COUNT = [0]


def test_one_line_says_what_is_missing(data: Data) -> None:
    reason = tcnn.missing()
    if reason is None:
        pytest.skip("tiny-cuda-nn is here")
    assert "\n" not in reason
    assert reason.startswith("tcnn: ")
    with pytest.raises(MissingDependencyError, match="tiny-cuda-nn"):
        tcnn.TcnnModel(
            of_key_frame(data.coreset, 0),
            np.full(3, 0.01),
            coarsest=4,
            seed=0,
            device=torch.device("cpu"),
        )


def test_training_beside_a_stand_in(data: Data, monkeypatch: pytest.MonkeyPatch) -> None:
    package = types.ModuleType("tinycudann")
    package.NetworkWithInputEncoding = StandIn  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tinycudann", package)
    monkeypatch.setattr(tcnn, "missing", lambda: None)
    coreset = of_key_frame(data.coreset, 0)
    box = coreset.box.shape
    levels = hash_resolutions(box, 4)
    COUNT[0] = tcnn_tables(box, 4, 1) + tcnn_network(len(levels), 1)
    model = tcnn.TcnnModel(
        coreset, np.full(50, 0.01), coarsest=4, seed=0, device=torch.device("cpu")
    )
    made = StandIn.made[-1]
    assert made["n_levels"] == len(levels)
    assert made["base_resolution"] * 2 ** (len(levels) - 1) == levels[0]
    assert (made["n_hidden_layers"], made["n_neurons"]) == (2, 64)
    samples = np.arange(len(coreset.values))
    before = np.square(model.infer(samples) - coreset.values).mean()
    for _ in range(40):
        model.train(np.arange(len(coreset.bricks)))
    assert np.square(model.infer(samples) - coreset.values).mean() < before
    assert model.moved() == 0  # the stand-in has no tables
    COUNT[0] -= 8
    with pytest.raises(MissingDependencyError, match="parameters"):
        tcnn.TcnnModel(coreset, np.full(3, 0.01), coarsest=4, seed=0, device=torch.device("cpu"))


def trained(name: str, protocol: str, data: Data, epochs: int = 2) -> TrainedEncoding:
    arranged = arrangement(protocol, name, data)
    encoding = build(
        name,
        data,
        arranged,
        steps=arranged.steps[0],
        epochs=epochs,
        seed=1,
        device=torch.device("cpu"),
    )
    for epoch in range(epochs):
        encoding.train_epoch(epoch)
    encoding.settle()
    return encoding


def near_masks(data: Data, key: int) -> np.ndarray:
    """Vertices (z, y, x) in the coreset of a key frame or of a neighbour."""
    return np.logical_or.reduce(data.masks[max(key - 1, 0) : key + 2])


@pytest.mark.parametrize(
    ("name", "protocol"),
    [
        ("dense", "published"),
        ("hash", "equal"),
        ("fhash", "published"),
        ("fhash", "released"),
        ("fhash", "best"),
    ],
)
def test_a_frame_holds_the_samples_and_the_background(name: str, protocol: str, data: Data) -> None:
    encoding = trained(name, protocol, data)
    for key, mask in enumerate(data.masks):
        frame = encoding.frame(key)
        trained_on = {"published": mask, "released": mask}.get(protocol, near_masks(data, key))
        if protocol == "published" and name != "fhash":
            trained_on = np.ones_like(mask)
        places = np.argwhere(trained_on)
        at = encoding.sample(key, torch.from_numpy(places)).numpy()
        np.testing.assert_allclose(frame[tuple(places.T)], at, atol=1e-5)
        if protocol != "released":
            assert (frame[~trained_on] == np.float32(data.background)).all()


def test_places_outside_the_box_are_the_background(data: Data) -> None:
    encoding = trained("fhash", "equal", data)
    outside = torch.tensor([[-1.0, 0, 0], [0, 0, 50.0]])
    assert (encoding.sample(0, outside) == np.float32(data.background)).all()


def test_between_key_frames_others_interpolate_values(data: Data) -> None:
    places = torch.tensor([[3.0, 4.0, 5.0], [3.5, 4.0, 4.0]])
    for name in ("dense", "fhash"):
        encoding = trained(name, "equal", data, epochs=4)
        before, after = (encoding.sample(key, places) for key in (0, 1))
        between = encoding.sample(0.5, places)
        linear = torch.allclose(between, (before + after) / 2, atol=1e-6)
        assert linear == (name == "dense")


def test_parameters_count_every_key_frame(data: Data) -> None:
    encoding = trained("dense", "published", data, epochs=1)
    assert encoding.tables == 7 * 9 * 12 * 2 * 3
    # 2 inputs, 2 hidden layers of 64, 1 output, a network for each key frame.
    assert encoding.mlp == 3 * (2 * 64 + 64 + 64 * 64 + 64 + 64 + 1)
    assert sum(array.size for array in encoding.arrays()) == encoding.tables + encoding.mlp
    assert encoding.buckets_used() == 1.0
    assert encoding.samples_an_epoch == 3 * 7 * 9 * 12
