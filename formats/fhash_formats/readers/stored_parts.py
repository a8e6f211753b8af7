"""Parts of a stored array that somebody wrote, and those for which a library gives a fill value.

Chunks that were never written, and what no source of a virtual dataset maps, look like data when
they are read. Here they are found from the listing of chunks alone; no value is read.
"""

from __future__ import annotations

import contextlib
import itertools
import operator
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.file_series import condense, inside_folder, refusing
from fhash_formats.readers.layout import Layout
from fhash_formats.series import NotStored
from fhash_formats.support.values import text_of

if TYPE_CHECKING:
    import zarr

MAX_BOXES = 1 << 24
"""Boxes of a grid that are told apart; of a finer one only the share of the whole is known."""

MAX_INNER = 4096
"""Boxes of one source of a virtual dataset that are told apart."""

MAX_DEPTH = 16
"""Virtual datasets that draw on each other."""

MAX_OPEN = 64
"""Source files that are held open."""

MAX_PROBES = 1 << 14
"""Chunks that are asked for one by one in a store that cannot list its keys."""

PROBES_AT_ONCE = 64

ABSENT = 2**64 - 1
"""Offset and length of a chunk that a shard lacks."""

Box = tuple[tuple[int, int], ...]
"""First and last + 1 along each dimension."""


def hdf5_file(path: Path) -> Any:
    """An HDF5 file open for reading, also one that a writer holds open in SWMR mode.

    Raises InputError for one that another program is writing in another way, or that is cut.
    """
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError as error:
        text = str(error)
        if "already open for write" in text:  # or its writer ended without closing it
            with contextlib.suppress(OSError):
                return h5py.File(path, "r", swmr=True)
        if "already open for" in text or "unable to lock file" in text:
            raise InputError(
                f"{path}: another program is writing it, or ended without closing it; wait until it"
                " has closed the file, or let it write in SWMR mode, which can be read meanwhile"
                " (where the file system has no locks: HDF5_USE_FILE_LOCKING=FALSE)"
            ) from error
        if "truncated file" in text:
            size, promised = path.stat().st_size, text.rpartition("=")[2].strip(" )")
            raise InputError(
                f"{path} cannot be read as HDF5: it is cut: it has {size} bytes, {promised} are"
                " promised"
            ) from error
        raise


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredParts:
    """A grid of boxes over an array, not all of which are stored.

    Attributes:
        edges: borders of the boxes along each dimension, from 0 to its length.
        share: of the values of each box that are stored, 0 to 1.
        fill: number that stands where nothing is stored.
    """

    edges: tuple[npt.NDArray[np.int64], ...]
    share: npt.NDArray[np.float32]
    fill: Any

    def along(
        self, place: int | None, chosen: Mapping[int, int | npt.NDArray[np.int64]]
    ) -> npt.NDArray[np.float64]:
        """Share of the values stored at each index along a dimension, shape (its length,).

        place: the dimension; None for all values together, shape (1,). chosen: the indices that
            count along some dimensions.
        """
        share: Any = self.share.astype(np.float64)
        for number in reversed(range(share.ndim)):
            borders = self.edges[number]
            indices = np.atleast_1d(chosen.get(number, np.arange(borders[-1])))
            boxes = np.searchsorted(borders, indices, side="right") - 1
            if number == place:
                share = share.take(boxes, axis=number)
            else:
                weights = np.bincount(boxes, minlength=len(borders) - 1)
                share = np.average(share, axis=number, weights=weights)
        each: npt.NDArray[np.float64] = np.reshape(share, -1)
        return each

    def taken(self, key: Mapping[int, Any]) -> StoredParts:
        """The parts of some indices along each dimension; a number takes its dimension away.

        key: a number, a slice or an array of indices by dimension.
        """
        edges: list[npt.NDArray[np.int64]] = []
        share: Any = self.share
        for place in reversed(range(share.ndim)):
            borders = self.edges[place]
            chosen = np.arange(borders[-1])[key.get(place, slice(None))]
            boxes = np.searchsorted(borders, chosen, side="right") - 1
            share = share.take(boxes, axis=place)
            if np.ndim(boxes):
                edges.insert(0, np.arange(len(boxes) + 1))
        return StoredParts(edges=tuple(edges), share=share, fill=self.fill)


def warn_of_column(name: str, parts: StoredParts | None) -> None:
    """Warn (FhashWarning) of positions that nobody wrote.

    One alone may well be the fill value, as a first time of 0, which Zarr does not store then.
    """
    share = 0.0 if parts is None else float(1 - parts.along(None, {})[0])
    if parts is not None and share * prod(int(borders[-1]) for borders in parts.edges) > 1.5:
        warnings.warn(
            f"coordinate {name}: {100 * share:.3g} % of its values are not stored: read as"
            f" {parts.fill}",
            FhashWarning,
            stacklevel=2,
        )


def whole(shape: Sequence[int], share: float, fill: Any) -> StoredParts:
    """An array of which only the stored share of the whole is known."""
    edges = tuple(np.array([0, length]) for length in shape)
    return StoredParts(edges=edges, share=np.full((1,) * len(shape), share, np.float32), fill=fill)


def not_stored(
    parts: Sequence[StoredParts | None], layout: Layout, *, joined: bool
) -> NotStored | None:
    """Values of a series that were never stored; None where all were.

    parts: of its array, or where `joined` of each of its arrays, which the first dimension counts.
    """
    fill = next((each.fill for each in parts if each is not None), None)
    if fill is None:
        return None
    axes = [place for place in range(len(layout.dimensions)) if place not in layout.picked]
    time = dict(zip(layout.axes, axes, strict=True)).get("t")
    steps = 1 if time is None else layout.dimensions[time].length
    shift = int(joined)
    inner = None if time is None or time < shift else time - shift
    picked = {place - shift: index for place, index in layout.picked.items()}
    each = [np.ones(1) if part is None else part.along(inner, picked) for part in parts]
    if not joined or 0 in layout.picked:
        shares = each[layout.picked[0] if joined else 0]
    elif time == 0:
        shares = np.concatenate(each)
    else:
        shares = np.mean(np.broadcast_arrays(*each), axis=0)
    if (shares >= 1).all():
        return None
    return NotStored(shares=1 - np.broadcast_to(shares, (steps,)), fill=np.asarray(fill).item())


def _of_grid(
    shape: Sequence[int], chunks: Sequence[int], stored: Iterable[Sequence[int]], fill: Any
) -> StoredParts | None:
    """An array in chunks. stored: index of each chunk that is there, in the grid of chunks."""
    counts = tuple(-(-length // chunk) for length, chunk in zip(shape, chunks, strict=True))
    share = np.zeros(counts, np.float32)
    for index in stored:
        if all(number < count for number, count in zip(index, counts, strict=True)):
            share[tuple(index)] = 1
    if share.all():
        return None
    edges = tuple(
        np.minimum(np.arange(count + 1, dtype=np.int64) * chunk, length)
        for count, chunk, length in zip(counts, chunks, shape, strict=True)
    )
    return StoredParts(edges=edges, share=share, fill=fill)


def _of_boxes(
    shape: Sequence[int], boxes: Sequence[tuple[Box, float]], fill: Any
) -> StoredParts | None:
    """An array whose boxes are stored, each to some share of it; they may overlap."""
    edges = tuple(
        np.unique([0, length, *(end for box, _ in boxes for end in box[place])])
        for place, length in enumerate(shape)
    )
    if prod(len(borders) - 1 for borders in edges) > MAX_BOXES:
        count = sum(prod(stop - first for first, stop in box) * share for box, share in boxes)
        return whole(shape, min(1.0, count / prod(shape)), fill) if count < prod(shape) else None
    share = np.zeros([len(borders) - 1 for borders in edges], np.float32)
    for box, part in boxes:
        region = tuple(
            slice(*np.searchsorted(borders, ends)) for borders, ends in zip(edges, box, strict=True)
        )
        share[region] = np.maximum(share[region], part)
    return None if (share >= 1).all() else StoredParts(edges=edges, share=share, fill=fill)


class Hdf5Sources:
    """Sources of the values of HDF5 datasets, through all virtual datasets and raw files.

    Attributes:
        files: files beside the dataset's own that hold its values.

    It is a context that closes the files.
    """

    def __init__(self, source: str) -> None:
        self.files: dict[Path, None] = {}
        self._source = source
        self._open: dict[Path, Any] = {}
        self._known: dict[tuple[str, str], StoredParts | None] = {}
        self._begun: set[tuple[str, str]] = set()

    def __enter__(self) -> Hdf5Sources:
        return self

    def __exit__(self, *error: object) -> None:
        for file in self._open.values():
            file.close()
        self._open.clear()

    def parts(self, name: str, dataset: Any, depth: int = 0) -> StoredParts | None:
        """The parts that are stored; None where all are.

        Raises InputError that names a file or dataset on which it draws, and which is not there or
        too short: HDF5 would give the fill value.
        """
        import h5py

        if not dataset.shape or 0 in dataset.shape:
            return None
        key = (dataset.file.filename, dataset.name)
        if key in self._known:
            return self._known[key]
        if key in self._begun or depth > MAX_DEPTH:
            raise InputError(
                f"{self._source}: {name} is a virtual dataset that draws on itself, or through more"
                f" than {MAX_DEPTH} others"
            )
        self._begun.add(key)
        found = None
        if dataset.is_virtual:
            found = self._virtual(name, dataset, depth)
        elif dataset.external:
            self._require_raw(name, dataset)
        elif dataset.chunks is not None:
            found = _of_chunks(dataset)
        elif dataset.id.get_space_status() == h5py.h5d.SPACE_STATUS_NOT_ALLOCATED:
            found = whole(dataset.shape, 0, dataset.fillvalue)
        self._known[key] = found
        return found

    def _virtual(self, name: str, dataset: Any, depth: int) -> StoredParts | None:
        boxes: list[tuple[Box, float]] = []
        for mapped in dataset.virtual_sources():
            if "%" in mapped.file_name or "%" in mapped.dset_name:
                boxes += self._numbered(name, dataset, mapped, depth)
                continue
            own = _boxes(mapped.vspace, dataset.shape)
            boxes += self._mapped(name, dataset, mapped, own, depth)
        return _of_boxes(dataset.shape, boxes, dataset.fillvalue)

    def _mapped(
        self,
        name: str,
        dataset: Any,
        mapped: Any,
        own: list[tuple[Box, float]],
        depth: int,
        number: int = -1,
    ) -> list[tuple[Box, float]]:
        """The boxes of a virtual dataset that one source fills; raises InputError without it."""
        import h5py

        file_name, inner = (
            _numbered_name(text, number) for text in (mapped.file_name, mapped.dset_name)
        )
        draws = f"{self._source}: {name} is a virtual dataset that draws on"
        what = f"{inner} of {file_name}" if file_name != "." else inner
        file = dataset.file if file_name == "." else self._file(dataset, file_name, draws)
        try:
            found = file[inner]
        except (KeyError, OSError, RuntimeError):
            found = None
        if not isinstance(found, h5py.Dataset):
            raise InputError(f"{draws} {what}, which is no dataset there")
        shape: tuple[int, ...] = found.shape or ()
        needed = _needed(mapped.src_space)
        if needed is None:
            count = round(sum(prod(b - a for a, b in box) * share for box, share in own))
            fits, asked = prod(shape) == count, f"{count} values are needed"
        else:
            fits = len(shape) == len(needed) and all(map(operator.ge, shape, needed))
            asked = f"{needed} is needed"
        if not fits:
            raise InputError(f"{draws} {what}, which has the shape {shape}; {asked}")
        parts = self.parts(what, found, depth + 1)
        if parts is None:
            return own
        return _inner_boxes(own, parts)

    def _numbered(
        self, name: str, dataset: Any, mapped: Any, depth: int
    ) -> list[tuple[Box, float]]:
        """The boxes that a numbered row of sources fills, one for each number."""
        import h5py

        start, stride, count, block = mapped.vspace.get_regular_hyperslab()
        place = next(
            (place for place, many in enumerate(count) if many >= h5py.h5s.UNLIMITED), None
        )
        if place is None:
            own = _boxes(mapped.vspace, dataset.shape)
            return self._mapped(name, dataset, mapped, own, depth, 0)
        boxes: list[tuple[Box, float]] = []
        length = dataset.shape[place]
        steps = range(start[place], length, max(1, stride[place]))
        for number, first in enumerate(steps):
            box = tuple(
                (first, min(first + block[place], length)) if each == place else (low, low + size)
                for each, (low, size) in enumerate(zip(start, block, strict=True))
            )
            boxes += self._mapped(name, dataset, mapped, [(box, 1.0)], depth, number)
        self._require_no_later(name, dataset, mapped.file_name, len(steps))
        return boxes

    def _require_no_later(self, name: str, dataset: Any, form: str, count: int) -> None:
        """Raise InputError where a row of files goes on behind the end that HDF5 found."""
        if "%b" not in form:
            return
        for number in range(count, count + MAX_OPEN):
            file = _numbered_name(form, number)
            if any(each.is_file() for each in candidates(dataset, file)):
                first = _numbered_name(form, count)
                raise InputError(
                    f"{self._source}: {name} is a virtual dataset that ends before {first}, which"
                    f" is not there or does not hold its part, though {file} is there"
                )

    def _file(self, dataset: Any, name: str, draws: str) -> Any:
        problem = "which is not there"
        for path in candidates(dataset, name):
            if path in self._open:
                return self._open[path]
            if not path.is_file():
                continue
            try:
                file = hdf5_file(path)
            except (InputError, OSError, RuntimeError) as error:
                problem = f"which cannot be read: {condense(error)}"
                continue
            if len(self._open) >= MAX_OPEN:
                self._open.pop(next(iter(self._open))).close()
            self._open[path] = file
            self.files[path] = None
            return file
        raise InputError(f"{draws} {name}, {problem}")

    def _require_raw(self, name: str, dataset: Any) -> None:
        """Raise InputError for raw files that are missing or too short for a dataset."""
        import h5py

        draws = f"{self._source}: the values of {name} are in the raw file"
        needed = prod(dataset.shape) * dataset.dtype.itemsize
        there, last = 0, ""
        for file, offset, size in dataset.external:
            (path,) = candidates(dataset, file, raw=True)
            if not path.is_file():
                where = (
                    ""
                    if path.is_absolute()
                    else (
                        "; HDF5 looks for it in the current folder, and beside the file with"
                        " HDF5_EXTFILE_PREFIX='${ORIGIN}'"
                    )
                )
                raise InputError(f"{draws} {file}, and {path} is not there{where}")
            self.files[path] = None
            stored = max(0, path.stat().st_size - offset)
            wanted = needed - there if size >= h5py.h5s.UNLIMITED else min(size, needed - there)
            if stored < wanted:
                raise InputError(
                    f"{draws} {file}, which has {stored} bytes from byte {offset} on; {wanted} are"
                    " needed"
                )
            there, last = there + wanted, file
        if there < needed:
            raise InputError(f"{draws} {last}, which ends after {there} of {needed} bytes")


def candidates(dataset: Any, name: str, *, raw: bool = False) -> list[Path]:
    """Places of a file that holds values of a dataset, in the order in which HDF5 looks there.

    raw: whether it is a file of raw values, for which HDF5 does not look beside the file.
    """
    folder = Path(dataset.file.filename).parent
    key = "HDF5_EXTFILE_PREFIX" if raw else "HDF5_VDS_PREFIX"
    prefixes = os.environ.get(key, "").replace("${ORIGIN}", str(folder))
    places = [Path(prefix) for prefix in prefixes.split(":") if prefix]
    if os.path.isabs(name):
        return (
            [Path(name)] if raw else [Path(name), *(p / Path(name).name for p in [*places, folder])]
        )
    if raw:
        return [(places or [Path()])[0] / name]
    return [*(place / name for place in (*places, folder)), Path(name)]


def require_inside(path: Path, seen: set[Path] | None = None) -> None:
    """Raise InputError if a file refers to another one outside its folder, whatever the object is.

    It looks at links, raw files and virtual datasets without following any, and at the files
    inside the folder that they name.

    seen: files that were looked at, and those that will be.
    """
    import h5py

    seen = {path.resolve()} if seen is None else seen
    with hdf5_file(path) as file:
        places = {
            each: candidates(file["/"], each) + candidates(file["/"], each, raw=True)
            for each in _named_files(file)
        }
    for name, found in places.items():
        inside_folder(path, path.parent / name)
        for place in found:
            if not place.exists():
                continue
            inside_folder(path, place)
            if place.resolve() not in seen and place.is_file() and h5py.is_hdf5(place):
                seen.add(place.resolve())
                require_inside(place, seen)


def require_alone(source: str, stored: Any) -> None:
    """Raise InputError if an HDF5 file elsewhere refers to any other one: HDF5 would look here.

    stored: the open file, whose place is kept.
    """
    import h5py

    with h5py.File(stored, "r") as file:
        for name in _named_files(file):
            raise InputError(
                f"{source} refers to {name[:1024]}, a file of this machine; without --no-external"
                " (no_external=True) it is read"
            )


def _named_files(file: Any) -> list[str]:
    """Names of the files that links, raw and virtual datasets of an HDF5 file draw on."""
    import h5py

    named: dict[str, None] = {}
    groups, known = [file["/"].id], set()
    while groups:
        group = groups.pop()
        info = h5py.h5o.get_info(group)
        if info.addr in known:
            continue
        known.add(info.addr)
        for name in list(group):
            kind = group.links.get_info(name).type
            if kind == h5py.h5l.TYPE_EXTERNAL:
                named[text_of(group.links.get_val(name)[0])] = None
            if kind != h5py.h5l.TYPE_HARD:
                continue
            opened = h5py.h5o.open(group, name)
            if isinstance(opened, h5py.h5g.GroupID):
                groups.append(opened)
            elif isinstance(opened, h5py.h5d.DatasetID):
                dataset = h5py.Dataset(opened)
                named |= {text_of(each[0]): None for each in dataset.external or ()}
                if dataset.is_virtual:
                    named |= {each.file_name: None for each in dataset.virtual_sources()}
    named.pop(".", None)
    return list(named)


def _numbered_name(text: str, number: int) -> str:
    """The name of a source; %b stands for its number, %% for a per cent sign."""
    return text if number < 0 else text.replace("%b", str(number)).replace("%%", "%")


def _of_chunks(dataset: Any) -> StoredParts | None:
    """The parts of a dataset in chunks."""
    counts = [-(-n // chunk) for n, chunk in zip(dataset.shape, dataset.chunks, strict=True)]
    stored = dataset.id.get_num_chunks()
    if stored >= prod(counts):
        return None
    if prod(counts) > MAX_BOXES:
        return whole(dataset.shape, stored / prod(counts), dataset.fillvalue)
    offsets: list[tuple[int, ...]] = []
    dataset.id.chunk_iter(lambda chunk: offsets.append(chunk.chunk_offset))
    indices = (
        tuple(first // n for first, n in zip(each, dataset.chunks, strict=True)) for each in offsets
    )
    return _of_grid(dataset.shape, dataset.chunks, indices, dataset.fillvalue)


def _boxes(space: Any, shape: Sequence[int]) -> list[tuple[Box, float]]:
    """The boxes of a selection in a virtual dataset of some shape, each with the selected share."""
    import h5py

    if space.get_select_type() == h5py.h5s.SEL_ALL:
        return [(tuple((0, length) for length in shape), 1.0)]
    if space.get_select_type() != h5py.h5s.SEL_HYPERSLABS:
        points = space.get_select_elem_pointlist() if space.get_select_npoints() else ()
        return [(tuple((int(n), int(n) + 1) for n in point), 1.0) for point in points]
    if not space.is_regular_hyperslab():
        listed = space.get_select_hyper_blocklist()
        return [
            (tuple((int(low), int(high) + 1) for low, high in zip(*corners, strict=True)), 1.0)
            for corners in listed
        ]
    spans: list[list[tuple[int, int]]] = []
    share = 1.0
    most = MAX_INNER
    for length, first, stride, count, block in zip(
        shape, *space.get_regular_hyperslab(), strict=True
    ):
        many = min(length, count) if block < h5py.h5s.UNLIMITED else 1
        if many > 1 and stride > block:
            starts = range(first, length, stride)[:many]
            if len(starts) <= most:
                spans.append([(start, min(length, start + block)) for start in starts])
                most //= max(1, len(starts))
                continue
            share *= block / stride
            spans.append([(first, min(length, starts[-1] + block))])
            continue
        end = length if block >= h5py.h5s.UNLIMITED else min(length, first + many * block)
        spans.append([(min(first, end), end)])
    return [(tuple(box), share) for box in itertools.product(*spans)]


def _needed(space: Any) -> tuple[int, ...] | None:
    """Lengths that a source must have for a selection in it; None where all of it is selected."""
    import h5py

    if space.get_select_type() == h5py.h5s.SEL_ALL:
        return None
    try:
        _, last = space.get_select_bounds()
    except (RuntimeError, ValueError):  # without an end: as long as the source
        return (0,) * len(space.shape)
    return tuple(int(n) + 1 for n in last)


def _inner_boxes(own: Sequence[tuple[Box, float]], parts: StoredParts) -> list[tuple[Box, float]]:
    """The boxes of a virtual dataset that a source fills of which parts were never stored."""
    lengths = [int(borders[-1]) for borders in parts.edges]
    if len(own) == 1 and parts.share.size <= MAX_INNER:
        outer, _ = own[0]
        long = [place for place, (first, stop) in enumerate(outer) if stop - first > 1]
        inner = [place for place, length in enumerate(lengths) if length > 1]
        if [outer[place][1] - outer[place][0] for place in long] == [lengths[n] for n in inner]:
            boxes = []
            for index in np.ndindex(parts.share.shape):
                box = list(outer)
                for place, source in zip(long, inner, strict=True):
                    first, borders = outer[place][0], parts.edges[source]
                    low, high = borders[index[source]], borders[index[source] + 1]
                    box[place] = (first + int(low), first + int(high))
                boxes.append((tuple(box), float(parts.share[index])))
            return boxes
    stored = float(parts.along(None, {})[0])
    return [(box, share * stored) for box, share in own]


def zarr_parts(array: zarr.Array[Any]) -> StoredParts | None:
    """The parts of an array of Zarr that are stored, chunks inside shards too; None where all are.

    Only keys are listed, and of shards the index is read. A store that cannot list is asked for
    each chunk, up to MAX_PROBES of them.
    """
    from zarr.core.sync import sync

    with refusing(f"array {array.name}"):  # of chunks that differ in size
        shards = getattr(array, "shards", None)
        outer = shards or array.chunks
    counts = tuple(-(-length // chunk) for length, chunk in zip(array.shape, outer, strict=True))
    if not counts or prod(counts) == 0:
        return None
    if prod(counts) > MAX_BOXES:
        return None
    stored: Iterable[Sequence[int]] = sync(_stored_chunks(array, counts))
    if shards:
        indexed = sync(_inside_shards(array, stored))
        if indexed is not None:
            return _of_grid(array.shape, array.chunks, indexed, array.fill_value)
    return _of_grid(array.shape, outer, stored, array.fill_value)


def labelled_parts(source: str, array: Any) -> tuple[StoredParts | None, dict[int, Any]]:
    """The stored parts of the array behind a variable of xarray, and the indices taken of it.

    xarray has no public way to it: nothing is known of what has another form. Of an array of dask
    after operations the indices are not known: one warning (FhashWarning) says so.
    """
    data: Any = getattr(array, "_data", None)
    name, graph = getattr(data, "name", None), getattr(data, "__dask_graph__", None)
    if graph is not None:
        layers = getattr(graph(), "layers", {})
        data = dict(layers.get(f"original-{name}", {})).get(f"original-{name}")
        if data is None:
            _warn_of_sources(source, layers)
    key: tuple[Any, ...] = ()
    while hasattr(data, "array"):
        key = getattr(getattr(data, "key", None), "tuple", key)
        data = data.array
    if hasattr(data, "_array") and hasattr(data._array, "metadata"):
        return zarr_parts(data._array), dict(enumerate(key))
    stored = getattr(getattr(data, "get_array", lambda: None)(), "_h5ds", None)
    if stored is None:
        return None, {}
    with Hdf5Sources(source) as behind:
        return behind.parts(stored.name, stored), dict(enumerate(key))


def _warn_of_sources(source: str, layers: Mapping[str, Mapping[Any, Any]]) -> None:
    """Warn of arrays behind a graph of dask that are not stored whole."""
    for key, layer in layers.items():
        data: Any = dict(layer).get(key) if key.startswith("original-") else None
        while hasattr(data, "array"):
            data = data.array
        array: Any = getattr(data, "_array", None)
        parts = zarr_parts(array) if hasattr(array, "metadata") else None
        if parts is not None and not _is_nan(parts.fill):
            share = 100 * (1 - parts.along(None, {})[0])
            warnings.warn(
                f"{source}: {share:.3g} % of the stored array behind it are not stored: read as"
                f" {parts.fill}; which of them are taken is not known",
                FhashWarning,
                stacklevel=2,
            )


def _is_nan(value: Any) -> bool:
    return bool(value != value)


async def _stored_chunks(array: zarr.Array[Any], counts: tuple[int, ...]) -> set[tuple[int, ...]]:
    """Index of each chunk, or of each shard, that the store has."""
    from zarr.storage import LocalStore, ZipStore

    store, path = array.store_path.store, array.store_path.path
    prefix = f"{path}/" if path else ""
    keys: list[str] = []
    if isinstance(store, LocalStore):  # its own listing makes a path of each key
        folder = os.path.join(store.root, path)
        for place, _, names in os.walk(folder):
            inner = place[len(folder) :].strip(os.sep).replace(os.sep, "/")
            keys += [f"{inner}/{name}".removeprefix("/") for name in names]
    else:
        with contextlib.suppress(Exception):  # what a server raises that cannot list
            keys += [key.removeprefix(prefix) async for key in store.list_prefix(prefix)]
    found: set[tuple[int, ...]] = set()
    for key in keys:
        words = key.removeprefix("c/").removeprefix("c.").replace(".", "/").split("/")
        if len(words) == len(counts) and all(map(str.isdecimal, words)):
            found.add(tuple(map(int, words)))
    inside = {each for each in found if all(map(operator.lt, each, counts))}
    if len(inside) == prod(counts) or isinstance(store, LocalStore | ZipStore):
        return inside
    absent = (index for index in np.ndindex(counts) if index not in inside)
    few = list(itertools.islice(absent, PROBES_AT_ONCE))
    if not any(await _exist(array, few)):
        return inside
    # the listing is not to be trusted
    every = list(np.ndindex(counts)) if prod(counts) <= MAX_PROBES else []
    there = await _exist(array, every)
    return {index for index, known in zip(every, there, strict=True) if known} or set(
        np.ndindex(counts)
    )


async def _exist(array: zarr.Array[Any], indices: Sequence[tuple[int, ...]]) -> list[bool]:
    """Whether the store has each of some chunks."""
    import asyncio

    found: list[bool] = []
    for first in range(0, len(indices), PROBES_AT_ONCE):
        keys = map(array.metadata.encode_chunk_key, indices[first : first + PROBES_AT_ONCE])
        found += await asyncio.gather(*((array.store_path / key).exists() for key in keys))
    return found


async def _inside_shards(
    array: zarr.Array[Any], shards: Iterable[Sequence[int]]
) -> list[tuple[int, ...]] | None:
    """Index of each chunk that some shards hold; None where an index is coded in another way."""
    import asyncio

    from zarr.abc.store import RangeByteRequest, SuffixByteRequest
    from zarr.buffer import default_buffer_prototype

    sharding: Any = array.metadata.codecs[0]  # type: ignore[union-attr]
    names = [str(codec.to_dict()["name"]) for codec in sharding.index_codecs]
    if names != ["bytes", "crc32c"]:
        return None
    inner = tuple(n // c for n, c in zip(array.shards or (), array.chunks, strict=True))
    size = 16 * prod(inner) + 4
    at_end = sharding.to_dict()["configuration"]["index_location"] == "end"
    part = SuffixByteRequest(size) if at_end else RangeByteRequest(0, size)
    found: list[tuple[int, ...]] = []
    listed = [tuple(shard) for shard in shards]
    for first in range(0, len(listed), PROBES_AT_ONCE):
        some = listed[first : first + PROBES_AT_ONCE]
        keys = (array.store_path / array.metadata.encode_chunk_key(shard) for shard in some)
        gets = (key.get(default_buffer_prototype(), part) for key in keys)
        for shard, data in zip(some, await asyncio.gather(*gets), strict=True):
            index = b"" if data is None else data.to_bytes()
            if len(index) != size:
                return None  # the reader of values says what is wrong
            places = np.frombuffer(index[:-4], "<u8").reshape(*inner, 2)
            here = np.argwhere((places != ABSENT).all(axis=-1)) + np.multiply(shard, inner)
            found += map(tuple, here.tolist())
    return found
