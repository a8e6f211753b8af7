"""Engines by name, and the state that lets any of them continue."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.native.network import machine_paths
from fhash_codec.paper.engines import describe_engine, make_engine
from fhash_codec.paper.network import Architecture
from fhash_formats.errors import InputError

CPU = torch.device("cpu")


def test_unknown_engines_are_refused(noise_coreset) -> None:
    architecture = Architecture.for_box((2, 2, 2), 1)
    with pytest.raises(InputError, match="unknown engine 'quick'"):
        make_engine(
            "quick", architecture, noise_coreset((1, 2, 2, 2)), np.zeros(1), seed=0, device=CPU
        )


def test_auto_is_native_where_it_takes_the_model_and_else_slab(noise_coreset) -> None:
    coreset = noise_coreset((1, 2, 2, 2))

    def chosen(hidden_layers):
        architecture = Architecture.for_box((2, 2, 2), 1, hidden_layers=hidden_layers)
        return make_engine("auto", architecture, coreset, np.zeros(1), seed=0, device=CPU)

    engine = chosen(2)
    assert describe_engine(engine, 3) == {
        "engine": "native",
        "threads": 3,
        "path": machine_paths()[0],
    }
    assert chosen(3).name == "slab"


def test_the_fused_engine_needs_a_cuda_device(noise_coreset) -> None:
    architecture = Architecture.for_box((2, 2, 2), 1)
    with pytest.raises(InputError, match="'fused', which needs a CUDA device"):
        make_engine(
            "fused", architecture, noise_coreset((1, 2, 2, 2)), np.zeros(1), seed=0, device=CPU
        )


@pytest.mark.parametrize("name", ["auto", "slab"])
def test_restoring_a_state_goes_on_bit_for_bit(noise_coreset, name) -> None:
    coreset = noise_coreset((3, 9, 10, 20))
    architecture = Architecture.for_box(coreset.box.shape, 3, width=8)
    rates = np.linspace(0.01, 0.001, 21)
    batches = np.random.default_rng(0).integers(0, len(coreset.bricks), (20, 1))

    def run(first, last, state=None):
        engine = make_engine(name, architecture, coreset, rates, seed=1, device=CPU)
        if state:
            engine.restore(state)
        for batch in batches[first:last]:
            engine.train(batch)
        return engine

    uninterrupted, half = run(0, 20), run(0, 9)
    state = {name: np.array(array) for name, array in half.state().items()}
    resumed = run(9, 20, state)
    for name_of_array, array in uninterrupted.state().items():
        np.testing.assert_array_equal(array, resumed.state()[name_of_array], err_msg=name_of_array)
