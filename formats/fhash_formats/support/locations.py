"""Places of files as people name them: paths, and URLs, which must never become paths."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

__all__ = ["file_name", "is_url", "local_path", "without_secrets"]

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(::[A-Za-z][A-Za-z0-9+.-]+)*://")
_LOCAL = re.compile(r"(?:file|local)://(?!.*::)(?:/(?=[A-Za-z]:[/\\]))?", re.IGNORECASE)
_USER = re.compile(r"://[^/@]*@")


def is_url(place: object) -> bool:
    """Whether a place is the text of a URL: "https://host/run.fhz", "zip://run.fhz::s3://a/b.zip".

    A scheme has two characters at least, since a drive of Windows has one.
    """
    return isinstance(place, str) and _URL.match(place) is not None


def local_path(place: str | os.PathLike[str]) -> Path | None:
    """The path of a local file, also of one that a URL names; None for another URL.

    As in fsspec, "%20" in such a URL stands for itself.
    """
    if not is_url(place):
        return Path(place)
    found = _LOCAL.match(str(place))
    return None if found is None else Path(str(place)[found.end() :])


def file_name(place: str | os.PathLike[str]) -> str:
    """The last name of a place: "run.fhz" of "https://host/a/run.fhz?signature=1"."""
    if not is_url(place):
        return Path(place).name
    return PurePosixPath(without_secrets(place).partition("::")[0].partition("://")[2]).name


def without_secrets(place: str | os.PathLike[str]) -> str:
    """The text of a place to be kept in other files: a URL without user, query and fragment."""
    if not is_url(place):
        return str(place)
    urls = str(place).split("::")
    return "::".join(re.split(r"[?#]", _USER.sub("://", url), maxsplit=1)[0] for url in urls)
