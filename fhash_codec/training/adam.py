"""Adam's constants, its step, and its steps without a gradient in closed form.

The source is Kingma and Ba 2015, algorithm 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor

BETA1 = 0.9
"""Decay of the mean of gradients per step."""
BETA2 = 0.999
"""Decay of the mean of squared gradients per step."""
EPSILON = 1e-8
"""Number added to the root of the mean square before it divides."""
WINDOW = 200
"""Steps without a gradient after which a parameter no longer moves.

(BETA1 / sqrt(BETA2))**200 is 8e-10.
"""

Column = npt.NDArray[np.float32]


class CatchUp(NamedTuple):
    """Effect of steps without a gradient on parameters, each float32 (n,).

    With Adam's mean m and mean square v as they were before these steps, a parameter moves by
    -factor * m / (sqrt(v) + epsilon). Then m decays by `mean_decay` and v by `square_decay`.
    """

    factor: Column
    epsilon: Column
    mean_decay: Column
    square_decay: Column


def corrections(step: int, rate: float) -> tuple[float, float]:
    """Return the numbers of a step of Adam: the factor of the mean square's root, and the pace.

    A parameter moves by -pace * mean / (factor * root + EPSILON).

    Args:
        step: number of the step, from 1 on.
        rate: learning rate.
    """
    return 1 / (1 - BETA2**step) ** 0.5, rate / (1 - BETA1**step)


def adam_step(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, step: int, rate: float
) -> None:
    """Do one step of Adam in place, on tensors of one shape.

    torch.optim.Adam does the same, but loads torch's compiler on its first use, which takes as long
    as loading torch itself.

    Args:
        parameter: the numbers to move.
        gradient: their gradient.
        mean: mean of the gradients.
        square: mean of the squared gradients.
        step: number of the step, from 1 on.
        rate: learning rate.
    """
    correction, pace = corrections(step, rate)
    _average(gradient, mean, square)
    parameter.addcdiv_(mean, square.sqrt().mul_(correction).add_(EPSILON), value=-pace)


def adam_step_on_device(
    parameter: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    correction: Tensor,
    pace: Tensor,
) -> None:
    """Do what `adam_step` does, by numbers on the device: a captured graph reads them anew.

    Args:
        parameter: the numbers to move.
        gradient: their gradient.
        mean: mean of the gradients.
        square: mean of the squared gradients.
        correction: factor of the root, of no axis (`corrections`).
        pace: pace, of no axis.
    """
    _average(gradient, mean, square)
    parameter.addcdiv_(mean * pace, square.sqrt().mul_(correction).add_(EPSILON), value=-1.0)


def _average(gradient: Tensor, mean: Tensor, square: Tensor) -> None:
    """Let a gradient into the mean of gradients and the mean of their squares, in place."""
    mean.lerp_(gradient, 1 - BETA1)
    square.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)


def catch_up(visited: npt.NDArray[np.int64], step: int, rates: npt.NDArray[np.float64]) -> CatchUp:
    """Return the effect of the steps visited + 1 .. step, all with a gradient of zero.

    At step j = visited + i Adam moves a parameter by
    -rate_j m b1^i / (1 - b1^j) / (sqrt(v b2^i / (1 - b2^j)) + eps). With r = b1 / sqrt(b2) and
    c_j = sqrt(1 - b2^j) / (1 - b1^j) that is
    -rate_j r^i c_j m / (sqrt(v) + eps sqrt((1 - b2^j) / b2^i)).
    All but the last root leave the sum over i. The root varies slowly and is replaced by its
    harmonic mean under the weights rate_j r^i c_j. That is exact where sqrt(v) is far above eps and
    where it is far below.

    Args:
        visited: number of the last step with a gradient for each parameter, int64 (n,); 0 for none.
        step: number of the present step.
        rates: learning rate of every step, counted from 1.
    """
    gap = step - visited
    missed = np.where(visited > 0, gap, 0)
    i = np.arange(1, min(int(missed.max(initial=0)), WINDOW) + 1)
    j = visited[:, None] + i
    within = i <= missed[:, None]
    correction2 = -np.expm1(j * np.log(BETA2))
    weight = np.where(within, rates[np.minimum(j, len(rates) - 1)] * (BETA1 / BETA2**0.5) ** i, 0.0)
    weight *= np.sqrt(correction2) / -np.expm1(j * np.log(BETA1))
    factor = weight.sum(axis=1)
    inverse = (weight / np.sqrt(correction2 / BETA2**i)).sum(axis=1)
    epsilon = EPSILON * np.divide(factor, inverse, out=np.ones_like(factor), where=inverse > 0)
    return CatchUp(
        factor=factor.astype(np.float32),
        epsilon=epsilon.astype(np.float32),
        mean_decay=(BETA1 ** missed.astype(np.float64)).astype(np.float32),
        square_decay=(BETA2 ** missed.astype(np.float64)).astype(np.float32),
    )


def catch_up_numbers(numbers: Tensor, effect: Tensor) -> None:
    """Let parameters and their moments catch up on missed steps, in place.

    Args:
        numbers: the parameters, their mean and their mean square, (3, E, n).
        effect: the columns of a `CatchUp`, (4, n).
    """
    parameter, mean, square = numbers
    factor, epsilon = effect[:2]
    parameter.addcdiv_(mean * factor, square.sqrt().add_(epsilon), value=-1.0)
    numbers[1:].mul_(effect[2:].unsqueeze(1))
