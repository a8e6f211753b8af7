"""Header of a container: its name, provenance, source, quality and figures of single steps."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.config import EncodeConfig, options_beyond
from fhash_codec.features.occupancy import write_bits
from fhash_codec.measure.metrics import even_steps
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import (
    SOURCE,
    Container,
    ContainerWriter,
    describe_coordinates,
    describe_metadata,
    read_metadata,
)
from fhash_formats.container.header import (
    BETWEEN,
    COMPACT,
    HISTORY,
    LINEAR,
    LOWEST,
    MISSING_ARRAY,
    NOT_STORED,
    STEP_BYTES,
    STEP_FIGURES,
    STEPS,
    TOGETHER,
)
from fhash_formats.errors import InputError
from fhash_formats.series import (
    AXES,
    Coordinate,
    Series,
    SourceMetadata,
    with_history,
)
from fhash_formats.support.values import is_within, json_attributes

if TYPE_CHECKING:
    from fhash_codec.features.scan import Scan
    from fhash_codec.file_info import FileInfo, HistoryPoint

DATA_SUFFIX_NAMES = """.npy .npz .h5 .hdf5 .hdf .he5 .nc .nc4 .netcdf .cdf .zarr .raw .vti .vtr .pvd
.pvti .pvtr .series .vtkhdf .nrrd .nhdr .mha .mhd .tif .tiff .vtp .ply"""
DATA_SUFFIXES = frozenset(DATA_SUFFIX_NAMES.split())
"""Suffixes of data files that are read or written. No container may have one of them.

Those that say nothing of their content (.zip, .bin, .dat) are allowed.
"""


def check_name(path: Path) -> None:
    """Raise InputError for a container named like a data file: most often the source itself."""
    if path.suffix.lower() in DATA_SUFFIXES:
        raise InputError(
            f"{path}: a container is not a {path.suffix} file; give it a name that ends in .fhz"
        )


NETWORK = "network"
"""Rule of values between steps in files of the published network, which gives them itself."""

PACKED = "pack"
"""Command in the header's `encoder` of a file whose tiles come from a Zarr store."""

FIGURES = {"fhash_max_error": "max_abs_error", "fhash_psnr": "psnr"}
"""Attributes of a variable that say how well the file holds it, and their names in its header."""

MAX_OPTION = 80
"""Letters of the value of an option in a line of the history; a longer one is cut."""


def described_source(
    series: Series, coords: Mapping[str, Coordinate], attributes: Mapping[str, Any]
) -> tuple[dict[str, Any] | None, dict[str, npt.NDArray[Any]]]:
    """The header's `source` of a series, and the arrays that belong to it.

    coords, attributes: as the header has them. The entry is None where nothing is known.
    """
    metadata = series.metadata
    if metadata is None:
        return None, {}
    assert set(metadata.dimensions.values()) <= {*AXES, ""}
    return describe_metadata(metadata, coords, attributes)


def date_of(config: EncodeConfig) -> dict[str, str]:
    """The time of the encoding for the header's `source`, in UTC.

    It is left out with the other times: then the same input and settings give the same bytes.
    """
    now = datetime.now(UTC).replace(microsecond=0, tzinfo=None)
    return {"date": f"{now.isoformat()}Z"} if config.timings else {}


def figure_attributes(header: Mapping[str, Any]) -> dict[str, float]:
    """Attributes of a variable that say how well the file holds it, as far as it tells."""
    found = {key: header["quality"].get(name) for key, name in FIGURES.items()}
    return {key: value for key, value in found.items() if value is not None}


def without_figures(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes without figures of an earlier file, from which the values came."""
    return {key: value for key, value in attributes.items() if key not in FIGURES}


def source_attributes(metadata: SourceMetadata) -> dict[str, str]:
    """Attributes of a file that name its source and the digest of it, as far as they are known."""
    named = {"fhash_source": metadata.file, "fhash_source_digest": metadata.digest}
    return {key: text for key, text in named.items() if text}


def metadata_of(container: Container, coords: Mapping[str, Coordinate]) -> SourceMetadata | None:
    """The source as a container tells it, with a line of history for the encoding.

    coords: those of the container. None where it says nothing.
    """
    metadata = read_metadata(container.header, container.arrays, coords)
    if metadata is None:
        return None
    line = history_line(container.header)
    return replace(metadata, attributes=with_history(metadata.attributes, line))


def history_line(header: Mapping[str, Any]) -> str:
    """The encoding as a line of the global attribute `history`, as CF asks of a program.

    It has the date where the header has it, the version of the encoder, and the command that asks
    for the same settings.
    """
    source = header.get(SOURCE, {})
    date = f"{source['date']} " if isinstance(source.get("date"), str) else ""
    name = f" {source['file']}" if isinstance(source.get("file"), str) else ""
    begun = f"{date}fhash {header['encoder']['version']}: fhash"
    if header["encoder"].get("command") == PACKED:
        return f"{begun} pack{name}"
    words = "".join(f" {word}" for word in _options(header))
    return f"{begun} encode{name}{words}"


def _options(header: Mapping[str, Any]) -> list[str]:
    """The settings other than the defaults, as options of the command line."""
    return [
        option if value is None else f"{option} {str(value)[:MAX_OPTION]}"
        for option, value in options_beyond(header.get("config", {}), EncodeConfig().to_dict())
    ]


MAX_LISTED = 512
"""Figures that stand in the header; an array of its own takes some 400 bytes."""
SMALL = 1 << 12
"""Vertices of a figure, at least: one of fewer takes much beside the bytes of their values."""
LEAST_FIGURES = 64
"""Figures of a series, if it has as many steps."""
HUNDREDTHS = 2000
"""Hundredths of a dB of a factor of ten."""
EXACT = -1
"""Number in place of the decibels of a figure that is 0."""
UNKNOWN = -2
"""Number in place of the decibels of a figure without a finite value."""
DIGITS_OF_A_STEP = 5
"""Significant digits of a figure that comes back from decibels."""


def steps_together(shape: Sequence[int]) -> int:
    """The number of neighbouring steps of a series (t, z, y, x) that have one figure together."""
    return max(1, min(SMALL // prod(shape[1:]), shape[0] // LEAST_FIGURES))


def write_steps(
    writer: ContainerWriter,
    figures: Mapping[str, Sequence[float | None]],
    data_range: float,
    together: int,
) -> dict[str, Any]:
    """Write the figures of all steps, or return what the header's `quality.steps` is.

    Args:
        writer: of the container; it gets an array for more than MAX_LISTED steps.
        figures: one for each step, by the names STEP_FIGURES.
        data_range: width of the header's value range.
        together: see `steps_together`.

    Returns an empty object where there is an array.
    """
    merged = {name: _merged(name, figures[name], together) for name in STEP_FIGURES}
    levels = {name: _levels(merged[name], data_range) for name in STEP_FIGURES}
    told = {TOGETHER: together} if together > 1 else {}
    if len(levels[STEP_FIGURES[0]]) <= MAX_LISTED + 1:
        return levels | told
    numbers = np.array([listed[1:] for listed in levels.values()]) - UNKNOWN
    planes = np.moveaxis(numbers.astype("<u4").view(np.uint8).reshape(*numbers.shape, 4), -1, 0)
    lowest = [listed[0] for listed in levels.values()]
    writer.add_whole(STEPS, planes[:STEP_BYTES], attributes={LOWEST: lowest} | told)
    return {}


def _merged(name: str, figures: Sequence[float | None], together: int) -> Sequence[float | None]:
    """One figure for some neighbouring steps each: their root mean square, or the largest."""
    if together == 1:
        return figures
    values = np.array(figures, dtype=np.float64)  # NaN for None
    merged = []
    for first in range(0, len(values), together):
        some = values[first : first + together]
        some = some[np.isfinite(some)]
        largest = float(some.max(initial=0.0))
        scaled = some / (largest or 1.0)
        root = largest * math.sqrt(float(np.square(scaled).mean())) if some.size else None
        merged.append(root if name == STEP_FIGURES[0] or root is None else largest)
    return merged


def read_steps(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The figures of each step as of `Errors.per_step`, rounded to the worse side.

    None where the file has none. Those of steps that have one together are the same.

    Args:
        header: of a variable.
        arrays: StoredArray by name.
    """
    quality = header["quality"]
    if "steps" in quality:
        lists = [quality["steps"][name] for name in STEP_FIGURES]
        together = quality["steps"].get(TOGETHER, 1)
    elif STEPS in arrays:
        array = arrays[STEPS]
        weights = 256 ** np.arange(STEP_BYTES)
        numbers = np.tensordot(weights, array.read().astype(np.int64), 1) + UNKNOWN
        pairs = zip(array.attributes[LOWEST], numbers.tolist(), strict=True)
        lists = [[lowest, *levels] for lowest, levels in pairs]
        together = array.attributes.get(TOGETHER, 1)
    else:
        return []
    low, high = header["value_range"]
    # Rounding must not pass the largest error of all steps.
    limits = (None, quality.get("max_abs_error"))
    columns = [
        [_step_figure(first, level, high - low, limit) for level in levels]
        for (first, *levels), limit in zip(lists, limits, strict=True)
    ]
    rows = [
        {"psnr": _psnr(row[0], high - low), **dict(zip(STEP_FIGURES, row, strict=True))}
        for row in zip(*columns, strict=True)
    ]
    steps = range(header["domain"]["shape"][0])
    return [{"step": step, **rows[step // together]} for step in steps]


def _levels(figures: Sequence[float | None], data_range: float) -> list[int]:
    """The smallest level, then each level counted from it, or EXACT or UNKNOWN."""
    width = _decades(data_range)
    levels: list[int | None] = []
    for figure in figures:
        if figure is not None and 0 < figure < math.inf:
            levels.append(math.floor(HUNDREDTHS * (width - math.log10(figure))))
        else:
            levels.append(None)
    lowest = min((level for level in levels if level is not None), default=0)
    result = [lowest]
    for figure, level in zip(figures, levels, strict=True):
        unlike = EXACT if figure == 0 else UNKNOWN
        result.append(unlike if level is None else level - lowest)
    return result


def _decades(data_range: float) -> float:
    """The decimal logarithm of a range; of the largest float64 for one beyond it."""
    return math.log10(min(data_range or 1.0, sys.float_info.max))


def _step_figure(lowest: int, level: int, data_range: float, limit: float | None) -> float | None:
    """The figure that is so many hundredths of a dB below a range, rounded up."""
    if level < 0:
        return 0.0 if level == EXACT else None
    exponent = _decades(data_range) - (lowest + level) / HUNDREDTHS
    if not -323 < exponent < 308:
        return None
    value = math.pow(10.0, exponent)
    if limit is not None and value >= limit:
        return float(limit)
    context = Context(prec=DIGITS_OF_A_STEP, rounding=ROUND_CEILING)
    rounded = float(context.create_decimal_from_float(value))
    return rounded if limit is None else min(rounded, float(limit))


MAX_POINTS = 24
"""Points of a training history that a file of the published network keeps at most."""

HEAD_POINTS = 8
"""Points that another file keeps at most, of the training of its head."""

DIGITS = 6
"""Significant digits of a figure over all steps."""

GAIN = ("what", "bytes", "seconds")
"""Entries of a list in `model.gains`, in this order."""
SEARCH = ("gains", "tiling")
"""Keys of the model that tell of the search, with the times alone."""

STEP_DIGITS = 5
"""Significant digits of a figure of one step."""


def describe_variable(series: Series) -> dict[str, Any]:
    """The header entry of the variable of a series."""
    variable: dict[str, Any] = {
        "name": str(series.name),
        "units": str(series.units),
        "dtype": (series.source_dtype or series.dtype).name,
        "attributes": json_attributes(series.attributes, without=frozenset()),
    }
    if series.fill is not None and math.isfinite(series.fill):
        variable["fill"] = series.fill
    elif series.dtype.kind == "f" and series.defaults:
        variable["fill"] = min(series.defaults)
    if series.not_stored is not None:
        variable[NOT_STORED] = series.not_stored.to_dict()
    return variable


def describe_source(
    series: Series, value_range: ValueRange, config: EncodeConfig, *, gaps: bool = False
) -> dict[str, Any]:
    """Header entries of a series: variable, source, shape, range, and a quality to be filled in.

    gaps: whether vertices are outside the coreset. Integers that floats have not all of then get a
    fill value, where the source has none: a reader cannot give them as floats with NaN.
    """
    from importlib.metadata import version

    variable = describe_variable(series)
    dtype = series.source_dtype or series.dtype
    if gaps and "fill" not in variable and value_range.is_far(dtype):
        low, high = (int(end) for end in value_range.ends)
        limits = np.iinfo(dtype)
        ends = [int(limits.min), int(limits.max)][:: 1 if dtype.kind == "i" else -1]
        free = [end for end in (*ends, low - 1, high + 1) if is_within(end, dtype)]
        free = [fill for fill in free if not low <= fill <= high]
        variable |= {"fill": free[0]} if free else {}
    source, _ = described_source(series, _storable_coords(series), variable["attributes"])
    return {
        **({} if source is None else {SOURCE: source | date_of(config)}),
        "encoder": {"version": version("fhash")},
        "variable": variable,
        "domain": {"shape": list(series.shape)},
        "value_range": [value_range.low, value_range.high],
        "dilation": config.dilation,
        "quality": {},
    }


def write_series(
    writer: ContainerWriter,
    series: Series,
    scanned: Scan,
    key_frames: Sequence[int],
    *,
    everything: bool = False,
) -> dict[str, Any]:
    """Write key frames, arrays beside the values, and masks of the values that are not finite.

    The writer begins the variable of the series. Returns the header's `coordinates`.

    Args:
        writer: of the container.
        series: what is encoded.
        scanned: its values that are not finite.
        key_frames: steps of the key frames.
        everything: whether the coreset of each step says which values are not finite, where every
            step is a key frame: all others are in it, and are read from there.
    """
    coords = _storable_coords(series)
    writer.begin()
    for name, array in described_source(series, coords, {})[1].items():
        writer.add_whole(name, array)
    every_step = len(key_frames) == series.shape[0]
    if not every_step:
        writer.add_whole("key_frames", np.array(key_frames, dtype=np.int64))
    if scanned.missing and not (everything and every_step):
        write_missing(writer, series.shape, scanned)
    return {"coordinates": describe_coordinates(coords)}


def _storable_coords(series: Series) -> dict[str, Coordinate]:
    """The coordinates of a series with names and attributes that JSON can hold."""
    return {
        axis: replace(
            coordinate,
            name=str(coordinate.name),
            attributes=json_attributes(coordinate.attributes, without=frozenset()),
        )
        for axis, coordinate in series.coords.items()
    }


def write_missing(writer: ContainerWriter, shape: tuple[int, ...], scanned: Scan) -> None:
    """Write one row of bits per step, 1 = not finite."""
    empty = np.zeros(-(-prod(shape[1:]) // 8), dtype=np.uint8)
    write_bits(
        writer,
        MISSING_ARRAY,
        (shape[0], empty.size),
        lambda step: scanned.missing.get(step, empty),
    )


def read_missing(container: Container, steps: range, region: Box) -> npt.NDArray[np.bool_] | None:
    """Mask (t, z, y, x) of the values of a region that are not finite at neighbouring steps.

    None if every value of the source is finite.
    """
    stored = container.arrays.get(MISSING_ARRAY)
    if stored is None:
        return None
    _, y, x = container.header["domain"]["shape"][1:]
    (low, high), *layer = region
    # the bytes that hold the region's layers, which lie one after the other
    first, end = low * y * x, high * y * x
    rows = stored.read((slice(steps.start, steps.stop), slice(first // 8, -(-end // 8))))
    bits = np.unpackbits(rows, axis=1)[:, first % 8 :][:, : end - first].view(np.bool_)
    return bits.reshape(len(steps), high - low, y, x)[:, :, *(slice(*span) for span in layer)]


def brief_quality(
    writer: ContainerWriter, quality: Mapping[str, Any], data_range: float, shape: Sequence[int]
) -> dict[str, Any]:
    """Figures as a file has them: rounded to the worse side, those of single steps in decibels.

    What follows from other entries of the header is left out, and `full_header` puts it back: the
    PSNR of a step, and the range and the steps of the SSIM where they are those of the series.

    Args:
        writer: of the container; it gets an array for the figures of many steps.
        quality: `metrics.Quality` as JSON values.
        data_range: width of the header's value range.
        shape: of the series (t, z, y, x).
    """
    brief: dict[str, Any] = {
        name: _figure(name, value, DIGITS) if isinstance(value, float) else value
        for name, value in quality.items()
        if name not in ("per_step", "between")
    }
    bulk = quality.get("bulk")
    if bulk is not None:
        # The RMSE follows from the two others.
        brief["bulk"] = {"psnr": _figure("psnr", bulk["psnr"], DIGITS), "range": bulk["range"]}
    between = quality.get("between")
    if between is not None:
        brief["between"] = {
            name: _figure(name, value, STEP_DIGITS) for name, value in between.items()
        }
    figures = {name: [step[name] for step in quality["per_step"]] for name in STEP_FIGURES}
    steps = write_steps(writer, figures, data_range, steps_together(shape))
    if steps:
        brief["steps"] = steps
    window = dict(quality["ssim_window"])
    if window.get("data_range") == data_range:
        del window["data_range"]
    measured = window.get("steps")
    if measured and measured == even_steps(shape[0], len(measured)):
        del window["steps"]
        window |= {"steps": len(measured)} if len(measured) < shape[0] else {}
    brief["ssim_window"] = window
    return brief


def brief_history(
    history: Sequence[Mapping[str, float | None]], most: int = MAX_POINTS
) -> dict[str, list[float | None]]:
    """A training history as a header has it: lists by name, of at most so many points.

    The last point is one of them. Seconds are rounded to milliseconds, PSNR to hundredths of a dB.
    Figures without a finite value, such as the PSNR of exact values, are None; a list of such
    figures alone is left out.
    """
    count = min(len(history), most)
    chosen = [history[(number + 1) * len(history) // count - 1] for number in range(count)]
    lists: dict[str, list[float | None]] = {
        "epoch": [point["epoch"] for point in chosen],
        "seconds": [_rounded(point["seconds"], 3) for point in chosen],
        "psnr": [_rounded(point["psnr"], 2) for point in chosen],
    }
    return {
        name: values for name, values in lists.items() if any(value is not None for value in values)
    }


def history_points(history: Mapping[str, Any]) -> list[HistoryPoint]:
    """The points of a header's training history."""
    lists = {name: history[name] for name in HISTORY if name in history}
    points = [dict(zip(lists, point, strict=True)) for point in zip(*lists.values(), strict=True)]
    return [cast("HistoryPoint", {"seconds": None, "psnr": None, **point}) for point in points]


def full_header(header: Mapping[str, Any], arrays: Mapping[str, Any]) -> dict[str, Any]:
    """A header as a report has it, with all that follows from the file.

    `quality.per_step` is a list with step, psnr, rmse and max_abs_error of each step, `history` a
    list of points, and `model.gains` a list of objects.

    Args:
        header: of a variable.
        arrays: its StoredArray by name.
    """
    low, high = header["value_range"]
    quality = {name: value for name, value in header["quality"].items() if name != "steps"}
    steps = read_steps(header, arrays)
    if steps:
        quality["per_step"] = steps
    if isinstance(quality.get("ssim_window"), Mapping):
        steps_of_series = header["domain"]["shape"][0]
        window = {"data_range": high - low, "steps": steps_of_series, **quality["ssim_window"]}
        if isinstance(window["steps"], int):
            count = min(max(window["steps"], 1), steps_of_series)
            window["steps"] = even_steps(steps_of_series, count)
        quality["ssim_window"] = window
    model = dict(header["model"])
    if isinstance(model.get("gains"), list):
        gains = [gain for gain in model["gains"] if isinstance(gain, list)]
        model["gains"] = [dict(zip(GAIN, gain, strict=False)) for gain in gains]
    history = history_points(header["history"])
    return {**header, "model": model, "quality": quality, "history": history}


def _psnr(rmse: Any, data_range: float) -> float | None:
    """The PSNR in dB of a root of the mean squared error; None where it is not finite."""
    if not isinstance(rmse, int | float) or rmse <= 0 or data_range <= 0:
        return None
    return _figure("psnr", 20 * (math.log10(data_range) - math.log10(rmse)), STEP_DIGITS)


def _figure(name: str, value: float | None, digits: int) -> float | None:
    """A figure rounded to significant digits, never to a better value."""
    if value is None:
        return None
    rounding = ROUND_FLOOR if name.startswith(("psnr", "ssim")) else ROUND_CEILING
    return float(Context(prec=digits, rounding=rounding).create_decimal_from_float(value))


def _rounded(value: float | None, digits: int) -> float | None:
    # numpy rounds by a product, which overflows; Python's numbers do not
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


def rule_between(header: Mapping[str, Any]) -> dict[str, Any]:
    """The rule of values between steps, `rule`, and `gain_db`, None where it was not measured."""
    model = header["model"]
    if model["profile"] != COMPACT:
        return {"rule": NETWORK, "gain_db": None}
    return {"rule": LINEAR, "gain_db": None, **model.get(BETWEEN, {})}


def describe_file(container: Container, path: object, key_frames: Sequence[int]) -> FileInfo:
    """The header of a container, and what follows from it; see `Volume.info`."""
    header = container.header
    raw = prod(header["domain"]["shape"]) * np.dtype(header["variable"]["dtype"]).itemsize
    arrays = {
        array.name: {
            "shape": list(array.shape),
            "dtype": str(array.dtype),
            "bytes": array.nbytes_stored,
        }
        for array in container.arrays.values()
    }
    full = full_header(header, container.arrays)
    return cast(
        "FileInfo",
        {
            **full,
            "model": {**full["model"], BETWEEN: rule_between(header)},
            "path": str(path),
            "bytes": container.size,
            "overhead_bytes": container.overhead(),
            "split": container.split(),
            "raw_bytes": raw,
            "ratio": raw / container.size,
            "key_frames": list(key_frames),
            "arrays": arrays,
        },
    )
