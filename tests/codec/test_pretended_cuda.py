"""The pretended CUDA device refuses what CUDA refuses, and counts what costs time there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pretended_cuda import CUDA, MixedDevices, pretended_cuda


def on_device(*shape: int) -> torch.Tensor:
    return torch.ones(shape, device="cuda")


MIXED = {
    "a product": lambda: on_device(4, 5) @ torch.ones(5, 3),
    "a sum": lambda: on_device(5) + torch.ones(5),
    "a sum in place": lambda: torch.ones(5).add_(on_device(5)),
    "a number in place": lambda: torch.ones(()).add_(on_device()),
    "a concatenation": lambda: torch.cat([on_device(2), torch.ones(2)]),
    "a CPU tensor indexed from the device": lambda: torch.ones(4)[on_device(2).long()],
    "CPU values written at indices": lambda: on_device(4).index_put_(
        (on_device(2).long(),), torch.ones(2)
    ),
    "rows copied": lambda: on_device(4, 2).index_copy_(0, torch.zeros(1).long(), on_device(1, 2)),
    "numpy": lambda: on_device(4).numpy(),
    "numpy by an array": lambda: np.asarray(on_device(4)),
    "a loss": lambda: (torch.ones(3, requires_grad=True) - on_device(3)).sum().backward(),
}
"""Operations that CUDA refuses."""


@pytest.mark.parametrize("operation", MIXED)
def test_operands_on_two_devices_are_refused(operation: str) -> None:
    with pretended_cuda(), pytest.raises((MixedDevices, TypeError)):
        MIXED[operation]()


def test_the_values_are_those_of_the_cpu_and_the_device_stays_with_them() -> None:
    with pretended_cuda():
        start = torch.arange(12.0).view(3, 4)
        moved = start.to("cuda").requires_grad_()
        loss = ((moved * 2.0 + torch.tensor(1.0))[1:].T @ torch.ones(2, device=CUDA)).sum()
        loss.backward()
        assert {each.device for each in (moved, loss, moved.grad, moved[0])} == {CUDA}
        assert not start.is_cuda
        assert moved.is_cuda
        assert float(loss.detach()) == (2 * np.arange(4, 12) + 1).sum()
        np.testing.assert_array_equal(moved.grad.cpu().numpy()[1:], 2.0)
        assert torch.zeros_like(moved).device == moved.new_zeros(3).device == CUDA


WAITING = {
    "item": (lambda a: a.sum().item(), 1),
    "float": (lambda a: float(a.sum()), 1),
    "a truth": (lambda a: bool((a > 0).all()), 1),
    "nonzero": (lambda a: a.nonzero(), 1),
    "a mask": (lambda a: a[a > 0], 1),
    "a mask written": (lambda a: a.__setitem__(a > 0, 2 * a), 1),
    "a number written by a mask": (lambda a: a.__setitem__(a > 0, 1.0), 0),
    "a copy to the host": (lambda a: a.cpu(), 1),
    "a list": (lambda a: a.tolist(), 1),
    "indices": (lambda a: a[torch.zeros(3, device=CUDA).long()], 0),
    "where": (lambda a: torch.where(a > 0, a, 0.0), 0),
    "positions": (lambda a: torch.searchsorted(a.cumsum(0), a), 0),
}
"""Operations on a tensor (2,) of ones, and how often the host waits."""


@pytest.mark.parametrize("operation", WAITING)
def test_waits_are_counted(operation: str) -> None:
    function, waits = WAITING[operation]
    with pretended_cuda() as pretended:
        function(on_device(2))
        assert pretended.counts["waits"] == waits, pretended.waits


def test_launches_and_copies_are_counted() -> None:
    with pretended_cuda() as pretended:
        a = torch.ones(6, device="cuda")
        assert pretended.counts == {"launches": 1}
        ((a.view(2, 3).T[1:] * 2) + 1).reshape(-1)[:1].add_(1)
        assert pretended.counts == {"launches": 5}  # the reshape copies
        pretended.forget()
        torch.ones(3).to("cuda")
        torch.ones(3).pin_memory().to("cuda", non_blocking=True)
        a.copy_(torch.empty(6, pin_memory=True).fill_(1.0), non_blocking=True)
        torch.tensor([1, 2], device="cuda")
        assert pretended.counts["copies"] == 4
        assert pretended.counts["pageable"] == 2
        assert pretended.counts["waits"] == 0


def test_a_graph_does_its_kernels_again_with_the_numbers_of_the_capture() -> None:
    with pretended_cuda() as pretended:
        total, step, graph = on_device(3), on_device(3), torch.cuda.CUDAGraph()
        factor = 2.0
        with torch.cuda.graph(graph):
            moved = step * factor
            total += moved
        graph.replay()  # the capture itself did the kernels
        assert total.tolist() == [3.0] * 3
        step.fill_(5.0)
        factor = 7.0
        pretended.forget()
        graph.replay()
        assert total.tolist() == [13.0] * 3
        assert moved.tolist() == [10.0] * 3
        with pytest.raises(RuntimeError, match="not permitted when"), torch.cuda.graph(graph):
            float(total.sum())
