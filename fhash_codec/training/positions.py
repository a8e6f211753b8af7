"""Positions of the true entries of a mask, found without a wait for the device."""

from __future__ import annotations

import torch
from torch import Tensor


def true_positions(mask: Tensor, count: int) -> Tensor:
    """Return where a mask (n,) is not 0, int64 (count,), ascending.

    `Tensor.nonzero` makes the host wait until the device has counted them.

    Args:
        mask: booleans, or 0 and 1 of an integer type.
        count: number of entries that are not 0.
    """
    if mask.device.type == "cpu":
        return mask.nonzero().squeeze(1)
    # Entry number k is the first at which k have been counted.
    return torch.searchsorted(mask.cumsum(0), torch.arange(1, count + 1, device=mask.device))
