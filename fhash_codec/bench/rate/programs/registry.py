"""Programs by the names that a user gives them: `--peer NAME=PATH`."""

from __future__ import annotations

from collections.abc import Mapping

from fhash_codec.bench.rate.programs.program import ProgramVariant, executable
from fhash_codec.bench.rate.programs.qoz import QOZ_NAMES, qoz_variants
from fhash_codec.bench.rate.programs.tthresh import tthresh_variants
from fhash_codec.bench.rate.programs.video import VIDEO_NAMES, video_variants
from fhash_formats.errors import InputError

__all__ = ["PROGRAMS", "programs"]

PROGRAMS = ("tthresh", *QOZ_NAMES, *VIDEO_NAMES)
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
        return tthresh_variants(path)
    if name in QOZ_NAMES:
        return qoz_variants(name, path)
    return video_variants(name, path)
