"""The fused engine: CUDA kernels that train and evaluate a brick in one launch each.

The kernels are text (`kernels/`), which NVRTC compiles for one model and one device at first use.
"""

from fhash_codec.paper.network import Architecture

MAX_WIDTH = 128
"""Largest width of a hidden layer."""
MAX_INPUTS = 64
"""Largest number of inputs of the layers."""
MAX_LAYERS = 2
"""Largest number of hidden layers."""


def refusal(architecture: Architecture) -> str | None:
    """Return why the kernels cannot do a network's layers; None if they can."""
    if architecture.width > MAX_WIDTH or architecture.hidden_layers > MAX_LAYERS:
        return (
            f"the network has {architecture.hidden_layers} hidden layers of {architecture.width},"
            f" and kernels for CUDA do {MAX_LAYERS} of {MAX_WIDTH} at most"
        )
    if architecture.inputs > MAX_INPUTS:
        return (
            f"the network has {architecture.inputs} inputs, and kernels for CUDA do {MAX_INPUTS}"
            " at most"
        )
    return None
