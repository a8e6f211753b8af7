"""Commands of `fhash bench`: click options, and results as text; the work is imported on use."""

from __future__ import annotations
