"""Fixtures of `helpers/command_line.py`, for the tests of the command line."""

from __future__ import annotations

import sys
from pathlib import Path

from command_line import data, fhash, refused, run  # noqa: F401

# pytest's importlib mode puts no folder of tests on the path; `source_kinds` is beside this file.
sys.path.insert(0, str(Path(__file__).parent))
