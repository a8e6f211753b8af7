"""The reference decoder and the native one give the same bits, tile by tile."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import NUMBERS, Draw, arrays, looking
from rarely import rarely
from reporting import LONG
from specs import MIXES, spec_of
from tiles import predictor_of, random_head

from fhash_codec import EncodeConfig, FhashError, encode
from fhash_codec.selftest.run import cases
from fhash_formats.container import Container, StoredArray
from fhash_formats.transform.predict import encode_differences
from fhash_formats.transform.spec import MaskLevels, encode_block
from fhash_formats.transform.stream import ArrayAxes
from fhash_formats.transform.tile import Coding, decode_tile_mask, encode_chunk, encode_tile
from fhash_formats.transform.tile_format import DIFFERENCES, TileSettings, seal
from reference import predictor as reference_predictor
from reference.kernels import encode_predicted
from reference.tile import chunk_of, decode_tile

GOLDEN = Path(__file__).parents[1] / "golden"
MOST_VERTICES = 1 << 17 if LONG else 4000
"""Most vertices of a tile that is compared."""
MOST_TILES = 1000 if LONG else 1
"""Most tiles of an array that are compared."""


def equal(one: tuple[Any, Any], other: tuple[Any, Any]) -> bool:
    """Whether values have the same type and bits, and masks are the same; None is all occupied."""
    (values, mask), (others, other_mask) = one, other
    masks = [True if m is None else m for m in (mask, other_mask)]
    same_masks = np.array_equal(*np.broadcast_arrays(*masks, values)[:2])
    same_bits = np.ascontiguousarray(values).tobytes() == np.ascontiguousarray(others).tobytes()
    return values.dtype == others.dtype and same_bits and same_masks


def decoded(array: StoredArray, index: tuple[int, ...]) -> tuple[Any, Any]:
    """The values of a tile, and its mask where it may have one."""
    values = array.decode_chunk(index)
    return values, array._tiles.decode_masked(array.coded(index))[1] if array.masked else None


def differing(path: Path) -> Iterator[str | None]:
    """Names of the compared tiles where the decoders differ; None for each one that is equal."""
    with Container.open(path) as container:
        for name, array in container.arrays.items():
            shared = None if array.settings is None else array.settings.to_bytes()
            small = prod(array.chunk_shape) <= MOST_VERTICES
            if array.coding != "fhash.transform" or not small:
                continue
            axes = None if array.axes is None else array.axes.names
            shape = array.chunk_shape
            tile = shape if axes is None else ArrayAxes(axes).tile_shape(shape)
            for index in islice(product(*map(range, array.grid)), MOST_TILES):
                values, mask = decode_tile(bytes(array.coded(index)), tile, array.dtype, shared)
                mask = None if mask is None else chunk_of(mask, axes, shape)
                mine = chunk_of(values, axes, shape), mask
                yield None if equal(mine, decoded(array, index)) else f"{path.name}: {name} {index}"


def test_goldens() -> None:
    found = [tile for path in sorted(GOLDEN.glob("*.fhz")) for tile in differing(path)]
    assert len(found) > 20
    assert not any(found), [tile for tile in found if tile]


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", "int16", "uint64"])
@pytest.mark.parametrize("shape", [(2, 3, 5, 12), (1, 2, 9, 4), (1, 1, 30, 1), (1, 1, 1, 1)])
def test_differences(dtype: str, shape: tuple[int, int, int, int]) -> None:
    """Smooth values of a type, then decimals, values of float32, fills, and any bits."""
    t, z, y, x = np.indices(shape)
    smooth = (40 + np.sin(x / 9 + z) * np.cos(y / 7 + t) * 30).astype(dtype)
    several = [smooth, np.round(smooth, 1), smooth.astype(np.float16).astype(dtype)]
    several += [np.where(x % 5 > y % 7, several[0].dtype.type(fill), smooth) for fill in (0, 100)]
    if smooth.dtype.kind == "f":
        odd = np.resize([np.nan, -np.inf, -0.0, 3e-5, -7.25, np.nan, 6e4], shape).astype(dtype)
        several += [odd, np.where(x % 5 > y % 7, odd, smooth)]
    noise = np.random.default_rng(1).bytes(smooth.nbytes)
    several.append(np.frombuffer(noise, dtype).reshape(shape))
    for values in several:
        body = encode_differences(values)
        if body is not None:
            data = seal(DIFFERENCES, [body])
            theirs = decode_tile_mask(data, shape, values.dtype)
            assert equal(decode_tile(data, shape, values.dtype), theirs)
            assert theirs[0].tobytes() == values.tobytes()


@pytest.mark.parametrize("quality", [{"max_error_rel": 1e-3}, *rarely({"max_error": 0.0})])
def test_windows_of_hard_cases(quality: dict[str, float]) -> None:
    """A window from the middle of each series of the catalogue, as a chunk."""
    compared = 0
    for case in cases() if LONG else cases()[::8]:
        frames = np.stack(list(islice(case.make().frames(), 3)))
        middle = tuple(
            slice((n - m) // 2, None) for n, m in zip(frames.shape, (3, 5, 6, 9), strict=True)
        )
        window = np.ascontiguousarray(frames[middle][:3, :5, :6, :9])
        data = encode_chunk(window, **quality)
        theirs = decode_tile_mask(data, window.shape, window.dtype)
        assert equal(decode_tile(data, window.shape, window.dtype), theirs), case.name
        compared += 1
    assert compared > 15


@pytest.mark.filterwarnings("ignore::fhash_codec.FhashWarning")
@pytest.mark.skipif(not LONG, reason="takes minutes")
def test_hard_cases(tmp_path: Path) -> None:
    """Every series of the catalogue that the profile compact takes."""
    compared = 0
    for number, case in enumerate(case for case in cases() if case.refused is None):
        for config in (
            EncodeConfig(max_error_rel=1e-3, effort=2, tile="2x4x5x8"),
            EncodeConfig(psnr=50.0, effort=5, tile="2x4x5x8"),
        ):
            path = tmp_path / f"{number}-{config.effort}.fhz"
            try:
                encode(case.make(), path, config)
            except FhashError:  # such as a series without a finite value
                continue
            found = list(differing(path))
            compared += len(found)
            assert not any(found), (case.name, [tile for tile in found if tile])
    assert compared > 1000


SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 6), st.integers(1, 20))


@st.composite
def tiles(draw: Draw) -> tuple[Any, TileSettings, Coding, Any]:
    """A tile, settings for it with the model of signs, options of the encoder, and a mask."""
    shape, kind = draw(SHAPES), np.dtype(draw(st.sampled_from(NUMBERS)))
    random = np.random.default_rng(draw(st.integers(0, 999)))
    values = np.cumsum(random.normal(size=shape), axis=-1) * draw(st.sampled_from([0.1, 3.0, 30.0]))
    if kind.kind != "f":
        limits = np.iinfo(kind)
        values = np.clip(np.rint(8 * values), max(limits.min, -1e6), min(limits.max, 1e6))
    values = values.astype(kind)
    low, high = float(values.min()), float(values.max())
    error = (
        draw(st.sampled_from([None, 0.01, 0.2]))
        if kind.kind == "f"
        else draw(st.sampled_from([None, 0.0, 3.0]))
    )
    error = None if error is None else error * max(high - low, 1e-3) if kind.kind == "f" else error
    whole = 0.0 if error is None else 2 * int(error) + 1.0
    quantum = 0.0 if error is None else whole if kind.kind != "f" else 1.9 * error
    double, trellis = draw(st.booleans()), draw(st.booleans())
    step = max(error or 0.05 * (high - low), 1e-3) * draw(st.sampled_from([0.5, 2.0, 8.0]))
    masked = draw(st.booleans())
    edges = (low + 0.3 * (high - low),) if high > low else ()
    settings = TileSettings(
        transform=spec_of(draw(st.sampled_from(MIXES)), draw(st.integers(1, 4)), shape, step),
        step=step,
        center=float(np.float32((low + high) / 2)),
        low=low,
        high=high,
        offsets=(17, -10, -5, -3, -2, -1) if trellis else (-5, -1, 0, 1, 2, -3),
        double=double,
        quantum=quantum,
        head=None
        if double or draw(st.booleans())
        else random_head(low=float(np.float32(low)), high=float(np.float32(high))),
        mask=MaskLevels(
            edges=edges,
            scores=(3, 700)[: len(edges) + 1],
            others=draw(st.sampled_from([(), (90, 5)[: len(edges) + 1]])),
            reach=draw(st.integers(0, 2)),
        )
        if masked
        else None,
        predictor=predictor_of((1, 2, 2, 2), (0, 3, 1, 2), draw(st.integers(0, 2)), step=quantum)
        if quantum and draw(st.booleans())
        else None,
        clip=draw(st.booleans()),
        labels=draw(st.booleans()),
        trellis=trellis,
    )
    mask = random.random(shape) < 0.7 if masked else None
    if kind.kind == "f" and draw(st.booleans()):
        values[random.random(shape) < 0.05] = draw(st.sampled_from([np.nan, np.inf]))
    coding = Coding(
        weight=draw(st.sampled_from([0.0, 0.09])),
        error=error,
        own_settings=draw(st.booleans()),
        fast=draw(st.booleans()),
        cut=sum(
            draw(st.sampled_from([0, max(axis.depth, 1)])) << 4 * a
            for a, axis in enumerate(settings.transform.axes)
            if axis.kind != "klt"
        ),
    )
    return values, settings, coding, mask


@looking(30, 1500)
@given(tiles())
def test_tiles(drawn: tuple[Any, TileSettings, Coding, Any]) -> None:
    values, settings, coding, mask = drawn
    try:
        coded = encode_tile(values, settings, coding, in_coreset=mask)
    except FhashError:  # settings that do not go together
        return
    shared = None if coding.own_settings else settings
    block = shared.to_bytes() if shared else None
    mine = decode_tile(coded.data, values.shape, values.dtype, block)
    theirs = decode_tile_mask(coded.data, values.shape, values.dtype, shared)
    assert equal(mine, theirs)
    assert equal((mine[0], None), (coded.decoded, None))


@looking(30, 1000)
@given(
    values=arrays(dims=(4, 4), side=5),
    quality=st.sampled_from([{"max_error": 0.0}, {"max_error_rel": 0.01}, {"step": 0.3}]),
)
def test_chunks_of_any_numbers(values: Any, quality: dict[str, float]) -> None:
    data = encode_chunk(values, **quality)
    theirs = decode_tile_mask(data, values.shape, values.dtype)
    assert equal(decode_tile(data, values.shape, values.dtype), theirs)


@pytest.mark.parametrize("scale", [1e4, *rarely(1e2, 1e6)])
def test_predicted_integers_of_any_size(scale: float) -> None:
    """Predictions are summed in 32 bits where values are small: here they grow from row to row."""
    shape = (3, 4, 5, 29)
    growing = np.linspace(0.0, 3 * scale, shape[1] * shape[2]).reshape(1, *shape[1:3], 1)
    integers = np.random.default_rng(2).normal(0, 1 + growing, shape).astype(np.int32)
    ours = predictor_of((1, 1, 1, 2), (0, 3, 1, 2), 2)
    data, coded = encode_predicted(integers, None, ours)
    weights = encode_block(np.array(ours.weights, np.int32).reshape(1, 1, 1, -1))
    passes = reference_predictor.passes_of(ours.levels, ours.order, ours.reach, weights)
    theirs = reference_predictor.decode_predicted(data, shape, ours.levels, passes)
    np.testing.assert_array_equal(theirs, integers)
    np.testing.assert_array_equal(coded, integers)


@pytest.mark.parametrize("count", [3, 300])
def test_labels(count: int) -> None:
    random = np.random.default_rng(count)
    palette = random.integers(0, 1 << 31, count, np.int32)
    values = palette[np.repeat(random.integers(0, count, (2, 3, 5, 30)), 8, axis=3)]
    data = encode_chunk(values, max_error=0.0)
    assert data[4] & 7 == 2
    assert equal(decode_tile(data, values.shape, values.dtype), (values, None))
