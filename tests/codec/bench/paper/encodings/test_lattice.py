"""The product's engine behind dense grids and F-Hash, beside the gather engine."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings.build import levels_of
from fhash_codec.bench.paper.encodings.corners import GridLevel
from fhash_codec.bench.paper.encodings.gather import GatherModel
from fhash_codec.bench.paper.encodings.lattice import LatticeModel
from fhash_codec.bench.paper.protocols import arrangement

CPU = torch.device("cpu")
RATES = np.full(100, 0.01)


def levels(name: str, data: Data) -> list[GridLevel]:
    found = levels_of(name, data, data.coreset, arrangement("best", name, data))
    return [level for level in found if isinstance(level, GridLevel)]


def same_numbers(lattice: LatticeModel, gather: GatherModel) -> None:
    """Give a gather model in float64 the numbers of a lattice model."""
    arrays = [torch.from_numpy(array).double() for array in lattice.arrays()]
    count = len(lattice.levels)
    table = torch.cat(arrays[:count])
    with torch.no_grad():
        gather.table.copy_(table if gather.rank is None else table[gather.rank >= 0])
        for number, array in zip(gather.numbers[1:], arrays[count:], strict=True):
            number.copy_(array)


@pytest.mark.parametrize("name", ["dense", "dense-multi", "fhash"])
def test_values_and_gradients_are_those_of_the_gather_engine(name: str, data: Data) -> None:
    lattice = LatticeModel(levels(name, data), data.coreset, RATES, seed=1, device=CPU)
    gather = GatherModel(
        levels(name, data), data.coreset, RATES, seed=1, device=CPU, dtype=torch.float64
    )
    assert (lattice.tables, lattice.mlp) == (gather.tables, gather.mlp)
    same_numbers(lattice, gather)
    samples, every = np.arange(len(data.coreset.values)), np.arange(len(data.coreset.bricks))
    np.testing.assert_allclose(lattice.infer(samples), gather.infer(samples), atol=1e-6)
    lattice.train(every)
    expected = gather.gradients(samples)
    # After one step Adam's mean is a tenth of the gradient.
    moments = lattice.engine.flat_mean[lattice.engine.coarse :] * 10
    network = torch.cat(
        [
            torch.column_stack([weight, bias]).flatten()
            for weight, bias in zip(expected[1::2], expected[2::2], strict=True)
        ]
    )
    np.testing.assert_allclose(moments, network, atol=2e-6)
    table = torch.zeros(gather.embeddings, 2, dtype=torch.float64)
    table[slice(None) if gather.rank is None else gather.rank >= 0] = expected[0]
    fine = lattice.engine.fine_mean * 10
    total = float(table[: lattice.levels[0].size].abs().sum())
    assert float(fine.abs().sum()) == pytest.approx(total, rel=1e-4)


@pytest.mark.parametrize("name", ["dense", "dense-multi", "fhash"])
def test_training_lowers_the_error_and_sample_agrees(name: str, data: Data) -> None:
    model = LatticeModel(levels(name, data), data.coreset, RATES, seed=2, device=CPU)
    samples, every = np.arange(len(data.coreset.values)), np.arange(len(data.coreset.bricks))
    before = np.square(model.infer(samples) - data.coreset.values).mean()
    for _ in range(60):
        model.train(every)
    model.settle()
    values = model.infer(samples)
    assert np.square(values - data.coreset.values).mean() < before / 50
    np.testing.assert_allclose(model.sample(model.places.double()).numpy(), values, atol=1e-5)
    assert 0 < model.moved() <= model.embeddings


def test_dense_grid_equals_grid_sample(data: Data) -> None:
    model = LatticeModel(levels("dense-multi", data), data.coreset, RATES, seed=4, device=CPU)
    for _ in range(5):
        model.train(np.arange(len(data.coreset.bricks)))
    model.settle()
    arrays = [torch.from_numpy(array) for array in model.arrays()]
    count, (keys, z, y, x) = len(model.levels), model.levels[0].sizes
    places = model.places
    grid = (2 * places[:, 1:] / (torch.tensor([z, y, x]) - 1) - 1).flip(1).float()
    hidden = []
    for level, table in zip(model.levels, arrays[:count], strict=True):
        volume = table.view(*level.resolution, 2).permute(0, 4, 1, 2, 3)
        of_keys = torch.nn.functional.grid_sample(
            volume, grid.expand(keys, -1, -1)[:, :, None, None], align_corners=True
        )[..., 0, 0]
        hidden.append(of_keys[places[:, 0].long(), :, torch.arange(len(places))])
    values = torch.cat(hidden, 1)
    for number, (weight, bias) in enumerate(zip(arrays[count::2], arrays[count + 1 :: 2])):  # noqa: B905
        values = (values if number == 0 else values.relu()) @ weight.T + bias
    samples = np.arange(len(data.coreset.values))
    np.testing.assert_allclose(model.infer(samples), values[:, 0].numpy(), atol=1e-5)
