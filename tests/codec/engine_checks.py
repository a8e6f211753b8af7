"""Agreement of training engines with the float64 oracle, as tests of every engine ask for it."""

from __future__ import annotations

import torch
from readable_paper import NaiveEngine
from torch import Tensor

from fhash_codec.paper.engines.parameters import Parameters

RATE = 0.01
"""Learning rate of the trainings."""


def assert_near(ours: Parameters, theirs: Parameters) -> None:
    """Parameters agree by median and count after some steps of Adam.

    Near a ReLU's kink float32 may take the other side, in torch's own Adam as well.
    """
    for a, b in (
        (ours.fine, theirs.fine),
        (ours.coarse, theirs.coarse),
        (ours.network, theirs.network),
    ):
        if not a.numel():
            continue
        # What no sample moved is 0 in ours and still at its start in the oracle's.
        apart = (a - b)[a != 0].abs()
        # A thousandth of one Adam step.
        assert float(apart.median()) < 1e-3 * RATE
        assert float((apart > 1e-3).double().mean()) < 0.01


def assert_gradient_of_autograd(gradient: Tensor, used: Tensor, oracle: NaiveEngine) -> None:
    """A gradient by coarse tables and layers is that of autograd, beside its largest entry.

    used: positions of the coarse numbers in the gradient, see `Upsampling.used`.
    """
    tables = torch.cat(
        [table.grad.flatten() for table in list(oracle.model.tables)[1:] if table.grad is not None]
    )
    gradients = [tables[used]]
    for weight, bias in zip(oracle.model.weights, oracle.model.biases, strict=True):
        assert weight.grad is not None
        assert bias.grad is not None
        gradients.append(torch.column_stack([weight.grad, bias.grad]))
    expected = torch.cat([part.flatten() for part in gradients]).float()
    apart = (gradient - expected).abs() / expected.abs().max()
    assert float(apart.median()) < 1e-7
    assert float((apart > 1e-5).double().mean()) < 0.001
