"""Reader of HDF5, with openPMD and plain groups of steps."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.readers.common.cf import (
    NAMES,
    SCALING,
    Column,
    Packing,
    beside,
    counts_steps,
    packing,
    role_of_coordinate,
    role_of_name,
    usable,
    written_times,
)
from fhash_formats.readers.common.file_series import (
    FileSeries,
    Request,
    Stamp,
    StoredFiles,
    StoredValues,
    refusing,
)
from fhash_formats.readers.common.layout import (
    Dimension,
    Layout,
    Read,
)
from fhash_formats.readers.common.listing import Listed, listing
from fhash_formats.readers.common.stored_parts import Hdf5Sources, not_stored, warn_of_column
from fhash_formats.readers.common.surroundings import (
    MAX_ARRAYS,
    Arranged,
    Stored,
    Wanted,
    metadata_of,
    named_dimensions,
    warn_left_out,
)
from fhash_formats.readers.common.variables import (
    MIN_DIMENSIONS,
    FileOfArrays,
    Variable,
    expand,
    field_reading,
    parent,
    plain_name,
)
from fhash_formats.series import AXES, AXIS_NAMES, Coordinate, SourceMetadata, shown_name
from fhash_formats.support.values import PACKING, PLUMBING, json_attributes, text_of

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


UNITS = "m"


def openpmd_axes(
    record: Mapping[str, Any], component: Mapping[str, Any], shape: Sequence[int]
) -> list[Column | None]:
    """A column of positions for each dimension of a mesh; None for each if the file is none.

    record: attributes of the group of the components of a vector, of which `component` is one; a
    scalar has all attributes itself.
    """
    own, group = json_attributes(component), json_attributes(record)
    known = own if "axisLabels" in own else group
    labels = known.get("axisLabels")
    if (
        not isinstance(labels, list)
        or len(labels) != len(shape)
        or not all(str(label) in AXES for label in labels)
    ):
        return [None] * len(shape)
    # in Fortran's order the labels begin with the fastest axis
    way = -1 if known.get("dataOrder") == "F" else 1
    labels = labels[::way]
    spacing = _numbers(known.get("gridSpacing"), len(shape), 1.0)[::way]
    offset = _numbers(known.get("gridGlobalOffset"), len(shape), 0.0)[::way]
    position = _numbers(own.get("position"), len(shape), 0.0)[::way]
    unit = known.get("gridUnitSI")
    scale = float(unit) if isinstance(unit, int | float) else 1.0
    return [
        _column(str(labels[place]), length, numbers * scale)
        for place, (length, numbers) in enumerate(
            zip(
                shape,
                np.stack([offset + position * spacing, spacing], axis=1),
                strict=True,
            )
        )
    ]


def _numbers(value: Any, count: int, default: float) -> npt.NDArray[np.float64]:
    if isinstance(value, list) and len(value) == count:
        return np.asarray(value, np.float64)
    return np.full(count, default)


def _column(name: str, length: int, line: npt.NDArray[np.float64]) -> Column:
    return Column(
        name=name,
        length=length,
        read=lambda: line[0] + line[1] * np.arange(length),
        attributes={"units": UNITS},
    )


SIGNATURE = b"\x89HDF\r\n\x1a\n"


def is_hdf5(head: bytes) -> bool:
    """Whether the first bytes of a file are those of HDF5.

    A user block of 512, 1024 or 2048 bytes may precede the signature.
    """
    return any(
        head[offset : offset + len(SIGNATURE)] == SIGNATURE for offset in (0, 512, 1024, 2048)
    )


def matches(head: bytes, path: Path) -> bool:
    """Whether this is an HDF5 file."""
    return is_hdf5(head)


def open_hdf5(path: Path, request: Request) -> FileSeries:
    """Open the series in an HDF5 file: the only suitable dataset, or the one named.

    Coordinates are the dimension scales, else 1-D datasets of a conventional name beside the
    dataset or in the root. Packing and fill values of the CF conventions are undone, as in NetCDF.
    Arrays with one group a step are one variable, and each field of a compound type is one.
    """
    import h5py

    source, stamp = str(path), Stamp.of(path)
    with refusing(f"{source} cannot be read as HDF5"):
        file = h5py.File(path, "r")
    try:
        with refusing(f"{source} cannot be read as HDF5"):
            return _series(source, path, stamp, file, request)
    except BaseException:
        file.close()
        raise


class Hdf5File(FileOfArrays):
    """The datasets of an open HDF5 file."""

    def __init__(self, source: str, path: Path, file: Any, request: Request) -> None:
        self.path, self.file = path, file
        found = walk(file)
        self.tree, self.groups = found.datasets, found.groups
        super().__init__(source, request, expand(variables(found)))

    def _stated(self, variable: Variable) -> list[Dimension]:
        dataset = variable.handle
        stated = openpmd_axes(self._attributes(parent(variable.name)), dataset.attrs, dataset.shape)
        return [
            *map(_dimension, dataset.dims, dataset.shape, stated),
            *(Dimension(name=None, length=length) for length in variable.shape[dataset.ndim :]),
        ]

    def check(self, variable: Variable) -> None:
        """Raise an error that says what is missing, if the values cannot be read here."""
        for member in variable.members or (variable,):
            require_filters(self.source, member.name, member.handle)

    def packing(self, variable: Variable) -> Packing | None:
        """The packing of the values, None where the user wants them as stored."""
        if self.request.raw_values or variable.field or variable.dtype.kind not in "iuf":
            return None
        return packing_of(self.source, variable.handle)

    def _reading(self, variable: Variable) -> Read:
        dataset, packed = variable.handle, self.packing(variable)
        if packed is not None:
            return lambda ranges: packed.unpack(dataset[ranges])
        return field_reading(lambda ranges: dataset[ranges], variable, dataset.ndim)

    def _positions(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes: what the file ties to a dimension, else by name."""
        group = parent((variable.members or (variable,))[0].name)
        places = [columns(self.tree, place) for place in dict.fromkeys([group, ""])]
        said = {
            axis: dimension
            for axis, dimension in zip(layout.axes, layout.kept, strict=True)
            if dimension.column is not None
        }
        certain = self.request.axes is not None or all(
            dimension.role is not None for dimension in layout.kept
        )
        fitting = {
            axis: dimension.column
            for axis, dimension in said.items()
            if dimension.column is not None
            and dimension.column.numeric
            and dimension.column.length == dimension.length
        }
        tied = [*said]
        if "t" in fitting and _counts_steps(fitting["t"]):
            tied.remove("t")  # a time beside the numbers of steps comes first
        named = beside(self.source, layout.axes, layout.shape, places, certain=certain, tied=tied)
        coords = layout.coordinates(self.source, fitting) | named
        if "t" in layout.axes and ("t" not in coords or not coords["t"].attributes):
            length = layout.shape[layout.axes.index("t")]
            texts = [text for place in (group, "") for text in texts_of(self.tree, place, length)]
            written = written_times("time", texts)
            coords |= {} if written is None else {"t": written}
        return coords

    def _columns(self, group: str) -> Mapping[str, Column]:
        return columns(self.tree, group)

    def _attributes(self, path: str) -> Mapping[str, Any]:
        attributes: Mapping[str, Any] = (self.groups.get(path) or self.tree[path]).attrs
        return attributes

    def _scalar(self, path: str) -> tuple[float, str] | None:
        dataset = self.tree.get(path)
        if dataset is None or dataset.size != 1 or dataset.dtype.kind not in "iuf":
            return None
        return float(dataset[()].reshape(-1)[0]), units_of(dataset)


def _counts_steps(column: Column) -> bool:
    """Whether a coordinate has no unit and only counts steps."""
    return "units" not in column.attributes and counts_steps(column.read())


def _series(source: str, path: Path, stamp: Stamp, file: Any, request: Request) -> FileSeries:
    found = Hdf5File(source, path, file, request)
    var = own_name(file, found.tree, request.var) if request.var else None
    variable = found.choose(var)
    found.check(variable)
    layout = found.arrange(variable)
    packed = found.packing(variable)
    scaled = request.raw_values and SCALING & set(variable.handle.attrs)
    first = (variable.members or (variable,))[0]
    chunks = first.handle.chunks
    trailing = first.shape[first.handle.ndim :]
    coords = found.coordinates(variable, layout)
    names = {*AXIS_NAMES.values()} | {each.name for each in coords.values()}
    with Hdf5Sources(source) as behind:
        parts = [
            behind.parts(member.name, member.handle) for member in variable.members or (variable,)
        ]
    series = FileSeries(
        files=StoredFiles(
            source=source,
            stamp=stamp,
            close=partial(_close, file, variable),
            beside=_beside(path, variable, behind.files),
        ),
        name=plain_name(shown_name(variable.name, names)),
        values=StoredValues(
            shape=layout.shape,
            dtype=variable.dtype if packed is None else packed.dtype,
            axes=layout.axes,
            fetch=layout.fetch(found.reading(variable)),
            chunks=layout.chunks(
                chunks and (*((1,) if variable.members else ()), *chunks, *trailing)
            ),
            packing=packed,
            not_stored=not_stored(parts, layout, joined=bool(variable.members)),
        ),
        coords=coords,
        attributes=json_attributes(
            variable.handle.attrs,
            # counts have not the unit of the values
            without=PLUMBING | PACKING | ({"units"} if scaled else frozenset()),
        )
        | layout.attributes(),
    )
    if not variable.members and not variable.field:
        series.metadata = partial(_metadata, found, variable, layout, series, packed)
    return series


def _metadata(
    found: Hdf5File,
    variable: Variable,
    layout: Layout,
    series: FileSeries,
    packed: Packing | None,
) -> SourceMetadata | None:
    """The datasets beside a variable; None where there are none but those of its positions.

    Dimensions without a name have that of the axis, and beside the variable one of their own.
    """
    taken = {each.name for each in series.coords.values()}
    names = named_dimensions(layout, series.coords)
    stored = {variable.name: _stored(variable.handle, variable.name, names)}
    positions = more = 0
    for path, dataset in found.tree.items():
        name = path.rpartition("/")[2]
        if path == variable.name or dataset.shape is None or dataset.ndim >= MIN_DIMENSIONS:
            continue  # what has so many dimensions can be encoded itself
        is_position = name in taken and dataset.shape in ((), *((n,) for n in layout.shape))
        positions += is_position
        if len(stored) > MAX_ARRAYS:
            more += 1
        elif not (dataset.is_scale and _valueless(dataset)):
            stored[path] = _stored(dataset, path, [name] * dataset.ndim if is_position else None)
    if len(stored) == 1 + positions:
        return None
    in_group = {path.removeprefix(f"{parent(variable.name)}/"): path for path in stored}
    flat = {path: short.replace("/", "_") for short, path in in_group.items()}
    if len(set(flat.values())) < len(flat):
        flat = {path: path.replace("/", "_") for path in stored}
    if more:
        warn_left_out(
            f"{found.source}: not everything beside {variable.name} is kept",
            {f"{more} datasets": f"more than {MAX_ARRAYS}"},
        )
    wanted = Wanted(source=found.source, name=flat[variable.name], path=found.path)
    with refusing(f"{found.source} cannot be read as HDF5"):
        return metadata_of(
            wanted,
            {flat[path]: each for path, each in stored.items()},
            json_attributes(found.file.attrs),
            Arranged(layout=layout, request=found.request, packed=packed, coords=series.coords),
        )


def _stored(dataset: Any, path: str, names: Sequence[str] | None) -> Stored:
    """A dataset as the file has it. names: of its dimensions; None for those it states."""
    import h5py

    text = h5py.check_string_dtype(dataset.dtype) is not None and dataset.dtype.kind == "O"

    def read(places: tuple[slice | int, ...]) -> Any:
        values = np.asarray(dataset[places])
        if not text:
            return values
        texts = [text_of(each) for each in values.reshape(-1)]
        return np.array(texts, dtype=object).reshape(values.shape)

    if names is None:
        own = path.replace("/", "_")
        names = [
            _dimension(each, length, None).name or f"{own}_dim_{place}"
            for place, (each, length) in enumerate(
                zip(dataset.dims if dataset.shape else (), dataset.shape, strict=True)
            )
        ]
    return Stored(
        dimensions=tuple(names),
        shape=tuple(dataset.shape),
        # references and lists of any length are objects, too
        dtype=dataset.dtype if text or dataset.dtype.kind != "O" else np.dtype("V8"),
        attributes=json_attributes(dataset.attrs),
        read=read,
    )


def _close(file: Any, variable: Variable) -> None:
    """Close a file, and those that its links lead to, which stay open with their datasets."""
    handles = [member.handle for member in variable.members or (variable,) if member.handle]
    for each in {handle.file.filename: handle.file for handle in handles}.values():
        each.close()
    file.close()


def _beside(path: Path, variable: Variable, files: Iterable[Path]) -> list[Path]:
    """The other files that hold values: those of external links, and those behind datasets."""
    linked = [Path(member.handle.file.filename) for member in variable.members or (variable,)]
    return [file for file in dict.fromkeys([*linked, *files]) if file != path]


def list_hdf5(path: Path, request: Request) -> list[Listed]:
    """The variables of an HDF5 file."""
    import h5py

    source = str(path)
    with refusing(f"{source} cannot be read as HDF5"), h5py.File(path, "r") as file:
        found = Hdf5File(source, path, file, replace(request, raw_values=False))
        return listing(source, found.variables, found.dimensions, request, found.packing)


def _dimension(dimension: Any, length: int, stated: Column | None) -> Dimension:
    scale = _scale(dimension)
    name = dimension.label or (scale[0] if scale else None)
    if scale is None:
        name = name or (stated.name if stated else None)
        role = role_of_name(name) if name else None
        return Dimension(name=name, length=length, role=role, column=stated)
    # a NetCDF dimension without values is a scale too, and says so in its NAME
    valued = not _valueless(scale[1]) and scale[1].shape == (length,)
    return Dimension(
        name=name,
        length=length,
        role=_hint(dimension.label, scale),
        column=column(*scale) if valued and scale[1].dtype.kind in "iufMSOU" else None,
    )


def _scale(dimension: Any) -> tuple[str, Any] | None:
    """Name and dataset of the dimension scale that was attached first; None without one."""
    if len(dimension) == 0:
        return None
    dataset = dimension[0]
    return dataset.name.rpartition("/")[2], dataset


def _hint(label: str, scale: tuple[str, Any] | None) -> str | None:
    if scale is not None:
        role = role_of_coordinate(scale[0], json_attributes(scale[1].attrs))
        if role is not None:
            return role
    return role_of_name(label) if label else None


def _valueless(scale: Any) -> bool:
    return text_of(scale.attrs.get("NAME", "")).startswith(
        "This is a netCDF dimension but not a netCDF variable"
    )
