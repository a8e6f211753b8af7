"""The size of a model, and the number of its parameters."""

from __future__ import annotations

import pytest
import torch
from readable_paper import FHash

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.levels import parameter_count


@pytest.mark.parametrize(
    "settings", [{}, {"hidden_layers": 0, "embedding_size": 1}, {"hidden_layers": 3}]
)
def test_parameters_are_those_of_the_model(settings) -> None:
    architecture = Architecture.for_box((5, 9, 17), 4, width=16, **settings)
    size = architecture.embedding_size
    tables = [torch.zeros(t * z * y * x, size) for t, z, y, x in architecture.levels]
    layers = [(torch.zeros(o, i), torch.zeros(o)) for o, i in architecture.layer_shapes]
    model = FHash(architecture, tables, layers)
    assert sum(p.numel() for p in model.parameters()) == architecture.parameters
    assert architecture.parameters > parameter_count(architecture.levels, size)


def test_the_defaults_are_the_papers() -> None:
    architecture = Architecture.for_box((54, 110, 200), 10)
    assert architecture.sizes == architecture.levels[0] == (10, 54, 110, 200)
    assert len(architecture.levels) == 8  # ceil(log2 200)
    assert architecture.inputs == 16
    assert architecture.layer_shapes == [(64, 16), (64, 64), (1, 64)]
