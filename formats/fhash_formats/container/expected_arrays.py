"""The arrays that a valid header asks for, and checks that a container has them.

FORMAT.md lists the arrays of each profile in its section "Arrays". Arrays of other names are
allowed and ignored.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.container.array import ArrayMetadata
from fhash_formats.container.coding import TRANSFORM
from fhash_formats.container.header import (
    BITS_ARRAY,
    CODED,
    COMPACT,
    COUNTS,
    HEAD_CROSS,
    HEAD_INPUTS,
    LOWEST,
    MASK_ARRAY,
    MASK_FEATURES,
    MAX_LEVEL,
    MISSING_ARRAY,
    PAPER,
    PLAIN_FEATURE,
    PLAIN_TABLE_TYPES,
    POSITIONS,
    SPARSE,
    STEP_BYTES,
    STEP_FIGURES,
    STEPS,
    TRANSFORM_FEATURE,
)
from fhash_formats.container.record import Record
from fhash_formats.container.source_entry import check_source
from fhash_formats.errors import DamagedFileError

Expected = tuple[str, tuple[int, ...], tuple[str, ...]]
"""Name, shape and allowed number types of an array."""


def check_arrays(header: Mapping[str, Any], arrays: Mapping[str, ArrayMetadata]) -> None:
    """Check that the arrays are those that a valid header asks for.

    Raises DamagedFileError that names the first array that is missing or does not fit.
    """
    masked = MASK_ARRAY in arrays and header["model"]["profile"] == PAPER
    if SPARSE in header["model"] and MASK_ARRAY in arrays:
        raise DamagedFileError(
            f"array {MASK_ARRAY} is there in a file of sparse tables, which needs {BITS_ARRAY}"
        )
    if masked and len(header["features"]) > MASK_FEATURES:
        raise DamagedFileError(
            f"array {MASK_ARRAY} is there in a file of {len(header['features'])} features; "
            f"more than {MASK_FEATURES} need {BITS_ARRAY}"
        )
    for name, shape, dtypes in _required_arrays(header, arrays):
        if name == BITS_ARRAY and masked:
            continue
        if name not in arrays:
            raise DamagedFileError(f"array {name} is missing")
        _check_array(name, arrays[name], shape, dtypes)
        if name.startswith("tables/"):
            _check_table_attributes(name, arrays[name], header["model"])
    if PLAIN_FEATURE in header["required_features"]:
        _check_layers(arrays, header["model"])
    _check_codecs(header["required_features"], arrays)
    for name, shape, dtypes in _optional_arrays(header):
        if name in arrays:
            _check_array(name, arrays[name], shape, dtypes)
    if STEPS in arrays:
        attributes = Record(arrays[STEPS].attributes, f"array {STEPS} attribute ")
        attributes.integers(LOWEST, len(STEP_FIGURES), -MAX_LEVEL, MAX_LEVEL)
    for axis in POSITIONS:
        name = f"coords/{axis}"
        if name in arrays and "name" in arrays[name].attributes:
            Record(arrays[name].attributes, f"array {name} attribute ").text("name")
    check_source(header, arrays)


def check_key_frames(header: Mapping[str, Any], key_frames: npt.NDArray[np.int64]) -> None:
    """Raise DamagedFileError unless the key frames increase within the steps of the domain."""
    steps = header["domain"]["shape"][0]
    if key_frames[0] < 0 or key_frames[-1] >= steps or np.any(key_frames[1:] <= key_frames[:-1]):
        raise DamagedFileError(f"array key_frames does not increase within 0..{steps - 1}")


def occupancy_bytes(box: Sequence[Sequence[int]]) -> int:
    """Bytes of the occupancy of one key frame, in ragged Morton order over the feature box.

    Each axis of the box is filled up to a power of two, and each vertex has one bit.
    """
    return -(-prod(1 << (high - low - 1).bit_length() for low, high in box) // 8)


def layer_shapes(model: Mapping[str, Any]) -> list[tuple[int, int]]:
    """(outputs, inputs) of each layer of the network or the head, from the header's `model`."""
    if model.get("profile") == COMPACT:
        return _head_shapes(model["head"])
    widths = [
        len(model["levels"]) * model["embedding_size"],
        *[model["width"]] * model["hidden_layers"],
        1,
    ]
    return [(outputs, inputs) for inputs, outputs in pairwise(widths)]


def _head_shapes(head: Mapping[str, Any] | None) -> list[tuple[int, int]]:
    """(outputs, inputs) of each layer of a head; none without a head."""
    if head is None:
        return []
    inputs = [HEAD_INPUTS, *head["hidden"]]
    if head["cross"]:
        inputs[1] *= HEAD_CROSS
    return list(zip([*head["hidden"], 1], inputs, strict=True))


def _required_arrays(
    header: Mapping[str, Any], arrays: Mapping[str, ArrayMetadata]
) -> Iterator[Expected]:
    """Yield the arrays that a valid header asks for; levels count from 1, as in FORMAT.md.

    arrays: those of the file, whose attributes say the lengths of sparse tables.
    """
    model = header["model"]
    compact = model["profile"] == COMPACT
    described = header.get("coordinates", {})
    for axis, length in zip(POSITIONS, header["domain"]["shape"], strict=True):
        if axis not in described:
            yield f"coords/{axis}", (length,), ("float64",)
    key_frames = model["levels"][0][0]
    if key_frames < header["domain"]["shape"][0]:
        yield "key_frames", (key_frames,), ("int64",)
    if compact and PLAIN_FEATURE not in header["required_features"]:
        yield "tables/level_1", tuple(model["levels"][0]), (model["tables"],)
        return
    for number, level in enumerate(model["levels"], start=1):
        if model["tables"] == CODED:
            for component in range(1, model["embedding_size"] + 1):
                yield f"tables/level_{number}/component_{component}", tuple(level), ("float32",)
            continue
        name, size = f"tables/level_{number}", model["embedding_size"]
        sparse = SPARSE in model
        shape = _sparse_shape(name, level, size, arrays) if sparse else (*level, size)
        yield name, shape, (model["tables"],)
    for number, (outputs, inputs) in enumerate(layer_shapes(model), start=1):
        yield f"mlp/weight_{number}", (outputs, inputs), ("float32",)
        yield f"mlp/bias_{number}", (outputs,), ("float32",)
    # The profile compact merges its features.
    features = 1 if compact else len(header["features"])
    size = occupancy_bytes(header["feature_bounding_box"])
    yield BITS_ARRAY, (features, key_frames, size), ("uint8",)


def _sparse_shape(
    name: str, level: Sequence[int], embedding_size: int, arrays: Mapping[str, ArrayMetadata]
) -> tuple[int, ...]:
    """The shape that the array of a sparse table must have, by its counts.

    Args:
        name: of the array.
        level: vertices (t, z, y, x) of the level.
        embedding_size: numbers at each vertex.
        arrays: all arrays of the file.

    Raises DamagedFileError where the counts do not fit the level.
    """
    if name not in arrays:
        raise DamagedFileError(f"array {name} is missing")
    attributes = Record(arrays[name].attributes, f"array {name} attribute ")
    counts = attributes.integers(COUNTS, level[0], 0, prod(level[1:]))
    return sum(counts), embedding_size


def _optional_arrays(header: Mapping[str, Any]) -> Iterator[Expected]:
    """Yield the arrays that may be left out, and are checked where they are there."""
    model, steps = header["model"], header["domain"]["shape"][0]
    for axis, length in zip(POSITIONS, header["domain"]["shape"], strict=True):
        yield f"coords/{axis}", (length,), ("float64",)
    yield "key_frames", (model["levels"][0][0],), ("int64",)
    if model["profile"] == COMPACT:
        yield "corrections", tuple(model["levels"][0]), PLAIN_TABLE_TYPES
    else:
        yield MASK_ARRAY, tuple(model["levels"][0]), ("uint8",)
    yield STEPS, (STEP_BYTES, len(STEP_FIGURES), steps), ("uint8",)
    yield MISSING_ARRAY, (steps, -(-prod(header["domain"]["shape"][1:]) // 8)), ("uint8",)


def _check_array(
    name: str, array: ArrayMetadata, shape: tuple[int, ...], dtypes: tuple[str, ...]
) -> None:
    if array.shape != shape or array.dtype.name not in dtypes:
        raise DamagedFileError(
            f"array {name} is {array.dtype.name} {array.shape}; "
            f"the header asks for {' or '.join(dtypes)} {shape}"
        )


def _check_table_attributes(name: str, table: ArrayMetadata, model: Mapping[str, Any]) -> None:
    """Check the attributes without which the numbers of a table mean nothing."""
    attributes = Record(table.attributes, f"array {name} attribute ")
    if table.dtype == np.uint8 and model["profile"] == PAPER:
        attributes.number("offset")
        attributes.need(attributes.number("scale") >= 0, "scale", "at least 0")
    if model["tables"] == CODED:
        attributes.numbers("mixing", model["embedding_size"])


def _check_layers(arrays: Mapping[str, ArrayMetadata], model: Mapping[str, Any]) -> None:
    """Check the units of the weights and biases of a plain head."""
    for number in range(1, len(layer_shapes(model)) + 1):
        for kind in ("weight", "bias"):
            name = f"mlp/{kind}_{number}"
            unit = Record(arrays[name].attributes, f"array {name} attribute ")
            unit.need(unit.number("scale") > 0, "scale", "above 0")


def _check_codecs(required_features: Sequence[str], arrays: Mapping[str, ArrayMetadata]) -> None:
    """Check that the header requires the feature of the codecs of the arrays."""
    if TRANSFORM_FEATURE in required_features:
        return
    for name, array in arrays.items():
        if array.sharding is not None or array.coding == TRANSFORM:
            raise DamagedFileError(
                f"array {name} has codecs of the feature {TRANSFORM_FEATURE}, "
                "which the header does not require"
            )
