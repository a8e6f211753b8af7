"""Positions of the true entries of a mask."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pretended_cuda import CUDA, pretended_cuda

from fhash_codec.training.positions import true_positions

MASKS = [[], [0], [1], [0, 1, 1, 0, 0, 1], [1, 1, 1], [0, 0, 0]]


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8])
def test_positions_are_those_of_nonzero_without_a_wait(mask: list[int], dtype: torch.dtype) -> None:
    expected = np.nonzero(mask)[0]
    here = true_positions(torch.tensor(mask, dtype=dtype), len(expected))
    with pretended_cuda() as pretended:
        on_device = torch.tensor(mask, dtype=dtype, device="cuda")
        there = true_positions(on_device, len(expected))
        assert pretended.counts["waits"] == 0
        assert there.device == CUDA
        there = there.cpu()
    for found in (here, there):
        assert found.dtype == torch.int64
        np.testing.assert_array_equal(found.numpy(), expected)
