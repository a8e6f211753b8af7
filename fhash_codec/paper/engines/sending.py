"""The numbers of a step that the host knows, brought to the device in one transfer.

On CUDA they go through pinned memory, so that the host does not wait, and always to the same place
for a batch of one size, so that a captured graph finds them there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.training.adam import CatchUp

SCALARS = 3
"""Single numbers of a step."""


@dataclass(frozen=True, kw_only=True)
class Sent:
    """A batch of bricks and the numbers of its step, on the device.

    Attributes:
        ids: numbers of the bricks, int64 (bricks,).
        caught_up: the columns of `adam.CatchUp`, float32 (4, bricks).
        correction: `adam.corrections`' factor of the root, float32 ().
        pace: `adam.corrections`' pace, float32 ().
        scale: factor of the gradients, float32 ().
    """

    ids: Tensor
    caught_up: Tensor
    correction: Tensor
    pace: Tensor
    scale: Tensor


class Sender:
    """Memory on a device for the numbers of steps, one piece for each number of bricks."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._memory: dict[int, Tensor] = {}

    def send(
        self,
        chosen: npt.NDArray[np.int64],
        columns: CatchUp,
        scalars: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> Sent:
        """Return a step's numbers on the device. The next call with as many bricks overwrites them.

        Args:
            chosen: numbers of the bricks, int64 (bricks,).
            columns: effect of the steps that the bricks were passed over.
            scalars: correction, pace and scale.
        """
        count = len(chosen)
        # The int64 come first: so all numbers lie at multiples of their own size.
        parts = (np.ascontiguousarray(chosen), *columns, np.array(scalars, dtype=np.float32))
        received = self._received(np.concatenate([part.view(np.uint8) for part in parts]), count)
        numbers = received[8 * count :].view(torch.float32)
        correction, pace, scale = numbers[4 * count :].unbind()
        return Sent(
            ids=received[: 8 * count].view(torch.int64),
            caught_up=numbers[: 4 * count].view(4, count),
            correction=correction,
            pace=pace,
            scale=scale,
        )

    def _received(self, packed: npt.NDArray[np.uint8], count: int) -> Tensor:
        """Return bytes on the device."""
        if self._device.type == "cpu":
            return torch.from_numpy(packed)
        if count not in self._memory:
            self._memory[count] = torch.empty(len(packed), dtype=torch.uint8, device=self._device)
        # Fresh at each step: torch hands pinned memory out again only after its copy is done.
        pinned = torch.empty(len(packed), dtype=torch.uint8, pin_memory=True)
        pinned.numpy()[:] = packed
        return self._memory[count].copy_(pinned, non_blocking=True)
