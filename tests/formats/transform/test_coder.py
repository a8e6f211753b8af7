"""The adaptive coder: round trips, adaptation, memory, damaged and hostile bytes."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.typing import NDArray
from reference import kernels
from reference.kernels import (
    MAX_INTEGER,
    State,
    Table,
    decode_integers,
    decode_labels,
    decode_mask,
    encode_integers,
    encode_labels,
    encode_mask,
    mask_prior_state,
    of_two_quantisers,
    single_band,
    unpack_state,
)
from reference.masks import mask_levels
from reference.transforms import band_table

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.spec import (
    WAVELETS,
    AxisTransform,
    MaskLevels,
    TransformSpec,
    decode_block,
    encode_block,
    fit_basis,
)

Integers = NDArray[np.int32]
Shape = tuple[int, ...]

COUPLED = ("haar", "5/3", "9/7", "9/7")
PACKETS = ("9/7", "haar", "5/3", "9/7")
BASES = ("klt", "haar", "klt", "klt")
NONE = ("none", "none", "none", "none")


def table_of(kinds: tuple[str, ...], depth: int, shape: Shape, step: float = 8.0) -> Table:
    axes = []
    for kind, n in zip(kinds, shape, strict=True):
        if kind == "klt":
            columns = np.cumsum(np.random.default_rng(n).standard_normal((n, 4 * n)), axis=0)
            axes.append(AxisTransform(kind=kind, basis=fit_basis(columns @ columns.T, step)))
        else:
            axes.append(AxisTransform(kind=kind, depth=depth if kind in WAVELETS else 0))
    t, z, y, x = axes
    return band_table(TransformSpec(axes=(t, z, y, x)), shape)


def inside(integers: Integers, table: Table) -> Integers:
    """Zeros outside the bands."""
    kept = np.zeros_like(integers)
    for row in table:
        box = tuple(slice(int(low), int(high)) for low, high in zip(row[:4], row[4:8], strict=True))
        kept[box] = integers[box]
    return kept


def make(kind: str, shape: Shape, seed: int = 0) -> Integers:
    random = np.random.default_rng(seed)
    if kind == "zero":
        return np.zeros(shape, dtype=np.int32)
    if kind == "huge":
        huge = random.integers(-MAX_INTEGER, MAX_INTEGER, shape, dtype=np.int32, endpoint=True)
        huge.flat[:: max(huge.size // 3, 1)] = MAX_INTEGER
        huge.flat[-1] = -MAX_INTEGER
        return huge
    values = random.standard_normal(shape)
    if kind == "mixed":  # all magnitudes, in rows that differ
        return np.rint(values * np.exp2(random.uniform(-6, 14, (*shape[:-1], 1)))).astype(np.int32)
    values *= 9 if kind == "dense" else np.where(random.random(shape) < 0.02, 4, 0)
    return np.rint(values).astype(np.int32)


def coefficients(shape: Shape, seed: int = 0) -> NDArray[np.float32]:
    """Coefficients / step: mostly small, smooth in magnitude, some beyond what is chosen."""
    random = np.random.default_rng(seed)
    scale = np.exp2(random.uniform(-4, 3, (*shape[:2], 1, 1)) + random.uniform(-2, 2, shape[2:]))
    return (random.standard_normal(shape) * scale).astype(np.float32)


def nearest(scaled: NDArray[np.float32]) -> Integers:
    return (np.sign(scaled) * np.floor(np.abs(scaled) + 0.5)).astype(np.int32)


@pytest.mark.parametrize("content", ["zero", "sparse", "dense", "mixed", "huge"])
@pytest.mark.parametrize("kinds", [NONE, COUPLED, PACKETS, BASES])
@pytest.mark.parametrize(
    "shape",
    [(1, 1, 1, 1), (2, 3, 5, 7), (1, 2, 1, 67), (3, 2, 37, 2), (5, 4, 13, 31), (2, 1, 20, 20)],
)
def test_there_and_back(shape: Shape, kinds: tuple[str, ...], content: str) -> None:
    table, integers = table_of(kinds, 3, shape), make(content, shape)
    given = integers.copy()
    encoded = encode_integers(integers, table)
    assert (integers == given).all()
    assert (encoded.integers == given).all()
    again = decode_integers(encoded.data, shape, table)
    assert again.dtype == np.int32
    assert (again == inside(integers, table)).all()


def test_each_way_to_write_a_magnitude() -> None:
    magnitudes = [
        *range(1, 19),
        4094,
        4095,
        4096,
        *(2**k for k in range(5, 30)),
        *(2**k - 1 for k in range(5, 30)),
        MAX_INTEGER,
    ]
    integers = np.array([[[[value, 0, -value, value] for value in magnitudes]]], dtype=np.int32)
    assert (decode_block(encode_block(integers), integers.shape) == integers).all()


def test_nothing_to_code_takes_no_bytes() -> None:
    table = table_of(("none", "klt", "9/7", "9/7"), 1, (3, 4, 5, 6), 1e9)
    assert len(table) == 0
    assert encode_integers(make("dense", (3, 4, 5, 6)), table).data == b""
    assert not decode_integers(b"", (3, 4, 5, 6), table).any()


def almost_nothing(shape: Shape) -> Integers:
    """Zeros but for the begin of each row and some places, so that estimates come to an end."""
    integers = np.zeros(shape, dtype=np.int32)
    integers[..., 0] = 2
    integers[np.random.default_rng(1).random(shape) < 0.0005] = -1
    return integers


@pytest.mark.parametrize("mode", ["integers", "trellis", "choice"])
def test_estimates_come_to_an_end(mode: str) -> None:
    shape, trellis = (1, 3, 40, 150), mode == "trellis"
    table, integers, scaled = single_band(shape), almost_nothing(shape), None
    if trellis:
        integers = of_two_quantisers(integers, table)
    if mode == "choice":
        noise = np.random.default_rng(2).uniform(-0.6, 0.6, shape)
        scaled = (integers + np.where(integers == 0, noise, 0.2)).astype(np.float32)
        integers = nearest(scaled)
    coded = encode_integers(integers, table, scaled=scaled, weight=0.3, trellis=trellis)
    again = encode_integers(coded.integers, table, trellis=trellis)
    decoded = decode_integers(again.data, shape, table, trellis=trellis)
    assert np.array_equal(decoded, coded.integers)


def rows_that_are_chosen_away() -> NDArray[np.float32]:
    """Lone coefficients that are not worth their bits, then many that exceed the first buffer."""
    scaled = np.zeros((1, 1, 600, 16), dtype=np.float32)
    scaled[:, :, :300, 3] = 0.56
    scaled[:, :, 300:] = np.random.default_rng(0).integers(-(2**29), 2**29, (300, 16))
    return scaled


def trellis_integers(kind: str, shape: Shape, table: Table) -> Integers:
    indices = make(kind, shape).clip(-(MAX_INTEGER // 2), MAX_INTEGER // 2)
    return of_two_quantisers(indices, table)


@pytest.mark.parametrize("content", ["zero", "sparse", "dense", "mixed", "huge"])
@pytest.mark.parametrize("kinds", [NONE, PACKETS, BASES])
@pytest.mark.parametrize("shape", [(1, 1, 1, 1), (2, 3, 5, 7), (3, 2, 37, 2), (5, 4, 13, 31)])
def test_two_quantisers_there_and_back(shape: Shape, kinds: tuple[str, ...], content: str) -> None:
    table = table_of(kinds, 3, shape)
    integers = trellis_integers(content, shape, table)
    data = encode_integers(integers, table, trellis=True).data
    assert np.array_equal(decode_integers(data, shape, table, trellis=True), integers)


def test_integers_of_the_other_quantiser_are_refused() -> None:
    shape = (1, 2, 3, 30)
    integers = trellis_integers("dense", shape, single_band(shape))
    flat = integers.ravel()
    at = int(np.flatnonzero(flat)[5])
    flat[at] += 1 if flat[at] > 0 else -1
    with pytest.raises(InputError, match="whose turn it is"):
        encode_integers(integers, single_band(shape), trellis=True)


def test_two_quantisers_and_a_choice_do_not_go_together() -> None:
    scaled = coefficients((1, 1, 2, 3))
    with pytest.raises(InputError, match="chosen before"):
        encode_integers(nearest(scaled), single_band(scaled.shape), scaled=scaled, trellis=True)


@pytest.mark.parametrize("choosing", [False, True])
def test_a_second_try_with_more_room_gives_the_same(
    choosing: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scaled = rows_that_are_chosen_away()
    results = []
    for room in (16, 1 << 20):
        # What the coder takes as the room of its first try.
        monkeypatch.setattr(kernels, "max", lambda *_, room=room: room, raising=False)
        coded = encode_integers(
            nearest(scaled),
            single_band(scaled.shape),
            scaled=scaled if choosing else None,
            weight=0.3,
        )
        assert len(coded.data) > 4096
        results.append((coded.data, coded.integers.tobytes()))
    assert results[0] == results[1]


def test_choosing_saves_bytes_for_little_error() -> None:
    shape = (4, 3, 21, 30)
    table, scaled = table_of(COUPLED, 2, shape), coefficients(shape)
    plain = encode_integers(nearest(scaled), table)
    for weight in (0.0, 0.1, 0.3):
        chosen = encode_integers(nearest(scaled), table, scaled=scaled, weight=weight)
        magnitude, most = np.abs(chosen.integers), np.abs(nearest(scaled))
        assert ((magnitude == most) | (magnitude == most - 1) | (magnitude == 0)).all()
        assert (chosen.integers[magnitude > 0] * scaled[magnitude > 0] > 0).all()
        assert (magnitude[most >= 14] == most[most >= 14]).all()
        assert (decode_integers(chosen.data, shape, table) == chosen.integers).all()
        # Squared error plus weight per bit: what was asked to be least is less.
        errors = [
            float(np.sum((scaled.astype(float) - q) ** 2))
            for q in (plain.integers, chosen.integers)
        ]
        assert errors[1] + weight * 8 * len(chosen.data) <= errors[0] + weight * 8 * len(plain.data)
        assert weight > 0 or np.array_equal(chosen.integers, plain.integers)
    assert len(chosen.data) < 0.95 * len(plain.data)


def tries(data: bytes, count: int) -> list[bytes]:
    """Damaged streams: cut, with a flipped bit, and noise."""
    random = np.random.default_rng(len(data))
    streams = [data[:cut] for cut in random.integers(0, len(data), count)]
    for at in random.integers(0, 8 * len(data), count):
        flipped = bytearray(data)
        flipped[at // 8] ^= 1 << (at % 8)
        streams.append(bytes(flipped))
    streams += [random.bytes(int(size)) for size in random.integers(0, 2 * len(data), count)]
    return [*streams, b"\xff" * len(data), b"\0" * 9, b""]


def survives(count: int, shape: Shape, table: Table) -> int:
    """Number of streams that are refused; all others give integers."""
    data, refused = encode_integers(make("mixed", shape), table).data, 0
    for damaged in tries(data, count):
        try:
            integers = decode_integers(damaged, shape, table)
        except DamagedFileError:
            refused += 1
        else:
            assert integers.shape == shape
            assert not (integers != inside(integers, table)).any()
    return refused


@pytest.mark.parametrize("kinds", [NONE, COUPLED, BASES])
def test_damage_is_refused_or_gives_other_integers(kinds: tuple[str, ...]) -> None:
    shape = (3, 2, 9, 26)
    survives(60, shape, table_of(kinds, 2, shape))


def test_an_endless_magnitude_is_refused() -> None:
    # The flags of the largest exponent end with a 0. A 1 lies below it in the range, so a somewhat
    # smaller number says that the exponent goes on.
    table = single_band((1, 1, 1, 1))
    largest = encode_integers(np.full((1, 1, 1, 1), 2**31 - 1, dtype=np.int32), table).data
    endless = []
    for bit in range(8 * len(largest)):
        smaller = int.from_bytes(largest, "big") - (1 << bit)
        data = max(smaller, 0).to_bytes(len(largest), "big")
        try:
            decode_integers(data, (1, 1, 1, 1), table)
        except DamagedFileError:
            endless.append(data)
    assert endless


def test_zeros_at_the_end_go_without_saying() -> None:
    shape = (2, 2, 9, 26)
    for seed in range(30):
        integers = make("mixed", shape, seed)
        data = encode_block(integers)
        assert data[-1] != 0
        assert (decode_integers(data + b"\0\0\0\0\0", shape, single_band(shape)) == integers).all()


@pytest.mark.parametrize("shape", [(0, 1, 1, 1), (1, 1, 0, 3), (2, 2, 2, 0)])
def test_a_block_of_nothing(shape: Shape) -> None:
    assert encode_block(np.zeros(shape, dtype=np.int32)) == b""
    assert decode_block(b"", shape).shape == shape
    with pytest.raises(DamagedFileError):
        decode_block(b"\xff", shape)


def test_tables_of_the_coder_do_not_depend_on_the_c_library() -> None:
    """The formulas of native/mixing.hpp and coder_signs.hpp: no value is near where it rounds."""
    p, logits = (np.arange(65536) + 0.5) / 65536, np.arange(-2816, 2817)
    tables = {
        "stretch": np.log(p / (1 - p)) * 256,
        "squash": 65536 / (1 + np.exp(-logits / 256)),
        "cost": -np.log2(np.arange(1, 65537) / 65536) * 2048,
        "log": np.log2(np.arange(1, 4096)) * 16,
        "octaves": 256 * np.log2(1.0 + np.arange(4096)),
        "rate": 0.006 * 8388608 * np.exp(-np.arange(241) / 32 * 0.69314718055994531),
    }
    for name, values in tables.items():
        fraction = (values + 0.5) % 1
        assert np.minimum(fraction, 1 - fraction).min() > 1e-9, name


SHAPES = [(1, 1, 1, 1), (2, 3, 4, 19), (1, 4, 1, 33), (3, 1, 5, 16)]


def labels(shape: tuple[int, ...], count: int, noise: float) -> np.ndarray:
    """Regions of equal labels, with a share of random ones."""
    chance = np.random.default_rng(count)
    regions = (np.indices(shape).sum(0) // 7) % count
    mixed = np.where(chance.random(shape) < noise, chance.integers(0, count, shape), regions)
    return mixed.astype(np.uint16)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 256, 257, 65536])
@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0])
def test_labels_come_back(shape, count, noise) -> None:
    source = labels(shape, count, noise)
    data = encode_labels(source, count)
    decoded = decode_labels(data, count, shape)
    assert decoded.dtype == source.dtype
    np.testing.assert_array_equal(decoded, source)


def test_regions_take_few_bytes_and_noise_hardly_more_than_its_entropy() -> None:
    shape = (4, 8, 24, 24)
    x = np.arange(24) + np.arange(4)[:, None, None, None]
    regions = np.broadcast_to(x // 6, shape).astype(np.uint8)
    assert len(encode_labels(regions, 5)) < 120
    noise = np.random.default_rng(0).integers(0, 8, shape).astype(np.uint8)
    assert len(encode_labels(noise, 8)) < noise.size * 3 / 8 * 1.08


def test_labels_that_are_numbered_in_their_order_of_appearance_cost_hardly_anything() -> None:
    blocks = np.arange(600).reshape(1, 1, 20, 30).repeat(4, 2).repeat(4, 3).astype(np.uint16)
    shuffled = np.random.default_rng(0).permutation(600).astype(np.uint16)[blocks]
    assert 3 * len(encode_labels(blocks, 600)) < len(encode_labels(shuffled, 600)) < 1000


SHAPES_MASK = [
    (1, 1, 1, 1),
    (2, 3, 4, 5),
    (3, 2, 9, 33),
    (1, 1, 1, 50),
    (5, 1, 1, 1),
    (1, 7, 1, 1),
    (2, 5, 16, 16),
    (1, 1, 11, 17),
]


def masks(shape: tuple[int, ...]) -> dict[str, npt.NDArray[np.bool_]]:
    t, z, y, x = np.indices(shape)
    random = np.random.default_rng(1).random(shape)
    return {
        "none": np.zeros(shape, bool),
        "all": np.ones(shape, bool),
        "noise": random < 0.5,
        "few": random < 0.02,
        "a ball": (z - 1) ** 2 + (y - 5) ** 2 + (x - 8 - t) ** 2 < 14,
        "half": x < shape[3] // 2,
    }


def levels_for(
    kind: str, mask: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    rng = np.random.default_rng(2)
    if kind == "nothing known":
        return np.zeros(mask.shape, np.uint8), np.zeros(mask.shape, np.uint8)
    if kind == "noise":
        return rng.integers(0, 32, mask.shape, np.uint8), rng.integers(0, 16, mask.shape, np.uint8)
    level = np.clip(np.where(mask, 24, 7) + rng.normal(0, 6, mask.shape), 0, 31).astype(np.uint8)
    return level, (level // 2).astype(np.uint8)


@pytest.mark.parametrize("shape", SHAPES_MASK, ids=str)
def test_a_mask_comes_back(shape: tuple[int, ...]) -> None:
    for mask in masks(shape).values():
        for kind in ("nothing known", "noise", "likely"):
            levels = levels_for(kind, mask)
            decoded = decode_mask(encode_mask(mask, levels), levels)
            assert decoded.dtype == bool
            np.testing.assert_array_equal(decoded, mask)


def test_what_the_levels_tell_need_not_be_coded() -> None:
    mask = masks((4, 8, 24, 40))["a ball"]
    certain = np.where(mask, 31, 0).astype(np.uint8)
    told = encode_mask(mask, (certain, certain // 2))
    untold = encode_mask(mask, levels_for("nothing known", mask))
    assert 3 * len(told) < len(untold) < mask.size / 50


def test_damaged_bytes_give_some_mask() -> None:
    mask = masks((2, 3, 9, 17))["a ball"]
    levels = levels_for("likely", mask)
    data = encode_mask(mask, levels)
    rng = np.random.default_rng(3)
    damaged = [data[:n] for n in range(len(data))] + [
        bytes(rng.integers(0, 256, n, np.uint8)) for n in (0, 1, 5, 500)
    ]
    for other in damaged:
        assert decode_mask(other, levels).shape == mask.shape


def test_the_prior_follows_the_tile_soon_and_is_not_changed() -> None:
    state = mask_prior_state()
    assert 0 < state.slots[:, 2].max() <= 12
    assert not state.slots.flags.writeable


@pytest.mark.parametrize("reach", [0, 1, 3, 64])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("shape", [(1, 1, 1, 1), (2, 3, 5, 17), (1, 9, 1, 40), (3, 1, 70, 2)])
def test_levels_are_those_of_the_reference(shape: tuple[int, ...], dtype: str, reach: int) -> None:
    random = np.random.default_rng(reach)
    values = random.normal(size=shape).astype(dtype)
    values.flat[::5] = 0.5
    for others in ((), (9, 0, 4095, 30)):
        scores = MaskLevels(
            edges=(-1.0, 0.5, 1e300), scores=(0, 3, 900, 4095), others=others, reach=reach
        )
        found = kernels.mask_levels(scores, values)
        both = [scores.scores, *([others] if others else [])]
        expected = mask_levels(values, {"edges": scores.edges, "reach": reach, "scores": both})
        for one, other in zip(found, expected, strict=True):
            assert one.dtype == np.uint8
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "change",
    [
        {"edges": (1.0,)},
        {"edges": (1.0, 1.0), "scores": (0, 1, 2)},
        {"edges": (float("nan"),), "scores": (0, 1)},
        {"edges": (10**400,), "scores": (0, 1)},
        {"edges": tuple(range(16)), "scores": (0,) * 17},
        {"scores": (-1,)},
        {"scores": (4096,)},
        {"scores": (1.5,)},
        {"others": (1, 2)},
        {"reach": 65},
        {"reach": True},
    ],
    ids=str,
)
def test_settings_that_are_not_allowed(change: Any) -> None:
    with pytest.raises(InputError):
        MaskLevels(**change)


def test_a_file_has_a_byte_for_each_number() -> None:
    blank = State.even(slots=3, weights=[(2, 100)], simples=2)
    numbers = bytes([0, 22, 43]) + bytes([1, 0]) + bytes([2, 256 - 3])
    state = unpack_state(zlib.compress(numbers), blank)
    assert state.slots.tolist() == [
        [32768, 32768, 0, 0],
        [32768, 32768, 12, 0],
        [65534, 65534, 12, 0],
    ]
    assert state.simples.tolist() == [[2, 12], [32768, 0]]
    assert state.weights.tolist() == [100 + 2 * 512, 100 - 3 * 512]
    assert not (blank.slots[:, 2]).any()


def test_the_probabilities_do_not_depend_on_the_c_library() -> None:
    values = 65536 / (1 + np.exp(-(np.arange(1, 44) - 22) / 2)) + 0.5
    near = np.abs(values - np.rint(values))
    near[21] = 1  # even odds are exact
    assert near.min() > 1e-3
    assert np.array_equal(kernels._PROBABILITIES[1:], np.floor(values))


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the memory limits of Linux")

SCRIPT = """
import resource, sys
import numpy as np
from reference import kernels
from reference.kernels import single_band
from fhash_formats.transform.predict import Predictor, passes_of

shape = (1, 1, 1 << 12, 1 << 12)  # 16 Mi vertices
levels, order = (0, 0, 1, 1), (0, 1, 2, 3)
taps = sum(len(a_pass.taps) for a_pass in passes_of(levels, order, 0))
predictor = Predictor(
    step=1.0, origin=0.0, levels=levels, order=order, reach=0, weights=(0,) * taps
)
nothing = (np.zeros(shape, np.uint8),) * 2
integers = np.arange(1 << 24, dtype=np.int32).reshape(shape)
bits = nothing[0].view(bool)
# Each call, and the MiB of its result (an int32 or a byte for each vertex) and its copies.
WORK = {
    "decode_integers": (64, lambda: kernels.decode_integers(b"", shape, single_band(shape))),
    "encode_integers": (8, lambda: kernels.encode_integers(integers, single_band(shape))),
    "decode_mask": (16, lambda: kernels.decode_mask(bytes([255]) * 99, nothing)),
    "encode_mask": (16, lambda: kernels.encode_mask(bits, nothing)),
    "decode_predicted": (64, lambda: kernels.decode_predicted(b"", shape, predictor)),
    "encode_predicted": (80, lambda: kernels.encode_predicted(integers, None, predictor)),
}
kernels.prior_state(False), kernels.mask_prior_state(), kernels.blank_predicted_state()
with open("/proc/self/status") as status:
    used = next(int(line.split()[1]) for line in status if line.startswith("VmData")) << 10
# The limit leaves room for the result and the coder's state, but not for its notes on each vertex.
result, call = WORK[sys.argv[1]]
limit = used + (result + 10 << 20)
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
try:
    call()
except MemoryError as error:
    print(error)
"""


@pytest.mark.parametrize(
    "name",
    [
        "decode_integers",
        "encode_integers",
        "decode_mask",
        "encode_mask",
        "decode_predicted",
        "encode_predicted",
    ],
)
def test_coders_say_where_memory_runs_out(name: str) -> None:
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SCRIPT, name]
    done = subprocess.run(command, capture_output=True, text=True, env=paths)
    assert done.returncode == 0, done.stderr
    assert "no memory" in done.stdout
