"""The size of a model: resolutions of levels, and the number of parameters."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from readable_paper import FHash

from fhash_codec.paper.architecture import (
    Architecture,
    axis_resolutions,
    ceil_log,
    level_resolutions,
    parameter_count,
)


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


@pytest.mark.parametrize(
    ("box", "parameters"),
    [((54, 110, 200), 25_374_176), ((185, 183, 156), 112_857_968)],
    ids=["combustion", "supernova"],
)
def test_the_papers_parameter_counts(box, parameters):
    assert parameter_count(level_resolutions(box, 10, 2), 2) == parameters


@pytest.mark.parametrize("base", range(2, 12))
def test_ceil_log_is_exact_around_every_power(base):
    for exponent in range(1, 12):
        power = base**exponent
        assert (ceil_log(power, base), ceil_log(power + 1, base)) == (exponent, exponent + 1)
    assert ceil_log(1, base) == 0


@pytest.mark.parametrize("fold", [2, 3, 5])
@pytest.mark.parametrize(
    "box", [(1, 1, 1), (1, 7, 250), (128, 128, 128), (54, 110, 200), (2, 3, 4)]
)
@pytest.mark.parametrize("key_frames", [1, 2, 10, 600])
def test_levels_follow_the_papers_rule(fold, box, key_frames):
    levels = level_resolutions(box, key_frames, fold)
    assert levels[0] == (key_frames, *box)
    assert len(levels) == max(1, *(ceil_log(size, fold) for size in box))
    for finer, coarser in pairwise(levels):
        for before, after in zip(finer, coarser, strict=True):
            assert after == (1 if before == 1 else -(-before // fold) if before > fold else 2)


def test_an_axis_of_one_vertex_stays_one_and_a_short_one_is_padded_with_two():
    assert axis_resolutions(1, 2, 4) == [1, 1, 1, 1]
    assert axis_resolutions(5, 2, 5) == [5, 3, 2, 2, 2]
