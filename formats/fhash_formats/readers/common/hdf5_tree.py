"""Datasets of an HDF5 file: which are coordinates, and whether they can be read here."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.common.cf_packing import Packing, packing
from fhash_formats.readers.common.positions import Column, usable
from fhash_formats.readers.common.roles import NAMES
from fhash_formats.readers.common.variables import Variable
from fhash_formats.support.attributes import PACKING, PLUMBING, json_attributes, text_of

FILTER_NAMES = {
    305: "LZO",
    307: "bzip2",
    32000: "LZF",
    32001: "Blosc",
    32004: "LZ4",
    32008: "bitshuffle",
    32013: "ZFP",
    32015: "Zstandard",
    32017: "SZ",
    32018: "FCIDECOMP",
    32019: "JPEG",
    32024: "SZ3",
    32026: "Blosc2",
    32028: "SPERR",
}
"""Names of registered HDF5 filters, for messages; the name in the file is often empty."""


def datasets(root: Any) -> Iterator[tuple[str, Any]]:
    """Every dataset under a group with its full name (no leading slash), once, in the order of
    names.

    Soft and external links are followed where they lead somewhere (visititems would skip them). An
    object reached a second time, by a hard link or by a cycle of groups, is skipped.
    """
    import h5py

    seen: set[tuple[int, int]] = set()
    waiting = [("", root)]
    while waiting:
        path, node = waiting.pop()
        info = h5py.h5o.get_info(node.id)
        if (info.fileno, info.addr) in seen:
            continue
        seen.add((info.fileno, info.addr))
        if isinstance(node, h5py.Dataset):
            yield path, node
        elif isinstance(node, h5py.Group):
            for name in sorted(node, reverse=True):
                child = _follow(node, name)
                # what a link leads to comes last, so that an object goes by its own name and not by
                # the link's
                place = (
                    len(waiting) if isinstance(node.get(name, getlink=True), h5py.HardLink) else 0
                )
                if child is not None:
                    waiting.insert(place, (f"{path}/{name}".lstrip("/"), child))


def _follow(group: Any, name: str) -> Any:
    try:
        return group[name]
    except (KeyError, OSError):
        return None  # a link to nowhere: there is no dataset behind it to offer


def own_name(file: Any, tree: Mapping[str, Any], name: str) -> str:
    """The name under which `datasets` lists an object that the user called by another of its names.

    It is the given name where there is none.
    """
    import h5py

    other = _follow(file, name)
    return (
        next((listed for listed, dataset in tree.items() if dataset == other), name)
        if isinstance(other, h5py.Dataset)
        else name
    )


def variables(tree: Mapping[str, Any]) -> list[Variable]:
    """Datasets that hold values, as Variables; dimension scales and bounds are auxiliary."""
    bounds = set()
    for name, dataset in tree.items():
        if isinstance(dataset.attrs.get("bounds"), str | bytes):
            bounds.add(sibling(name, text_of(dataset.attrs["bounds"])))
    return [
        Variable(
            name=name,
            shape=dataset.shape,
            dtype=dataset.dtype,
            auxiliary=dataset.is_scale or name in bounds,
            handle=dataset,
            units=units_of(dataset),
        )
        for name, dataset in tree.items()
        if dataset.shape is not None
    ]


def columns(tree: Mapping[str, Any], group: str) -> dict[str, Column]:
    """Datasets directly in a group that may be coordinates, by lower-case name.

    They are 1-D numbers, or one number alone.
    """
    coordinates = {}
    for path, dataset in tree.items():
        place, _, name = path.rpartition("/")
        if (
            place == group
            and dataset.shape is not None
            and len(dataset.shape) < 2
            and usable(dataset.dtype)
        ):
            coordinates[name.lower()] = column(path, dataset)
    return coordinates


def texts_of(
    tree: Mapping[str, Any], group: str, length: int
) -> Iterator[tuple[str, Any, Mapping[str, Any]]]:
    """Datasets of so many texts directly in a group, with a name of times: path, texts, attributes.

    Names are those of `roles.NAMES`.
    """
    for path, dataset in tree.items():
        place, _, name = path.rpartition("/")
        told = place == group and name.lower() in NAMES["t"].split()
        if told and dataset.shape == (length,) and dataset.dtype.kind in "SO":
            yield path, dataset[()], json_attributes(dataset.attrs)


def column(path: str, dataset: Any) -> Column:
    """A dataset of at most one dimension as a Column."""
    numeric = usable(dataset.dtype)
    packed = packing_of(path, dataset) if dataset.dtype.kind in "iuf" else None

    def read() -> Any:
        stored = dataset[()]
        return stored if packed is None else packed.unpack(np.array(stored))

    return Column(
        name=path,
        length=dataset.size,
        read=read,
        attributes=json_attributes(dataset.attrs, without=PLUMBING | PACKING),
        numeric=numeric,
    )


def packing_of(source: str, dataset: Any) -> Packing:
    """The packing of a dataset of numbers by its attributes; an empty attribute says nothing."""
    import h5py

    given = {name: dataset.attrs[name] for name in PACKING if name in dataset.attrs}
    return packing(
        source,
        dataset.dtype,
        {name: value for name, value in given.items() if not isinstance(value, h5py.Empty)},
    )


def units_of(dataset: Any) -> str:
    """The attribute `units` of a dataset as text, "" without one."""
    units = dataset.attrs.get("units", "") if "units" in dataset.attrs else ""
    return text_of(units) if isinstance(units, str | bytes) else ""


def sibling(path: str, name: str) -> str:
    """Full name of another dataset in the same group."""
    return f"{path.rpartition('/')[0]}/{name}".lstrip("/")


def require_filters(source: str, name: str, dataset: Any) -> None:
    """Check that the filters of a dataset can be undone, with hdf5plugin if need be.

    Raises MissingDependencyError that names the filter and what to install, or InputError where no
    plug-in known here has it.
    """
    import h5py

    plist = dataset.id.get_create_plist()
    for place in range(plist.get_nfilters()):
        code, _, _, stored = plist.get_filter(place)
        if h5py.h5z.filter_avail(code):
            continue
        label = (
            f"{FILTER_NAMES.get(code) or text_of(stored).split(' ')[0] or 'unknown'} (id {code})"
        )
        try:
            importlib.import_module("hdf5plugin")
        except ImportError as error:
            raise MissingDependencyError(
                f"{source}: {name} is compressed with the HDF5 filter {label}, which needs"
                " hdf5plugin: pip install 'fhash[formats]'"
            ) from error
        if not h5py.h5z.filter_avail(code):
            raise InputError(
                f"{source}: {name} is compressed with the HDF5 filter {label}, which neither h5py"
                " nor hdf5plugin has"
            )


def require_sources(source: str, path: Path, name: str, dataset: Any) -> None:
    """Raise InputError if a virtual dataset refers to a file that is missing.

    HDF5 would silently give fill values for it.
    """
    if not dataset.is_virtual:
        return
    for mapped in dataset.virtual_sources():
        file = mapped.file_name
        if (
            file != "."
            and "%b" not in file
            and not (path.parent / file).exists()
            and not Path(file).exists()
        ):
            raise InputError(
                f"{source}: {name} is a virtual dataset that draws on {file}, which is not there"
            )


def files_beside(path: Path, dataset: Any) -> list[Path]:
    """The other files that hold values of a dataset.

    They are those of an external link, raw files, and those behind a virtual dataset.
    """
    names = [] if Path(dataset.file.filename) == path else [dataset.file.filename]
    names += [name for name, _, _ in dataset.external or ()]
    if dataset.is_virtual:
        names += [
            mapped.file_name for mapped in dataset.virtual_sources() if mapped.file_name != "."
        ]
    # HDF5 looks for a relative name beside the file, then in the current folder
    return list(
        dict.fromkeys(
            files for name in names for files in (path.parent / name, Path(name)) if files.exists()
        )
    )
