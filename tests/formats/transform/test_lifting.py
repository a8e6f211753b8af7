"""The bands of a transformed tile: the coefficients they cover and the bands they refer to."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rarely import rarely
from reference.elementwise import OFFSET_UNIT, clip_shifted, dequantise
from reference.kernels import KINDS, Table
from reference.transforms import MAX_LOD, Transform, band_lengths, band_table
from specs import MIXES, SHAPES, TYPES, axis_of, mixes_and_depths, noise, spec_of
from tiles import HIGH, LOW, random_head, random_tile

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.head import INPUTS, Layer, NeighbourHead
from fhash_formats.transform.spec import KINDS as TRANSFORMS
from fhash_formats.transform.spec import AxisTransform, TransformSpec

RANDOM_SHAPES = [
    (1, 1, 1, 1),
    (2, 3, 5, 7),
    (4, 9, 17, 33),
    (16, 1, 2, 64),
    (1, 2, 1, 40),
    (2, 2, 40, 1),
    (7, 13, 31, 29),
    (5, 1, 6, 6),
]
RANDOM_MIXES = [
    ("none", "none", "none", "none"),
    ("haar", "5/3", "9/7", "9/7"),
    ("haar", "none", "haar", "haar"),
    ("9/7", "haar", "5/3", "9/7"),
    ("none", "9/7", "none", "5/3"),
    ("haar", "klt", "9/7", "klt"),
    ("klt", "haar", "5/3", "5/3"),
    ("klt", "klt", "klt", "klt"),
]


def box(row: Table) -> tuple[slice, ...]:
    return tuple(slice(int(low), int(high)) for low, high in zip(row[:4], row[4:8], strict=True))


CASES = [
    pytest.param(
        spec_of(kinds, depth, shape, 8.0),
        shape,
        id=f"{'-'.join(kinds)}-{depth}-{'x'.join(map(str, shape))}",
    )
    for (kinds, depth), shape in product(mixes_and_depths(RANDOM_MIXES, (1, 2, 10)), RANDOM_SHAPES)
]


@pytest.mark.parametrize(("spec", "shape"), CASES)
def test_each_coefficient_is_in_one_band(spec: TransformSpec, shape: tuple[int, ...]) -> None:
    covered = np.zeros(shape, dtype=int)
    for row in band_table(spec, shape):
        assert all(
            0 <= low < high <= n for low, high, n in zip(row[:4], row[4:8], shape, strict=True)
        )
        covered[box(row)] += 1
    kept = tuple(
        slice(n if axis.basis is None else axis.basis.rank)
        for axis, n in zip(spec.axes, shape, strict=True)
    )
    assert (covered[kept] == 1).all()
    assert covered.sum() == covered[kept].size
    kinds = band_table(spec, shape)[:, 8]
    assert ((kinds >= 0) & (kinds < KINDS)).all()


@pytest.mark.parametrize(("spec", "shape"), CASES)
def test_references_point_back_to_bands_that_lie_alike(
    spec: TransformSpec, shape: tuple[int, ...]
) -> None:
    table = band_table(spec, shape)
    sizes = table[:, 4:8] - table[:, :4]
    for number, row in enumerate(table):
        # Axes along which each reference stays in place: the parent and the sibling along t and
        # z, the band before along t along z, y, x, the band before along z along t, y, x.
        for reference, same in zip(
            row[9:].reshape(4, 5), ([0, 1], [1, 2, 3], [0, 2, 3], [0, 1]), strict=True
        ):
            to, shifts = int(reference[0]), reference[1:]
            if to < 0:
                assert to == -1
                continue
            assert to < number
            assert set(shifts) <= {0, 1}
            assert (sizes[to] > 0).all()
            assert (row[same] == table[to, same]).all()
            assert (row[np.add(same, 4)] == table[to, np.add(same, 4)]).all()
            for axis in range(4):
                places = np.minimum(
                    np.arange(sizes[number, axis]) >> shifts[axis], sizes[to, axis] - 1
                )
                assert places.min() >= 0
                # The other band is as long, or half as long, except for an odd end.
                if axis in same or shifts[axis]:
                    assert (sizes[number, axis] - 1) >> shifts[axis] <= sizes[to, axis]


def test_a_table_is_made_once_and_read_only() -> None:
    spec = spec_of(("haar", "none", "9/7", "9/7"), 2, (4, 4, 8, 8))
    table = band_table(spec, (4, 4, 8, 8))
    assert table is band_table(spec, (4, 4, 8, 8))
    assert table.dtype == np.int32
    assert table.flags.c_contiguous
    with pytest.raises(ValueError, match="read-only"):
        table[0, 0] = 1


@settings(max_examples=60)
@given(
    shape=st.tuples(*(st.integers(1, 23),) * 4),
    kinds=st.tuples(*(st.sampled_from(TRANSFORMS),) * 4),
    depths=st.tuples(*(st.integers(1, 6),) * 4),
    seed=st.integers(0, 9),
    kind=st.sampled_from([(np.float32, 5e-5), (np.float64, 1e-10)]),
)
def test_any_mix_comes_back(
    shape: tuple[int, ...],
    kinds: tuple[str, ...],
    depths: tuple[int, ...],
    seed: int,
    kind: tuple[Any, float],
) -> None:
    dtype, tolerance = kind
    transform = Transform(spec_of(kinds, depths, shape), shape, dtype)
    values = noise(shape, dtype, seed)
    assert np.abs(transform.inverse(transform.forward(values)) - values).max() < tolerance


@pytest.mark.parametrize("center", [3.25, 0.0])
@pytest.mark.parametrize("offsets", [(5, -9, 2, 2, 2, 2), (5, -9, 2, 1, -3, 7)])
@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize(("kinds", "depth"), mixes_and_depths(MIXES, [1, 4]))
@pytest.mark.parametrize("shape", [(3, 4, 9, 37), (1, 1, 16, 64), (4, 1, 1, 5)])
@pytest.mark.parametrize("empty", ["last", "planes", *rarely("first", "but one", "all")])
def test_one_run_gives_the_bits_of_its_three_steps(
    shape: tuple[int, ...],
    kinds: tuple[str, ...],
    depth: int,
    dtype: Any,
    offsets: Any,
    center: float,
    empty: str,
) -> None:
    transform = Transform(spec_of(kinds, (depth,) * 4, shape), shape, dtype)
    random = np.random.default_rng(5)
    integers = (random.integers(-9, 10, shape) * (random.random(shape) < 0.1)).astype(np.int32)
    kept = {"last": slice(-1), "first": slice(1, None)}.get(empty, slice(0))
    some = np.zeros(shape, bool)
    some[kept] = True
    some[:, 1::2] |= empty == "planes"
    some[-1, -1] |= empty == "but one"
    integers[~some] = 0  # steps and planes without anything; some rows have nothing anyway
    coefficients = dequantise(integers, 0.75, offsets, dtype)
    expected = clip_shifted(transform.inverse(coefficients), center, -20.0, 20.0)
    six = (offset / OFFSET_UNIT for offset in offsets)
    numbers = (0.75, *six, center, -20.0, 20.0)
    for in_place in (False, True):
        result = transform.reconstruct(integers, numbers, in_place=in_place)
        assert result is not None
        assert result.tobytes() == expected.tobytes()


def test_a_centre_of_minus_zero_takes_three_steps() -> None:
    transform = Transform(spec_of(("none",) * 4, (0,) * 4, (1, 1, 2, 2)), (1, 1, 2, 2))
    numbers = (1.0, *(0.0,) * 6, -0.0, -1.0, 1.0)
    assert transform.reconstruct(np.zeros((1, 1, 2, 2), np.int32), numbers) is None


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("kinds", [kinds for kinds in MIXES if "klt" not in kinds])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_constant_stays_itself_at_every_resolution(
    shape: tuple[int, ...], kinds: tuple[str, ...], dtype: Any
) -> None:
    transform = Transform(spec_of(kinds, (2, 3, 4, 4), shape), shape, dtype)
    coefficients = transform.forward(np.full(shape, 3.25, dtype))
    for lod in range(MAX_LOD + 1):
        reduced = transform.inverse(coefficients, lod)
        assert reduced.shape == (shape[0], *(-(-n // 2**lod) for n in shape[1:]))
        assert reduced.dtype == dtype
        assert np.abs(reduced - 3.25).max() < (3e-5 if dtype is np.float32 else 1e-12)


@pytest.mark.parametrize("kind", ["none", "5/3", "9/7", "klt"])
@pytest.mark.parametrize("lod", [1, 2])
def test_reduced_vertices_stand_at_every_2_to_the_nth(kind: str, lod: int) -> None:
    shape = (2, 32, 33, 40)
    t, z, y, x = np.meshgrid(*(np.arange(n) / 40.0 for n in shape), indexing="ij")
    values = 1.0 + t + z * 2 + y * 3 + np.sin(2 * x)
    transform = Transform(
        spec_of(("none", kind, kind, kind), (0, 2, 2, 2), shape), shape, np.float64
    )
    step = 1 << lod
    reduced, expected = (
        transform.inverse(transform.forward(values), lod),
        values[:, ::step, ::step, ::step],
    )
    inside = (slice(None), *(slice(2, -2),) * 3)
    assert np.abs(reduced - expected)[inside].max() < 0.01


def test_a_haar_low_band_is_the_mean() -> None:
    shape = (2, 4, 8, 8)
    values = noise(shape, np.float64)
    transform = Transform(spec_of(("haar",) * 4, (1, 2, 2, 2), shape), shape, np.float64)
    means = values.reshape(2, 2, 2, 4, 2, 4, 2).mean(axis=(2, 4, 6))
    assert np.allclose(transform.inverse(transform.forward(values), 1), means, atol=1e-12)


def test_entries_beyond_the_rank_are_zero() -> None:
    shape = (2, 12, 5, 9)
    transform = Transform(
        spec_of(("none", "klt", "none", "klt"), (0,) * 4, shape, step=30.0), shape
    )
    z, x = (transform.spec.axes[axis].basis for axis in (1, 3))
    assert z is not None
    assert x is not None
    assert z.rank < 12
    assert x.rank < 9
    coefficients = transform.forward(noise(shape, np.float32))
    assert not coefficients[:, z.rank :].any()
    assert not coefficients[..., x.rank :].any()
    assert coefficients[:, : z.rank, :, : x.rank].all()
    changed = coefficients.copy()
    changed[:, z.rank :] = np.nan
    assert transform.inverse(changed).tobytes() == transform.inverse(coefficients).tobytes()


def test_a_basis_of_rank_0_gives_zeros() -> None:
    shape = (2, 3, 4, 5)
    none = AxisTransform(kind="none")
    z, x = axis_of("klt", 0, 3, step=1e9), axis_of("klt", 0, 5, step=1e9)
    transform = Transform(TransformSpec(axes=(none, z, none, x)), shape)
    assert not transform.forward(noise(shape, np.float32)).any()
    assert not transform.inverse(noise(shape, np.float32)).any()


@pytest.mark.parametrize("shape", [(1, 1, 1, 1500), (600, 1, 2, 3), (1, 1, 700, 530)])
def test_long_axes_come_back(shape: tuple[int, ...]) -> None:
    transform = Transform(spec_of(("9/7",) * 4, (4,) * 4, shape), shape, np.float64)
    values = noise(shape, np.float64)
    assert np.abs(transform.inverse(transform.forward(values)) - values).max() < 1e-11


def test_the_input_is_unchanged_and_may_have_any_strides() -> None:
    shape = (3, 4, 6, 8)
    transform = Transform(spec_of(("haar", "klt", "9/7", "9/7"), (1, 0, 2, 2), shape), shape)
    values = noise(shape, np.float32)
    kept = values.copy()
    coefficients = transform.forward(values)
    strided = np.asfortranarray(values)
    assert transform.forward(strided).tobytes() == coefficients.tobytes()
    held = coefficients.copy()
    transform.inverse(coefficients)
    assert np.array_equal(values, kept)
    assert np.array_equal(coefficients, held)


@pytest.mark.filterwarnings("error")
def test_hostile_coefficients_raise_nothing() -> None:
    shape = (2, 4, 8, 8)
    transform = Transform(spec_of(("haar", "none", "9/7", "9/7"), (1, 0, 2, 2), shape), shape)
    coefficients = np.full(shape, np.float32(3e38))
    coefficients[0, 0, 0, :3] = np.nan, np.inf, -np.inf
    for lod, reduced in ((0, shape), (1, (2, 2, 4, 4)), (3, (2, 1, 1, 1))):
        assert transform.inverse(coefficients, lod).shape == reduced


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        ((2, 3, 4), np.float32, "four axes"),
        ((0, 1, 1, 1), np.float32, "four axes"),
        ((1, 1, 1, 1), np.float16, "float16"),
        ((1, 9, 1, 1), np.float32, "along z is for 6"),
    ],
)
def test_bad_tiles_are_refused(shape: tuple[int, ...], dtype: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Transform(spec_of(("none", "klt", "none", "none"), (0,) * 4, (1, 6, 1, 1)), shape, dtype)


@pytest.mark.parametrize("lod", [-1, MAX_LOD + 1, 1.0, True, "1"])
def test_bad_resolutions_are_refused(lod: Any) -> None:
    transform = Transform(spec_of(("none",) * 4, (0,) * 4, (1, 1, 2, 2)), (1, 1, 2, 2))
    with pytest.raises(InputError, match="lod is 0 to"):
        transform.inverse(np.zeros((1, 1, 2, 2), np.float32), lod)


def test_other_arrays_are_refused() -> None:
    transform = Transform(spec_of(("none",) * 4, (0,) * 4, (1, 1, 2, 2)), (1, 1, 2, 2))
    with pytest.raises(InputError, match="float32 of shape"):
        transform.forward(np.zeros((1, 1, 2, 2)))
    with pytest.raises(InputError, match="float32 of shape"):
        transform.inverse(np.zeros((1, 1, 2, 3), np.float32))


def test_a_low_band_is_half_as_long_rounded_up() -> None:
    assert band_lengths(13, 5) == [13, 7, 4, 2, 1, 1]
    assert band_lengths(4, 0) == [4]


@pytest.mark.parametrize("kinds", MIXES)
@pytest.mark.parametrize("shape", [(2, 3, 5, 7), (3, 8, 16, 12)])
def test_norms_are_those_of_the_synthesis_vectors(
    shape: tuple[int, ...], kinds: tuple[str, ...]
) -> None:
    transform = Transform(spec_of(kinds, (1, 2, 3, 3), shape), shape, np.float64)
    places = np.random.default_rng(2).choice(int(np.prod(shape)), 25, replace=False)
    for place in places:
        impulse = np.zeros(shape)
        impulse.flat[place] = 1.0
        assert np.sqrt(np.sum(transform.inverse(impulse) ** 2)) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("shape", [(1, 1, 1, 1500), (600, 1, 2, 3), (1, 1, 700, 530)])
def test_long_axes_have_the_norms_of_the_interior(shape: tuple[int, ...]) -> None:
    transform = Transform(spec_of(("9/7",) * 4, (4,) * 4, shape), shape, np.float64)
    middle = tuple(n * 3 // 4 if n > 512 else 0 for n in shape)  # inside the finest high band
    impulse = np.zeros(shape)
    impulse[middle] = 1.0
    assert np.sum(transform.inverse(impulse) ** 2) == pytest.approx(1.0, abs=1e-6)


def test_a_strided_tile_gives_the_same_as_its_copy() -> None:
    tile = random_tile((2, 6, 8, 40))[:, ::2, :, ::3]
    assert random_head().apply(tile).tobytes() == random_head().apply(tile.copy()).tobytes()


@pytest.mark.parametrize("tile", [np.zeros((2, 2, 2), np.float32), np.zeros((1, 2, 2, 2))])
def test_other_tiles_are_refused(tile: npt.NDArray[Any]) -> None:
    with pytest.raises(InputError, match="float32 tile"):
        random_head().apply(tile)


@pytest.mark.parametrize("hidden", [(12, 8), (1,), (24, 12), (64, 64, 64)])
def test_bytes_and_json_there_and_back(hidden: tuple[int, ...]) -> None:
    head = random_head(hidden)
    assert head.to_bytes()[0] == len(hidden)
    told = json.loads(json.dumps(head.to_json()))
    assert len(told["weights"]) == sum(layer.weights.size for layer in head.layers)
    for again in (NeighbourHead.from_bytes(head.to_bytes()), NeighbourHead.from_json(told)):
        assert (again.hidden, again.sigma, again.low, again.high) == (
            head.hidden,
            head.sigma,
            head.low,
            head.high,
        )
        for first, second in zip(head.layers, again.layers, strict=True):
            np.testing.assert_array_equal(first.weights, second.weights)
            np.testing.assert_array_equal(first.biases, second.biases)
            scales = second.weight_scale, second.bias_scale
            assert (first.weight_scale, first.bias_scale) == scales


def test_the_default_head_is_small() -> None:
    assert len(random_head(spread=12.0).to_bytes()) <= 530


@pytest.mark.parametrize("head", [random_head(), random_head((3, 4))])
def test_damaged_bytes_are_refused_or_are_another_sound_head(head: NeighbourHead) -> None:
    data = head.to_bytes()
    for position in range(len(data)):
        for bit in (0, 7):
            damaged = bytearray(data)
            damaged[position] ^= 1 << bit
            with suppress(DamagedFileError):
                NeighbourHead.from_bytes(bytes(damaged))
    for length in range(len(data)):
        with pytest.raises(DamagedFileError):
            NeighbourHead.from_bytes(data[:length])


@pytest.mark.parametrize(
    "start",
    [
        b"\x00",
        b"\x04\x04\x04\x04\x04",
        b"\x82\x04\x04",
        b"\x02\x04",
        b"\x02\x04\x41",
        b"\x02\x00\x04",
    ],
)
def test_other_hidden_layers_are_refused(start: bytes) -> None:
    rest = random_head((4, 4)).to_bytes()[3:]
    with pytest.raises(DamagedFileError, match=r"hidden layers|widths|requires a buffer"):
        NeighbourHead.from_bytes(start + rest if len(start) > 2 else start)


@pytest.mark.parametrize(
    ("hidden", "message"),
    [((), "1 to 3 hidden layers"), ((8,) * 4, "1 to 3 hidden layers"), ((8, 65), "65 outputs")],
)
def test_a_head_has_few_hidden_layers_and_exact_sums(hidden: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        random_head(hidden)


@pytest.mark.parametrize("tail", [b"\0", b"\1", b"\xff" * 5000])
def test_longer_bytes_are_refused(tail: bytes) -> None:
    with pytest.raises(DamagedFileError):
        NeighbourHead.from_bytes(random_head().to_bytes() + tail)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": 0.0}, "sigma"),
        ({"sigma": float("nan")}, "finite"),
        ({"sigma": 0.1}, "float32"),
        ({"low": 3.0}, "low <= high"),
        ({"high": float("inf")}, "finite"),
        ({"layers": ()}, "hidden layers"),
    ],
)
def test_bad_heads_are_refused(change: dict[str, Any], message: str) -> None:
    head = random_head()
    with pytest.raises(InputError, match=message):
        NeighbourHead(
            **{
                "layers": head.layers,
                "sigma": head.sigma,
                "low": head.low,
                "high": head.high,
                **change,
            }
        )


@pytest.mark.parametrize(
    "change",
    [
        {"weights": np.full((12, INPUTS), 32, np.int8)},
        {"weights": np.zeros((12, 27), np.int8)},
        {"weight_scale": 0.1},
        {"bias_scale": 0.0},
    ],
)
def test_bad_layers_are_refused(change: dict[str, Any]) -> None:
    head = random_head()
    fields = {**asdict(head.layers[0]), **change}
    with pytest.raises(InputError):
        NeighbourHead(
            layers=(Layer(**fields), *head.layers[1:]), sigma=head.sigma, low=LOW, high=HIGH
        )
