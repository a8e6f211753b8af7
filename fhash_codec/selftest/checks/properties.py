"""The checks that every run has to pass, whatever the case."""

from __future__ import annotations

from fhash_codec.selftest.case import Check
from fhash_codec.selftest.checks import access, accuracy, pictures, repeating

__all__ = ["COMMON_CHECKS"]

COMMON_CHECKS: tuple[Check, ...] = (
    *accuracy.CHECKS,
    *access.CHECKS,
    *repeating.CHECKS,
    *pictures.CHECKS,
)
