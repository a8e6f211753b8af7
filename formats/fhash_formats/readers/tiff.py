"""TIFF stacks (.tif, .tiff), read with tifffile: pages along z, ImageJ and OME hyperstacks by axes.

Time, z and channels come from the series' own axes; a channel is a variable, such as `cells.0`.
Pages without axes lie along z. Several files of one page each may be slices or steps, and nothing
in them says which: `--axes z,y,x` or `--axes t,y,x` does.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import Request, Stamp, condense, library, naming
from fhash_formats.readers.stored_bytes import PlainFile, lattice
from fhash_formats.readers.stored_parts import StoredParts
from fhash_formats.readers.variables import (
    Behind,
    Source,
    Variable,
    components,
    file_source,
    placed,
)
from fhash_formats.series import AXES, AXIS_NAMES

SUFFIXES = (".tif", ".tiff")
MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

PAGES = "QIZ"
"""Letters of tifffile for pages, images and z: all are slices along z."""

CHANNEL = "channel"
"""Role of a dimension of channels."""

CENTIMETRE = {2: "inch", 3: "cm"}
"""Units of a page's resolution by its code."""


def matches(head: bytes, path: Path) -> bool:
    """Whether this is TIFF, by its first bytes or its suffix."""
    return head[:4] in MAGIC or path.suffix.lower() in SUFFIXES


def _tifffile(source: str) -> Any:
    return library(source, "TIFF", "tifffile", "fhash[formats]")


class _Complaints(logging.Handler):
    """Keeps the errors that tifffile logs."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage())


@contextmanager
def _strictly() -> Iterator[None]:
    """Raise InputError for what tifffile only logs: pages that are missing or damaged.

    It would go on with the pages before them.
    """
    logger, complaints = logging.getLogger("tifffile"), _Complaints()
    shown = logger.propagate
    logger.addHandler(complaints)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(complaints)
        logger.propagate = shown
    if complaints.texts:
        raise InputError(f"it is cut or damaged: {condense(Exception(complaints.texts[0]))}")


def open_tiff(path: Path, request: Request) -> Source:
    """The stack in a TIFF file, or its channels.

    Raises InputError for colours and for axes beyond time, z, channel, y and x.
    """
    source, stamp = str(path), Stamp.of(path)
    tifffile = _tifffile(source)
    with naming(source), _strictly():
        # the metadata of OME name further files
        file = tifffile.TiffFile(path, _multifile=False if request.no_external else None)
    try:
        with naming(source), _strictly():
            found = _variables(path, file)
    except BaseException:
        file.close()
        raise
    return file_source(path, found, stamp=stamp, close=file.close)


def _variables(path: Path, file: Any) -> list[Variable]:
    if not file.series:
        raise InputError("it holds no picture")
    if len(file.series) > 1:
        shapes = ", ".join(str(each.shape) for each in file.series[:4])
        raise InputError(f"it holds {len(file.series)} series of pages ({shapes}); keep one")
    series = file.series[0]
    letters, shape = str(series.axes), tuple(int(length) for length in series.shape)
    axes = _roles(letters, shape)
    kept = [n for n, axis in enumerate(axes) if axis]
    _check_size(path, series)

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        index: list[slice | int] = [0] * len(axes)
        for n, each in zip(kept, places, strict=True):
            index[n] = each
        return _pages(series, index)

    whole = Variable(
        name=path.stem.removesuffix(".ome"),
        shape=tuple(shape[n] for n in kept),
        dtype=np.dtype(series.dtype),
        dimensions=tuple(AXIS_NAMES.get(axes[n]) for n in kept),
        read=read,
        behind=lambda: Behind(parts=_stored_parts(series, kept)),
    )
    lengths = {axis: shape[n] for n, axis in enumerate(axes) if axis}
    channel = [axes[n] for n in kept].index(CHANNEL) if CHANNEL in axes else None
    arrays = [whole]
    if channel is not None:
        arrays = components(whole, channel, _channel_names(file), interleaved=False)
    return placed(arrays, _coordinates(file, lengths))


def _stored_parts(series: Any, kept: Sequence[int]) -> StoredParts | None:
    """The pages whose strips or tiles are in the file; None where all are."""
    shares = [
        sum(map(bool, page.databytecounts)) / max(1, prod(page.chunked))
        for page in series.pages
        if page is not None
    ]
    outer = series.shape[: len(series.shape) - len(series.keyframe.shape)]
    if not any(share < 1 for share in shares) or prod(outer) != len(shares):
        return None
    inner = [1] * (len(series.shape) - len(outer))
    share = np.clip(np.reshape(shares, (*outer, *inner)), 0, 1).astype(np.float32)
    edges = tuple(
        np.arange(length + 1) if n < len(outer) else np.array([0, length])
        for n, length in enumerate(series.shape)
    )
    return StoredParts(
        edges=tuple(edges[n] for n in kept),
        share=share.reshape([share.shape[n] for n in kept]),
        fill=np.dtype(series.dtype).type(series.keyframe.nodata),
    )


def _roles(letters: str, shape: Sequence[int]) -> list[str]:
    """The axis of each dimension of the series, CHANNEL for channels; "" for those of one
    picture."""
    axes: list[str] = []
    for letter, length in zip(letters, shape, strict=True):
        if letter == "S" and length > 1:
            raise InputError(f"its pages are colour pictures of {length} samples; one can be read")
        role = "z" if letter in PAGES else {"T": "t", "C": CHANNEL}.get(letter, letter.lower())
        if length == 1 and letter not in "YX":
            role = ""
        elif role not in (*AXES, CHANNEL) or role in axes:
            raise InputError(
                f"its axes are {letters} {tuple(shape)}; time, z, channels, y and x can be read"
            )
        axes.append(role)
    if not letters.endswith("YX") and not letters.endswith("YXS"):
        raise InputError(f"its axes are {letters}; the last two must be y and x")
    return axes


def _check_size(path: Path, series: Any) -> None:
    """Raise InputError where pages lie beyond the end of the file, or promise too much."""
    size = path.stat().st_size
    stored = 0
    for page in series.pages:
        if page is None:
            continue
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False):
            if offset + count > size:
                raise InputError(f"a page lies beyond its end at byte {size}; it is cut")
            stored += count
        if page.compression == 1 and series.dataoffset is not None:
            break
    needed = prod(series.shape) * np.dtype(series.dtype).itemsize
    if series.dataoffset is not None and series.dataoffset + needed > size:
        raise InputError(f"it needs {series.dataoffset + needed} bytes and has {size}; it is cut")


def _pages(series: Any, index: Sequence[slice | int]) -> npt.NDArray[Any]:
    """The values at an index or a range along each dimension of the file."""
    per_page = prod(series.keyframe.shape)
    outer = 0
    while prod(series.shape[outer:]) > per_page:
        outer += 1
    numbers = np.arange(prod(series.shape[:outer])).reshape(series.shape[:outer])
    chosen = numbers[tuple(index[:outer])]
    pages = [_page(series, int(page)) for page in np.ravel(chosen)]
    stack = np.stack(pages).reshape(*np.shape(chosen), *series.shape[outer:])
    return stack[(..., *index[outer:])]


def _page(series: Any, number: int) -> npt.NDArray[Any]:
    """One page; where all values lie in a row, as in ImageJ's large files, by its place in it."""
    if series.dataoffset is None:
        page = series.pages[number]
        if page is None:
            raise InputError(f"page {number} is missing")
        return np.asarray(page.asarray())
    shape = series.keyframe.shape
    dtype = np.dtype(series.dtype).newbyteorder(series.parent.byteorder)
    values = np.empty(shape, dtype)
    path = Path(series.parent.filehandle.path)
    stored = PlainFile(path, start=series.dataoffset + number * values.nbytes, size=values.nbytes)
    stored.readinto(0, values.reshape(-1).view(np.uint8).data)
    return values


def _coordinates(file: Any, lengths: Mapping[str, int]) -> dict[str, Variable]:
    """Positions from ImageJ's metadata, OME's, or the resolution of the first page."""
    steps: dict[str, tuple[float, str]] = {}
    resolution = _resolution(file.series[0].keyframe)
    if file.is_imagej:
        found: Mapping[str, Any] = file.imagej_metadata or {}
        unit = str(found.get("unit", "") or "").replace("\\u00B5", "µ")
        for axis in "xy":
            if axis in resolution and unit and unit != "pixel":
                steps[axis] = (1 / resolution[axis][0], unit)
        steps["z"] = (_number(found.get("spacing")), unit)
        steps["t"] = (_number(found.get("finterval")), "s")
    elif file.is_ome:
        steps = _ome_steps(file)
    else:
        steps = {
            axis: (1 / per_unit, unit) for axis, (per_unit, unit) in resolution.items() if unit
        }
    return {
        axis: lattice(axis, 0.0, step, lengths[axis], units=unit)
        for axis, (step, unit) in steps.items()
        if axis in lengths and np.isfinite(step) and step > 0
    }


def _ome_pixels(file: Any) -> dict[str, Any]:
    """The description of the pixels of the first picture in the metadata of OME."""
    pixels = importlib.import_module("tifffile").xml2dict(file.ome_metadata)
    for key in ("OME", "Image", "Pixels"):
        pixels = pixels.get(key, {}) if isinstance(pixels, dict) else {}
        pixels = pixels[0] if isinstance(pixels, list) and pixels else pixels
    return pixels if isinstance(pixels, dict) else {}


def _channel_names(file: Any) -> list[str]:
    """Names of the channels, as OME's metadata and ImageJ's labels have them."""
    if not file.is_ome:
        return []
    channels = _ome_pixels(file).get("Channel", [])
    channels = channels if isinstance(channels, list) else [channels]
    return [str(each.get("Name", "")) for each in channels if isinstance(each, dict)]


def _ome_steps(file: Any) -> dict[str, tuple[float, str]]:
    pixels = _ome_pixels(file)
    names = {axis: f"PhysicalSize{axis.upper()}" for axis in "xyz"} | {"t": "TimeIncrement"}
    return {
        axis: (
            _number(pixels.get(name)),
            str(pixels.get(f"{name}Unit", "s" if axis == "t" else "µm")),
        )
        for axis, name in names.items()
    }


def _resolution(page: Any) -> dict[str, tuple[float, str]]:
    """Pixels per unit along x and y, and the unit, "" for none."""
    found = {}
    code = page.tags.get("ResolutionUnit")
    unit = CENTIMETRE.get(int(code.value) if code is not None else 2, "")
    for axis, name in (("x", "XResolution"), ("y", "YResolution")):
        tag = page.tags.get(name)
        if tag is not None and len(tag.value) == 2 and tag.value[0] > 0 and tag.value[1] > 0:
            found[axis] = (tag.value[0] / tag.value[1], unit)
    return found


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def open_pages(pattern: str, paths: Sequence[Path], request: Request) -> Source | None:
    """Files of one page each as one series: `--axes` says what they are.

    None where the first file holds more than a page, or where there is one file: each file is then
    a step, as in any pattern. Raises InputError where the axes are not given, and for files that
    differ from the first.
    """
    tifffile = _tifffile(pattern)
    with naming(str(paths[0])), _strictly(), tifffile.TiffFile(paths[0]) as file:
        if len(file.series) != 1 or len(paths) == 1:
            return None
        letters, shape = str(file.series[0].axes), tuple(file.series[0].shape)
        dtype = np.dtype(file.series[0].dtype).newbyteorder("=")
        if letters == "YXS":
            raise InputError(f"{paths[0]} is a colour picture; one number a pixel can be read")
        if letters != "YX":
            return None
        coords = _coordinates(file, {"y": shape[0], "x": shape[1]})
    if request.axes not in (("z", "y", "x"), ("t", "y", "x")):
        raise InputError(
            f"{pattern}: {len(paths)} files of one page each; say whether they are slices, with"
            " --axes z,y,x, or steps, with --axes t,y,x"
        )
    request.refuse_var(pattern)

    def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
        chosen = paths[places[0]]
        if isinstance(chosen, Path):
            return _plane(tifffile, chosen, shape, dtype)[places[1:]]
        planes = np.stack([_plane(tifffile, path, shape, dtype) for path in chosen])
        return planes[(slice(None), *places[1:])]

    whole = Variable(
        name=paths[0].stem.rstrip("0123456789_-. ") or paths[0].stem,
        shape=(len(paths), *shape),
        dtype=dtype,
        dimensions=tuple(AXIS_NAMES[axis] for axis in request.axes),
        read=read,
    )
    return Source(
        name=pattern,
        variables=placed([whole], coords),
        stamp=Stamp.of(paths[0]),
        files=paths,
    )


def _plane(
    tifffile: Any, path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> npt.NDArray[Any]:
    with naming(str(path)), _strictly(), tifffile.TiffFile(path) as file:
        found = file.series[0] if file.series else None
        if found is None or tuple(found.shape) != shape or np.dtype(found.dtype) != dtype:
            raise InputError(f"its page is not {dtype} {shape}, as that of the first file")
        _check_size(path, found)
        return np.asarray(file.series[0].asarray())
