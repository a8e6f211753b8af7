"""Torch's threads during a training."""

from __future__ import annotations

from contextlib import suppress

import pytest
import torch
from forked import ended_well, forked, needs_fork

from fhash_codec.training.threads import VERTICES_A_THREAD, leave_threads_of_parent, threads_for


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


@needs_fork
def test_a_forked_process_does_not_wait_for_the_threads_of_its_parent() -> None:
    def computes() -> bool:
        leave_threads_of_parent()
        return bool((torch.arange(3_000_000.0) % 7).max() == 6)

    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        leave_threads_of_parent()
        assert torch.get_num_threads() == 3
        (torch.arange(3_000_000.0) % 7).sum()  # begins the threads
        assert ended_well(forked(computes))
    finally:
        torch.set_num_threads(usual)
