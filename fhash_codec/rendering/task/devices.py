"""The arrays of a device: numpy, or torch on CUDA."""

from __future__ import annotations

import ctypes
import sys

from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_formats.errors import InputError

DEVICES = ("auto", "cpu", "cuda")


DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"


def arrays_on(device: str) -> Arrays:
    """The arrays of a device: 'cpu' is numpy, 'cuda' torch's, 'auto' those of CUDA where it is to be had and numpy's elsewhere.

    Raises InputError for another name, and for 'cuda' where there is none. torch is imported only where there is a driver of CUDA.
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
