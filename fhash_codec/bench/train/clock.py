"""The two clocks of a measurement: time that passes, and time that processors work.

A busy machine stretches the first. The second counts the work of all threads of this process, also
of those that wait in a loop.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

__all__ = ["Spent", "now", "wait"]

SHORTEST = 1e-9
"""Seconds that a measured piece of work takes at least: a clock may stand still for a short one."""


@dataclass(frozen=True)
class Spent:
    """Seconds of a piece of work.

    Attributes:
        wall: seconds that passed.
        cpu: seconds that processors worked for this process.
    """

    wall: float = 0.0
    cpu: float = 0.0

    def __add__(self, other: Spent) -> Spent:
        return Spent(self.wall + other.wall, self.cpu + other.cpu)

    def __sub__(self, other: Spent) -> Spent:
        return Spent(self.wall - other.wall, self.cpu - other.cpu)

    def on(self, device: str) -> float:
        """Seconds that count on a type of device: those of processors, but on a GPU wall time."""
        return max(self.cpu if device == "cpu" else self.wall, SHORTEST)


def now() -> Spent:
    """Return both clocks."""
    return Spent(time.perf_counter(), time.process_time())


def wait(device: torch.device) -> None:
    """Wait until a device has done its work."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)
