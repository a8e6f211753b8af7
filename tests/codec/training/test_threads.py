"""Torch's threads during a training."""

from __future__ import annotations

from contextlib import suppress

import pytest
import torch

from fhash_codec.training.threads import VERTICES_A_THREAD, threads_for


@pytest.mark.parametrize(("vertices", "threads"), [(0, 1), (VERTICES_A_THREAD * 2, 2), (10**9, 3)])
def test_threads_are_those_that_pay_and_come_back_after_an_error(vertices, threads) -> None:
    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with suppress(ZeroDivisionError), threads_for(vertices) as used:
            assert used == torch.get_num_threads() == threads
            raise ZeroDivisionError
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(usual)
