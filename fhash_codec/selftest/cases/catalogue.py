"""The catalogue of all hard cases."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases.features import FEATURE_CASES
from fhash_codec.selftest.cases.fronts import FRONT_CASES
from fhash_codec.selftest.cases.invariance import GUISE_CASES
from fhash_codec.selftest.cases.networks import NETWORK_CASES
from fhash_codec.selftest.cases.rays import RAY_CASES
from fhash_codec.selftest.cases.shapes import SHAPE_CASES
from fhash_codec.selftest.cases.times import TIME_CASES
from fhash_codec.selftest.cases.values import VALUE_CASES
from fhash_formats.errors import InputError, suggestion

__all__ = ["cases", "choose_cases"]


@cache
def cases() -> tuple[Case, ...]:
    """All cases, group by group."""
    return (
        *VALUE_CASES,
        *SHAPE_CASES,
        *FRONT_CASES,
        *FEATURE_CASES,
        *TIME_CASES,
        *NETWORK_CASES,
        *RAY_CASES,
        *GUISE_CASES,
    )


def choose_cases(
    *, names: Sequence[str] = (), groups: Sequence[str] = (), everything: bool = False
) -> tuple[Case, ...]:
    """The cases with these names or of these groups; without names and groups, all quick cases.

    With `everything`, a call without names and groups returns the long set too. Raises InputError
    for an unknown name or group; its message offers the nearest one.
    """
    all_cases = cases()
    _check_names("case", names, [case.name for case in all_cases])
    _check_names("group", groups, list(dict.fromkeys(case.group for case in all_cases)))
    if names or groups:
        return tuple(case for case in all_cases if case.name in names or case.group in groups)
    return tuple(case for case in all_cases if case.quick or everything)


def _check_names(kind: str, names: Sequence[str], allowed: Sequence[str]) -> None:
    for name in names:
        if name not in allowed:
            raise InputError(f"unknown {kind} '{name}'; {suggestion(name, allowed)}")
