"""Choice of the device that torch computes on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import torch


def choose_device(name: str) -> torch.device:
    """Return the torch device named cpu, cuda or auto; auto is CUDA where there is a device.

    Raises InputError for cuda where torch finds no CUDA device.
    """
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device is 'cuda', but torch finds no CUDA device here; use --device cpu")
    return torch.device(name)
