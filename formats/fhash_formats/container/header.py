"""What the root of a container says of the volume, checked by itself and against the arrays (FORMAT.md, "Header" and "Arrays").

Keys that are not known are kept and ignored: a minor version may add some. What a reader has to understand is in `required_features`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import DTYPES, ArrayMetadata
from fhash_formats.container.coding import TRANSFORM
from fhash_formats.container.coordinates import MAX_RULED, check_positions
from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

FORMAT = "fhash"
FORMAT_VERSION = (1, 1)
TRANSFORM_FEATURE = "transform"
KNOWN_FEATURES = frozenset({TRANSFORM_FEATURE, "cross", "mask", "predictor"})
PAPER, COMPACT = "paper", "compact"
KNOWN_PROFILES = (PAPER, COMPACT)
POSITIONS = ("time", "z", "y", "x")
QUALITY = (
    "psnr",
    "rmse",
    "max_abs_error",
    "ssim",
    "psnr_domain",
    "rmse_domain",
    "max_abs_error_domain",
)
HISTORY = ("seconds", "epoch", "psnr")
CODED = "transform"
TABLE_TYPES = ("float32", "float16", "uint8", CODED)
MAX_LEVELS = 64
MAX_EMBEDDING = 1024
MAX_HIDDEN_LAYERS = 64
MAX_WIDTH = 1 << 16

Expected = tuple[str, tuple[int, ...], tuple[str, ...]]
"""Name, shape and allowed number types of an array."""


def validate_header(header: Mapping[str, Any]) -> None:
    """Raises UnsupportedFileError for a newer format, DamagedFileError naming the first key that is missing or has a wrong value."""
    top = Record(header, "header key ")
    _check_format(top)
    encoder, variable = top.record("encoder"), top.record("variable")
    encoder.text("version")
    encoder.whole("seed", -(2**63), 2**64 - 1)
    variable.text("name")
    variable.text("units")
    dtype = DTYPES[variable.choice("dtype", tuple(DTYPES))]
    variable.record("attributes")
    shape = top.record("domain").wholes("shape", 4, 1, MAX_LENGTH)
    low, high = top.numbers("value_range", 2)
    most = _largest_decoded(dtype)
    top.need(low <= high, "value_range", "low <= high")
    top.need(
        max(abs(low), abs(high)) <= most,
        "value_range",
        f"numbers up to {most:.6g}, as values of {dtype} decode to",
    )
    top.need(
        abs(top.number("background")) <= most,
        "background",
        f"a number up to {most:.6g}, as values of {dtype} decode to",
    )
    box = _box(top, shape)
    top.texts("features")
    top.whole("dilation", 0, MAX_LENGTH)
    top.need(0 <= top.number("coreset_fraction") <= 1, "coreset_fraction", "a number from 0 to 1")
    profile = _check_model(top.record("model"), shape[0], box, dtype)
    if profile == COMPACT or header["model"]["tables"] == CODED:
        needed = f"{TRANSFORM_FEATURE} in the profile {COMPACT} and for tables coded by {CODED}"
        top.need(TRANSFORM_FEATURE in header["required_features"], "required_features", needed)
    if profile == COMPACT:
        _check_coordinates(top, shape)
    top.record("config")
    training, quality = top.record("training"), top.record("quality")
    training.get("seconds")
    training.number_or_null("seconds")
    training.whole("epochs", 0, MAX_LENGTH)
    training.text("device")
    if training.has("restarts"):
        training.whole("restarts", 0, MAX_LENGTH)
    training.number_or_null("learning_rate")
    for key in QUALITY:
        quality.number_or_null(key)
    for entry in (
        top.records("history") if profile == PAPER or isinstance(top.get("history"), list) else ()
    ):
        for key in HISTORY:
            entry.number_or_null(key)
    if profile == COMPACT and not isinstance(top.get("history"), list):
        columns = top.record("history")
        for key in HISTORY:
            if columns.has(key):
                columns.numbers(
                    key, len(columns.get("epoch")) if isinstance(columns.get("epoch"), list) else 0
                )


def check_arrays(header: Mapping[str, Any], arrays: Mapping[str, ArrayMetadata]) -> None:
    """Whether the arrays are those that a valid header speaks of; raises DamagedFileError naming the first that is not."""
    for name, shape, dtypes in _expected(header):
        if name not in arrays:
            raise DamagedFileError(f"array {name} is missing")
        _check_array(name, arrays[name], shape, dtypes)
        attributes = Record(arrays[name].attributes, f"array {name} attribute ")
        if (
            name.startswith("tables/")
            and arrays[name].dtype == np.uint8
            and header["model"]["profile"] == "paper"
        ):
            attributes.number("offset")
            attributes.need(attributes.number("scale") >= 0, "scale", "at least 0")
        if name.startswith("tables/") and header["model"]["tables"] == CODED:
            attributes.numbers("mixing", header["model"]["embedding_size"])
    if TRANSFORM_FEATURE not in header["required_features"]:
        for name, array in arrays.items():
            if array.sharding is not None or array.codecs[0]["name"] == TRANSFORM:
                raise DamagedFileError(
                    f"array {name} has codecs of the feature {TRANSFORM_FEATURE}, which the header does not require"
                )
    for name, array in arrays.items():
        for feature in array.coder.features:
            if feature not in header["required_features"]:
                raise DamagedFileError(
                    f"array {name} has the feature {feature}, which the header does not require"
                )
    for name, shape, dtypes in _optional(header):
        if name in arrays:
            _check_array(name, arrays[name], shape, dtypes)
    for axis in POSITIONS:
        if f"coords/{axis}" in arrays and "name" in arrays[f"coords/{axis}"].attributes:
            Record(arrays[f"coords/{axis}"].attributes, f"array coords/{axis} attribute ").text(
                "name"
            )


def check_key_frames(header: Mapping[str, Any], key_frames: npt.NDArray[np.int64]) -> None:
    """Whether the key frames increase within the domain; raises DamagedFileError."""
    steps = header["domain"]["shape"][0]
    if key_frames[0] < 0 or key_frames[-1] >= steps or np.any(key_frames[1:] <= key_frames[:-1]):
        raise DamagedFileError(f"array key_frames does not increase within 0..{steps - 1}")


def occupancy_bytes(box: Sequence[Sequence[int]]) -> int:
    """Bytes of one occupancy grid in ragged Morton order: every axis of the box filled up to a power of two, one bit per voxel."""
    return -(-prod(1 << (high - low - 1).bit_length() for low, high in box) // 8)


def layer_shapes(model: Mapping[str, Any]) -> list[tuple[int, int]]:
    """(outputs, inputs) of each layer of the network."""
    widths = [
        len(model["levels"]) * model["embedding_size"],
        *[model["width"]] * model["hidden_layers"],
        1,
    ]
    return [(outputs, inputs) for inputs, outputs in pairwise(widths)]


def _check_format(top: Record) -> None:
    if top.get("format") != FORMAT:
        raise DamagedFileError(
            f"header key format is {ascii(top.get('format'))[:40]}; '{FORMAT}' is needed"
        )
    major, minor = top.wholes("format_version", 2, 0, 10_000)
    if major > FORMAT_VERSION[0]:
        raise UnsupportedFileError(
            f"written by a newer fhash format {major}.{minor}; this version reads {FORMAT_VERSION[0]}.x; upgrade"
        )
    top.need(major == FORMAT_VERSION[0], "format_version", f"[{FORMAT_VERSION[0]}, n]")
    unknown = [name for name in top.texts("required_features") if name not in KNOWN_FEATURES]
    if unknown:
        raise UnsupportedFileError(
            f"the file needs the feature {unknown[0][:80]!a}, which this version does not know; upgrade"
        )


def _box(top: Record, shape: Sequence[int]) -> list[int]:
    """Lengths (z, y, x) of the feature bounding box."""
    bounds = top.get("feature_bounding_box")
    top.need(
        isinstance(bounds, list) and len(bounds) == 3,
        "feature_bounding_box",
        "[[z0, z1], [y0, y1], [x0, x1]]",
    )
    for bound, length in zip(bounds, shape[1:], strict=True):
        whole = isinstance(bound, list) and len(bound) == 2 and all(type(n) is int for n in bound)
        top.need(
            whole and 0 <= bound[0] < bound[1] <= length,
            "feature_bounding_box",
            f"within the domain {list(shape)}",
        )
    return [high - low for low, high in bounds]


def _check_coordinates(top: Record, shape: Sequence[int]) -> None:
    """Positions in the header; those of an axis that it does not name are in an array."""
    if top.has("coordinates"):
        coordinates = top.record("coordinates")
        for axis, length in zip(POSITIONS, shape, strict=True):
            if coordinates.has(axis):
                coordinates.need(
                    length <= MAX_RULED, axis, f"an array for more than {MAX_RULED} positions"
                )
                check_positions(coordinates.record(axis), length)


def _largest_decoded(source: np.dtype[Any]) -> float:
    """The largest value of the type that values of a source decode to: float32 where it is precise enough, else float64."""
    return float(
        np.finfo(np.float32 if source.itemsize <= 2 or source == np.float32 else np.float64).max
    )


def _check_model(model: Record, steps: int, box: Sequence[int], source: np.dtype[Any]) -> str:
    """The profile."""
    profile = model.text("profile")
    if profile not in KNOWN_PROFILES:
        known = ", ".join(KNOWN_PROFILES)
        raise UnsupportedFileError(
            f"header key model.profile is {profile[:40]!a}; this version knows {known}; upgrade"
        )
    if profile == PAPER:
        model.whole("fold", 2, MAX_LENGTH)
        model.whole("embedding_size", 1, MAX_EMBEDDING)
        model.whole("hidden_layers", 0, MAX_HIDDEN_LAYERS)
        model.whole("width", 1, MAX_WIDTH)
        model.whole("parameters", 1, 1 << 62)
        model.choice("tables", TABLE_TYPES)
        model.number_or_null("tables_loss_db")
    else:
        model.whole("embedding_size", 1, 1)
        model.whole("parameters", 0, 1 << 62)
        tables = DTYPES[model.choice("tables", tuple(DTYPES))]
        narrow = _largest_decoded(source) < np.finfo(np.float64).max
        model.need(
            not (narrow and tables == np.float64), "tables", f"no float64 for a source of {source}"
        )
        model.need(
            model.get("head") is None or isinstance(model.get("head"), Mapping),
            "head",
            "an object or null",
        )
    levels = model.get("levels")
    model.need(
        isinstance(levels, list) and 1 <= len(levels) <= MAX_LEVELS,
        "levels",
        f"1 to {MAX_LEVELS} of [t, z, y, x]",
    )
    finer: Sequence[int] = [MAX_LENGTH] * 4
    for level in levels:
        whole = isinstance(level, list) and len(level) == 4 and all(type(n) is int for n in level)
        fits = whole and all(1 <= n <= limit for n, limit in zip(level, finer, strict=True))
        model.need(
            fits, "levels", "[t, z, y, x] from finest to coarsest, none longer than the one before"
        )
        finer = level
    model.need(levels[0][1:] == list(box), "levels", f"the box {list(box)} at the finest level")
    model.need(
        levels[0][0] <= steps, "levels", f"at most the {steps} steps of the domain as key frames"
    )
    model.need(
        profile == PAPER or len(levels) == 1, "levels", f"one level in the profile {COMPACT}"
    )
    return profile


def _expected(header: Mapping[str, Any]) -> Iterator[Expected]:
    model = header["model"]
    compact = model["profile"] == COMPACT
    described = header.get("coordinates", {}) if compact else {}
    for axis, length in zip(POSITIONS, header["domain"]["shape"], strict=True):
        if axis not in described:
            yield f"coords/{axis}", (length,), ("float64",)
    key_frames = model["levels"][0][0]
    if not compact or key_frames < header["domain"]["shape"][0]:
        yield "key_frames", (key_frames,), ("int64",)
    if compact:
        yield "tables/level_1", tuple(model["levels"][0]), (model["tables"],)
        return
    for number, level in enumerate(model["levels"], start=1):
        if model["tables"] == CODED:
            for component in range(1, model["embedding_size"] + 1):
                yield f"tables/level_{number}/component_{component}", tuple(level), ("float32",)
        else:
            yield f"tables/level_{number}", (*level, model["embedding_size"]), (model["tables"],)
    for number, (outputs, inputs) in enumerate(layer_shapes(model), start=1):
        yield f"mlp/weight_{number}", (outputs, inputs), ("float32",)
        yield f"mlp/bias_{number}", (outputs,), ("float32",)
    yield (
        "occupancy/bits",
        (key_frames, occupancy_bytes(header["feature_bounding_box"])),
        ("uint8",),
    )


def _optional(header: Mapping[str, Any]) -> Iterator[Expected]:
    """Arrays that are checked where they are there."""
    model, steps = header["model"], header["domain"]["shape"][0]
    for axis, length in zip(POSITIONS, header["domain"]["shape"], strict=True):
        yield f"coords/{axis}", (length,), ("float64",)
    if model["profile"] == COMPACT:
        key_frames, *box = model["levels"][0]
        yield "key_frames", (key_frames,), ("int64",)
        yield (
            "occupancy/bits",
            (key_frames, occupancy_bytes(header["feature_bounding_box"])),
            ("uint8",),
        )
        yield "occupancy/mask", (key_frames, *box), ("uint8",)
    yield "missing/bits", (steps, -(-prod(header["domain"]["shape"][1:]) // 8)), ("uint8",)


def _check_array(
    name: str, array: ArrayMetadata, shape: tuple[int, ...], dtypes: tuple[str, ...]
) -> None:
    if array.shape != shape or array.dtype.name not in dtypes:
        raise DamagedFileError(
            f"array {name} is {array.dtype.name} {array.shape}; the header asks for {' or '.join(dtypes)} {shape}"
        )
