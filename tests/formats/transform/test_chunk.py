"""Chunks of any type, shape and quality; bases, transforms and axes."""

from __future__ import annotations

import base64
import itertools
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.typing import NDArray
from tiles import SETTINGS, SHAPE, same, wave

from fhash_formats.errors import DamagedFileError, FhashError, InputError, UnsupportedFileError
from fhash_formats.transform.spec import (
    MAX_DEPTH,
    MAX_EXPONENT,
    MAX_LENGTH,
    AxisTransform,
    Basis,
    MaskLevels,
    TransformSpec,
    _dct,
    fit_basis,
)
from fhash_formats.transform.stream import TILE_AXES, ArrayAxes, TransformCoder, take_axes
from fhash_formats.transform.tile import Coding, decode_chunk, encode_chunk, encode_tile, tile_shape
from fhash_formats.transform.tile_format import KIND, LABELS, TileSettings

FLOATS = ["f2", "f4", "f8", ">f4"]
INTEGERS = ["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", ">i2"]
SHAPES: list[tuple[int, ...]] = [(), (1,), (45,), (9, 12), (3, 8, 9), (2, 3, 8, 9), (2, 1, 2, 4, 6)]


def field(shape: tuple[int, ...], scale: float, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    grid = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij") if shape else []
    wave = sum((np.sin(4 * (i + 1) * x) for i, x in enumerate(grid)), start=np.zeros(shape))
    wave = wave / max(1, len(shape)) + np.random.default_rng(3).uniform(-0.01, 0.01, shape)
    return (wave * scale if np.dtype(dtype).kind != "u" else np.abs(wave) * scale).astype(dtype)


def worst(values: npt.NDArray[Any], decoded: npt.NDArray[Any]) -> float:
    """The largest difference; integers are compared as Python integers."""
    if values.dtype.kind == "f":
        return float(np.abs(values.astype(np.float64) - decoded.astype(np.float64)).max(initial=0))
    pairs = zip(values.ravel(), decoded.ravel(), strict=True)
    return max((abs(int(value) - int(other)) for value, other in pairs), default=0)


def check(values: npt.NDArray[Any], error: float, **quality: Any) -> bytes:
    """The stream of an array, after its error, shape, type and missing values are checked."""
    data = encode_chunk(values, **quality)
    decoded = decode_chunk(data, values.shape, values.dtype)
    assert (decoded.shape, decoded.dtype) == (values.shape, values.dtype)
    finite = np.isfinite(values)
    assert worst(values[finite], decoded[finite]) <= error
    if values.dtype.kind == "f":
        assert np.array_equal(values[~finite], decoded[~finite], equal_nan=True)
    return data


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [*FLOATS, *INTEGERS])
def test_the_bound_holds(dtype: str, shape: tuple[int, ...]) -> None:
    values = field(shape, 100, dtype)
    for error in (0, 0.4, 1, 3.7):
        check(values, error, max_error=error)
    span = float(values.max()) - float(values.min())
    for fraction in (1e-7, 0.01, 0.3):
        check(values, fraction * span, max_error_rel=fraction)


@pytest.mark.parametrize(
    ("dtype", "scale"),
    [
        ("f2", 1e-6),
        ("f2", 6e4),
        ("f4", 1e-42),
        ("f4", 1e-38),
        ("f4", 3e38),
        ("f8", 1e-310),
        ("f8", 8e307),
    ],
)
def test_the_bound_holds_at_the_ends_of_the_types(dtype: str, scale: float) -> None:
    values = field((6, 7), scale, dtype)
    values.flat[0], values.flat[1] = 0.0, -0.0
    values.flat[2:5] = [np.nan, np.inf, -np.inf]
    span = float(np.ptp(values[np.isfinite(values)].astype(np.float64)))
    for fraction in (1e-5, 0.01):
        check(values, fraction * span, max_error_rel=fraction)


@pytest.mark.parametrize(("dtype", "peak"), [("f2", 6e4), ("f4", 2.7e38), ("f4", 3.4e38)])
def test_a_residual_beyond_the_type_is_clipped_where_it_decodes(dtype: str, peak: float) -> None:
    """A quantum of nearly the range takes the peak beyond the largest number of the type."""
    values = np.zeros((5, 5, 2, 2), dtype)
    values.flat[0] = peak
    for fraction in (0.3, 0.45, 0.5):
        check(values, fraction * float(values.max()), max_error_rel=fraction)


@pytest.mark.parametrize("dtype", INTEGERS)
def test_the_ends_of_whole_numbers(dtype: str) -> None:
    limits = np.iinfo(dtype)
    values = (
        np.random.default_rng(1)
        .integers(limits.min, limits.max, (5, 6), np.dtype(dtype).newbyteorder("="), endpoint=True)
        .astype(dtype)
    )
    values.flat[:2] = limits.min, limits.max
    for error in (0, 2, 1e6):
        check(values, error, max_error=error)


def test_whole_numbers_without_loss_are_smaller_than_themselves() -> None:
    values = field((8, 16, 16), 1000, "i2")
    assert len(check(values, 0, max_error=0)) < 0.6 * values.nbytes


def test_constants_and_nothing_take_a_few_bytes() -> None:
    for values in (
        np.full((20, 30), 0.1),
        np.full((20, 30), 7, "u1"),
        np.full((20, 30), np.nan, "f4"),
        np.full((20, 30), 2**63 - 1),
    ):
        assert len(check(values, 0, max_error=0)) < 130
    assert encode_chunk(np.empty((0, 3), "f4"), max_error=1) == b""
    assert decode_chunk(b"", (0, 3), "f4").shape == (0, 3)


def test_missing_values_take_no_part_in_range_or_bound() -> None:
    values = field((12, 16), 1, "f4")
    values[:, :5] = np.nan
    values[3, 7] = np.inf
    check(values, 0.01 * float(np.ptp(values[np.isfinite(values)])), max_error_rel=0.01)


def test_a_step_beyond_the_range_leaves_the_range() -> None:
    values = field((6, 7), 1, "f4")
    check(values, float(np.ptp(values)), step=1e308)


@pytest.mark.parametrize("step", [1e-9, 1e-200, 5e-324])
def test_a_step_too_fine_for_the_coder_is_exact(step: float) -> None:
    values = field((6, 7), 1, "f8")
    check(values, 4 * step, step=step)


def test_a_given_transform_is_taken() -> None:
    transform = {"t": "none", "z": "none", "y": ["5/3", 1], "x": "none"}
    values = field((9, 12), 1, "f4")
    data = encode_chunk(values, max_error=0.01, transform=transform)
    assert worst(values, decode_chunk(data, values.shape, "f4")) <= 0.01
    assert data != encode_chunk(values, max_error=0.01)


def test_more_effort_takes_no_more_bytes() -> None:
    values = field((4, 16, 32, 48), 1, "f4")
    sizes = [len(check(values, 0.02, max_error=0.02, effort=effort)) for effort in (1, 2, 3)]
    assert sizes[0] > sizes[1] >= sizes[2]


@pytest.mark.parametrize("effort", [0, 10, 1.5, True, "2", None])
def test_unsuitable_efforts_are_refused(effort: Any) -> None:
    with pytest.raises(InputError, match="a whole number from 1 to 9"):
        encode_chunk(np.zeros(3), max_error=1, effort=effort)


@pytest.mark.parametrize(
    "quality",
    [
        {},
        {"max_error": 1, "step": 1},
        {"max_error": -1},
        {"step": 0},
        {"max_error_rel": math.nan},
        {"max_error": True},
        {"step": math.inf},
        {"max_error": "1"},
    ],
)
def test_unsuitable_qualities_are_refused(quality: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"max_error|step"):
        encode_chunk(np.zeros(3), **quality)


@pytest.mark.parametrize("dtype", ["?", "c8", "S3", "M8[s]", "O"])
def test_unsuitable_types_are_refused(dtype: str) -> None:
    with pytest.raises(InputError, match="not "):
        encode_chunk(np.zeros(3).astype(dtype), max_error=1)


@pytest.mark.parametrize("values", [[-0.0], [-0.0, 0.0, -0.0], [0.0, 0.0], [-0.0, np.nan, 0.0]])
@pytest.mark.parametrize("dtype", ["f2", "f4", "f8"])
def test_zeros_without_loss_keep_their_signs(values: list[float], dtype: str) -> None:
    given = np.array(values, dtype)
    decoded = decode_chunk(encode_chunk(given, max_error=0.0), given.shape, given.dtype)
    assert decoded.tobytes() == given.tobytes()


@pytest.mark.parametrize(
    ("shape", "tile"),
    [
        ((), (1, 1, 1, 1)),
        ((5,), (1, 1, 1, 5)),
        ((2, 3), (1, 1, 2, 3)),
        ((2, 3, 4, 5), (2, 3, 4, 5)),
        ((2, 3, 4, 5, 6), (6, 4, 5, 6)),
    ],
)
def test_an_array_of_any_axes_is_a_tile_of_four(
    shape: tuple[int, ...], tile: tuple[int, ...]
) -> None:
    assert tile_shape(shape) == tile


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "u1", "i4"])
@pytest.mark.parametrize("share", [0.02, 0.2])
def test_no_value_leaves_the_range_of_its_chunk(dtype: str, share: float) -> None:
    values = field((2, 4, 9, 12), 1 if dtype[0] == "f" else 100, dtype)
    error = float(values.max() - values.min()) * share
    decoded = decode_chunk(check(values, error, max_error=error), values.shape, values.dtype)
    assert values.min() <= decoded.min() <= decoded.max() <= values.max()
    coarse = encode_chunk(values, step=4 * error)
    decoded = decode_chunk(coarse, values.shape, values.dtype)
    assert values.min() <= decoded.min() <= decoded.max() <= values.max()


def grains(count: int, dtype: str) -> npt.NDArray[Any]:
    """Blocks of `count` numbers in a random order."""
    numbers = np.random.default_rng(0).permutation(count)[np.arange(1200).reshape(30, 40) % count]
    return np.broadcast_to(numbers.repeat(3, 0).repeat(3, 1), (4, 90, 120)).astype(dtype)


@pytest.mark.parametrize("count", [60, 1200])
@pytest.mark.parametrize(("dtype", "error"), [("i4", 0), ("u2", 0.9), ("f4", 0)])
def test_labels_without_loss_are_coded_as_labels(count: int, dtype: str, error: float) -> None:
    values = grains(count, dtype)
    data = check(values, 0, max_error=error)
    assert data[4] & KIND == LABELS
    assert 40 * len(data) < values.nbytes


@pytest.mark.parametrize(("dtype", "error"), [("i4", 1), ("f4", 0.5)])
def test_a_looser_bound_codes_no_labels(dtype: str, error: float) -> None:
    assert check(grains(60, dtype), error, max_error=error)[4] & KIND != LABELS


SIZES = {
    "wave": {0.01: 1958, 0.001: 5075},
    "front": {0.01: 11475, 0.001: 25496},
    "noise": {0.01: 24767, 0.001: 96456},
}
"""Bytes of each chunk at bounds that are shares of its range."""


def chunk(kind: str) -> npt.NDArray[np.float32]:
    """A generated chunk (t, z, y, x): a smooth wave, a front that moves, or noise."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (6, 12, 48, 48)), indexing="ij")
    if kind == "wave":
        values = np.sin(9 * x + 3 * t) * np.cos(7 * y - 2 * z) + 0.3 * np.sin(23 * x * y + z)
    elif kind == "front":
        values = np.tanh((np.hypot(x - 0.5, y - 0.4) - 0.15 - 0.3 * t) / 0.01 + np.sin(20 * z))
    else:
        values = np.sin(5 * x + t) + 0.02 * np.random.default_rng(1).normal(size=x.shape)
    return values.astype(np.float32)


@pytest.mark.parametrize("kind", SIZES)
def test_generated_chunks_take_the_bytes_that_they_took(kind: str) -> None:
    values = chunk(kind)
    for share, size in SIZES[kind].items():
        error = share * float(np.ptp(values))
        assert len(check(values, error, max_error=error)) < 1.03 * size


def test_labels_keep_every_bit_of_floats() -> None:
    values = grains(60, "f4")
    values[values == 3] = -0.0
    values[values == 4] = np.nan
    values[values == 5] = np.inf
    decoded = decode_chunk(encode_chunk(values, max_error=0), values.shape, "f4")
    assert decoded.tobytes() == values.tobytes()


@pytest.mark.parametrize("least", [-(2**63), 2**60, 2**63 - 999])
def test_integers_far_from_zero_are_coded_as_near_ones(least: int) -> None:
    near = np.rint(field((9, 11, 13), 400, "f8")).astype(np.int64)
    near -= near.min()
    values = near + np.int64(least)
    sizes = []
    for tile in (near, values):
        for quality in ({"max_error": 3}, {"max_error_rel": 0.01}, {"step": 9.0}):
            data = encode_chunk(tile, **quality)
            decoded = decode_chunk(data, tile.shape, tile.dtype)
            assert decoded.min() >= tile.min()
            assert decoded.max() <= tile.max()
            sizes.append(len(data))
    assert max(sizes[3:]) <= max(sizes[:3]) + 40


def test_an_origin_is_of_64_bit_integers_alone() -> None:
    values = np.arange(2**60, 2**60 + 60).reshape(3, 4, 5)
    data = encode_chunk(values, max_error=3)
    for dtype in ("f8", "i4", "u2"):
        with pytest.raises(
            DamagedFileError, match="no values about the origin 1152921504606847006"
        ):
            decode_chunk(data, values.shape, dtype)
    # As the other type of 64 bits the same integers come out, within its range.
    again = decode_chunk(data, values.shape, np.uint64)
    assert (again == decode_chunk(data, values.shape, np.int64).astype(np.uint64)).all()


def smooth(n: int, count: int = 400) -> NDArray[np.float64]:
    """Columns of random walks."""
    return np.cumsum(np.random.default_rng(n).standard_normal((n, count)), axis=0)


@pytest.mark.parametrize("n", [1, 2, 3, 8, 61, 200])
@pytest.mark.parametrize("step", [1e-3, 0.5, 8.0])
def test_analysis_and_synthesis_lose_less_than_the_step(n: int, step: float) -> None:
    columns = smooth(n)
    basis = fit_basis(columns @ columns.T, step)
    assert 0 < basis.rank <= n
    assert basis.synthesis.shape == (n, basis.rank)
    again = basis.synthesis.astype(np.float64) @ (basis.analysis @ columns)
    # Each dropped vector had a total amplitude below the step; each kept one is off by at most
    # about a step per entry.
    assert np.sum((again - columns) ** 2) < 2 * n * n * step**2
    assert np.allclose(basis.analysis @ basis.synthesis, np.eye(basis.rank), atol=1e-10)


def test_nothing_to_keep_is_a_basis_of_rank_0() -> None:
    basis = fit_basis(np.zeros((5, 5)), 1.0)
    assert basis.rank == 0
    assert Basis.from_bytes(basis.to_bytes(), 5) == basis
    assert basis.synthesis.shape == (5, 0)


@pytest.mark.parametrize("n", [1, 2, 17, 64])
@pytest.mark.parametrize("step", [0.1, 10.0])
def test_bytes_there_and_back(n: int, step: float) -> None:
    columns = smooth(n)
    basis = fit_basis(columns @ columns.T, step)
    again = Basis.from_bytes(basis.to_bytes(), n)
    assert again == basis
    assert hash(again) == hash(basis)
    assert again.synthesis.tobytes() == basis.synthesis.tobytes()


@pytest.mark.parametrize("n", [1, 2, 3, 5, 64, 127, MAX_LENGTH])
def test_the_cosines_are_those_of_the_library(n: int) -> None:
    rows = np.array(_dct(n))
    exact = [
        [
            math.cos(math.pi * (2 * i + 1) * k / (2 * n)) * math.sqrt((2 if k else 1) / n)
            for i in range(n)
        ]
        for k in range(n)
    ]
    assert np.allclose(rows, exact, rtol=0, atol=2e-14)


def test_every_cut_and_many_flips_end_in_an_error_or_a_basis() -> None:
    columns = smooth(12)
    packed = fit_basis(columns @ columns.T, 2.0).to_bytes()
    for end in range(min(len(packed), 12)):
        with pytest.raises(DamagedFileError):
            Basis.from_bytes(packed[:end], 12)
    for place in range(len(packed)):
        for bit in (0, 3, 7):
            broken = bytearray(packed)
            broken[place] ^= 1 << bit
            try:
                basis = Basis.from_bytes(bytes(broken), 12)
            except DamagedFileError:
                continue
            assert np.isfinite(basis.synthesis).all()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x01\x00\x01",
        b"\x00\x00\x00\x00",
        b"\x03\x00\x04\x00" + bytes(9),
        b"\xff\xff\x01\x00" + bytes(9),
        b"\x03\x00\x00\x00more",
        b"\x03\x00\x02\x00" + bytes(40),
    ],
)
def test_hostile_headers(data: bytes) -> None:
    with pytest.raises(DamagedFileError):
        Basis.from_bytes(data)


def test_a_basis_for_another_length_is_refused() -> None:
    with pytest.raises(DamagedFileError, match="of length 5 where 6"):
        Basis.from_bytes(fit_basis(np.eye(5), 0.1).to_bytes(), 6)


@pytest.mark.parametrize(
    ("integers", "exponents"),
    [
        (np.zeros((1, 3), np.int32), (2,)),
        (np.ones((1, 3), np.int64), (2,)),
        (np.ones((1, 3), np.int32), (MAX_EXPONENT + 1,)),
        (np.ones((1, 3), np.int32), (-1,)),
        (np.ones((2, 3), np.int32), (2, 3)),
        (np.ones((1, 3), np.int32), ()),
        (np.ones((4, 3), np.int32), (1, 1, 1, 1)),
        (np.full((1, 3), 100, np.int32), (2,)),
        (np.full((1, 3), -(2**31), np.int32), (2,)),
        (np.ones((1, MAX_LENGTH + 1), np.int32), (2,)),
    ],
)
def test_impossible_bases_are_refused(
    integers: NDArray[np.int32], exponents: tuple[int, ...]
) -> None:
    with pytest.raises(InputError):
        Basis(integers=integers, exponents=exponents)


@pytest.mark.parametrize(
    ("gram", "step"),
    [
        (np.eye(3)[:2], 1.0),
        (np.full((2, 2), np.nan), 1.0),
        (np.eye(2), 0.0),
        (np.eye(2), math.inf),
        (np.zeros((0, 0)), 1.0),
        (np.zeros((513, 513)), 1.0),
    ],
)
def test_impossible_fits_are_refused(gram: NDArray[np.float64], step: float) -> None:
    with pytest.raises(InputError):
        fit_basis(gram, step)


def test_dependent_vectors_can_be_decoded_but_not_encoded_with() -> None:
    basis = Basis(integers=np.array([[2, 0, 0], [2, 0, 0]], np.int32), exponents=(2, 2))
    assert basis.synthesis.shape == (3, 2)
    with pytest.raises(FhashError, match="depend on each other"):
        _ = basis.analysis


PLAIN: dict[str, Any] = {"t": ["haar", 2], "z": "none", "y": ["9/7", 4], "x": ["9/7", 4]}


def some_basis() -> Basis:
    columns = np.cumsum(np.random.default_rng(1).standard_normal((9, 50)), axis=0)
    return fit_basis(columns @ columns.T, 0.5)


def test_there_and_back() -> None:
    spec = TransformSpec.from_dict(PLAIN)
    assert spec.axes[0] == AxisTransform(kind="haar", depth=2)
    assert spec.to_dict() == PLAIN
    assert TransformSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


def test_a_basis_is_no_json() -> None:
    axis = AxisTransform(kind="klt", basis=some_basis())
    with pytest.raises(InputError, match="no JSON value"):
        axis.to_json()


@pytest.mark.parametrize(
    "value",
    [
        None,
        7,
        "dct",
        "9/7",
        "klt",
        "",
        [],
        ["9/7"],
        ["9/7", 0],
        ["9/7", -1],
        ["9/7", MAX_DEPTH + 1],
        ["9/7", 10**30],
        ["9/7", 2.0],
        ["9/7", True],
        ["9/7", "2"],
        ["none", 1],
        ["klt", 0],
        [["9/7"], 2],
        ["9/7", 2, 2],
        {},
        {"klt": 3},
        {"klt": ""},
        {"klt": "no base64!"},
        {"klt": "\u00e4"},
        {"klt": "AAAA"},
        {"klt": "A" * (1 << 22)},
        {"klt": base64.b64encode(b"\xff\xff\xff\xff" + bytes(100)).decode()},
        {"klt": base64.b64encode(b"\x04\x00\x02\x00").decode()},
        {"klt": "AAAA", "more": 1},
    ],
)
@pytest.mark.parametrize("key", ["t", "x"])
def test_a_bad_value_is_refused_by_name(key: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"key '{key}'") as caught:
        TransformSpec.from_dict({**PLAIN, key: value})
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({**PLAIN, "w": "none"}, "unknown key 'w'"),
        ({key: PLAIN[key] for key in "tzy"}, "missing key 'x'"),
        ({}, "missing key 't'"),
        ([1, 2], "a mapping"),
        (None, "a mapping"),
        (dict[Any, Any](PLAIN) | {3: "none"}, "unknown key 3"),
    ],
)
def test_a_bad_set_of_keys_is_refused(values: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        TransformSpec.from_dict(values)


def test_axes_hold_what_they_need() -> None:
    with pytest.raises(InputError, match="needs a basis"):
        AxisTransform(kind="klt")
    with pytest.raises(InputError, match="nothing else"):
        AxisTransform(kind="none", basis=some_basis())
    with pytest.raises(InputError, match="four axes"):
        TransformSpec(axes=(AxisTransform(kind="none"),) * 3)  # type: ignore[arg-type]


@pytest.mark.parametrize("names", list(itertools.permutations(TILE_AXES)), ids="".join)
def test_a_tile_has_the_axes_in_its_own_order_and_gives_the_chunk_back(
    names: tuple[str, ...],
) -> None:
    lengths = {"t": 2, "z": 3, "y": 4, "x": 5}
    chunk = np.arange(120).reshape([lengths[name] for name in names])
    axes = ArrayAxes(names)
    tile = axes.to_tile(chunk)
    assert tile.shape == axes.tile_shape(chunk.shape) == (2, 3, 4, 5)
    place = dict(zip(TILE_AXES, (1, 2, 3, 4), strict=True))
    assert tile[1, 2, 3, 4] == chunk[tuple(place[name] for name in names)]
    assert np.array_equal(axes.from_tile(tile), chunk)
    assert axes.usual == (names == TILE_AXES)


@pytest.mark.parametrize(
    ("names", "chunk", "tile"),
    [
        (("t", "y", "x"), (2, 3, 4), (2, 1, 3, 4)),
        (("z", "y", "x"), (2, 3, 4), (1, 2, 3, 4)),
        (("x",), (7,), (1, 1, 1, 7)),
        (("", "x", "", "t"), (1, 5, 1, 3), (3, 1, 1, 5)),
        (("x", "t", "", "y", "z"), (5, 2, 1, 3, 4), (2, 4, 3, 5)),
    ],
)
def test_an_axis_that_is_not_named_has_length_1(
    names: tuple[str, ...], chunk: tuple[int, ...], tile: tuple[int, ...]
) -> None:
    values = np.arange(np.prod(chunk)).reshape(chunk)
    axes = ArrayAxes(names)
    assert axes.to_tile(values).shape == tile
    assert np.array_equal(axes.from_tile(axes.to_tile(values)), values)


def test_a_tile_with_less_detail_gives_a_smaller_chunk() -> None:
    tile = np.arange(24).reshape(2, 3, 4, 1)
    assert ArrayAxes(("y", "t", "z")).from_tile(tile).shape == (4, 2, 3)


def test_the_last_axes_are_the_usual_ones() -> None:
    assert ArrayAxes(("y", "x")).usual
    assert not ArrayAxes(("t", "y", "x")).usual


def test_they_are_taken_from_a_configuration() -> None:
    assert take_axes({"step": 1}) == ({"step": 1}, None)
    assert take_axes({"step": 1, "axes": ["t", "x"]}) == ({"step": 1}, ArrayAxes(("t", "x")))


@pytest.mark.parametrize("wrong", [[], ["t", "t"], ["u"], "tzyx", 3, [1], ["t", None]], ids=str)
def test_other_axes_are_refused(wrong: object) -> None:
    with pytest.raises(InputError, match="axes are"):
        take_axes({"axes": wrong})


def test_chunks_of_another_form_are_refused() -> None:
    axes = ArrayAxes(("t", "", "x"))
    with pytest.raises(InputError, match="of 2 axes"):
        axes.tile_shape((2, 3))
    with pytest.raises(InputError, match="length 1"):
        axes.tile_shape((2, 3, 4))


FLOAT = np.dtype(np.float32)


def named(settings: TileSettings) -> dict[str, Any]:
    return {"settings": settings.to_text()}


def coder(settings: TileSettings | None, shape: tuple[int, ...] = SHAPE) -> TransformCoder:
    configuration = {} if settings is None else named(settings)
    return TransformCoder([{"configuration": configuration}], FLOAT, shape)


@pytest.mark.parametrize("axes", [1, 2, 3, 4])
def test_a_chunk_of_fewer_axes_comes_back(axes: int) -> None:
    values = wave()[(0,) * (4 - axes)]
    shared = coder(SETTINGS, values.shape)
    decoded = shared.decode(memoryview(shared.encode(values)))
    assert decoded.shape == values.shape
    assert np.abs(decoded - values).max() <= 0.4


def test_a_reduced_chunk_has_every_second_vertex_of_space() -> None:
    shared = coder(SETTINGS)
    assert shared.decode(memoryview(shared.encode(wave())), lod=1).shape == (2, 2, 4, 5)


def test_without_shared_settings_each_stream_has_its_own() -> None:
    coded = encode_tile(wave(), SETTINGS, Coding(own_settings=True))
    assert same(coder(None).decode(memoryview(coded.data)), coded.decoded)
    assert same(coder(None).decode(memoryview(coder(None).encode(wave()))), wave())


def test_the_mask_comes_with_the_values() -> None:
    settings, occupied = replace(SETTINGS, mask=MaskLevels()), wave() > 0.5
    masked = coder(settings)
    assert masked.masked
    coded = encode_tile(wave(), settings, in_coreset=occupied)
    values, mask = masked.decode_masked(memoryview(coded.data))
    assert same(values, coded.decoded)
    assert np.array_equal(mask, occupied)


@pytest.mark.parametrize(
    ("codecs", "shape", "error", "message"),
    [
        ([{}, {}], SHAPE, UnsupportedFileError, "no codec may follow"),
        ([{}], (1, *SHAPE), DamagedFileError, "at most 4 axes"),
        ([{"configuration": {"transform": 3}}], SHAPE, DamagedFileError, "has settings, and axes"),
        ([{"configuration": {"settings": "a"}}], SHAPE, DamagedFileError, "no base64"),
    ],
)
def test_other_configurations_are_refused(
    codecs: list[dict[str, Any]], shape: tuple[int, ...], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        TransformCoder(codecs, FLOAT, shape)


AXES = ("y", "x", "t", "z")


@pytest.mark.parametrize("settings", [SETTINGS, None])
def test_a_chunk_is_coded_along_the_axes_that_are_named(settings: TileSettings | None) -> None:
    order = ["tzyx".index(axis) for axis in AXES]
    values = wave().transpose(order)
    configuration = {**({} if settings is None else named(settings)), "axes": list(AXES)}
    given = TransformCoder([{"configuration": configuration}], FLOAT, values.shape)
    coded = encode_tile(wave(), SETTINGS, Coding(own_settings=settings is None))
    assert same(given.decode(coded.data), coded.decoded.transpose(order))
    if settings is not None:
        assert given.encode(values) == coded.data


def test_a_level_of_detail_keeps_every_position_along_the_first_axis() -> None:
    plain, data = coder(SETTINGS), encode_tile(wave(), SETTINGS).data
    time_first = {**named(SETTINGS), "axes": ["t", "x", "y", "z"]}
    shape = tuple(wave().transpose(0, 3, 2, 1).shape)
    given = TransformCoder([{"configuration": time_first}], FLOAT, shape)
    assert same(given.decode(data, lod=1), plain.decode(data, lod=1).transpose(0, 3, 2, 1))
    swapped = {**named(SETTINGS), "axes": ["z", "t", "y", "x"]}
    shape = tuple(wave().transpose(1, 0, 2, 3).shape)
    given = TransformCoder([{"configuration": swapped}], FLOAT, shape)
    everything = plain.decode(data).transpose(1, 0, 2, 3)
    assert same(given.decode(data, lod=1), everything[:, ::2, ::2, ::2])


def test_axes_come_with_masks() -> None:
    settings, occupied = replace(SETTINGS, mask=MaskLevels()), wave() > 0.5
    configuration = {**named(settings), "axes": ["x", "z", "y", "t"]}
    shape = tuple(wave().transpose(3, 1, 2, 0).shape)
    given = TransformCoder([{"configuration": configuration}], FLOAT, shape)
    coded = encode_tile(wave(), settings, in_coreset=occupied)
    values, mask = given.decode_masked(coded.data)
    assert same(values, coded.decoded.transpose(3, 1, 2, 0))
    assert np.array_equal(mask, occupied.transpose(3, 1, 2, 0))


@pytest.mark.parametrize(
    "axes", [["t", "z", "y"], ["t", "t", "y", "x"], "tzyx", ["", "z", "y", "x"]]
)
def test_axes_that_do_not_fit_are_damage(axes: object) -> None:
    with pytest.raises(DamagedFileError, match=r"axes|chunks"):
        TransformCoder([{"configuration": {"axes": axes}}], FLOAT, SHAPE)
