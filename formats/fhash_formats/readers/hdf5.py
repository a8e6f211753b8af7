"""Reader of HDF5 and NetCDF-4, with openPMD: datasets by name, their dimensions by scales."""

from __future__ import annotations

import importlib
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError, MissingDependencyError
from fhash_formats.readers.file_series import Request, Stamp, naming, refusing, require_length
from fhash_formats.readers.layout import Read
from fhash_formats.readers.simulations import (
    athena_variables,
    flash_variables,
    in_place_of,
    warn_of_system,
)
from fhash_formats.readers.stored_bytes import lattice
from fhash_formats.readers.stored_parts import Hdf5Sources, hdf5_file
from fhash_formats.readers.variables import (
    Behind,
    Source,
    Variable,
    by_ranges,
    file_source,
    parent,
    placed,
    plain_name,
    positions,
)
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import PLUMBING, decoded_text, json_attributes, text_of

SUFFIXES = (".h5", ".hdf5", ".hdf", ".he5", ".mnc", ".athdf")
NETCDF_SUFFIXES = (".nc", ".nc4", ".netcdf", ".cdf")

NOT_A_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""Beginning of the NAME of a dimension scale that holds no values."""
HIDDEN = "_nc4_non_coord_"
"""Beginning of the name of a NetCDF variable that is called as a dimension, and is not along it."""

DEFAULT_FILLS = {
    "i2": -32767,
    "u2": 65535,
    "i4": -2147483647,
    "u4": 4294967295,
    "i8": -9223372036854775806,
    "u8": 18446744073709551614,
    "f4": 9.969209968386869e36,
    "f8": 9.969209968386869e36,
}
"""NC_FILL_SHORT and so on of netcdf.h; bytes have none that counts."""


def default_fill(dtype: np.dtype[Any]) -> float | int | None:
    """The number that NetCDF puts where nobody wrote; None for bytes and other types."""
    return DEFAULT_FILLS.get(dtype.newbyteorder("=").str[1:])


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


def says_netcdf(head: bytes, path: Path) -> bool:
    """Whether an HDF5 file is NetCDF: by its suffix, `_NCProperties` or CF `Conventions`.

    Raises InputError for a file that cannot be opened.
    """
    if not is_hdf5(head):
        return False
    if path.suffix.lower() in NETCDF_SUFFIXES:
        return True
    with refusing(f"{path} cannot be read as HDF5"), hdf5_file(path) as file:
        conventions = text_of(file.attrs.get("Conventions", "")).strip().upper()
        return "_NCProperties" in file.attrs or conventions.startswith("CF-")


class Attributes(Mapping[str, Any]):
    """Attributes of an object, read at the first use.

    Bytes are texts unless they stand for missing values; what h5py cannot read is left out.
    """

    def __init__(self, described: Any) -> None:
        self._described = described

    @cached_property
    def _values(self) -> dict[str, Any]:
        import h5py

        found = {}
        attributes = self._described.attrs
        for name in attributes:
            if name in PLUMBING:
                continue
            try:
                value = attributes[name]
            except (OSError, TypeError, RuntimeError):
                continue
            if isinstance(value, h5py.Empty):
                if value.dtype.kind not in "SO":
                    continue
                value = ""
            found[name] = _plain(name, value)
        return found

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def _plain(name: str, value: Any) -> Any:
    """An attribute as NetCDF has it: a number, a text, or an array of several."""
    if isinstance(value, np.ndarray) and value.shape == (1,):
        value = value[0]
    if isinstance(value, np.ndarray) and value.dtype.kind in "SOU":
        listed = value.reshape(-1).tolist()
        if all(isinstance(each, str | bytes) for each in listed):
            return [text_of(each) for each in listed]
    if isinstance(value, bytes) and name not in ("_FillValue", "missing_value"):
        return decoded_text(value)
    return value


@dataclass(frozen=True)
class Tree:
    """Objects of a file by full name without a leading slash.

    Attributes:
        datasets: each once, in the order of names.
        groups: each once.
        broken: links that lead nowhere, and where they point.
        files: each file that links lead to, the own one too, by its number.
    """

    datasets: dict[str, Any] = field(default_factory=dict)
    groups: dict[str, Any] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)
    files: dict[int, Any] = field(default_factory=dict)


class Scalar:
    """A dataset of one number or text, which is opened when it is asked for.

    HDF5 is slow at many thousands of open objects.
    """

    shape: tuple[int, ...] = ()
    is_scale, chunks = False, None

    def __init__(self, group: Any, name: bytes, dtype: np.dtype[Any]) -> None:
        self._group, self._name, self.dtype = group, name, dtype

    def __getattr__(self, name: str) -> Any:
        return getattr(self._opened(), name)

    def __getitem__(self, places: Any) -> Any:
        return self._opened()[places]

    def _opened(self) -> Any:
        import h5py

        return h5py.Dataset(h5py.h5o.open(self._group.id, self._name))


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
        if info.fileno not in tree.files:
            tree.files[info.fileno] = h5py.File(h5py.h5i.get_file_id(opened))
        if isinstance(opened, h5py.h5d.DatasetID):
            if opened.get_space().get_simple_extent_type() == h5py.h5s.SCALAR:
                tree.datasets[path] = Scalar(group, name, opened.dtype)
            else:
                tree.datasets[path] = h5py.Dataset(opened)
        elif isinstance(opened, h5py.h5g.GroupID):
            node = tree.groups[path] = h5py.Group(opened)
            for child in reversed(list(opened)):  # in the order of their making, or of names
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


def open_hdf5(path: Path, request: Request, *, netcdf: bool = False) -> Source:
    """The datasets of an HDF5 file, of which a NetCDF-4 file is one.

    netcdf: whether the rules of NetCDF hold: dimensions belong to groups, and values that nobody
    wrote are the format's fill values.
    """
    source, stamp = str(path), Stamp.of(path)
    kind = "NetCDF" if netcdf else "HDF5"
    with naming(source), refusing(f"{source} cannot be read as {kind}"):
        file = hdf5_file(path)
        try:
            tree = walk(file)
            variables = _Variables(path, tree, netcdf=netcdf).listed()
            if MINC_IMAGE in tree.datasets:
                variables = minc_variables(path, tree, variables, raw=request.raw_values)
            elif "unknown names" in tree.datasets:
                variables = flash_variables(variables)
            elif "NumMeshBlocks" in file.attrs:
                variables = athena_variables(variables, Attributes(file))
                warn_of_system(source, text_of(file.attrs.get("Coordinates", "")).strip())
            var = request.var and _own_name(file, tree.datasets, request.var)
        except BaseException:
            file.close()
            raise
    return file_source(
        path,
        variables,
        groups={name: Attributes(group) for name, group in tree.groups.items()},
        close=partial(_close, tree),
        stamp=stamp,
        naming=netcdf,
        spread=not netcdf,
        aliases={} if var == request.var else {str(request.var): str(var)},
        default_fill=default_fill if netcdf else lambda dtype: None,
    )


def open_netcdf(path: Path, request: Request) -> Source:
    """The variables of a NetCDF-4 file."""
    return open_hdf5(path, request, netcdf=True)


def _close(tree: Tree) -> None:
    """Close a file, and those that its links lead to, which stay open with their datasets."""
    for file in tree.files.values():
        file.close()


def _own_name(file: Any, tree: Mapping[str, Any], name: str) -> str:
    """The name under which `walk` lists an object that the user called by another of its names.

    It is the given name where there is none.
    """
    import h5py

    try:
        other = None if name in tree else file.get(name)
    except (KeyError, OSError, RuntimeError):  # a link to nowhere
        other = None
    if not isinstance(other, h5py.Dataset):
        return name
    return next((listed for listed, dataset in tree.items() if dataset == other), name)


class _Variables:
    """Makes the variables of a file."""

    def __init__(self, path: Path, tree: Tree, *, netcdf: bool) -> None:
        self.source, self.path, self.tree, self.netcdf = str(path), path, tree, netcdf
        self._records: dict[str, int] = {}  # lengths of unlimited dimensions, by their scales
        # scales of dimensions without values
        self._empty = {
            name for name, each in tree.datasets.items() if each.is_scale and _is_empty(each)
        }

    @cached_property
    def _names(self) -> dict[str, str]:
        """Paths by the names that HDF5 gives datasets."""
        datasets = self.tree.datasets.items()
        return {each.name: path for path, each in datasets if not isinstance(each, Scalar)}

    def listed(self) -> list[Variable]:
        """Datasets that hold values, and links to nowhere."""
        dims = {name: self._dimensions(name, each) for name, each in self.tree.datasets.items()}
        for name, (_, scales) in dims.items() if self.netcdf else ():
            dataset = self.tree.datasets[name]
            for place, scale in enumerate(scales):
                if scale and dataset.maxshape[place] is None:
                    known = self._records.get(scale, 0)
                    self._records[scale] = max(known, dataset.shape[place])
        found: list[Variable] = []
        for name, dataset in self.tree.datasets.items():
            if dataset.shape is not None and name not in self._empty:
                found += self._variables(name, dataset, *dims[name])
        return found + [
            Variable(
                name=name,
                shape=(),
                dtype=np.dtype(object),
                error=f"a link to {target}, which is not there",
            )
            for name, target in self.tree.broken.items()
        ]

    def _dimensions(self, path: str, dataset: Any) -> tuple[list[str | None], list[str]]:
        """Name of each dimension, and the path of its scale, "" without one."""
        if not dataset.shape:
            return [], []
        if dataset.is_scale:
            ids = dataset.attrs.get("_Netcdf4Coordinates") if self.netcdf else None
            if ids is not None and len(ids) == len(dataset.shape):
                scales = [self._by_id.get(int(number), "") for number in ids]
                return [plain_name(scale) or None for scale in scales], scales
            own = path.replace(HIDDEN, "")
            rest = len(dataset.shape) - 1
            return [plain_name(own), *[None] * rest], [path, *[""] * rest]
        names: list[str | None] = []
        scales = []
        for dimension in dataset.dims:
            scale = dimension[0].name if len(dimension) else None
            label = dimension.label
            names.append(label or (None if scale is None else scale.rpartition("/")[2]))
            scales.append("" if scale is None else self._names.get(scale, ""))
        return names, scales

    @cached_property
    def _by_id(self) -> dict[int, str]:
        """Paths of scales by the number that NetCDF gives its dimensions."""
        return {
            int(each.attrs["_Netcdf4Dimid"]): path
            for path, each in self.tree.datasets.items()
            if each.is_scale and "_Netcdf4Dimid" in each.attrs
        }

    def _variables(
        self, path: str, dataset: Any, names: list[str | None], scales: list[str]
    ) -> Iterator[Variable]:
        """The variable of a dataset, and the positions that openPMD says of it."""
        import h5py

        text = h5py.check_string_dtype(dataset.dtype) is not None and dataset.dtype.kind == "O"
        # references and lists of any length are objects, too
        dtype = dataset.dtype if text or dataset.dtype.kind != "O" else np.dtype("V8")
        if dtype.names is None and not text:
            dtype = np.dtype(dtype.str)  # without what h5py notes of it, such as enumerations
        attributes: Mapping[str, Any] = Attributes(dataset)
        if self.netcdf and dtype == np.int8 and attributes.get("dtype") == "bool":
            dtype = np.dtype(bool)  # as xarray writes booleans
            attributes = {key: each for key, each in attributes.items() if key != "dtype"}
        shape = tuple(dataset.shape)
        if self._records:
            grown = zip(shape, scales, dataset.maxshape, strict=True)
            shape = tuple(
                max(length, self._records.get(scale, 0)) if limit is None else length
                for length, scale, limit in grown
            )
        variable = Variable(
            name=path.replace(HIDDEN, ""),
            shape=shape,
            dtype=dtype,
            dimensions=tuple(names),
            attributes=attributes,
            read=_padded(dataset, shape, dtype, text=text),
            chunks=dataset.chunks,
            auxiliary=bool(dataset.is_scale),
            unlimited=[
                name
                for name, most in zip(names, dataset.maxshape, strict=True)
                if name and most is None
            ]
            if self.netcdf
            else (),
            scales={
                name: scale
                for name, scale in zip(names, scales, strict=True)
                if name and scale not in ("", path) and scale not in self._empty
            },
            behind=partial(self._behind, path, dataset),
            require=partial(require_filters, self.source, path, dataset),
        )
        lines = {}
        if len(shape) > 1 and not any(scales):
            group = self.tree.groups.get(parent(path))
            around = {} if group is None else Attributes(group)
            lines = openpmd_lines(around, attributes, shape)
        if lines:
            named = [f"{path}/{axis}" for axis in lines]
            for name, values in zip(named, lines.values(), strict=True):
                yield positions(name, values, {"units": UNITS})
            variable = replace(
                variable, dimensions=tuple(lines), scales=dict(zip(lines, named, strict=True))
            )
        yield variable

    def _behind(self, path: str, dataset: Any) -> Behind:
        with Hdf5Sources(self.source) as sources:
            parts = sources.parts(path, dataset)
            linked = Path(dataset.file.filename)
            files = dict.fromkeys([linked, *sources.files])
        return Behind(parts=parts, files=[file for file in files if file != self.path])


def _is_empty(scale: Any) -> bool:
    """Whether a scale is that of a dimension without values."""
    return text_of(scale.attrs.get("NAME", "")).startswith(NOT_A_VARIABLE)


def _padded(dataset: Any, shape: Sequence[int], dtype: np.dtype[Any], *, text: bool) -> Read:
    """The read of a dataset; its fill value stands where an unlimited dimension has grown since."""

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        values = np.asarray(dataset[places])
        if text:
            texts = [text_of(each) for each in values.reshape(-1)]
            return np.array(texts, dtype=object).reshape(values.shape)
        return values if dtype.names else values.astype(dtype, copy=False)

    def grown(wanted: list[range]) -> npt.NDArray[Any]:
        result = np.full([len(each) for each in wanted], dataset.fillvalue, dtype)
        there = [
            slice(each.start, max(each.start, min(each.stop, length)))
            for each, length in zip(wanted, dataset.shape, strict=True)
        ]
        stored = dataset[tuple(there)]
        result[tuple(map(slice, stored.shape))] = stored
        return result

    return read if tuple(shape) == tuple(dataset.shape) else by_ranges(shape, grown)


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


def openpmd_lines(
    record: Mapping[str, Any], component: Mapping[str, Any], shape: Sequence[int]
) -> dict[str, npt.NDArray[np.float64]]:
    """Positions along each dimension of a mesh, by its label; none if the array is no mesh.

    record: attributes of the group of the components of a vector, of which `component` is one; a
    scalar has all attributes itself.
    """
    known = json_attributes(component if "axisLabels" in component else record)
    labels = known.get("axisLabels")
    labels = [labels] if isinstance(labels, str) else labels
    if not isinstance(labels, list) or len(labels) != len(shape):
        return {}
    if not all(str(label) in AXES for label in labels) or len(set(labels)) < len(labels):
        return {}
    # in Fortran's order the labels begin with the fastest axis
    way = -1 if known.get("dataOrder") == "F" else 1
    labels = labels[::way]
    spacing = _numbers(known.get("gridSpacing"), len(shape), 1.0)[::way]
    offset = _numbers(known.get("gridGlobalOffset"), len(shape), 0.0)[::way]
    place = _numbers(json_attributes(component).get("position"), len(shape), 0.0)[::way]
    for label, length in zip(labels, shape, strict=True):
        require_length(str(label), length)
    unit = known.get("gridUnitSI")
    scale = float(unit) if isinstance(unit, int | float) else 1.0
    return {
        str(labels[n]): scale * (offset[n] + place[n] * spacing[n])
        + scale * spacing[n] * np.arange(length)
        for n, length in enumerate(shape)
    }


def _numbers(value: Any, count: int, default: float) -> npt.NDArray[np.float64]:
    value = [value] if isinstance(value, int | float) else value
    if isinstance(value, list) and len(value) == count:
        return np.asarray(value, np.float64)
    return np.full(count, default)


MINC_IMAGE = "minc-2.0/image/0/image"
"""Full name of the values of MINC2 in full resolution."""
MINC_NAMES = {axis: f"{axis}space" for axis in AXES[1:]} | {"t": AXIS_NAMES["t"]}


def minc_variables(
    path: Path, tree: Tree, variables: Sequence[Variable], *, raw: bool
) -> list[Variable]:
    """The variables of a MINC2 file, with one of its image in real values before all others.

    Integers are scaled between the least and the greatest value of their slice; those outside of
    the valid range are missing. Positions are along the axes of the image, as MINC counts them, and
    a warning (FhashWarning) says where these are turned against the scanner's. Raises InputError
    for labels and other scales.

    raw: whether the values are left as they are stored.
    """
    known = {each.name: each for each in variables}
    image = replace(known[MINC_IMAGE], name=path.stem, scales={})
    names = _minc_dimensions(image)
    if len(names) != len(image.shape):
        raise InputError(f"its image has the shape {image.shape} and the dimensions {names}")
    if tree.datasets[MINC_IMAGE].dtype.metadata:
        raise InputError("its image holds labels of an enumeration, no numbers")
    axes = {name: axis for axis, name in MINC_NAMES.items()}
    found = [AXIS_NAMES[axes[name]] if name in axes else "component" for name in names]
    image = replace(image, dimensions=tuple(found))
    if image.dtype.kind in "iu" and not raw:
        around = MINC_IMAGE.removesuffix("image")
        ends = [known[around + "image-min"], known[around + "image-max"]]
        image = _minc_scaled(image, names, *ends)
    coords, turns = {}, np.eye(3)
    for length, name in zip(image.shape, names, strict=True):
        place = f"minc-2.0/dimensions/{name}"
        if name not in axes or place not in tree.datasets:
            continue
        axis, told = axes[name], Attributes(tree.datasets[place])
        start, step = float(told.get("start", 0)), float(told.get("step", 1))
        units = text_of(told.get("units", ""))
        coords[axis] = lattice(axis, start, step, length, units=units)
        if text_of(told.get("spacing", "")).startswith("irregular"):
            listed = known[place].whole().reshape(length)
            coords[axis] = positions(AXIS_NAMES[axis], listed, {"units": units})
        if axis != "t" and "direction_cosines" in told:
            turns["xyz".index(axis)] = told["direction_cosines"]
    if not np.allclose(turns, np.eye(3), rtol=0, atol=1e-6):
        warnings.warn(
            f"{path}: its axes are turned against those of the scanner; positions are along its"
            " own axes",
            FhashWarning,
            stacklevel=2,
        )
    return in_place_of(variables, placed([image], coords))


def _minc_dimensions(variable: Variable) -> list[str]:
    """Names of the dimensions, the slowest first."""
    listed = text_of(variable.attributes.get("dimorder", "")).split(",")
    return listed[: len(variable.shape)]


def _minc_scaled(
    image: Variable, names: Sequence[str], least: Variable, greatest: Variable
) -> Variable:
    """The image in real values, float64, NaN outside of the valid range."""
    count = len(least.shape)
    for each in (least, greatest):
        fits = each.shape == image.shape[:count] and _minc_dimensions(each) == list(names[:count])
        if count > 2 or not fits:
            raise InputError(f"{each} does not scale slices of the image {image.shape}")
    limits = np.iinfo(image.dtype)
    told = image.attributes.get("valid_range", (limits.min, limits.max))
    low, high = (float(each) for each in told)
    if not limits.min <= low < high <= limits.max:
        raise InputError(f"its valid range is {low} to {high}, of values of type {image.dtype}")
    slopes = (greatest.whole() - least.whole()) / (high - low)
    offsets = least.whole() - low * slopes
    if not np.isfinite(slopes + offsets).all():
        raise InputError(f"{least} and {greatest} are not finite")

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        stored = image.read(places)
        values = stored.astype(np.float64)
        kept = sum(isinstance(each, slice) for each in places[count:])
        part = (*places[:count], *[np.newaxis] * kept)
        values *= slopes[part]
        values += offsets[part]
        values[(stored < low) | (stored > high)] = np.nan
        return values

    one = np.unique(np.stack([slopes.ravel(), offsets.ravel()]), axis=1)
    told = {"scale_factor": one[0, 0], "add_offset": one[1, 0]} if one.shape[1] == 1 else {}
    attributes = {key: each for key, each in image.attributes.items() if key != "valid_range"}
    return replace(
        image, values=np.dtype(np.float64), read=read, handle=told, attributes=attributes
    )
