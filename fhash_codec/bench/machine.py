"""The machine that a benchmark ran on."""

from __future__ import annotations

import os
import platform
from typing import Any

from fhash_formats.support.threads import usable_threads


def machine() -> dict[str, Any]:
    """Describe the processor, cores and threads of this machine, which computes on its CPU."""
    return {
        "device": "cpu",
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": usable_threads(),
    }
