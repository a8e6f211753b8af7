"""Places of containers: paths, URLs and open files, and the sources of their bytes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from fhash_formats.container.source import FileSource, OpenFileSource, Source, damage_named
from fhash_formats.errors import InputError
from fhash_formats.support.locations import is_url, local_path

__all__ = ["Location", "Place", "StorageOptions", "located"]

StorageOptions = Mapping[str, Any] | None
"""Options of a URL's file system in fsspec, by name."""


@dataclass(frozen=True, kw_only=True)
class Location:
    """A container's place, from which it can be opened again, also in another process.

    Attributes:
        place: path, or text of a URL.
        storage_options: options of the URL's file system in fsspec, which may be secret.
        digest: `Container.digest` of the file that is meant; None for any.
    """

    place: Path | str
    storage_options: StorageOptions = field(default=None, repr=False)
    digest: str | None = None


Place = str | os.PathLike[str] | BinaryIO | Location
"""A container to open: path, URL, open binary file, or the location of one that was open."""


def located(
    place: Place, storage_options: StorageOptions
) -> tuple[Location | None, Path | str, Source]:
    """The location of a container, its name in messages, and its bytes.

    The location is None for an open file, which cannot be opened again elsewhere. A `file:` URL
    becomes a path. Raises MissingInputError, MissingDependencyError or InputError.
    """
    if isinstance(place, Location):
        return located(place.place, place.storage_options)
    if not isinstance(place, str | os.PathLike):
        _refuse_options(storage_options, "an open file")
        return _opened(place)
    path = local_path(place)
    if path is None:
        from fhash_formats.container.fsspec_file import FsspecFile
        from fhash_formats.container.remote import RemoteSource

        url = str(place)
        location = Location(place=url, storage_options=storage_options)
        with damage_named(url):
            return location, url, RemoteSource(FsspecFile.open(url, storage_options or {}))
    _refuse_options(storage_options, str(path))
    if is_url(str(path).replace(":/", "://", 1)) and not path.exists():
        raise InputError(f"{path}: a URL is given as text, not as a Path, which changes it")
    return Location(place=path), path, FileSource(path)


def _opened(file: Any) -> tuple[None, str, Source]:
    """Name and bytes of an open file; one of fsspec is read by ranges, not by its large blocks."""
    fs, path = getattr(file, "fs", None), getattr(file, "path", None)
    if hasattr(fs, "cat_file") and isinstance(path, str):
        from fhash_formats.container.fsspec_file import FsspecFile
        from fhash_formats.container.remote import RemoteSource

        if getattr(file, "compression", None) is not None:
            raise InputError(f"{path}: a compressed file; decompress it, ranges of it are needed")
        full_name = str(getattr(file, "full_name", path))
        with damage_named(full_name):
            return None, full_name, RemoteSource(FsspecFile(fs, path, full_name))
    if not (hasattr(file, "read") and hasattr(file, "seek")):
        raise InputError(
            f"{type(file).__name__} is no place of a container; "
            "give a path, a URL, or a file opened with 'rb'"
        )
    name = getattr(file, "name", None)
    shown = name if isinstance(name, str) else f"<{type(file).__name__}>"
    return None, shown, OpenFileSource(file)


def _refuse_options(storage_options: StorageOptions, place: str) -> None:
    if storage_options:
        raise InputError(f"{place}: storage_options are for URLs, such as s3://bucket/run.fhz")
