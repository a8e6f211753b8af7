"""torch's tensors on one device, for marching: the operations of `Arrays` by torch. Imported only where a device is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.rendering.task.arrays import Array, Arrays
from fhash_formats.errors import InputError

__all__ = ["TorchArrays"]


class TorchArrays(Arrays):
    """Tensors on a device; on one that is no processor large batches, as each call of a kernel costs more than its work on few numbers."""

    xp = torch

    def __init__(self, device: torch.device) -> None:
        self.device = device
        if device.type != "cpu":
            self.batch = 1 << 20

    def array(self, values: npt.ArrayLike, kind: str | None = None) -> Array:
        """As `Arrays` has it."""
        # A copy: torch would warn of numbers that must not be written.
        return torch.from_numpy(np.array(values, dtype=kind)).to(self.device)

    def host(self, array: Array) -> npt.NDArray[Any]:
        """As `Arrays` has it."""
        return np.asarray(array.cpu().numpy())

    def empty(self, shape: Sequence[int], kind: str = "float64") -> Array:
        """As `Arrays` has it."""
        return torch.empty(shape, dtype=getattr(torch, kind), device=self.device)

    def full(self, shape: Sequence[int] | int, value: float, kind: str = "float64") -> Array:
        """As `Arrays` has it."""
        return torch.full(
            (shape,) if isinstance(shape, int) else tuple(shape),
            value,
            dtype=getattr(torch, kind),
            device=self.device,
        )

    def range(self, count: int) -> Array:
        """As `Arrays` has it."""
        return torch.arange(count, device=self.device)

    def whole(self, array: Array) -> Array:
        """As `Arrays` has it."""
        return array.to(torch.int64)

    def real(self, array: Array) -> Array:
        """As `Arrays` has it."""
        return array.to(torch.float64)

    def single(self, array: Array) -> Array:
        """As `Arrays` has it."""
        return array.to(torch.float32)

    def copy(self, array: Array) -> Array:
        """As `Arrays` has it."""
        return array.clone()

    def nonzero(self, array: Array) -> tuple[Array, ...]:
        """As `Arrays` has it."""
        return torch.nonzero(array, as_tuple=True)

    def take_along(self, array: Array, index: Array, axis: int) -> Array:
        """As `Arrays` has it."""
        return torch.take_along_dim(array, index, dim=axis)

    def add_rows(self, array: Array, rows: Array, values: Array) -> None:
        """As `Arrays` has it."""
        array.index_put_((rows,), values, accumulate=True)

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """As `Arrays` has it."""
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise InputError(
                f"the memory of the device {self.device} is not enough for this picture; make it smaller, give fewer samples_per_pass, "
                "or march on the cpu"
            ) from error
