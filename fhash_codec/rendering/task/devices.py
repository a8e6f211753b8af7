"""The arrays of a device: numpy on the host, torch on CUDA."""

from __future__ import annotations

import ctypes
import sys

from fhash_codec.rendering.scene.scene import DEVICES
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.training.devices import choose_device, has_torch
from fhash_formats.errors import InputError

__all__ = ["arrays_on"]

DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
"""File name of the driver of CUDA."""


def arrays_on(device: str) -> Arrays:
    """The arrays of a device.

    device: 'cpu' for numpy, 'cuda' for torch on CUDA, 'auto' for CUDA where there is one and else
    numpy. torch is imported only where the driver of CUDA and torch itself are installed.
    Raises InputError for another name, and for 'cuda' where there is none; MissingDependencyError
    for 'cuda' without torch.
    """
    if device not in DEVICES:
        raise InputError(f"device is '{device}'; allowed: {', '.join(DEVICES)}")
    if device == "cpu" or (device == "auto" and not (_driver_exists() and has_torch())):
        return NUMPY
    chosen = choose_device(device)
    if chosen.type == "cpu":
        return NUMPY
    from fhash_codec.rendering.task.torch_arrays import TorchArrays

    return TorchArrays(chosen)


def _driver_exists() -> bool:
    """Whether the driver of CUDA can be loaded. Importing torch to ask it would take seconds."""
    try:
        ctypes.CDLL(DRIVER)
    except OSError:
        return False
    return True
