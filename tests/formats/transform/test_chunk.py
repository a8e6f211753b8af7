"""Transforms to try: each once, none that fits no axis, and no deeper than the axes allow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.chunk import (
    candidates,
    decode_chunk,
    encode_chunk,
    tile_shape,
)
from fhash_formats.transform.tile_format import KIND, LABELS, TRANSFORMED


@pytest.mark.parametrize("shape", [(8, 16, 32, 48), (1, 1, 1, 3), (1, 5, 40, 40), (2, 1, 1, 1)])
def test_each_is_tried_once_and_fits_the_axes(shape: tuple[int, int, int, int]) -> None:
    specs = candidates(shape)
    assert len(set(specs)) == len(specs) > 0
    for spec in specs:
        for axis, length in zip(spec.axes, shape, strict=True):
            assert axis.kind == "none" or 1 <= axis.depth < length.bit_length() + 1


def test_the_first_axis_is_also_tried_with_haar_and_without() -> None:
    kinds = [spec.axes[0].kind for spec in candidates((8, 16, 32, 48))]
    assert kinds == ["9/7", "haar", "none", "haar"]


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
    assert check(grains(60, dtype), error, max_error=error)[4] & KIND == TRANSFORMED


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
