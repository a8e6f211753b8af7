"""The device that a training runs on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import torch


def choose_device(name: str) -> torch.device:
    """The device of this name; 'auto' is a CUDA device where there is one. Raises InputError where it is not to be had."""
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device is 'cuda', but torch finds no CUDA device here; use --device cpu")
    return torch.device(name)
