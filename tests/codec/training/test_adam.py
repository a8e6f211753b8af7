"""Adam's own steps, and its steps without a gradient in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.training.adam import (
    BETA1,
    BETA2,
    EPSILON,
    adam_step,
    adam_step_on_device,
    catch_up,
    catch_up_numbers,
    corrections,
)


def test_a_step_is_that_of_torch() -> None:
    random = torch.Generator().manual_seed(0)
    ours = torch.randn(100, generator=random, dtype=torch.float64)
    theirs = torch.nn.Parameter(ours.clone())
    adam = torch.optim.Adam([theirs], lr=0.01, betas=(BETA1, BETA2), eps=EPSILON, fused=True)
    mean, square = torch.zeros_like(ours), torch.zeros_like(ours)
    for step in range(1, 6):
        gradient = torch.randn(100, generator=random, dtype=torch.float64)
        adam_step(ours, gradient, mean, square, step, 0.01)
        theirs.grad = gradient
        adam.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-10, atol=1e-12)


def test_a_step_by_numbers_on_the_device_is_the_same() -> None:
    random = torch.Generator().manual_seed(1)
    here = [torch.rand(50, generator=random) for _ in range(4)]
    there = [tensor.clone() for tensor in here]
    for step in (1, 2, 30):
        adam_step(*here, step, 0.01)
        correction, pace = (torch.tensor(number) for number in corrections(step, 0.01))
        adam_step_on_device(*there, correction, pace)
    for ours, theirs in zip(here, there, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-7)
    before = there[0].clone()
    adam_step_on_device(*there, torch.tensor(1.0), torch.tensor(0.0))  # the end of a schedule
    assert torch.equal(there[0], before)


def test_catching_up_equals_stepping_without_gradient() -> None:
    rates = 0.01 * (0.5 + 0.5 * np.cos(np.linspace(0, np.pi, 400)))
    visited = np.array([0, 1, 5, 100, 250, 299])
    for scale in (1e-2, 1e-6, 1e-9):
        m, v = 0.3 * scale, scale**2
        effect = catch_up(visited, 299, rates)
        for number, first in enumerate(visited):
            mean, square, moved = m, v, 0.0
            for step in range(first + 1, 300) if first else ():
                mean, square = BETA1 * mean, BETA2 * square
                moved -= (
                    rates[step]
                    * mean
                    / (1 - BETA1**step)
                    / ((square / (1 - BETA2**step)) ** 0.5 + EPSILON)
                )
            ours = -float(effect.factor[number]) * m / (v**0.5 + float(effect.epsilon[number]))
            # The one approximation shows only where sqrt(v) is near eps within Adam's first steps,
            # while its correction still moves.
            assert ours == pytest.approx(
                moved, rel=0.05 if scale < 1e-8 and first < 100 else 2e-3, abs=1e-12
            )
            assert effect.mean_decay[number] == pytest.approx(mean / m, rel=1e-5, abs=1e-37)
            assert effect.square_decay[number] == pytest.approx(square / v, rel=1e-5)


def test_numbers_that_catch_up_move_by_the_effect_and_their_moments_decay() -> None:
    random = torch.Generator().manual_seed(2)
    numbers = torch.rand(3, 2, 4, generator=random)
    effect = catch_up(np.array([0, 3, 5, 9]), 9, np.full(10, 0.01))
    factor, epsilon, mean_decay, square_decay = map(torch.from_numpy, effect)
    parameter, mean, square = numbers.clone()
    catch_up_numbers(numbers, torch.from_numpy(np.stack(effect)))
    moved = parameter - factor * mean / (square.sqrt() + epsilon)
    torch.testing.assert_close(numbers[0], moved)
    torch.testing.assert_close(numbers[1], mean * mean_decay)
    torch.testing.assert_close(numbers[2], square * square_decay)
    # Without steps, or without a gradient before them, nothing changes.
    assert torch.equal(numbers[0][:, [0, 3]], parameter[:, [0, 3]])
    assert not torch.equal(numbers[0][:, 1], parameter[:, 1])
