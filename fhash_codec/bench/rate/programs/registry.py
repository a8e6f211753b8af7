"""Programs by the names that a user gives them: `--peer NAME=PATH`."""

from __future__ import annotations

from collections.abc import Mapping

from fhash_codec.bench.rate.programs import qoz, tthresh, video
from fhash_codec.bench.rate.programs.program import ProgramVariant, executable
from fhash_formats.errors import InputError

__all__ = ["PROGRAMS", "programs"]

PROGRAMS = ("tthresh", *qoz.NAMES, *video.NAMES)
"""Names that can be given."""


def programs(
    named: Mapping[str, str],
) -> tuple[dict[str, tuple[ProgramVariant, ...]], dict[str, str]]:
    """The variants of programs by the names of their codecs, and why others were left out.

    named: path by name.

    Raises InputError for an unknown name, or a path without a program.
    """
    found: dict[str, tuple[ProgramVariant, ...]] = {}
    refused: dict[str, str] = {}
    for name, given in named.items():
        if name not in PROGRAMS:
            raise InputError(f"peer is '{name}'; programs: {', '.join(PROGRAMS)}")
        path = executable(name, given)
        try:
            variants = _variants(name, path)
        except InputError as error:
            refused[name] = str(error)
        else:
            found[variants[0].peer] = variants
    return found, refused


def _variants(name: str, path: str) -> tuple[ProgramVariant, ...]:
    if name == "tthresh":
        return tthresh.variants(path)
    if name in qoz.NAMES:
        return qoz.variants(name, path)
    return video.variants(name, path)
