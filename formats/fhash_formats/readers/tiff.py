"""TIFF stacks (.tif, .tiff), read with tifffile: pages along z, ImageJ and OME hyperstacks by axes.

Time, z and channels come from the series' own axes; a channel is a variable, such as `cells.0`.
Pages without axes lie along z. Several files of one page each may be slices or steps, and nothing
in them says which: `--axes z,y,x` or `--axes t,y,x` does.
"""

from __future__ import annotations

import importlib
import logging
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from logging.handlers import BufferingHandler
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.file_series import Request, Stamp, condense, library, naming, refusing
from fhash_formats.readers.stored_bytes import MAX_LINE, FlatArray, lattice
from fhash_formats.readers.stored_parts import StoredParts
from fhash_formats.readers.variables import (
    Behind,
    Source,
    Variable,
    by_ranges,
    components,
    file_source,
    placed,
)
from fhash_formats.series import AXES, AXIS_NAMES
from fhash_formats.support.values import is_number

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


@contextmanager
def _strictly() -> Iterator[None]:
    """Raise InputError for what tifffile only logs: pages that are missing or damaged.

    It would go on with the pages before them.
    """
    logger, complaints = logging.getLogger("tifffile"), BufferingHandler(sys.maxsize)
    complaints.setLevel(logging.ERROR)
    shown = logger.propagate
    logger.addHandler(complaints)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(complaints)
        logger.propagate = shown
    if complaints.buffer:
        text = condense(Exception(complaints.buffer[0].getMessage()))
        raise InputError(f"it is cut or damaged: {text}")


def open_tiff(path: Path, request: Request) -> Source:
    """The stack in a TIFF file, or its channels.

    Raises InputError for colours and for axes beyond time, z, channel, y and x.
    """
    source, stamp = str(path), Stamp.of(path)
    tifffile = library(source, "TIFF", "tifffile", "fhash[formats]")
    with naming(source), refusing("it is cut or damaged"), ExitStack() as opened:
        with _strictly():
            _require_pages(path)
            # the metadata of OME name further files
            file = tifffile.TiffFile(path, _multifile=False if request.no_external else None)
            found = _variables(path, opened.enter_context(file))
        close = opened.pop_all().close
    return file_source(path, found, stamp=stamp, close=close)


def _require_pages(path: Path) -> None:
    """Raise InputError where the first page is described behind the end of the file."""
    with path.open("rb") as file:
        head = file.read(16)
    order: Literal["little", "big"] = "little" if head[:2] == b"II" else "big"
    place = head[8:16] if head[:4] in MAGIC[2:] else head[4:8]
    first, size = int.from_bytes(place, order), path.stat().st_size
    if head[:4] in MAGIC and not 8 <= first < size:
        raise InputError(f"it is cut: its pages are listed at byte {first}, it has {size}")


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
    whole = _meant(str(path), file, whole)
    arrays = [whole]
    if CHANNEL in axes:
        place = kept.index(axes.index(CHANNEL))
        arrays = components(whole, place, _channel_names(file), interleaved=False)
    return placed(arrays, _coordinates(file, lengths))


NO_DATA = 42113
"""Tag in which GDAL keeps the number that stands for missing values."""
ROLES = {"scale": "scale_factor", "offset": "add_offset", "unittype": "units"}
"""Attributes for the roles of items in GDAL's metadata."""
ITEM = re.compile(r'<Item name="[^"<>]*" sample="0" role="(\w{1,20})">([^<>]{1,80})</Item>')
LINE = 0
"""Function of ImageJ's calibration that is a line c0 + c1 * count."""
NO_FUNCTION = 20
"""Code of ImageJ's calibration for none; those between are curves."""
SHOWN = {0: "0 is white in its pictures", 3: "its pictures have a palette of colours"}
"""Remarks by the code of PhotometricInterpretation, of what numbers alone do not tell."""


def _meant(source: str, file: Any, whole: Variable) -> Variable:
    """The array with what its metadata say of its numbers: missing ones, scale, units, sign.

    ImageJ keeps signed numbers of 16 bits as unsigned ones with a calibration. Warns (FhashWarning)
    of what the numbers alone do not tell.
    """
    page = file.series[0].keyframe
    found: dict[str, Any] = {}
    tag = page.tags.get(NO_DATA)
    if tag is not None and is_number(str(tag.value)):
        found["_FillValue"] = float(str(tag.value))
    for role, text in ITEM.findall(str(file.gdal_metadata or "")[:MAX_LINE]):
        if role == "unittype" or (role in ROLES and is_number(text)):
            found[ROLES[role]] = text if role == "unittype" else np.float64(text)
    told: Mapping[str, Any] = (file.imagej_metadata or {}) if file.is_imagej else {}
    shown = page.tags.get("PhotometricInterpretation")
    remarks = [] if shown is None or int(shown.value) not in SHOWN else [SHOWN[int(shown.value)]]
    orientation = page.tags.get("Orientation")
    if orientation is not None and int(orientation.value) != 1:
        remarks.append(f"its pictures are turned or mirrored (Orientation {orientation.value})")
    if told.get("cf", NO_FUNCTION) == LINE:
        offset, scale = (_number(told.get(name)) for name in ("c0", "c1"))
        if whole.dtype.kind == "u" and whole.dtype.itemsize == 2 and (scale, offset) == (1, -32768):
            return replace(whole, dtype=np.dtype("i2"), read=partial(_signed, whole))
        if np.isfinite([scale, offset]).all() and scale:
            found |= {"scale_factor": np.float32(scale), "add_offset": np.float32(offset)}
            found["units"] = str(told.get("vunit", ""))
    elif told.get("cf", NO_FUNCTION) < NO_FUNCTION:
        remarks.append("ImageJ's calibration by a curve is not applied")
    if remarks:
        warnings.warn(
            f"{source}: {'; '.join(remarks)}; the numbers are read as they are stored",
            FhashWarning,
            stacklevel=2,
        )
    return replace(whole, attributes=found)


def _signed(whole: Variable, places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
    """Numbers of 16 bits that are stored 32768 larger than they are."""
    values: npt.NDArray[Any] = (np.asarray(whole.read(places)).astype(np.int32) - 32768).astype(
        "i2"
    )
    return values


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
    lengths = [(series.shape[n], 1 if n < len(outer) else series.shape[n]) for n in kept]
    return StoredParts(
        edges=tuple(np.arange(0, length + 1, each) for length, each in lengths),
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
    ends = [0]
    for page in series.pages:
        if page is not None:
            ends += map(sum, zip(page.dataoffsets, page.databytecounts, strict=False))
        if series.dataoffset is not None:  # all values lie in a row
            needed = prod(series.shape) * np.dtype(series.dtype).itemsize
            ends.append(series.dataoffset + needed)
            break
    if max(ends) > path.stat().st_size:
        raise InputError(f"its pages end at byte {max(ends)}, beyond its own end; it is cut")


def _pages(series: Any, index: Sequence[slice | int]) -> npt.NDArray[Any]:
    """The values at an index or a range along each dimension of the file."""
    if series.dataoffset is not None:  # all in a row, as in ImageJ's large files
        dtype = np.dtype(series.dtype).newbyteorder(series.parent.byteorder)
        path, shape = Path(series.parent.filehandle.path), tuple(series.shape)
        return FlatArray(path, shape, dtype, offset=series.dataoffset).read(index)
    outer = 0
    while prod(series.shape[outer:]) > prod(series.keyframe.shape):
        outer += 1
    numbers = np.arange(prod(series.shape[:outer])).reshape(series.shape[:outer])
    chosen = numbers[tuple(index[:outer])]
    pages = [series.pages[number] for number in np.ravel(chosen).tolist()]
    if None in pages:
        raise InputError("a page is missing")
    stack = np.stack([page.asarray() for page in pages])
    return stack.reshape(*np.shape(chosen), *series.shape[outer:])[(..., *index[outer:])]


def _coordinates(file: Any, lengths: Mapping[str, int]) -> dict[str, Variable]:
    """Positions from ImageJ's metadata, OME's, or the resolution of the first page."""
    steps: dict[str, tuple[float, str]] = {}
    resolution = _resolution(file.series[0].keyframe)
    if file.is_imagej:
        found: Mapping[str, Any] = file.imagej_metadata or {}
        unit = str(found.get("unit", "") or "").replace("\\u00B5", "µ")
        for axis in "xy":
            if axis in resolution and unit and unit != "pixel":
                steps[axis] = (resolution[axis][0], unit)
        steps["z"] = (_number(found.get("spacing")), unit)
        steps["t"] = (_number(found.get("finterval")), "s")
    elif file.is_ome:
        pixels = _ome_pixels(file)
        for axis, unit in zip("xyzt", ["µm", "µm", "µm", "s"], strict=True):
            name = "TimeIncrement" if axis == "t" else f"PhysicalSize{axis.upper()}"
            steps[axis] = (_number(pixels.get(name)), str(pixels.get(f"{name}Unit", unit)))
    else:
        steps = {axis: each for axis, each in resolution.items() if each[1]}
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


def _resolution(page: Any) -> dict[str, tuple[float, str]]:
    """Length of a pixel along x and y, and its unit, "" for none."""
    found = {}
    code = page.tags.get("ResolutionUnit")
    unit = CENTIMETRE.get(int(code.value) if code is not None else 2, "")
    for axis, name in (("x", "XResolution"), ("y", "YResolution")):
        tag = page.tags.get(name)
        if tag is not None and len(tag.value) == 2 and tag.value[0] > 0 and tag.value[1] > 0:
            found[axis] = (1 / (tag.value[0] / tag.value[1]), unit)
    return found


def _number(value: Any) -> float:
    return float(value) if is_number(str(value)) else float("nan")


def open_pages(pattern: str, paths: Sequence[Path], request: Request) -> Source | None:
    """Files of one page each as one series: `--axes` says what they are.

    None where the first file holds more than a page, or where there is one file: each file is then
    a step, as in any pattern. Raises InputError where the axes are not given, and for files that
    differ from the first.
    """
    tifffile = library(pattern, "TIFF", "tifffile", "fhash[formats]")
    for path in paths:
        request.beside(path, path)
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

    def get(ranges: list[range]) -> npt.NDArray[Any]:
        rows, columns = (slice(each.start, each.stop) for each in ranges[1:])
        planes = [_plane(tifffile, paths[n], shape, dtype)[rows, columns] for n in ranges[0]]
        return np.stack(planes)

    described = Variable(
        name=paths[0].stem.rstrip("0123456789_-. ") or paths[0].stem,
        shape=(len(paths), *shape),
        dtype=dtype,
        dimensions=tuple(AXIS_NAMES[axis] for axis in request.axes),
        read=by_ranges((len(paths), *shape), get),
    )
    with naming(str(paths[0])), tifffile.TiffFile(paths[0]) as file:
        whole = _meant(str(paths[0]), file, described)
    found, stamp = placed([whole], coords), Stamp.of(paths[0])
    return Source(name=pattern, variables=found, stamp=stamp, files=paths)


def _plane(
    tifffile: Any, path: Path, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> npt.NDArray[Any]:
    with naming(str(path)), _strictly(), tifffile.TiffFile(path) as file:
        found = file.series[0] if file.series else None
        if found is None or tuple(found.shape) != shape or np.dtype(found.dtype) != dtype:
            raise InputError(f"its page is not {dtype} {shape}, as that of the first file")
        _check_size(path, found)
        return np.asarray(file.series[0].asarray())
