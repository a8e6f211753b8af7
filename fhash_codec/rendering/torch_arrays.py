"""The operations of `Arrays` by torch, on one device. Imported only where a device is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.rendering.march_task import Array, Arrays
from fhash_formats.errors import InputError


def true_positions(mask: torch.Tensor, count: int) -> torch.Tensor:
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


class TorchArrays(Arrays):
    """Tensors on a device.

    On a device that is no processor batches are large, since the call of a kernel costs more than
    its work on few numbers. `leaps` and `turns` weigh such calls against waits: unmeasured guesses.
    """

    xp = torch
    leaps = 2
    turns = 4

    def __init__(self, device: torch.device) -> None:
        self.device = device
        if device.type != "cpu":
            self.batch = 1 << 20

    def array(self, values: npt.ArrayLike, dtype: str | None = None) -> Array:
        # A copy: torch would warn of numbers that must not be written.
        return torch.from_numpy(np.array(values, dtype=dtype)).to(self.device)

    def host(self, array: Array) -> npt.NDArray[Any]:
        return np.asarray(array.cpu().numpy())

    def empty(self, shape: Sequence[int], dtype: str = "float64") -> Array:
        return torch.empty(shape, dtype=getattr(torch, dtype), device=self.device)

    def full(self, shape: Sequence[int] | int, value: float, dtype: str = "float64") -> Array:
        return torch.full(
            (shape,) if isinstance(shape, int) else tuple(shape),
            value,
            dtype=getattr(torch, dtype),
            device=self.device,
        )

    def range(self, count: int) -> Array:
        return torch.arange(count, device=self.device)

    def to_int64(self, array: Array) -> Array:
        return array.to(torch.int64)

    def to_float64(self, array: Array) -> Array:
        return array.to(torch.float64)

    def to_float32(self, array: Array) -> Array:
        return array.to(torch.float32)

    def copy(self, array: Array) -> Array:
        return array.clone()

    def nonzero(self, array: Array) -> tuple[Array, ...]:
        return torch.nonzero(array, as_tuple=True)

    def candidates(self, mask: Array) -> Array:
        return slice(None)

    def kept(self, mask: Array, results: Array, other: Array | float) -> Array:
        return torch.where(mask.view(-1, *(1,) * (results.ndim - 1)), results, other)

    def counts(self, *numbers: Array) -> list[int]:
        return [int(number) for number in torch.stack(numbers).tolist()]

    def chosen(self, mask: Array, count: int) -> Array:
        return true_positions(mask, count)

    def take_along(self, array: Array, index: Array, axis: int) -> Array:
        return torch.take_along_dim(array, index, dim=axis)

    def add_rows(self, array: Array, rows: Array, values: Array) -> None:
        array.index_put_((rows,), values, accumulate=True)

    @contextmanager
    def guarded(self) -> Iterator[None]:
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise InputError(
                f"the memory of the device {self.device} is not enough for this picture; make it "
                "smaller, give fewer samples_per_pass, or march on the cpu"
            ) from error
