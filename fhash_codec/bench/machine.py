"""The machine that a benchmark ran on."""

from __future__ import annotations

import os
import platform
from typing import Any

import torch


def machine(device: torch.device) -> dict[str, Any]:
    """Describe the device, processor, cores, threads and torch version of this machine."""
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
