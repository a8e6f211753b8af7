"""The checks that every run has to pass, whatever the case."""

from __future__ import annotations

from fhash_codec.selftest.case import Check
from fhash_codec.selftest.checks.access import ACCESS_CHECKS
from fhash_codec.selftest.checks.accuracy import ACCURACY_CHECKS
from fhash_codec.selftest.checks.pictures import PICTURES_CHECKS
from fhash_codec.selftest.checks.repeating import REPEATING_CHECKS

__all__ = ["COMMON_CHECKS"]

COMMON_CHECKS: tuple[Check, ...] = (
    *ACCURACY_CHECKS,
    *ACCESS_CHECKS,
    *REPEATING_CHECKS,
    *PICTURES_CHECKS,
)
