"""The start of the fuzzer: setups with which Python calls the native decoders, and first inputs.

Some inputs are coded here, others are tiles of the golden containers.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections import Counter
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from reference.kernels import (
    Table,
    blank_predicted_state,
    encode_integers,
    encode_labels,
    encode_mask,
    encode_predicted,
    fast_prior,
    mask_prior_state,
    of_two_quantisers,
    pass_arrays,
    prior_state,
    single_band,
)
from reference.transforms import band_table

from fhash_formats.container import Container
from fhash_formats.container.array import TRANSFORM
from fhash_formats.transform.predict import Predictor, passes_of
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile_format import TRANSFORMED, TileSettings, parse_stream

GOLDENS = Path(__file__).parents[2] / "golden"
NAMES = (
    "coder",
    "mask",
    "predictor",
    "transforms",
    "head",
    "values",
    "encode",
    "light",
    "labels",
    "label-encoder",
    "training",
    "figures",
    "slopes",
    "samples",
    "points",
    "tile",
    "file",
    "march",
)
"""Names of the targets. The place of a name is the first byte of its inputs in targets.cpp."""
CODER, MASK, PREDICTOR, _, _, _, ENCODE, _, LABELS, *_, TILE, FILE, _ = range(len(NAMES))
PLAIN, TRELLIS, FAST, FAST_TRELLIS = range(4)
"""Ways to code integers, as inputs of the coder name them."""
WITH_SEEDS = (CODER, PREDICTOR)
"""Targets that have seeds of their own only; those of all others are random bytes, too."""

SPECS: tuple[tuple[tuple[str, int], ...], ...] = (
    (("none", 0),) * 4,
    (("haar", 1), ("5/3", 1), ("9/7", 2), ("9/7", 2)),
    (("haar", 2), ("none", 0), ("5/3", 1), ("9/7", 3)),
    (("9/7", 10), ("9/7", 10), ("9/7", 10), ("9/7", 10)),
    (("none", 0), ("haar", 3), ("none", 0), ("5/3", 5)),
)
SHAPES = (
    (1, 1, 1, 1),
    (2, 3, 4, 5),
    (1, 1, 1, 40),
    (5, 1, 7, 3),
    (3, 6, 9, 17),
    (1, 4, 16, 33),
    (11, 2, 1, 2),
)
PREDICTORS = (
    ((0, 0, 0, 0), 0),
    ((1, 1, 1, 1), 1),
    ((2, 3, 3, 3), 2),
    ((0, 0, 2, 3), 2),
    ((8, 0, 1, 8), 1),
    ((1, 0, 0, 0), 0),
)


def write_setups(path: Path) -> tuple[list[Any], list[Any]]:
    """Write the file that setups.hpp reads.

    Returns the bands as (shape, table) and the passes as (shape, Predictor), in their order there.
    """
    tables = [(shape, single_band(shape)) for shape in SHAPES]
    tables += [(shape, band_table(_spec(axes), shape)) for axes in SPECS for shape in SHAPES]
    for _, settings, shape in golden_streams():
        if np.prod(shape) < 1 << 14:
            tables += [
                (shape, band_table(settings.transform, shape)),
                (shape, single_band(shape)),
            ]
    # Many tiles of the goldens have the same bands.
    bands = list({(shape, table.tobytes()): (shape, table) for shape, table in tables}.values())
    passes = [
        (shape, _predictor(levels, order, reach))
        for levels, reach in PREDICTORS
        for shape, order in _orders()
    ]
    passes += [
        (shape, settings.predictor)
        for _, settings, shape in golden_streams()
        if settings.predictor is not None
    ]
    with path.open("wb") as file:

        def put(array: npt.NDArray[Any]) -> None:
            data = np.ascontiguousarray(array).tobytes()
            file.write(struct.pack("<q", len(data)) + data)

        for state in (
            prior_state(False),
            prior_state(True),
            mask_prior_state(),
            blank_predicted_state(),
        ):
            for array in (state.slots, state.weights, state.simples):
                put(array)
        for array in (fast_prior().slots, fast_prior().defaults, fast_prior().lookup):
            put(array)
        file.write(struct.pack("<q", len(bands)))
        for shape, table in bands:
            put(np.array(shape, np.int64))
            put(table)
        file.write(struct.pack("<q", len(passes)))
        for shape, predictor in passes:
            rows, taps, _ = pass_arrays(predictor)
            levels = np.array(predictor.levels, np.int64)
            for array in (np.array(shape, np.int64), levels, rows, taps):
                put(array)
    return bands, passes


def write_seeds(
    folder: Path,
    bands: list[Any],
    passes: list[Any],
    every: int = 1,
    only: str | None = None,
) -> int:
    """Write the inputs, one file each, and return their number.

    With `every`, only every so many inputs of each target are written, with `only` those of one
    target.
    """
    folder.mkdir(parents=True, exist_ok=True)
    numbers, turns = count(), Counter[int]()
    rng = np.random.default_rng(0)

    def put(target: int, *parts: bytes) -> None:
        turns[target] += 1
        if only in (None, NAMES[target]) and (turns[target] - 1) % every == 0:
            (folder / f"{next(numbers):04}").write_bytes(bytes([target]) + b"".join(parts))

    for number, (shape, table) in enumerate(bands):
        for scale in (0.5, 30.0, 1e8):
            integers = (rng.laplace(0, scale, shape)).astype(np.int32)
            scaled = (rng.laplace(0, scale, shape)).clip(-9e8, 9e8)
            path = of_two_quantisers(integers.clip(-(1 << 28), 1 << 28), table)
            for how, coded in ((PLAIN, integers), (TRELLIS, path), (FAST, integers)):
                trellis, fast = how == TRELLIS, how == FAST
                data = encode_integers(coded, table, trellis=trellis, fast=fast).data
                put(CODER, struct.pack("<HB", number, how), data)
            chosen = encode_integers(
                integers, table, scaled=scaled.astype(np.float32), trellis=True, fast=True
            )
            put(CODER, struct.pack("<HB", number, FAST_TRELLIS), chosen.data)
    for number, (shape, predictor) in enumerate(passes):
        weights = np.array(predictor.weights, np.int16).tobytes()
        smooth = np.cumsum(rng.integers(-3, 4, shape), axis=-1)
        for integers in (smooth, rng.integers(-(1 << 20), 1 << 20, shape)):
            put(
                PREDICTOR,
                struct.pack("<H", number),
                weights,
                encode_predicted(integers.astype(np.int32), None, predictor)[0],
            )
    setup_of_bands = {
        (shape, table.tobytes()): number
        for number, (shape, table) in reversed(list(enumerate(bands)))
    }
    for stream, settings, shape in golden_streams():
        for data, table, how in coded_sections(stream, settings, shape):
            setup = setup_of_bands.get((shape, table.tobytes()))
            if setup is not None:
                put(CODER, struct.pack("<HB", setup, how), data)
        # Decoded in all ways, with settings beside the stream.
        for how in (0, 2, 9, 7):
            packed = settings.to_bytes()
            if len(packed) < 4096 and max(shape) <= 64:
                of = bytes([how, *(n - 1 for n in shape), 9])
                put(TILE, of, struct.pack("<H", len(packed)), packed, stream)
    for shape in ((1, 1, 1, 3), (2, 3, 5, 17), (4, 8, 8, 24)):
        nothing = (np.zeros(shape, np.uint8),) * 2
        for density in (0.02, 0.5):
            coded = encode_mask(rng.random(shape) < density, nothing)
            put(MASK, bytes([*(n - 1 for n in shape), 0]), coded)
    for shape, labels, data in label_streams():
        put(LABELS, bytes([*(n - 1 for n in shape)]), struct.pack("<H", labels - 1), data)
    for path in sorted(GOLDENS.glob("*.fhz")):
        put(FILE, b"\x03", _stored(path))
    for target in range(len(NAMES)):
        if target in WITH_SEEDS:
            continue
        for _ in range(96 if target == ENCODE else 24):
            put(target, rng.bytes(400))
        put(target, bytes(300))
    return next(numbers)


def label_streams() -> Iterator[tuple[tuple[int, ...], int, bytes]]:
    """Yield shapes, numbers of labels and coded labels: regions, noise and both."""
    rng = np.random.default_rng(1)
    for shape in ((1, 1, 1, 3), (2, 3, 5, 17), (3, 4, 6, 40)):
        regions = np.indices(shape).sum(0) // 5
        # More than 256 are those whose upper byte is odd (target_coding.cpp).
        for most in (1, 2, 5, 17, 256, 257, 300, 65536):
            for noise in (0.0, 0.05, 1.0):
                random = rng.integers(0, most, shape)
                labels = np.where(rng.random(shape) < noise, random, regions % most)
                yield shape, most, encode_labels(labels.astype(np.uint16), most)


def golden_streams() -> Iterator[tuple[bytes, TileSettings, tuple[int, int, int, int]]]:
    """Yield each coded tile of the goldens with its settings and shape."""
    for path in sorted(GOLDENS.glob("*.fhz")):
        with Container.open(path) as container:
            for array in container.arrays.values():
                if array.coding != TRANSFORM:
                    continue
                t, z, y, x = (
                    (1,) * (4 - len(array.chunk_shape)) + array.chunk_shape
                    if array.axes is None
                    else array.axes.tile_shape(array.chunk_shape)
                )
                for index in np.ndindex(*array.grid):
                    stream = bytes(array.coded(index))
                    own = parse_stream(stream).settings
                    settings = array.settings if own is None else TileSettings.from_bytes(own)
                    if settings is not None:  # else the stream has no coded integers
                        yield stream, settings, (t, z, y, x)


def coded_sections(
    stream: bytes, settings: TileSettings, shape: tuple[int, ...]
) -> Iterator[tuple[bytes, Table, int]]:
    """Yield the coded integers of a tile: bytes, bands, and how they are coded."""
    parts = parse_stream(stream)
    plain = FAST if parts.fast else PLAIN
    if parts.kind == TRANSFORMED and parts.body is not None:
        table = band_table(settings.transform, shape)
        yield bytes(parts.body), table, plain + TRELLIS if settings.trellis else plain
    if parts.residual is not None:
        yield bytes(parts.residual), single_band(shape), plain


def _spec(axes: tuple[tuple[str, int], ...]) -> TransformSpec:
    t, z, y, x = (AxisTransform(kind=kind, depth=depth) for kind, depth in axes)
    return TransformSpec(axes=(t, z, y, x))


def _orders() -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    return [
        (shape, (3, 2, 1, 0) if number % 2 else (0, 1, 2, 3)) for number, shape in enumerate(SHAPES)
    ]


def _predictor(levels: tuple[int, ...], order: tuple[int, ...], reach: int) -> Predictor:
    taps = sum(len(a_pass.taps) for a_pass in passes_of(levels, order, reach))  # type: ignore[arg-type]
    weights = tuple(int(weight) for weight in np.random.default_rng(taps).integers(-600, 600, taps))
    return Predictor(step=1.0, origin=0.0, levels=levels, order=order, reach=reach, weights=weights)  # type: ignore[arg-type]


def _stored(path: Path) -> bytes:
    """A container whose documents are not deflated, so that mutations change their text.

    The target mends the digest in the comment.
    """
    target = io.BytesIO()
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w") as copy:
        for name in source.namelist():
            info = zipfile.ZipInfo(name)  # of 1980, as members are
            info.create_system, info.external_attr = 3, 0x81A40000
            copy.writestr(info, source.read(name))
        copy.comment = source.comment
    return target.getvalue()
