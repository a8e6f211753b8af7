"""The start of every training."""

from __future__ import annotations

from math import prod

import torch

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.initial import SPREAD, initial_parameters


def test_the_start_depends_on_the_seed_alone(noise_coreset) -> None:
    coreset = noise_coreset((2, 5, 6, 7))
    architecture = Architecture.for_box(coreset.box.shape, 2)
    one, same, other = (initial_parameters(architecture, coreset, seed) for seed in (4, 4, 5))
    assert torch.equal(one.fine, same.fine)
    assert torch.equal(one.coarse, same.coarse)
    assert torch.equal(one.network, same.network)
    assert not torch.equal(one.network, other.network)
    assert (
        one.coarse.numel() + one.network.numel() + prod(architecture.levels[0]) * 2
        == architecture.parameters
    )


def test_parameters_are_within_their_bounds_and_split_by_level_and_layer(noise_coreset) -> None:
    coreset = noise_coreset((2, 5, 6, 7))
    architecture = Architecture.for_box(coreset.box.shape, 2)
    parameters = initial_parameters(architecture, coreset, 0)
    tables, layers = parameters.dense(architecture)
    assert [tuple(table.shape) for table in tables] == [
        (prod(level), 2) for level in architecture.levels[1:]
    ]
    for table in (parameters.fine, *tables):
        assert 0.5 * SPREAD < float(table.abs().max()) <= SPREAD
    for (weight, bias), (outputs, inputs) in zip(layers, architecture.layer_shapes, strict=True):
        assert (weight.shape, bias.shape) == ((outputs, inputs), (outputs,))
        assert max(float(weight.abs().max()), float(bias.abs().max())) <= inputs**-0.5


def test_embeddings_of_samples_start_where_those_of_whole_bricks_did(
    noise_coreset, in_coreset, monkeypatch
) -> None:
    coreset = noise_coreset((2, 9, 10, 20), 0.7)
    architecture = Architecture.for_box(coreset.box.shape, 2)
    shape = (len(coreset.bricks), 2, prod(coreset.brick_shape))
    random = torch.Generator().manual_seed(3)
    whole = torch.empty(shape).uniform_(-SPREAD, SPREAD, generator=random)
    expected = whole.transpose(0, 1)[:, torch.from_numpy(in_coreset(coreset))]
    for bricks in (1, 3, 1024):
        monkeypatch.setattr("fhash_codec.paper.engines.initial.BRICKS_AT_A_TIME", bricks)
        assert torch.equal(initial_parameters(architecture, coreset, 3).fine, expected)
