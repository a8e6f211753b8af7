"""Datasets of an HDF5 file: which are coordinates, and whether they can be read here."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.common.cf_packing import Packing, packing
from fhash_formats.readers.common.positions import Column, usable
from fhash_formats.readers.common.roles import NAMES
from fhash_formats.readers.common.stored_parts import Hdf5Sources, warn_of_column
from fhash_formats.readers.common.variables import Variable
from fhash_formats.support.attributes import PACKING, PLUMBING, json_attributes, text_of

CONVENTIONAL = frozenset(name for names in NAMES.values() for name in names.split())
"""Names of coordinates, in lower case."""

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


class Scalar:
    """A dataset of one number or text, which is opened again when more of it is asked for.

    HDF5 is slow at many thousands of open objects.

    Attributes:
        dtype, units: of the dataset.
    """

    shape: tuple[int, ...] = ()
    ndim, size, is_scale = 0, 1, False

    def __init__(self, group: Any, name: bytes, opened: Any) -> None:
        import h5py

        self._group, self._name, self.dtype = group, name, opened.dtype
        self.units = units_of(h5py.Dataset(opened)) if h5py.h5a.exists(opened, b"units") else ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._opened(), name)

    def __getitem__(self, places: Any) -> Any:
        return self._opened()[places]

    def _opened(self) -> Any:
        import h5py

        return h5py.Dataset(h5py.h5o.open(self._group.id, self._name))


@dataclass(frozen=True)
class Tree:
    """Objects of a file by full name without a leading slash.

    Attributes:
        datasets: each once, in the order of names.
        groups: each once.
        broken: links that lead nowhere, and where they point.
    """

    datasets: dict[str, Any] = field(default_factory=dict)
    groups: dict[str, Any] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)


def walk(root: Any) -> Tree:
    """All that is under a group.

    Soft and external links are followed where they lead somewhere (visititems would skip them). An
    object reached a second time, by a hard link or by a cycle of groups, is skipped.
    """
    import h5py

    tree = Tree()
    seen: set[tuple[int, int]] = set()
    # what a link leads to comes last, so that an object goes by its own name and not by the link's
    waiting: list[tuple[str, Any, bytes]] = [("", root, b".")]
    linked: deque[tuple[str, Any, bytes]] = deque()
    while waiting or linked:
        path, group, name = waiting.pop() if waiting else linked.popleft()
        try:
            opened = h5py.h5o.open(group.id, name, lapl=group._lapl)
        except (KeyError, OSError, RuntimeError):
            tree.broken[path] = _target(group, name)
            continue
        info = h5py.h5o.get_info(opened)
        if (info.fileno, info.addr) in seen:
            continue
        seen.add((info.fileno, info.addr))
        if isinstance(opened, h5py.h5d.DatasetID):
            if opened.get_space().get_simple_extent_type() == h5py.h5s.SCALAR:
                tree.datasets[path] = Scalar(group, name, opened)
            else:
                tree.datasets[path] = h5py.Dataset(opened)
        elif isinstance(opened, h5py.h5g.GroupID):
            node = tree.groups[path] = h5py.Group(opened)
            for child in sorted(opened, reverse=True):
                entry = (f"{path}/{text_of(child)}".lstrip("/"), node, child)
                hard = opened.links.get_info(child).type == h5py.h5l.TYPE_HARD
                waiting.append(entry) if hard else linked.append(entry)
    return tree


def _target(group: Any, name: bytes) -> str:
    """The place that a link points to."""
    import h5py

    kind = group.id.links.get_info(name).type
    if kind == h5py.h5l.TYPE_HARD:
        return "an object that cannot be opened"
    value = group.id.links.get_val(name)
    if kind == h5py.h5l.TYPE_SOFT:
        return text_of(value)
    return f"{text_of(value[1])} of {text_of(value[0])}"


def own_name(file: Any, tree: Mapping[str, Any], name: str) -> str:
    """The name under which `walk` lists an object that the user called by another of its names.

    It is the given name where there is none.
    """
    import h5py

    try:
        other = None if name in tree else file.get(name)
    except (KeyError, OSError, RuntimeError):  # a link to nowhere
        other = None
    return (
        next((listed for listed, dataset in tree.items() if dataset == other), name)
        if isinstance(other, h5py.Dataset)
        else name
    )


def variables(tree: Tree) -> list[Variable]:
    """Datasets that hold values, and links to nowhere, as Variables.

    Dimension scales and bounds are auxiliary.
    """
    bounds = set()
    for name, dataset in tree.datasets.items():
        if dataset.shape and isinstance(dataset.attrs.get("bounds"), str | bytes):
            bounds.add(sibling(name, text_of(dataset.attrs["bounds"])))
    return [
        Variable(
            name=name,
            shape=dataset.shape,
            dtype=dataset.dtype,
            auxiliary=dataset.is_scale or name in bounds,
            handle=dataset,
            units=dataset.units if isinstance(dataset, Scalar) else units_of(dataset),
        )
        for name, dataset in tree.datasets.items()
        if dataset.shape is not None
    ] + [
        Variable(
            name=name,
            shape=(),
            dtype=np.dtype(object),
            error=f"a link to {target}, which is not there",
        )
        for name, target in tree.broken.items()
    ]


def columns(tree: Mapping[str, Any], group: str) -> dict[str, Column]:
    """Datasets directly in a group that may be coordinates, by lower-case conventional name.

    They are 1-D numbers, or one number alone.
    """
    coordinates = {}
    for path, dataset in tree.items():
        place, _, name = path.rpartition("/")
        if (
            place == group
            and name.lower() in CONVENTIONAL
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
        with Hdf5Sources(path) as behind:
            warn_of_column(path, behind.parts(path, dataset))
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
