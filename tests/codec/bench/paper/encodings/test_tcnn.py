"""tiny-cuda-nn: one clear line without it, and its use beside a stand-in for the package."""

from __future__ import annotations

import sys
import types
from typing import Any

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings import tcnn
from fhash_codec.bench.paper.encodings.places import of_key_frame
from fhash_codec.bench.paper.sets import hash_resolutions, tcnn_network, tcnn_tables
from fhash_formats.errors import MissingDependencyError


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
