"""Lets tests import the helpers of the tests of the transform and of the hard cases."""

from __future__ import annotations

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS / "formats" / "transform"), str(TESTS / "hard")]
