"""Header of a container: its checks, what it leaves out, the positions in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.record import MAX_LENGTH, Record
from fhash_formats.errors import InputError, UnsupportedFileError
from fhash_formats.series import AXIS_NAMES, Coordinate
from fhash_formats.support.values import DTYPES, Double

MAX_LISTED = 1 << 20
"""Numbers of a list of positions, or of differences from a rule."""
MAX_NEARLY = 1024
"""Positions up to which rules are tried from which all differ a little; each try is a pass."""
MAX_ULPS = 99
"""Units in the last place by which a position but the last may differ from a written rule."""
ULPS_LIMIT = 2**52 - 1
"""Largest such difference that a reader takes."""
MAX_RULED = 1 << 26
"""Positions of a rule: 512 MiB. The limit keeps a few bytes from asking for more memory."""
NOT_FINITE = ("NaN", "Infinity", "-Infinity")
"""Texts of positions that are no numbers in JSON."""
TYPES = ("float64", "float32")
"""Number types that positions are rounded to; the first is the default."""

_DIGITS = (*range(1, 16), 17)
"""Numbers of significant decimal digits that guesses of a step are rounded to."""


def describe_coordinates(coords: Mapping[str, Coordinate]) -> dict[str, Any]:
    """The header's `coordinates`.

    coords: a coordinate for each of "t", "z", "y" and "x". Raises InputError for irregular
    positions beyond MAX_LISTED.
    """
    described = {}
    for axis, stored in AXIS_NAMES.items():
        coordinate = coords[axis]
        description = describe_positions(coordinate.values)
        if description is None:
            raise InputError(
                f"axis {axis} has {coordinate.values.size:,} irregular positions; a file has"
                f" {MAX_LISTED:,} at most: encode parts of it, or give it regular positions"
            )
        if coordinate.name != stored:
            description["name"] = coordinate.name
        if coordinate.attributes:
            description["attributes"] = dict(coordinate.attributes)
        if description:
            described[stored] = description
    return described


def described_coordinate(description: Mapping[str, Any], stored: str, length: int) -> Coordinate:
    """The coordinate that a description stands for, once `check_positions` has passed it.

    Args:
        description: the axis' object in the header.
        stored: name of the axis: "time", "z", "y" or "x".
        length: number of positions.
    """
    return Coordinate(
        name=description.get("name", stored),
        values=positions(description, length),
        attributes=description.get("attributes", {}),
    )


def shared_coordinates(entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Headers in which axes have the objects of the variables whose numbers stood there."""
    found = []
    for entry in entries:
        coordinates = dict(entry.get("coordinates", {}))
        for axis in POSITIONS:  # those that libfhash has looked at
            if type(number := coordinates.get(axis)) is int:
                coordinates[axis] = entries[number]["coordinates"][axis]
        found.append({**entry, "coordinates": coordinates})
    return found


def describe_positions(values: Double) -> dict[str, Any] | None:
    """The header's description of positions, float64 (n,); None where there is none.

    `positions` turns the description into the same positions, bit by bit; all NaN are one.
    """
    if not np.isfinite(values).all():
        texts = [value if np.isfinite(value) else _text(value) for value in values.tolist()]
        return {"values": texts} if values.size <= MAX_LISTED else None
    with np.errstate(over="ignore"):
        narrow = np.array_equal(values, values.astype(np.float32))
    kinds = TYPES if narrow else TYPES[:1]
    for kind, most in product(kinds if values.size <= MAX_RULED else (), (0, 1)):
        for start, step in _candidates(values, kind):
            rule = _moved_rule(values, start, step, kind)
            if rule is not None and len(rule.get("ulps", ())) <= most:
                return rule
    if values.size > MAX_LISTED:
        return None
    nearly = _nearly_ruled(values, kinds) if values.size <= MAX_NEARLY else None
    if nearly is not None:
        return nearly
    short = (
        {"values": [_shortest(value, "float32") for value in values], "dtype": "float32"}
        if narrow
        else {}
    )
    return (
        short
        if narrow and positions(short, values.size).tobytes() == values.tobytes()
        else {"values": values.tolist()}
    )


def _text(value: float) -> str:
    """The text of a number that is not finite."""
    return NOT_FINITE[0] if np.isnan(value) else NOT_FINITE[1 if value > 0 else 2]


def positions(description: Mapping[str, Any], length: int) -> Double:
    """The positions that a description stands for, float64 (length,).

    The description is one that `check_positions` has passed.
    """
    # A position beyond its type becomes an infinity; arrays of positions may hold infinities too.
    with np.errstate(over="ignore", invalid="ignore"):
        if "values" in description:
            values = np.array([float(value) for value in description["values"]], dtype=np.float64)
        else:
            values = np.arange(length, dtype=np.float64) * float(description.get("step", 1))
            values += float(description.get("start", 0))
        rounded = values.astype(description.get("dtype", "float64"))
        if "ulps" in description:
            ulps = np.array(description["ulps"], dtype=np.int64)
            rounded[-ulps.size :] = _moved(rounded[-ulps.size :], ulps)
        return rounded.astype(np.float64)


def check_positions(record: Record, length: int) -> None:
    """Raise DamagedFileError, naming the key, unless `record` describes `length` positions."""
    for key in ("start", "step"):
        if record.has(key):
            record.number(key)
    if record.has("dtype"):
        record.choice("dtype", TYPES)
    if record.has("values"):
        values = record.get("values")
        listed = isinstance(values, list) and len(values) == length <= MAX_LISTED
        record.need(listed, "values", f"a list of {length} positions, at most {MAX_LISTED}")
        finite = [value for value in values if value not in NOT_FINITE]
        good = all(type(value) in (int, float) for value in finite)
        record.need(good, "values", f"numbers, {', '.join(NOT_FINITE)}")
    else:
        record.need(length <= MAX_RULED, "step", f"of at most {MAX_RULED} positions")
    if record.has("ulps"):
        ulps = record.get("ulps")
        count = len(ulps) if isinstance(ulps, list) else 0
        most = min(length, MAX_LISTED)
        record.need(1 <= count <= most, "ulps", f"1 to {most} whole numbers")
        record.integers("ulps", count, -ULPS_LIMIT, ULPS_LIMIT)
        record.need(not record.has("values"), "ulps", "a rule, and no values")
    if record.has("name"):
        record.text("name")
    if record.has("attributes"):
        record.record("attributes")


def _nearly_ruled(values: Double, kinds: Sequence[str]) -> dict[str, Any] | None:
    """A rule and how far each position is from it, in units in the last place; None without one.

    Of several rules the one from which the fewest positions differ is taken.
    """
    if values.size < 3:
        return None
    best: dict[str, Any] | None = None
    for kind in kinds:
        first, last = _shortest(values[0], kind), _shortest(values[-1], kind)
        with np.errstate(over="ignore", invalid="ignore"):
            step = (last - first) / (values.size - 1)
            steps = [float(f"{step:.{digits - 1}e}") for digits in _DIGITS if np.isfinite(step)]
        for guess in dict.fromkeys([*steps, step]):
            rule = _moved_rule(values, first, guess, kind) if np.isfinite(guess) else None
            if rule is not None and (best is None or _differing(rule) < _differing(best)):
                best = rule
    return best


def _moved_rule(values: Double, start: float, step: float, kind: str) -> dict[str, Any] | None:
    """A rule and how far positions are from it, in units in the last place; None if too far."""
    rule: dict[str, Any] = {}
    if start != 0 or np.signbit(start):
        rule["start"] = _plain(start)
    if step != 1:
        rule["step"] = _plain(step)
    if kind != TYPES[0]:
        rule["dtype"] = kind
    ulps = _ordered(values.astype(kind)) - _ordered(positions(rule, values.size).astype(kind))
    if np.abs(ulps[:-1]).max(initial=0) > MAX_ULPS or abs(ulps[-1]) > ULPS_LIMIT:
        return None
    if ulps.any():
        rule["ulps"] = ulps[np.flatnonzero(ulps)[0] :].tolist()
    return rule if positions(rule, values.size).tobytes() == values.tobytes() else None


def _differing(rule: Mapping[str, Any]) -> int:
    """Number of positions that differ from a rule."""
    return int(np.count_nonzero(rule.get("ulps", ())))


def _ordered(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Whole numbers in the order of floats: neighbouring floats have neighbouring numbers."""
    whole = np.dtype(f"i{values.dtype.itemsize}")
    bits = values.view(whole).astype(np.int64)
    return np.where(bits < 0, int(np.iinfo(whole).min) - bits, bits)


def _moved(values: npt.NDArray[Any], ulps: npt.NDArray[np.int64]) -> npt.NDArray[Any]:
    """Floats moved by so many floats of their type towards larger ones, no farther than infinity.

    0 and -0 count as one float, and what is moved onto it is 0.
    """
    whole = np.dtype(f"i{values.dtype.itemsize}")
    end = int(_ordered(np.array([np.inf], dtype=values.dtype))[0])
    there = np.clip(_ordered(values) + ulps, -end, end)
    bits = np.where(there < 0, int(np.iinfo(whole).min) - there, there).astype(whole)
    return np.where(ulps == 0, values, bits.view(values.dtype))


def _candidates(values: Double, kind: str) -> Iterator[tuple[float, float]]:
    """Yield starts and steps that the source may have used, those of few digits first."""
    starts = list(dict.fromkeys((_shortest(values[0], kind), float(values[0]))))
    if values.size == 1:
        yield from ((start, 1.0) for start in starts)
        return
    first, last = _shortest(values[0], kind), _shortest(values[-1], kind)
    # Differences overflow at the ends of float64; guesses that are not finite are dropped below.
    with np.errstate(over="ignore", invalid="ignore"):
        guesses = [
            float(values[1] - values[0]),
            float((values[-1] - values[0]) / (values.size - 1)),
            (last - first) / (values.size - 1),
        ]
        # Each position bounds the step: it was rounded by at most half of its spacing. A further
        # guess is the middle of the steps that all positions allow for, with the last and
        # without it, since the last may not follow the rule.
        numbers = np.arange(1, values.size)
        spacing = np.spacing(values[1:].astype(kind)).astype(np.float64)
        low, high = (
            (values[1:] + sign * 0.5 * np.abs(spacing) - first) / numbers for sign in (-1, 1)
        )
        for end in {max(1, values.size - 2), values.size - 1}:
            guesses.append(float(low[:end].max() / 2 + high[:end].min() / 2))
    guesses = [guess for guess in guesses if np.isfinite(guess)]
    rounded = [float(f"{guess:.{digits - 1}e}") for digits in _DIGITS for guess in guesses]
    for step in dict.fromkeys([*rounded, *guesses]):
        # Most guesses fail at the second position, so that the whole rule need not be tried.
        for start in starts:
            with np.errstate(over="ignore"):
                second = np.dtype(kind).type(np.float64(start) + np.float64(step))
            if second == values[1] or values.size == 2:
                yield start, step


def _shortest(value: np.floating[Any] | float, kind: str) -> float:
    """The number with the fewest digits that `kind` rounds to the same value."""
    return float(str(np.dtype(kind).type(value)))


def _plain(value: float) -> float | int:
    """The number, as an int where it is whole: '.0' would cost two bytes of JSON."""
    negative_zero = value == 0 and np.signbit(value)
    is_whole = abs(value) < 2**53 and value == int(value) and not negative_zero
    return int(value) if is_whole else float(value)


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
LAYERS = "mlp/parameters"
SCALES = "scales"
"""Attribute of the layers in whole numbers: the scales of weight and bias of each in turn."""
"""Name of the array of all layers of a network of coded tables, in place of two of each."""
KNOWN_FEATURES = frozenset({TRANSFORM_FEATURE, PLAIN_FEATURE, SPARSE_FEATURE})
"""Names in `required_features` that this version understands."""
PAPER = "paper"
COMPACT = "compact"
KNOWN_PROFILES = (PAPER, COMPACT)
MLP = "mlp"
"""Key of the header: the MLP of the profile compact."""
TABLE = "table_1"
"""Name of the array of the finest table."""
BITS_ARRAY = "occupancy"
"""Name of the array of the occupancy as bits."""
CORESET_ARRAY = "coreset"
"""Name of the array of exact masks as tiles, beside which the occupancy is of blocks."""
MASK_FEATURES = 8
"""Largest number of features that the numbers of masks tell."""
MISSING_ARRAY = "missing"
"""Name of the array of the bits of vertices without a value."""
STEPS = "step_figures"
"""Name of the array of the figures of single steps, where they are not in the header."""
STEP_FIGURES = ("rmse", "max_abs_error")
"""Lists of `quality.steps`, and rows of this array."""
STEP_BYTES = 3
"""Bytes of a number in this array, the lowest first, each in a plane of its own."""
LOWEST = "lowest"
"""Attribute of this array: the first number of each list."""
TOGETHER = "together"
"""Attribute of this array, or key beside the lists: neighbouring steps of which each number is."""
POSITIONS = ("time", "z", "y", "x")
"""Names of the coordinates in a container, in the order of the axes."""
BETWEEN = "between"
"""Key of `model` in the profile compact: the rule between steps, and what its choice gains."""
LINEAR = "linear"
CUBIC = "cubic"
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
BETWEEN_QUALITY = (
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

DEFAULTS: dict[str, Any] = {
    "features": ["all"],
    "dilation": 1,
    "coreset_fraction": 1.0,
    "coordinates": {},
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
    dtype = _check_source(top)
    shape = top.record("domain").integers("shape", 4, 1, MAX_LENGTH)
    _check_values(top, dtype)
    box = _box(top, shape)
    top.need(bool(top.texts("features")), "features", "at least one")
    top.integer("dilation", 0, MAX_LENGTH)
    top.need(0 <= top.number("coreset_fraction") <= 1, "coreset_fraction", "a number from 0 to 1")
    plain = PLAIN_FEATURE in header["required_features"]
    profile = _check_model(top.record("model"), shape[0], box, dtype, plain=plain)
    if profile == COMPACT:
        top.get(MLP)
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
        for key in BETWEEN_QUALITY:
            quality.record("between").number_or_null(key)
    if quality.has("steps"):
        steps = quality.record("steps")
        together = steps.integer(TOGETHER, 1, MAX_LENGTH) if steps.has(TOGETHER) else 1
        for key in STEP_FIGURES:
            steps.integers(key, -(-shape[0] // together) + 1, -MAX_LEVEL, MAX_LEVEL)
    _check_history(top.record("history"))


def _check_bulk(quality: Record) -> None:
    """Check the figures of the bulk, which may be missing or null."""
    if not quality.has("bulk") or quality.get("bulk") is None:
        return
    bulk = quality.record("bulk")
    bulk.number_or_null("psnr")
    low, high = bulk.numbers("range", 2)
    bulk.need(low <= high, "range", "two numbers, the lower first")


def _check_source(top: Record) -> np.dtype[Any]:
    """Check `encoder` and `variable`; the number type of the source."""
    encoder, variable = top.record("encoder"), top.record("variable")
    encoder.text("version")
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
    training.number_or_null("saved")


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
    """Check the positions along the axes."""
    coordinates = top.record("coordinates")
    for axis, length in zip(POSITIONS, shape, strict=True):
        if coordinates.has(axis):
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
        if model.has("tiling"):
            _check_tiling(model.record("tiling"))
        if model.has(BETWEEN):
            between = model.record(BETWEEN)
            between.choice("rule", (LINEAR, CUBIC))
            between.number_or_null("gain_db")
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
    tiling.number_or_null("price")
    if tiling.has("tried"):
        tiling.integer("tried", 0, MAX_LENGTH)
    if tiling.has("coder"):
        tiling.choice("coder", ("fast",))


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
