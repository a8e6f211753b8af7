"""Captured steps: which are captured, and what happens where that fails."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from pretended_cuda import pretended_cuda

from fhash_codec.paper.engines import graphs
from fhash_codec.paper.engines.graphs import WARM_UPS, StepGraphs
from fhash_formats.errors import FhashWarning


def test_each_shape_is_captured_after_its_first_steps_and_results_stay() -> None:
    with pretended_cuda():
        steps, calls = StepGraphs(), []
        total = torch.zeros(2, device="cuda")
        amount = torch.ones(2, device="cuda")

        def step(shape: int) -> torch.Tensor:
            calls.append(shape)
            return total.add_(amount * shape) * 1

        results = []
        for turn in range(6):
            amount.fill_(float(turn))
            results += [steps.run(shape, lambda shape=shape: step(shape)) for shape in (1, 10)]
        # 0, 11 * 1, 11 * 2 ... in all; a result is not overwritten by later steps.
        assert [float(result[0]) for result in results[1::2]] == [0, 11, 33, 66, 110, 165]
        assert calls == [1, 10] * (WARM_UPS + 1)


def test_there_are_no_more_graphs_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "MAX_GRAPHS", 1)
    with pretended_cuda():
        steps, calls = StepGraphs(), []

        def step(shape: int) -> torch.Tensor:
            calls.append(shape)
            return torch.zeros(1, device="cuda")

        for _ in range(5):
            for shape in (1, 2):
                steps.run(shape, lambda shape=shape: step(shape))
    assert (calls.count(1), calls.count(2)) == (WARM_UPS + 1, 5)


def test_a_step_that_waits_is_not_captured_and_told_once() -> None:
    with pretended_cuda():
        steps = StepGraphs()

        def waiting() -> Any:
            number = torch.ones(1, device="cuda")
            return number * float(number)

        with pytest.warns(FhashWarning, match="no CUDA graph .*not permitted") as told:
            results = [float(steps.run("a", waiting)) for _ in range(5)]
    assert results == [1.0] * 5
    assert len(told) == 1
