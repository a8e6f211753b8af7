"""torch, which the extra `train` installs, and the choice of the device that it computes on."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from fhash_formats.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    import torch


def has_torch() -> bool:
    """Return whether torch is installed, without importing it."""
    return find_spec("torch") is not None


def need_torch(what: str) -> None:
    """Import torch, or raise MissingDependencyError that names what needs it and the extra."""
    try:
        import torch  # noqa: F401
    except ImportError as error:
        absent = isinstance(error, ModuleNotFoundError) and error.name == "torch"
        reason = "" if absent else f" (the torch that is installed fails: {error})"
        raise MissingDependencyError(
            f"{what} needs torch: pip install 'fhash[train]'{reason}"
        ) from error


def choose_device(name: str) -> torch.device:
    """Return the torch device named cpu, cuda or auto; auto is CUDA where there is a device.

    Raises InputError for cuda where torch finds no CUDA device, MissingDependencyError without
    torch.
    """
    need_torch(f"device '{name}'")
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device is 'cuda', but torch finds no CUDA device here; use --device cpu")
    return torch.device(name)


def first_line(error: Exception) -> str:
    """Return the first line of an error's text: CUDA adds advice for programmers to it."""
    return str(error).strip().split("\n")[0]
