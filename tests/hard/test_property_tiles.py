"""Laws of tiles, transforms and labels, for any values."""

from __future__ import annotations

import json
import math
from fractions import Fraction

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from properties import NUMBERS, Draw, arrays, looking, same
from reference.kernels import (
    MAX_INTEGER,
    decode_integers,
    decode_labels,
    encode_integers,
    encode_labels,
    single_band,
)
from reference.sections import labelled_stream
from reference.transforms import Transform, band_table

from fhash_formats.errors import InputError
from fhash_formats.transform.numcodecs_codec import NumcodecsTransform
from fhash_formats.transform.spec import (
    KINDS,
    MAX_LABELS,
    WAVELETS,
    AxisTransform,
    MaskLevels,
    TransformSpec,
    decode_block,
    encode_block,
    fit_basis,
)
from fhash_formats.transform.tile import (
    Coding,
    decode_chunk,
    decode_tile,
    decode_tile_mask,
    encode_chunk,
    encode_tile,
)
from fhash_formats.transform.tile_format import TileSettings

pytestmark = pytest.mark.hard


@st.composite
def specs(draw: Draw, shape: tuple[int, ...]) -> TransformSpec:
    """Draw a transform of any kinds and depths that fits a tile."""
    axes = []
    for length in shape:
        kind = draw(st.sampled_from(KINDS))
        if kind == "klt":
            columns = np.cumsum(
                np.random.default_rng(draw(st.integers(0, 9))).standard_normal(
                    (length, 4 * length)
                ),
                axis=0,
            )
            axes.append(
                AxisTransform(
                    kind=kind,
                    basis=fit_basis(columns @ columns.T, draw(st.sampled_from([1e-3, 1.0, 8.0]))),
                )
            )
        else:
            axes.append(
                AxisTransform(kind=kind, depth=draw(st.integers(1, 10)) if kind in WAVELETS else 0)
            )
    t, z, y, x = axes
    return TransformSpec(axes=(t, z, y, x))


TILES = hnp.array_shapes(min_dims=4, max_dims=4, min_side=1, max_side=9)


@looking(60)
@given(
    shape=TILES,
    dtype=st.sampled_from(["float32", "float64"]),
    power=st.integers(-90, 90),
    kind=st.sampled_from(["noise", "constant", "step", "spike", "checkerboard", "ramp"]),
    data=st.data(),
)
def test_any_tile_of_any_size_of_values_comes_back(
    shape: tuple[int, ...], dtype: str, power: int, kind: str, data: Draw
) -> None:
    """The error is relative to the largest value, so it does not depend on the magnitude of the
    numbers."""
    spec = data.draw(
        specs(shape).filter(
            lambda spec: all(
                axis.basis is None or axis.basis.rank == axis.basis.n for axis in spec.axes
            )
        )
    )
    t, z, y, x = np.meshgrid(*map(np.arange, shape), indexing="ij")
    values = {
        "noise": np.random.default_rng(0).standard_normal(shape),
        "constant": np.ones(shape),
        "step": np.where(x + y > shape[3] // 2, 1.0, -1.0),
        "spike": (np.arange(math.prod(shape)) == math.prod(shape) // 2).reshape(shape) * 1.0,
        "checkerboard": 1.0 - 2 * ((t + z + y + x) % 2),
        "ramp": 0.1 * (t + 2.0 * z - y + 3 * x),
    }[kind]
    values = np.ldexp(values, power).astype(dtype)
    transform = Transform(spec, shape, np.dtype(dtype))
    again = transform.inverse(transform.forward(values))
    largest = float(np.abs(values).max())
    error = float(np.abs(again.astype(np.float64) - values).max())
    assert error <= (2e-4 if dtype == "float32" else 1e-11) * largest


@looking(60)
@given(shape=TILES, data=st.data())
def test_a_transform_is_what_its_json_says(shape: tuple[int, ...], data: Draw) -> None:
    spec = data.draw(specs(shape))
    if any(axis.basis is not None for axis in spec.axes):  # stands in settings as bytes alone
        with pytest.raises(InputError, match="is no JSON value"):
            spec.to_dict()
        return
    again = TransformSpec.from_dict(json.loads(json.dumps(spec.to_dict())))
    values = np.random.default_rng(0).standard_normal(shape)
    assert again.to_dict() == spec.to_dict()
    assert same(
        Transform(again, shape, np.float64).forward(values),
        Transform(spec, shape, np.float64).forward(values),
    )


INTEGERS = hnp.arrays(
    np.int32,
    hnp.array_shapes(min_dims=4, max_dims=4, min_side=1, max_side=7),
    elements=st.one_of(st.integers(-3, 3), st.integers(-MAX_INTEGER, MAX_INTEGER)),
    fill=st.just(0),
)


@looking(80)
@given(integers=INTEGERS, data=st.data())
def test_any_integers_in_any_bands_come_back(integers: np.ndarray, data: Draw) -> None:
    table = band_table(data.draw(specs(integers.shape)), integers.shape)
    encoded = encode_integers(integers, table)
    again = decode_integers(encoded.data, integers.shape, table)
    kept = np.zeros_like(integers)
    for row in table:
        box = tuple(slice(int(low), int(high)) for low, high in zip(row[:4], row[4:8], strict=True))
        kept[box] = integers[box]
    assert (again == kept).all()


@looking(60)
@given(
    integers=hnp.arrays(
        np.int32,
        hnp.array_shapes(min_dims=4, max_dims=4, min_side=0, max_side=5),
        elements=st.integers(-999, 999),
    )
)
def test_a_block_comes_back(integers: np.ndarray) -> None:
    assert (decode_block(encode_block(integers), integers.shape) == integers).all()
    if integers.size:
        assert (
            decode_integers(encode_block(integers), integers.shape, single_band(integers.shape))
            == integers
        ).all()


def gap(one: np.ndarray, other: np.ndarray) -> Fraction:
    """Return the largest difference of the finite values, exactly."""
    return max(
        (abs(Fraction(a) - Fraction(b)) for a, b in zip(one.tolist(), other.tolist(), strict=True)),
        default=Fraction(0),
    )


@looking(150)
@given(
    values=arrays(dims=(0, 6), side=5),
    bound=st.one_of(st.just(0.0), st.floats(0, 1e300), st.sampled_from([1e-9, 0.5, 3.0, 1e5])),
)
@example(values=np.array([1e8, 1e8 + 1e-3]), bound=1e-4)
@example(values=np.array([-(2**63), 2**63 - 1], dtype=np.int64), bound=0.0)
@example(values=np.array([5e-324, -5e-324, 0.0]), bound=0.0)
@example(values=np.array([-0.0, 0.0]), bound=0.0)
def test_any_chunk_keeps_its_bound_strictly(values: np.ndarray, bound: float) -> None:
    decoded = decode_chunk(encode_chunk(values, max_error=bound), values.shape, values.dtype)
    assert decoded.dtype == values.dtype
    assert decoded.shape == values.shape
    if bound == 0:
        assert same(decoded, values)
        return
    finite = np.isfinite(values) if values.dtype.kind == "f" else np.ones(values.shape, bool)
    assert same(decoded[~finite], values[~finite])
    assert gap(decoded[finite], values[finite]) <= Fraction(bound)


@looking(80)
@given(
    values=arrays(dims=(1, 4), side=6),
    share=st.floats(1e-7, 1),
    padding=st.lists(st.integers(0, 3), min_size=4, max_size=4),
    fill=st.sampled_from([0, 1, 100]),
    codec=st.booleans(),
)
@example(
    values=np.arange(2**63 - 9, 2**63), share=0.3, padding=[2] * 4, fill=0, codec=True
)  # far from the padding
def test_any_chunk_keeps_its_relative_bound(
    values: np.ndarray, share: float, padding: list[int], fill: int, codec: bool
) -> None:
    """The range is that of the values without those that a store has put behind them."""
    ends = [(0, more) for more in padding[: values.ndim]]
    whole = np.pad(values, ends, constant_values=fill)
    if codec:
        numcodec = NumcodecsTransform(max_error_rel=share)
        decoded = numcodec.decode(numcodec.encode(whole))
    else:
        data = encode_chunk(whole, max_error_rel=share)
        decoded = decode_chunk(data, whole.shape, whole.dtype)
    kept = np.isfinite(whole)
    assert not kept.any() or decoded[kept].max() <= whole[kept].max()
    assert not kept.any() or decoded[kept].min() >= whole[kept].min()
    decoded = decoded[tuple(slice(0, n) for n in values.shape)]
    finite = np.isfinite(values)
    assert same(decoded[~finite], values[~finite])
    exact = [Fraction(value) for value in values[finite].tolist()]
    if exact:
        span = max(exact) - min(exact)
        assert gap(decoded[finite], values[finite]) <= Fraction(share) * span * Fraction(1 + 1e-9)


@looking(60)
@given(values=arrays(dims=(1, 4), side=6), step=st.floats(1e-6, 1e6))
def test_the_same_chunk_gives_the_same_bytes(values: np.ndarray, step: float) -> None:
    first = encode_chunk(values, step=step)
    assert encode_chunk(np.asfortranarray(values), step=step) == first
    assert encode_chunk(values.astype(values.dtype.newbyteorder()), step=step) == first
    decode_chunk(first, values.shape, values.dtype)


_T, _Z, _Y, _X = (AxisTransform(kind="5/3", depth=1) for _ in range(4))
SPEC = TransformSpec(axes=(_T, _Z, _Y, _X))
SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 4), st.integers(1, 20))


@st.composite
def labels(draw: Draw) -> tuple[npt.NDArray[np.uint16], int]:
    """Draw labels in regions, of which some are random, and their number."""
    shape, count = draw(SHAPES), draw(st.integers(1, MAX_LABELS))
    lengths = draw(st.tuples(*(st.integers(1, 20) for _ in shape)))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    places = np.indices(shape) // np.array(lengths).reshape(4, 1, 1, 1, 1)
    regions = (places * np.array([7, 5, 3, 1]).reshape(4, 1, 1, 1, 1)).sum(0) % count
    alone = random.random(shape) < draw(st.sampled_from([0.0, 0.1, 1.0]))
    return np.where(alone, random.integers(0, count, shape), regions).astype(np.uint16), count


@looking(20)
@given(drawn=labels())
def test_any_labels_come_back(
    drawn: tuple[npt.NDArray[np.uint16], int],
) -> None:
    source, count = drawn
    data = encode_labels(source, count)
    np.testing.assert_array_equal(decode_labels(data, count, source.shape), source)


@looking(60)
@given(
    dtype=st.sampled_from(NUMBERS),
    shape=SHAPES,
    masked=st.booleans(),
    own=st.booleans(),
    data=st.data(),
)
def test_tiles_of_any_few_bits_come_back(
    dtype: str, shape: tuple[int, ...], masked: bool, own: bool, data: Draw
) -> None:
    kind = np.dtype(dtype)
    unsigned = np.dtype(f"u{kind.itemsize}")
    palette = data.draw(hnp.arrays(unsigned, st.integers(1, 40)))
    random = np.random.default_rng(data.draw(st.integers(0, 99)))
    values = palette[random.integers(0, len(palette), shape)].view(kind)
    settings = TileSettings(
        transform=SPEC,
        step=1.0,
        center=0.0,
        low=0.0,
        high=1.0,
        labels=True,
        mask=MaskLevels() if masked else None,
    )
    occupied = random.random(shape) < 0.7 if masked else None
    stream = labelled_stream(values, settings if own else None, occupied)
    assert stream is not None
    decoded, mask = decode_tile_mask(stream, shape, kind, None if own else settings)  # type: ignore[arg-type]
    counted = np.ones(shape, bool) if occupied is None else occupied
    np.testing.assert_array_equal(mask, counted)
    assert decoded[counted].tobytes() == values[counted].tobytes()


@looking(60)
@given(
    dtype=st.sampled_from(["int8", "uint16", "int32", "float16", "float32", "float64"]),
    shape=SHAPES,
    power=st.integers(-8, 8),
    share=st.sampled_from([1e-3, 0.02, 0.3, 0.9]),
    data=st.data(),
)
def test_clipped_values_lie_in_their_range_and_bound(
    dtype: str, shape: tuple[int, ...], power: int, share: float, data: Draw
) -> None:
    kind = np.dtype(dtype)
    random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    values = random.normal(size=shape) * 2.0**power
    if kind.kind != "f":
        values = np.clip(values * 64, *(np.iinfo(kind).min, np.iinfo(kind).max))
    values = values.astype(kind)
    low, high = float(values.min()), float(values.max())
    error = max(share * (high - low), 0.0 if kind.kind == "f" else 1.0)
    whole = kind.kind != "f"
    settings = TileSettings(
        transform=SPEC,
        # Coarse steps leave much to the residual, which alone can pass the ends of the range.
        step=max(error, 1e-30) * data.draw(st.sampled_from([1, 5, 20])),
        center=(low + high) / 2,
        low=low,
        high=high,
        quantum=2 * int(error) + 1.0 if whole else 1.9 * error,
        clip=True,
        double=kind.itemsize > 2,
    )
    coded = encode_tile(values, settings, Coding(error=error))
    decoded = decode_tile(coded.data, shape, kind, settings)  # type: ignore[arg-type]
    assert decoded.tobytes() == coded.decoded.tobytes()
    assert decoded.min() >= values.min()
    assert decoded.max() <= values.max()
    assert np.abs(decoded.astype(np.float64) - values.astype(np.float64)).max() <= error
