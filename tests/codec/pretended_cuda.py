"""A pretended CUDA device for torch without CUDA: tensors stay on the CPU and claim a device.

Every tensor keeps its values, so that a program runs to its end and gives numbers. The storage of
each tensor carries the device that the program put it on. Each operation of torch is checked as
CUDA would check it: operands on two devices are an error, and so is `numpy()` of a tensor on the
device. Counted are the launches of kernels, the copies to the device, and the waits: operations
after which the host must have a number from the device before it can go on.

The names that modes of torch see are those of the Python interface (`_Interface`) and the kernels
below it (`_Kernels`). Both modes belong to one thread: tensors of worker threads are not seen.
Nothing is known of kernels that CUDA lacks, of races, and of another rounding.
"""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from fhash_codec import devices

CUDA = torch.device("cuda", 0)
CPU = torch.device("cpu")

WAITING = {
    "_local_scalar_dense", "_unique2", "bincount", "equal", "is_nonzero", "item", "masked_select",
    "nonzero", "unique_consecutive", "unique_dim",
}  # fmt: skip
"""Kernels whose result, or its size, the host needs."""
FREE = {
    "_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "diagonal", "empty",
    "empty_like", "empty_strided", "expand", "lift_fresh", "new_empty", "permute", "reshape",
    "select", "slice", "split", "split_with_sizes", "squeeze", "t", "transpose", "unbind", "unfold",
    "unsqueeze", "view",
}  # fmt: skip
"""Operations that launch no kernel: other views of the same memory, and memory without values."""
STRICT = {
    "_fused_adam", "addmm", "baddbmm", "bmm", "cat", "gather", "index_add", "index_copy",
    "index_select", "mm", "scatter", "stack", "take",
}  # fmt: skip
"""Kernels that take no number from the CPU, not even one without an axis."""


class MixedDevices(RuntimeError):
    """Operands of one operation on two devices."""


class Pretended:
    """The state of the pretended device.

    Attributes:
        counts: launches, waits, and copies to the device.
        waits: waits by the operation that waits.
        free: bytes that the device says are free.
    """

    def __init__(self) -> None:
        self.counts: collections.Counter[str] = collections.Counter()
        self.waits: collections.Counter[str] = collections.Counter()
        self.free = 1 << 40
        self._labels: dict[int, torch.device] = {}

    def forget(self) -> None:
        """Set all counts to zero."""
        self.counts.clear()
        self.waits.clear()

    def label(self, tensor: torch.Tensor) -> torch.device | None:
        """Return the device that a tensor claims; None for one that torch made within itself."""
        return self._labels.get(storage_of(tensor))

    def claim(self, tensor: torch.Tensor, device: torch.device | None) -> torch.Tensor:
        """Note the device of a tensor's storage."""
        if device is None:
            self._labels.pop(storage_of(tensor), None)
        else:
            self._labels[storage_of(tensor)] = device
        return tensor

    def waited(self, name: str) -> None:
        """Count a wait."""
        self.counts["waits"] += 1
        self.waits[name] += 1

    def copied(self) -> None:
        """Count a copy to the device."""
        self.counts["copies"] += 1


def storage_of(tensor: torch.Tensor) -> int:
    """Return a number that tensors of one storage share."""
    return int(tensor.untyped_storage()._cdata)


def tensors_in(*values: Any) -> list[torch.Tensor]:
    """Return the tensors in nested lists, tuples and dicts."""
    return [value for value in tree_flatten(values)[0] if isinstance(value, torch.Tensor)]


class _Kernels(TorchDispatchMode):
    """Checks and counts the kernels."""

    def __init__(self, pretended: Pretended) -> None:
        super().__init__()
        self.pretended = pretended

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs, pretended = kwargs or {}, self.pretended
        name = func.name().split("::")[1].split(".")[0]
        base = name.rstrip("_")
        given = tensors_in(args, kwargs)
        labels = [pretended.label(tensor) for tensor in given]
        if CUDA in labels:
            device: torch.device | None = CUDA
        else:
            device = None if not given or None in labels else CPU
        if device == CUDA:
            self._check(base, name, given, labels)
            if base not in FREE:
                pretended.counts["launches"] += 1
        result = func(*args, **kwargs)
        known = {storage_of(tensor) for tensor in given}
        for tensor in tensors_in(result):
            if storage_of(tensor) not in known:
                pretended.claim(tensor, device)
        return result

    def _check(
        self, base: str, name: str, given: list[torch.Tensor], labels: list[torch.device | None]
    ) -> None:
        """Raise MixedDevices where CUDA would; count waits and copies."""
        pretended = self.pretended
        strange = [tensor for tensor, label in zip(given, labels, strict=True) if label == CPU]
        if base == "copy":
            if labels[0] == CPU:
                pretended.waited("copy to the host")
            elif strange:
                pretended.copied()
        elif base in ("index", "index_put", "_index_put_impl"):
            self._check_index(base, given, labels)
        elif strange and (
            any(tensor.dim() for tensor in strange)
            or base in STRICT
            or (name.endswith("_") and labels[0] == CPU)
        ):
            raise MixedDevices(f"{name}: operands on {labels}")
        if base in WAITING:
            pretended.waited(base)

    def _check_index(
        self, base: str, given: list[torch.Tensor], labels: list[torch.device | None]
    ) -> None:
        """Check an indexed tensor, its indices, and for `index_put` the values at the end."""
        if labels[0] == CPU:
            raise MixedDevices(f"{base}: a tensor of the CPU indexed from {labels}")
        indices = given[1:] if base == "index" else given[1:-1]
        for label in labels[1 : 1 + len(indices)]:
            if label == CPU:
                self.pretended.copied()
        if base == "index":
            filled = False
        else:
            filled = given[-1].numel() == 1 and labels[-1] != CUDA  # becomes masked_fill
            if labels[-1] == CPU and given[-1].dim():
                raise MixedDevices(f"{base}: values of the CPU")
        if not filled:
            for index in indices:
                if index.dtype in (torch.bool, torch.uint8):
                    self.pretended.waited(f"{base} by a mask")


class _Interface(TorchFunctionMode):
    """Takes devices out of the calls of Python, before torch asks for CUDA."""

    def __init__(self, pretended: Pretended) -> None:
        super().__init__()
        self.pretended = pretended

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs, pretended = dict(kwargs or {}), self.pretended
        name = getattr(func, "__name__", "")
        if name == "__get__":
            return self._attribute(func, args, kwargs)
        if name in ("numpy", "__array__", "__dlpack__", "tolist"):
            if pretended.label(args[0]) == CUDA:
                if name != "tolist":
                    raise TypeError("can't convert a tensor of cuda:0 to numpy; use cpu() first")
                pretended.waited(name)
            return func(*args, **kwargs)
        if name in ("to", "cpu", "cuda"):
            return self._moved(func, name, args, kwargs)
        return self._made(func, name, args, kwargs)

    def _attribute(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        of = getattr(func, "__self__", None)
        label = self.pretended.label(args[0]) or CPU
        if of is torch.Tensor.device:
            return label
        if of is torch.Tensor.is_cuda:
            return label == CUDA
        return func(*args, **kwargs)

    def _moved(self, func: Any, name: str, args: Any, kwargs: dict[str, Any]) -> Any:
        """Do `to`, `cpu` or `cuda`: a copy with another claim where the device changes."""
        tensor, rest = args[0], list(args[1:])
        goal = {"cpu": CPU, "cuda": CUDA, "to": None}[name]
        if name == "to":
            for number, value in enumerate(rest):
                if isinstance(value, torch.Tensor):
                    goal = self.pretended.label(value)
                elif isinstance(value, (str, torch.device)):
                    goal, rest[number] = _device(value), CPU
            if kwargs.get("device") is not None:
                goal, kwargs["device"] = _device(kwargs["device"]), CPU
        before = self.pretended.label(tensor)
        moved = func(tensor, *rest, **kwargs) if name == "to" else tensor
        if goal is None or goal == before:
            return moved
        if goal == CPU and before == CUDA:
            self.pretended.waited("copy to the host")
        elif goal == CUDA:
            self.pretended.copied()
        with torch._C.DisableTorchFunction():
            moved = moved.clone() if storage_of(moved) == storage_of(tensor) else moved
        return self.pretended.claim(moved, goal)

    def _made(self, func: Any, name: str, args: Any, kwargs: dict[str, Any]) -> Any:
        """Do any other call; a tensor that it makes claims the device that the call names."""
        pretended, goal = self.pretended, None
        if kwargs.get("device") is not None:
            goal, kwargs["device"] = _device(kwargs["device"]), CPU
        result = func(*args, **kwargs)
        made = isinstance(result, torch.Tensor) and not tensors_in(args, kwargs)
        if goal is not None:
            if goal == CUDA:
                if name in ("tensor", "as_tensor"):
                    pretended.copied()
                elif name.split("_like")[0].removeprefix("new_") != "empty":
                    pretended.counts["launches"] += made
            return pretended.claim(result, goal)
        # One that torch makes within itself has no claim: it follows its operands.
        return pretended.claim(result, CPU) if made else result


def _device(name: str | torch.device) -> torch.device:
    return CUDA if torch.device(name).type == "cuda" else CPU


@contextmanager
def pretended_cuda() -> Iterator[Pretended]:
    """A context with a pretended CUDA device; yields its counts."""
    pretended, plain = Pretended(), torch.from_numpy

    def from_numpy(array: Any) -> torch.Tensor:
        return pretended.claim(plain(array), CPU)

    def synchronize(*_: Any) -> None:
        pretended.waited("synchronize")

    replaced: dict[str, Callable[..., Any]] = {
        "is_available": lambda: True,
        "mem_get_info": lambda *_: (pretended.free, 1 << 40),
        "synchronize": synchronize,
        "get_device_name": lambda *_: "pretended",
    }
    with ExitStack() as stack:
        stack.enter_context(patch.object(torch, "from_numpy", from_numpy))
        stack.enter_context(patch.object(devices, "may_have_cuda", lambda: True))
        for name, function in replaced.items():
            stack.enter_context(patch.object(torch.cuda, name, function))
        stack.enter_context(_Kernels(pretended))
        stack.enter_context(_Interface(pretended))
        yield pretended
