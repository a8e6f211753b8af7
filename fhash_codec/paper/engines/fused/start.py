"""The start of fused kernels on a device: they are had, or the reason why not is said."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused.engine import Device, FusedEngine
from fhash_codec.paper.engines.fused.points import FusedPoints, PointKernels
from fhash_codec.paper.engines.fused.source import Unavailable
from fhash_codec.paper.network import Network
from fhash_formats.errors import FhashWarning, InputError


def start_fused(
    architecture: Architecture,
    coreset: Coreset,
    rates: npt.NDArray[np.float64],
    *,
    seed: int,
    device: torch.device,
    required: bool,
) -> FusedEngine | None:
    """Return a fused engine, or None, with one FhashWarning for each reason.

    There is no warning where torch is not built for CUDA, which needs no engine of ours to be slow.

    Args:
        architecture, coreset, rates, seed, device: as in `make_engine`.
        required: whether nothing else will do.

    Raises:
        InputError: the engine is required and cannot be had.
    """
    if device.type != "cuda" or torch.version.cuda is None:
        if required:
            raise InputError(
                f"engine is 'fused', which needs a CUDA device, but the device is '{device.type}'"
                " or torch is not built for CUDA; use --engine auto"
            )
        return None
    from fhash_codec.paper.engines.fused.driver import CudaDevice

    try:
        return FusedEngine(
            architecture, coreset, rates, seed=seed, device=device, kernels=CudaDevice(device)
        )
    except Unavailable as error:
        if required:
            raise InputError(f"engine 'fused' cannot be had: {error}; use --engine auto") from error
        _warn_once(f"training takes the engine slab, since the faster one cannot be had: {error}")
        return None


def start_points(network: Network, key: float, device: torch.device) -> FusedPoints | None:
    """Return a network at one time on a device, or None, with one FhashWarning for each reason.

    There is no warning on a processor or where torch is not built for CUDA.

    Args:
        network, key, device: as in `FusedPoints`.

    Raises:
        DamagedFileError: numbers of a table are not finite.
    """
    if device.type != "cuda" or torch.version.cuda is None:
        return None
    from fhash_codec.paper.engines.fused.driver import CudaDevice

    try:
        kernels = _point_kernels(CudaDevice, device)
        return FusedPoints(network, key, device=device, kernels=kernels)
    except Unavailable as error:
        _warn_once(
            f"the network is evaluated on the CPU, since kernels for it cannot be had: {error}"
        )
        return None


@cache
def _point_kernels(make: Callable[[torch.device], Device], device: torch.device) -> PointKernels:
    """Return the kernels of points on a device, for all networks and key indices."""
    return PointKernels(make(device))


@cache
def _warn_once(message: str) -> None:
    """Warn that something is slower than it could be."""
    warnings.warn(message, FhashWarning, stacklevel=4)
