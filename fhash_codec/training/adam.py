"""Adam's constants, and its steps without a gradient in closed form (Kingma and Ba 2015, algorithm 1)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from torch import Tensor

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-8
WINDOW = 200  # (BETA1 / sqrt(BETA2))**200 is 8e-10: later steps without a gradient no longer move a parameter


def adam_step(
    parameter: Tensor, gradient: Tensor, mean: Tensor, square: Tensor, step: int, rate: float
) -> None:
    """Step number `step` (from 1 on) of Adam, in place; all tensors of one shape.

    torch.optim.Adam does the same, but loads torch's compiler on its first use, which takes as long as torch itself.
    """
    mean.lerp_(gradient, 1 - BETA1)
    square.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
    root = square.sqrt().mul_(1 / (1 - BETA2**step) ** 0.5).add_(EPSILON)
    parameter.addcdiv_(mean, root, value=-rate / (1 - BETA1**step))


def catch_up(
    visited: npt.NDArray[np.int64], step: int, rates: npt.NDArray[np.float64]
) -> tuple[
    npt.NDArray[np.float32],
    npt.NDArray[np.float32],
    npt.NDArray[np.float32],
    npt.NDArray[np.float32],
]:
    """What steps visited+1 .. step with zero gradients do to parameters whose last gradient came at `visited` (0: never), each (n,).

    Returns factor, epsilon, mean decay and square decay; with Adam's mean m and square v as they were at `visited`,
    the parameter moves by -factor * m / (sqrt(v) + epsilon), and m and v decay by the two factors.

    At step j = visited + i Adam moves by -rate_j m b1^i / (1 - b1^j) / (sqrt(v b2^i / (1 - b2^j)) + eps). With r = b1 / sqrt(b2)
    that is -rate_j r^i c_j m / (sqrt(v) + eps sqrt((1 - b2^j) / b2^i)), c_j = sqrt(1 - b2^j) / (1 - b1^j): all but the last root
    leave the sum over i. The root varies slowly; its harmonic mean under the weights rate_j r^i c_j stands for it, which is exact
    where sqrt(v) is far above eps and where it is far below.
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
    return (
        factor.astype(np.float32),
        epsilon.astype(np.float32),
        (BETA1 ** missed.astype(np.float64)).astype(np.float32),
        (BETA2 ** missed.astype(np.float64)).astype(np.float32),
    )
