"""What the tests of hard cases share: whether the long set is wanted, and where the figures go."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

LONG = os.environ.get("FHASH_HARD") == "1"
"""Whether the long set is wanted."""


def record(case: str, figures: Mapping[str, Any]) -> None:
    """Append one line of JSON, {"case": name, figure: value, ...}, to the file that FHASH_HARD_REPORT names, if it names one.

    One write for a line, so that several processes may report to one file.
    """
    path = os.environ.get("FHASH_HARD_REPORT")
    if path:
        line = json.dumps({"case": case, **figures}, allow_nan=False) + "\n"
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(descriptor, line.encode())
        finally:
            os.close(descriptor)
