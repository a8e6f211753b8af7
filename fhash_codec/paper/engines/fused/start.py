"""The start of the fused engine on a device: it is made, or the reason why not is said."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import numpy.typing as npt
import torch

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.fused.engine import FusedEngine
from fhash_codec.paper.engines.fused.source import Unavailable
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
        _warn_once(str(error))
        return None


@cache
def _warn_once(reason: str) -> None:
    """Warn that training is slower than it could be."""
    warnings.warn(
        f"training takes the engine slab, since the faster one cannot be had: {reason}",
        FhashWarning,
        stacklevel=4,
    )
