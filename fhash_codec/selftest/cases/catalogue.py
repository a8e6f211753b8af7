"""All hard cases."""

from __future__ import annotations

import difflib
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
from fhash_formats.errors import InputError

__all__ = ["cases", "chosen"]


@cache
def cases() -> tuple[Case, ...]:
    """Every case, group by group."""
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


def chosen(
    *, names: Sequence[str] = (), groups: Sequence[str] = (), everything: bool = False
) -> tuple[Case, ...]:
    """The cases of these names and groups; all quick ones where none is given, or all with `everything`.

    Raises InputError for an unknown name or group, and offers the nearest.
    """
    every = cases()
    _check("case", names, [case.name for case in every])
    _check("group", groups, list(dict.fromkeys(case.group for case in every)))
    if names or groups:
        return tuple(case for case in every if case.name in names or case.group in groups)
    return tuple(case for case in every if case.quick or everything)


def _check(what: str, given: Sequence[str], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise InputError(f"unknown {what} '{name}'; did you mean '{near}'?")
