"""The catalogue of all hard cases."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases import (
    features,
    fronts,
    invariance,
    networks,
    rays,
    shapes,
    times,
    values,
)
from fhash_formats.errors import InputError, suggestion

__all__ = ["cases", "choose_cases"]


@cache
def cases() -> tuple[Case, ...]:
    """All cases, group by group."""
    return (
        *values.CASES,
        *shapes.CASES,
        *fronts.CASES,
        *features.CASES,
        *times.CASES,
        *networks.CASES,
        *rays.CASES,
        *invariance.CASES,
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
