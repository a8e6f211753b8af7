"""The groups and arrays of a zarr hierarchy, found without consolidated metadata."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fhash_formats.errors import InputError
from fhash_formats.readers.common.failures import condense, refusing

if TYPE_CHECKING:
    import zarr

METADATA = ("zarr.json", ".zarray", ".zgroup")


def metadata_of(path: Path) -> Path | None:
    """The metadata file of a group or array in a folder; None if the folder is neither."""
    return next((path / name for name in METADATA if (path / name).is_file()), None)


def nodes_in_folder(folder: Path, place: str = "") -> Iterator[str]:
    """Paths of all groups and arrays below a group.

    Folders of chunks have no metadata and are not entered.
    """
    for child in sorted(folder.iterdir()):
        if child.is_dir() and metadata_of(child) is not None:
            yield f"{place}{child.name}"
            if not (child / ".zarray").is_file():
                yield from nodes_in_folder(child, f"{place}{child.name}/")


def nodes_in_zip(source: str, path: Path) -> tuple[str, list[str]]:
    """Place of the hierarchy in a ZIP, and its groups and arrays from there.

    The place is the top, or the one folder that was zipped.
    """
    with refusing(f"{source} cannot be read as a ZIP"), zipfile.ZipFile(path) as file:
        names = file.namelist()
    nodes = sorted(
        {name.rpartition("/")[0] for name in names if name.rpartition("/")[2] in METADATA}
    )
    tops = {name.split("/", 1)[0] for name in names}
    inside = "" if "" in nodes else next(iter(tops)) if len(tops) == 1 else None
    if inside is None or inside not in nodes:
        raise InputError(
            f"{source} is a ZIP that holds no zarr hierarchy ({', '.join(METADATA)} at its top)"
        )
    return inside, [node.removeprefix(inside).lstrip("/") for node in nodes]


def open_arrays(
    store: Any, inside: str, nodes: Iterable[str]
) -> tuple[dict[str, zarr.Array[Any]], dict[str, Mapping[str, Any]], dict[str, str]]:
    """Arrays by path, the attributes of groups, and the errors of those that cannot be opened.

    An array with an unknown codec does not bar the others.
    """
    import zarr

    arrays: dict[str, zarr.Array[Any]] = {}
    groups: dict[str, Mapping[str, Any]] = {}
    failed: dict[str, str] = {}
    for node in nodes:
        try:
            opened = zarr.open(store=store, path=f"{inside}/{node}".strip("/"), mode="r")
        except Exception as error:  # codecs, types and JSON raise all kinds
            failed[node] = condense(error)
            continue
        if isinstance(opened, zarr.Array):
            arrays[node] = opened
        else:
            groups[node] = dict(opened.attrs)
    return arrays, groups, failed
