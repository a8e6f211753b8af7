"""Checks of the header of a variable, and the values that it leaves out.

FORMAT.md describes the header in its section "Header". Unknown keys are kept and ignored, because
a minor version may add some; what a reader must understand is named in `required_features`.

Values that follow from FORMAT.md or from the rest are left out: in a small file the header costs as
much as the coefficients. The defaults belong to the format: a default of the encoder that changes
is from then on written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np

from fhash_formats.container.coordinates import MAX_RULED, check_positions
from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.container.zip_file import check_major
from fhash_formats.errors import DamagedFileError, UnsupportedFileError
from fhash_formats.support.number_types import DTYPES

FORMAT = "fhash"
TRANSFORM_FEATURE = "transform"
PLAIN_FEATURE = "plain"
"""Feature of a file of the profile compact whose tables are plain numbers."""
SPARSE = "sparse"
"""Key of the header's `model` that says whose needed vertices the tables have."""
SPARSE_FEATURE = "sparse-tables"
"""Feature of files whose tables have needed vertices alone."""
CORESET = "coreset"
"""Value of the key: the vertices that the coreset needs."""
FRINGE = "fringe"
"""Value of the key: the vertices that the coreset and its fringe need."""
COUNTS = "counts"
"""Attribute of a table: number of its vertices at each time node."""
KNOWN_FEATURES = frozenset({TRANSFORM_FEATURE, PLAIN_FEATURE, SPARSE_FEATURE})
"""Names in `required_features` that this version understands."""
PAPER = "paper"
COMPACT = "compact"
KNOWN_PROFILES = (PAPER, COMPACT)
TABLE = "tables/level_1"
"""Name of the array of the finest table."""
BITS_ARRAY = "occupancy/bits"
"""Name of the array of the occupancy as bits."""
MASK_ARRAY = "occupancy/mask"
"""Name of the array of an occupancy that is coded, in place of bits."""
MASK_FEATURES = 8
"""Largest number of features whose occupancy the numbers of a mask tell."""
MISSING_ARRAY = "missing/bits"
"""Name of the array of the bits of vertices without a value."""
STEPS = "steps/figures"
"""Name of the array of the figures of single steps, where they are not in the header."""
STEP_FIGURES = ("rmse", "max_abs_error")
"""Lists of `quality.steps`, and rows of this array."""
STEP_BYTES = 3
"""Bytes of a number in this array, the lowest first, each in a plane of its own."""
LOWEST = "lowest"
"""Attribute of this array: the first number of each list."""
POSITIONS = ("time", "z", "y", "x")
"""Names of the coordinates in a container, in the order of the axes."""
QUALITY = (
    "psnr",
    "rmse",
    "max_abs_error",
    "ssim",
    "psnr_domain",
    "rmse_domain",
    "max_abs_error_domain",
)
"""Figures in `quality`, each a number or null."""
BETWEEN = (
    "psnr_key_frames",
    "psnr",
    "psnr_linear",
    "psnr_fringe",
    "psnr_fringe_linear",
    "fringe_fraction",
)
"""Figures in `quality.between`, likewise."""
EVERYTHING = "all"
"""Name of the feature that every vertex with a value belongs to."""
NOT_STORED = "not_stored"
"""Key of `variable`: what nobody wrote of the values."""
HISTORY = ("seconds", "epoch", "psnr")
"""Lists of `history`, one figure each at some epochs."""
CODED = "transform"
"""Value of `model.tables` for tables that are coded component by component."""
TABLE_TYPES = ("float32", "float16", "uint8", CODED)
"""Values of `model.tables` in the profile paper."""
PLAIN_TABLE_TYPES = ("float32", "float64")
"""Values of `model.tables` in a plain file of the profile compact."""
HEAD_INPUTS = 28
"""Inputs of the first layer of a head."""
HEAD_CROSS = 9
"""Vertices at which the second layer of a head with a cross sees the first one's outputs."""
MAX_HEAD_LAYERS = 3
"""Hidden layers of a head."""
MAX_HEAD_WIDTH = 64
"""Outputs of a hidden layer of a head."""
MAX_LEVEL = 2**31 - 1
"""Hundredths of a dB that a figure of a step may lie below or above the range."""
MAX_LEVELS = 64
MAX_EMBEDDING = 1024
"""Numbers of an embedding."""
MAX_HIDDEN_LAYERS = 64
MAX_WIDTH = 1 << 16
"""Outputs of a hidden layer."""
MAX_PARAMETERS = 1 << 62
Change = Callable[[Mapping[str, Any], Mapping[str, Any]], dict[str, Any]]
"""An object and its defaults to the object with or without them."""

CONFIG_DEFAULTS: dict[str, Any] = {
    "access": "balanced",
    "batch": 0,
    "brick": "auto",
    "device": "auto",
    "dilation": 1,
    "effort": 5,
    "embedding_size": 0,
    "engine": "auto",
    "epochs": 0,
    "features": ["all"],
    "fold": 0,
    "fringe": "trained",
    "hidden_layers": 2,
    "key_frames": "all",
    "learning_rate": 0.01,
    "max_error": None,
    "max_error_rel": None,
    "profile": "compact",
    "psnr": None,
    "psnr_bulk": None,
    "ratio": None,
    "schedule": "cosine",
    "seed": 0,
    "tables": "float16",
    "tile": "auto",
    "timings": True,
    "train_on_seconds": 3600,
    "width": 0,
    "without": [],
}
"""Values of the settings that a header leaves out."""
DEFAULTS: dict[str, Any] = {
    "features": ["all"],
    "dilation": 1,
    "coreset_fraction": 1.0,
    "coordinates": {},
    "config": CONFIG_DEFAULTS,
    "training": {"seconds": None, "steps": 0, "epochs": 0, "device": "none"},
    "history": {},
}
"""Values of keys that a header leaves out."""
SSIM_WINDOW: dict[str, Any] = {"window": 11, "sigma": 1.5}
"""Window and sigma of the SSIM, in vertices, where the quality was measured."""
DOMAIN_FIGURES = ("psnr", "rmse", "max_abs_error")
"""Figures over the coreset; those over the domain are the same where they are left out."""


def validate_header(header: Mapping[str, Any]) -> None:
    """Check a header alone.

    Raises UnsupportedFileError for another format, and DamagedFileError that names the first key
    that is missing or has a wrong value.
    """
    top = Record(header, "header key ")
    check_format(top)
    dtype = _check_source(top)
    shape = top.record("domain").integers("shape", 4, 1, MAX_LENGTH)
    _check_values(top, dtype)
    box = _box(top, shape)
    top.need(bool(top.texts("features")), "features", "at least one")
    top.integer("dilation", 0, MAX_LENGTH)
    top.need(0 <= top.number("coreset_fraction") <= 1, "coreset_fraction", "a number from 0 to 1")
    plain = PLAIN_FEATURE in header["required_features"]
    profile = _check_model(top.record("model"), shape[0], box, dtype, plain=plain)
    if (profile == COMPACT and not plain) or header["model"]["tables"] == CODED:
        needed = f"{TRANSFORM_FEATURE} in the profile {COMPACT} and for tables coded by {CODED}"
        top.need(TRANSFORM_FEATURE in header["required_features"], "required_features", needed)
    check_sparse(
        top.record("model"),
        header["required_features"],
        allowed=profile == PAPER and header["model"]["tables"] != CODED,
    )
    _check_coordinates(top, shape)
    top.record("config")
    _check_training(top.record("training"))
    quality = top.record("quality")
    for key in QUALITY:
        quality.number_or_null(key)
    _check_bulk(quality)
    if quality.has("between") and quality.get("between") is not None:
        for key in BETWEEN:
            quality.record("between").number_or_null(key)
    if quality.has("steps"):
        for key in STEP_FIGURES:
            quality.record("steps").integers(key, shape[0] + 1, -MAX_LEVEL, MAX_LEVEL)
    _check_history(top.record("history"))


def _check_bulk(quality: Record) -> None:
    """Check the figures of the bulk, which may be missing or null."""
    if not quality.has("bulk") or quality.get("bulk") is None:
        return
    bulk = quality.record("bulk")
    bulk.number_or_null("psnr")
    low, high = bulk.numbers("range", 2)
    bulk.need(low <= high, "range", "two numbers, the lower first")


def check_format(top: Record) -> None:
    """Check the format of a header; raises UnsupportedFileError for one of another version."""
    if top.get("format") != FORMAT:
        raise DamagedFileError(
            f"header key format is {ascii(top.get('format'))[:40]}; '{FORMAT}' is needed"
        )
    major, minor = top.integers("format_version", 2, 0, 10_000)
    check_major(major, f"{major}.{minor}")
    features = top.texts("required_features")
    # Every variable has this list: a long one would be read as often.
    top.need(len(features) == len(set(features)), "required_features", "names that stand once")
    unknown = [name for name in features if name not in KNOWN_FEATURES]
    if unknown:
        raise UnsupportedFileError(
            f"the file needs the feature {unknown[0][:80]!a}, "
            "which this version does not know; upgrade"
        )


def _check_source(top: Record) -> np.dtype[Any]:
    """Check `encoder` and `variable`; the number type of the source."""
    encoder, variable = top.record("encoder"), top.record("variable")
    encoder.text("version")
    encoder.integer("seed", -(2**63), 2**64 - 1)
    encoder.number_or_null("seconds")
    encoder.number_or_null("took_seconds")
    if encoder.has("command"):
        encoder.text("command")
    if encoder.has("codec"):
        encoder.record("codec")
    if encoder.has("predicted"):
        predicted = encoder.record("predicted")
        for figure in ("seconds", "bytes", "psnr"):
            predicted.number_or_null(figure)
    variable.text("name")
    variable.text("units")
    dtype = DTYPES[variable.choice("dtype", tuple(DTYPES))]
    variable.record("attributes")
    if variable.has("fill"):
        variable.number("fill")
    if variable.has(NOT_STORED):
        _check_not_stored(variable.record(NOT_STORED))
    return dtype


def _check_not_stored(told: Record) -> None:
    """Check `variable.not_stored`."""
    told.need(0 <= told.number("share") <= 1, "share", "a number from 0 to 1")
    spans = told.get("steps")
    pairs = isinstance(spans, list) and all(
        isinstance(span, list) and len(span) == 2 and all(type(n) is int for n in span)
        for span in spans
    )
    told.need(
        pairs and all(0 <= first < end <= MAX_LENGTH for first, end in spans),
        "steps",
        "pairs of a step and the end of the run that it begins",
    )
    if told.has("fill"):
        told.number("fill")


def _check_values(top: Record, dtype: np.dtype[Any]) -> None:
    """Check `value_range` and `background` of a source of `dtype`."""
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


def _check_training(training: Record) -> None:
    training.get("seconds")  # must be there, if only as null
    training.number_or_null("seconds")
    training.integer("epochs", 0, MAX_LENGTH)
    training.text("device")
    if training.has("steps"):
        training.integer("steps", 0, MAX_LENGTH)
    if training.has("restarts"):
        training.integer("restarts", 0, MAX_LENGTH)
    training.number_or_null("learning_rate")


def _check_history(history: Record) -> None:
    """Check `history`: lists of numbers or null by name, as long as each other."""
    for key in HISTORY:
        if history.has(key):
            epochs = history.get("epoch")
            history.numbers_or_null(key, len(epochs) if isinstance(epochs, list) else 0)


def _box(top: Record, shape: Sequence[int]) -> list[int]:
    """Lengths (z, y, x) of the feature bounding box."""
    bounds = top.get("feature_bounding_box")
    top.need(
        isinstance(bounds, list) and len(bounds) == 3,
        "feature_bounding_box",
        "[[z0, z1], [y0, y1], [x0, x1]]",
    )
    for bound, length in zip(bounds, shape[1:], strict=True):
        is_pair = isinstance(bound, list) and len(bound) == 2 and all(type(n) is int for n in bound)
        top.need(
            is_pair and 0 <= bound[0] < bound[1] <= length,
            "feature_bounding_box",
            f"within the domain {list(shape)}",
        )
    return [high - low for low, high in bounds]


def _check_coordinates(top: Record, shape: Sequence[int]) -> None:
    """Check the positions that stand in the header; those of other axes are in arrays."""
    if top.has("coordinates"):
        coordinates = top.record("coordinates")
        for axis, length in zip(POSITIONS, shape, strict=True):
            if coordinates.has(axis):
                coordinates.need(
                    length <= MAX_RULED, axis, f"an array for more than {MAX_RULED} positions"
                )
                check_positions(coordinates.record(axis), length)


def _largest_decoded(source: np.dtype[Any]) -> float:
    """The largest value of the type that values of a source decode to.

    That type is float32 for sources of float32 and of at most 16 bits, else float64.
    """
    in_float32 = source.itemsize <= 2 or source == np.float32
    return float(np.finfo(np.float32 if in_float32 else np.float64).max)


def _check_model(
    model: Record, steps: int, box: Sequence[int], source: np.dtype[Any], *, plain: bool
) -> str:
    """Check `model`; the profile.

    Args:
        model: the object in the header.
        steps: of the domain.
        box: lengths (z, y, x) of the feature bounding box.
        source: number type of the source.
        plain: whether the file has the feature `plain`.
    """
    profile = model.text("profile")
    if profile not in KNOWN_PROFILES:
        known = ", ".join(KNOWN_PROFILES)
        raise UnsupportedFileError(
            f"header key model.profile is {profile[:40]!a}; this version knows {known}; upgrade"
        )
    if profile == PAPER:
        model.integer("fold", 2, MAX_LENGTH)
        model.integer("embedding_size", 1, MAX_EMBEDDING)
        model.integer("hidden_layers", 0, MAX_HIDDEN_LAYERS)
        model.integer("width", 1, MAX_WIDTH)
        model.integer("parameters", 1, MAX_PARAMETERS)
        model.choice("tables", TABLE_TYPES)
        model.number_or_null("tables_loss_db")
    else:
        model.integer("embedding_size", 1, 1)
        model.integer("parameters", 0, MAX_PARAMETERS)
        key = "values" if plain else "tables"
        tables = DTYPES[model.choice(key, tuple(DTYPES))]
        in_float32 = _largest_decoded(source) < np.finfo(np.float64).max
        model.need(
            not (in_float32 and tables == np.float64),
            key,
            f"no float64 for a source of {source}",
        )
        model.need(
            model.get("head") is None or isinstance(model.get("head"), Mapping),
            "head",
            "an object or null",
        )
        if model.has("tiling"):
            _check_tiling(model.record("tiling"))
    model.need(profile == COMPACT or not plain, "profile", f"{COMPACT} in a plain file")
    if plain:
        _check_plain(model)
    _check_levels(model, steps, box)
    model.need(
        profile == PAPER or plain or len(model.get("levels")) == 1,
        "levels",
        f"one level in the profile {COMPACT}",
    )
    return profile


def _check_tiling(tiling: Record) -> None:
    """Check `model.tiling`, each of whose keys may be missing."""
    for key in ("price", "region_ms"):
        tiling.number_or_null(key)
    if tiling.has("best"):
        tiling.integers("best", 4, 1, MAX_LENGTH)
    if tiling.has("tried"):
        tiling.integer("tried", 0, MAX_LENGTH)


def _check_levels(model: Record, steps: int, box: Sequence[int]) -> None:
    """Check `model.levels`: resolutions (t, z, y, x), the finest first, that of box and steps."""
    levels = model.get("levels")
    model.need(
        isinstance(levels, list) and 1 <= len(levels) <= MAX_LEVELS,
        "levels",
        f"1 to {MAX_LEVELS} of [t, z, y, x]",
    )
    finer: Sequence[int] = [MAX_LENGTH] * 4
    for level in levels:
        has_axes = (
            isinstance(level, list) and len(level) == 4 and all(type(n) is int for n in level)
        )
        fits = has_axes and all(1 <= n <= limit for n, limit in zip(level, finer, strict=True))
        model.need(
            fits, "levels", "[t, z, y, x] from finest to coarsest, none longer than the one before"
        )
        finer = level
    model.need(levels[0][1:] == list(box), "levels", f"the box {list(box)} at the finest level")
    model.need(
        levels[0][0] <= steps, "levels", f"at most the {steps} steps of the domain as key frames"
    )


def _check_plain(model: Record) -> None:
    """Check the keys of `model` that only a plain file of the profile compact has."""
    model.choice("tables", PLAIN_TABLE_TYPES)
    model.integers("tile", 4, 1, MAX_LENGTH)
    if model.get("head") is None:
        return
    model.need(model.get("tables") == "float32", "tables", "float32 where there is a head")
    head = model.record("head")
    hidden = head.get("hidden")
    count = len(hidden) if isinstance(hidden, list) else 0
    head.need(1 <= count <= MAX_HEAD_LAYERS, "hidden", f"1 to {MAX_HEAD_LAYERS} widths")
    head.integers("hidden", count, 1, MAX_HEAD_WIDTH)
    for key in ("sigma", "low", "high"):
        head.number(key)
    head.need(isinstance(head.get("cross"), bool), "cross", "true or false")
    head.need(not head.get("cross") or count == 2, "hidden", "2 widths of a head with a cross")


def brief(header: Mapping[str, Any]) -> dict[str, Any]:
    """A header without what `complete` puts back."""
    return _changed(_without, header)


def complete(header: Mapping[str, Any]) -> dict[str, Any]:
    """A header with all that was left out; what is there stays, of whatever form it is."""
    return _changed(_with, header)


def _changed(change: Change, header: Mapping[str, Any]) -> dict[str, Any]:
    """A header and its measured quality after `_without` or `_with`."""
    result = change(header, DEFAULTS)
    quality = result.get("quality")
    if isinstance(quality, dict) and "psnr" in quality:
        result["quality"] = change(quality, _of_quality(quality))
    return result


def _of_quality(quality: Mapping[str, Any]) -> dict[str, Any]:
    """The defaults of a measured quality, some of which follow from its figures."""
    same = {f"{name}_domain": quality[name] for name in DOMAIN_FIGURES if name in quality}
    return {**same, "ssim_window": SSIM_WINDOW}


def _without(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The values of an object other than its defaults."""
    result = {}
    for key, value in values.items():
        default = defaults.get(key, ...)
        if isinstance(default, dict) and isinstance(value, dict):
            value, default = _without(value, default), {}
        if value != default:
            result[key] = value
    return result


def _with(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """An object with its defaults in place of what it lacks."""
    result = dict(values)
    for key, default in defaults.items():
        value = result.setdefault(key, {} if isinstance(default, dict) else deepcopy(default))
        if isinstance(default, dict) and isinstance(value, dict):
            result[key] = _with(value, default)
    return result


def check_sparse(model: Record, required_features: Sequence[str], *, allowed: bool) -> None:
    """Check the key of the header's `model`, where it is there.

    Args:
        model: the object in the header.
        required_features: names of the header.
        allowed: whether the tables of the file are plain numbers of the profile paper.
    """
    if not model.has(SPARSE):
        return
    model.choice(SPARSE, (CORESET, FRINGE))
    model.need(allowed, SPARSE, "tables of plain numbers in the profile paper")
    model.need(
        SPARSE_FEATURE in required_features,
        SPARSE,
        f"the feature {SPARSE_FEATURE} in required_features",
    )
