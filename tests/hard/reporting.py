"""The choice between the quick and the long set, and the file for figures."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

LONG = os.environ.get("FHASH_HARD") == "1"
"""Whether the long set runs."""


def record(case: str, figures: Mapping[str, Any]) -> None:
    """Append a line of JSON, {"case": name, figure: value, ...}, to the file that FHASH_HARD_REPORT
    names.

    A line is one write, so several processes may report to one file. Without the variable, nothing
    is written.
    """
    path = os.environ.get("FHASH_HARD_REPORT")
    if path:
        line = json.dumps({"case": case, **figures}, allow_nan=False) + "\n"
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)
