"""Names of a hierarchy: where arrays of one or several variables lie, and headers in the root."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fhash_formats.container.header import complete, shared_coordinates, validate_header
from fhash_formats.errors import DamagedFileError

VARIABLES = "variables"
"""Key of the root's header: the headers of the variables."""
GROUP_KEY = "group"
"""Key of the header of one of several variables: the group of its arrays, v and its number."""
SHARES = "shares"
"""Key of a variable's header: arrays that lie with another variable."""

_OF_ROOT = ("format", "format_version", "required_features")


def path_of(header: Mapping[str, Any], name: str) -> str:
    """The path of an array of a variable in the hierarchy."""
    return f"{header[GROUP_KEY]}/{name}" if GROUP_KEY in header else name


@contextmanager
def variable_named(name: str, count: int) -> Iterator[None]:
    """A block whose errors about a file begin with the name of a variable, if it is one of several.

    count: number of the file's variables.
    """
    try:
        yield
    except DamagedFileError as error:
        if count == 1:
            raise
        raise type(error)(f"variable {name[:80]!a}: {error}") from error


def read_headers(root: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The headers of all variables by name, complete and checked, in the order of the file.

    root: attribute "fhash" of the root. Raises DamagedFileError or UnsupportedFileError for a
    header that is not sound.
    """
    of_root = {key: root[key] for key in _OF_ROOT}
    headers: dict[str, dict[str, Any]] = {}
    for entry in shared_coordinates(root[VARIABLES]):
        name = entry.get("name", entry["variable"]["name"])
        with variable_named(name, len(root[VARIABLES])):
            header = complete(entry) | of_root
            validate_header(header)
        headers[name] = header
    return headers


GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group"}
"""The zarr.json of a group without attributes."""
