"""The arrays of a device: numpy, or torch on CUDA."""

from __future__ import annotations

import ctypes
import sys

from fhash_codec.rendering.scene.scene import DEVICES
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_formats.errors import InputError

DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
"""Library of CUDA's driver."""


def arrays_on(device: str) -> Arrays:
    """The arrays of a device.

    'cpu' is numpy, 'cuda' torch on CUDA, 'auto' CUDA where it is available and numpy elsewhere. torch
    is imported only where a driver of CUDA is installed. Raises InputError for another name, and for
    'cuda' without a CUDA device.
    """
    if device not in DEVICES:
        raise InputError(f"device is '{device}'; allowed: {', '.join(DEVICES)}")
    if device == "cpu" or (device == "auto" and not _driver()):
        return NUMPY
    from fhash_codec.rendering.task.torch_arrays import TorchArrays
    from fhash_codec.training.devices import choose_device

    chosen = choose_device(device)
    return NUMPY if chosen.type == "cpu" else TorchArrays(chosen)


def _driver() -> bool:
    """Whether the driver of CUDA is there: importing torch to ask it takes seconds."""
    try:
        ctypes.CDLL(DRIVER)
    except OSError:
        return False
    return True
