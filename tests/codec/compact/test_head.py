"""Heads: the network in training, and the choice of one."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planned import plan_task
from reference.head import Head, clip, inputs_of

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact import head as training
from fhash_codec.compact.head import LEAST_GAIN, likely_widths
from fhash_codec.compact.head_training import (
    BATCH_VOXELS,
    BLOCK_VOXELS,
    ERROR_UNIT,
    Batches,
    Budget,
    ErrorRange,
    Network,
    Pair,
    adam_factors,
    batches,
    draw,
    foretold_gain,
    train_head,
    weights_of,
)
from fhash_codec.compact.plan import first_settings
from fhash_codec.compact.planner import by_prices
from fhash_codec.compact.tiles import Coding, Tile
from fhash_codec.compact.transform import Bases, Gram, gram_of
from fhash_formats.errors import InputError
from fhash_formats.transform.head import INPUTS
from fhash_formats.transform.spec import AxisTransform, TransformSpec
from fhash_formats.transform.tile import TRELLIS_WEIGHT, decode_tile, encode_tile
from fhash_formats.transform.tile_format import TileSettings


def voxels(batches: int, blocks: int, *, largest: bool = False, seed: int = 0) -> Batches:
    """Batches of random voxels; or with every number at its limit, so that sums are largest."""
    random = np.random.default_rng(seed)
    shape = (batches, blocks, INPUTS, BLOCK_VOXELS)
    inputs = random.integers(-1500, 1501, shape)
    size = (batches, blocks * BLOCK_VOXELS)
    targets = np.rint(random.normal(size=size) * ERROR_UNIT)
    if largest:
        inputs = np.full(shape, 4095)
        targets = np.full(size, 1 << 30) * np.where(random.random(size) < 0.9, 1, -1)
    limit = np.full(size, 1 << 30, np.int32)
    low = np.full(size, -ERROR_UNIT, np.int32) if not largest else -limit
    return Batches(
        inputs=inputs.astype(np.int16),
        targets=targets.astype(np.int32),
        lowest=low,
        highest=limit,
        weights=np.ones(size, np.float32) if largest else random.random(size, np.float32),
    )


def network(widths: tuple[int, int] = (5, 3), seed: int = 0) -> Network:
    return Network(widths, np.random.default_rng(seed))


def factors(count: int, rate: float = 0.01) -> tuple[npt.NDArray[np.float64], ...]:
    return adam_factors(np.full(count, rate))


def layer_arrays(
    parameters: npt.NDArray[np.float64], widths: tuple[int, int]
) -> list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]:
    """Views of the weights (out, in) and biases (out,) of each layer."""
    arrays, at = [], 0
    for inputs, outputs in zip((INPUTS, *widths), (*widths, 1), strict=True):
        end = at + outputs * inputs
        weights = parameters[at:end].reshape(outputs, inputs)
        arrays.append((weights, parameters[end : end + outputs]))
        at = end + outputs
    return arrays


def test_the_gradient_is_that_of_the_mean_squared_error() -> None:
    data = voxels(1, 4)
    trained = network((4, 3))

    def loss(parameters: npt.NDArray[np.float64]) -> float:
        return _loss(data, parameters, (4, 3))

    start = trained.parameters.copy()
    trained.learn(data, 1, *factors(1, rate=0.0), rounded=False)
    assert (trained.parameters == start).all()
    gradient = 10 * trained.means
    numeric = np.empty_like(gradient)
    for index in range(len(gradient)):
        step = np.zeros_like(gradient)
        step[index] = 1e-6
        numeric[index] = loss(trained.parameters + step) - loss(trained.parameters - step)
    numeric /= 2e-6
    numeric /= max(np.linalg.norm(numeric), 1.0)  # longer gradients are shortened
    # Activations and slopes are rounded: to 1/128 and 2**-14.
    assert np.linalg.norm(gradient - numeric) < 0.03 * np.linalg.norm(numeric)


def _loss(data: Batches, parameters: npt.NDArray[np.float64], widths: tuple[int, int]) -> float:
    """The mean squared error of the first batch in sigma, by the definition, without rounding."""
    layers = layer_arrays(parameters, widths)
    values = data.inputs[0].transpose(1, 0, 2).reshape(INPUTS, -1) / 512
    for number, (weights, biases) in enumerate(layers):
        values = weights @ values + biases[:, None]
        if number < 2:
            values = np.where(values > 0, values, values / 8)
    low, high, target = (each[0] / ERROR_UNIT for each in (data.lowest, data.highest, data.targets))
    return float(np.mean(data.weights[0] * (np.clip(values[0], low, high) - target) ** 2))


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("rounded", [False, True])
def test_the_bits_of_training_are_fixed(rounded: bool, threads: int) -> None:
    """So that the same series gives the same bytes on every machine."""
    data = voxels(2, 3)
    trained = network()
    trained.learn(data, 1, *factors(6), rounded=rounded, threads=threads)
    sums = trained.squared_errors(data, rounded=rounded)
    digest = hashlib.sha256(trained.parameters.tobytes() + repr(sums).encode()).hexdigest()
    assert digest[:16] == DIGESTS[rounded]


DIGESTS = {False: "ddaaf270cd9038d7", True: "804d969ac5100df2"}


def tiles() -> list[Pair]:
    """Tiles with extreme values, thin ones among them."""
    random = np.random.default_rng(3)
    pairs = []
    for shape in ((3, 5, 7, 11), (1, 1, 9, 30), (2, 1, 1, 1)):
        original = random.normal(size=shape).astype(np.float32)
        decoded = original + random.normal(size=shape).astype(np.float32) ** 5
        decoded.ravel()[::17] = np.float32(3e38)
        decoded.ravel()[::19] = np.nan
        decoded.ravel()[::23] = -np.inf
        pairs.append(Pair(decoded, original, None))
    return pairs


@pytest.mark.parametrize(
    ("low", "high", "sigma"),
    [(-2.0, 2.0, 0.3), (0.0, 0.0, 1.0), (-3e38, 3e38, 2.0**-100), (-1.0, 2.0, 2.0**100)],
)
def test_inputs_are_those_that_the_head_computes(low: float, high: float, sigma: float) -> None:
    pairs, random = tiles(), np.random.default_rng(4)
    ends = np.float32(low), np.float32(high)
    value_range = ErrorRange(low=ends[0], high=ends[1], sigma=np.float32(sigma))
    drawn = draw(pairs, BATCH_VOXELS, random, *ends)
    with np.errstate(over="ignore", invalid="ignore"):
        found = batches(pairs, drawn, np.random.default_rng(5), value_range)
        expected = []
        for pair, voxels in zip(pairs, drawn, strict=True):
            head = Head([], np.float32(sigma), *ends)
            values = clip(pair.decoded, *ends)
            planes = inputs_of(values, head)
            expected.append(np.array(planes)[:, *voxels.places])
    inputs = found.inputs.transpose(2, 0, 1, 3).reshape(len(planes), -1)
    order = np.random.default_rng(5).permutation(inputs.shape[1])
    shuffled = np.empty_like(inputs)
    shuffled[:, order] = np.concatenate(expected, axis=1)
    np.testing.assert_array_equal(inputs, shuffled)


Floats = npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def front() -> tuple[Floats, Floats]:
    """A travelling step between two plateaus, and a smoothed copy: three-voxel means with noise."""
    t, z, y, x = np.meshgrid(
        np.arange(3), np.arange(12), np.arange(14), np.arange(40), indexing="ij"
    )
    original = np.where(x + 0.4 * y - 2 * t + 0.3 * z > 18, 2.0, -1.0).astype(np.float32)
    wide = np.pad(original, ((0, 0), (0, 0), (0, 0), (1, 1)), mode="edge")
    decoded = (wide[..., :-2] + wide[..., 1:-1] + wide[..., 2:]) / 3 + 0.05 * np.sin(x)
    decoded += np.random.default_rng(0).normal(scale=0.6, size=decoded.shape)
    return decoded.astype(np.float32), original


def mse(first: Floats, second: Floats) -> float:
    return float(np.mean((first.astype(np.float64) - second) ** 2))


def test_a_front_is_sharpened_by_what_the_gain_says(front: tuple[Floats, Floats]) -> None:
    decoded, original = front
    budget = Budget(updates=300, samples=200_000)
    trained = train_head([Pair(decoded, original, None)], -1.0, 2.0, (12, 8), budget)
    gained = 10 * np.log10(
        mse(np.clip(decoded, -1, 2), original) / mse(trained.head.apply(decoded), original)
    )
    assert trained.gain_db > 6
    assert gained == pytest.approx(trained.gain_db, abs=1.0)
    assert trained.history[-1][1:] == (300, trained.gain_db)
    assert len(trained.head.to_bytes()) <= 530


def test_the_same_seed_gives_the_same_head(front: tuple[Floats, Floats]) -> None:
    budgets = [Budget(updates=40, samples=40_000, seed=seed) for seed in (4, 4, 5)]
    runs = [
        train_head([Pair(*front, None)], -1.0, 2.0, (4, 4), budget).head.to_bytes()
        for budget in budgets
    ]
    assert runs[0] == runs[1] != runs[2]


def test_voxels_that_do_not_count_do_not_matter(front: tuple[Floats, Floats]) -> None:
    decoded, original = front
    counted = np.zeros(original.shape, dtype=bool)
    counted[:, 2:9] = True
    other = np.where(counted, original, np.nan).astype(np.float32)
    budget = Budget(updates=40, samples=40_000)
    heads = [
        train_head([Pair(decoded, values, counted)], -1.0, 2.0, (12, 8), budget).head
        for values in (original, other)
    ]
    assert heads[0].to_bytes() == heads[1].to_bytes()


@pytest.mark.parametrize(
    "pair",
    [
        Pair(*(np.zeros((1, 2, 2, 2), np.float32),) * 2, None),
        Pair(*(np.full((1, 4, 4, 4), value, np.float32) for value in (0.0, 1e-33)), None),
        Pair(*(np.full((1, 4, 4, 4), value, np.float32) for value in (-3e38, 3e38)), None),
        Pair(
            np.zeros((1, 2, 2, 2), np.float32),
            np.ones((1, 2, 2, 2), np.float32),
            np.zeros((1, 2, 2, 2), dtype=bool),
        ),
    ],
    ids=["exact", "error too small", "error too large", "no voxel counts"],
)
def test_where_nothing_can_be_learned_there_is_no_head(pair: Pair) -> None:
    budget = Budget(updates=5, samples=4096)
    assert train_head([pair], -3e38, 3e38, (12, 8), budget) is None


def fronts() -> npt.NDArray[np.float32]:
    """Return two plateaus with a travelling, slanted and curved border.

    A wavelet smears it, and a head sharpens it.
    """
    t, z, y, x = np.meshgrid(
        np.arange(5), np.arange(12), np.arange(40), np.arange(40), indexing="ij"
    )
    distance = x + 0.6 * y - 2 * t + 4 * np.sin(z / 5 + t / 4) - 26
    return (1 / (1 + np.exp(-2 * distance))).astype(np.float32)


def test_under_a_bound_a_head_makes_files_smaller_and_the_bound_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Prediction would be smaller still.
    monkeypatch.setattr("fhash_codec.compact.predictor.best_predictor", lambda *_, **__: None)
    source, sizes, calls = fronts(), {}, []

    def progress(stage: str, done: int, total: int, note: str) -> None:
        assert threading.current_thread() is threading.main_thread()
        assert 0 <= done <= total >= 1
        calls.append((stage, note.partition(",")[0]))

    for effort in (4, 5):
        config = EncodeConfig(effort=effort, max_error=0.01)
        calls.clear()
        figures = fhash_codec.encode(
            source, tmp_path / "a.fhz", config, force=True, progress=progress
        )
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert np.abs(volume[...].astype(np.float64) - source).max() <= 0.01
            assert (volume.info["mlp"] is not None) == (effort == 5)
        sizes[effort] = figures["bytes"]
    assert sizes[5] < 0.97 * sizes[4]
    # Every stage of the last encoding reported, the trials and the training too.
    for part in ("first guess", "tiles and transform", "head"):
        assert ("planning", part) in calls
    assert ("training", "") in calls
    stages = [stage for stage, _ in dict.fromkeys(calls)]
    assert list(dict.fromkeys(stages)) == [
        "scanning", "selecting", "planning", "training", "coding", "measuring", "writing",
    ]  # fmt: skip


def test_an_interruption_ends_a_training(tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int, note: str) -> None:
        if stage == "training" and done >= 50:
            raise KeyboardInterrupt

    config = EncodeConfig(psnr=45)
    with pytest.raises(KeyboardInterrupt):
        fhash_codec.encode(fronts(), tmp_path / "a.fhz", config, progress=interrupt)
    assert not list(tmp_path.iterdir())


def test_widths_pay_where_there_are_bytes_to_save() -> None:
    assert likely_widths(4_000, 2.0, "small") == (12, 8)
    assert likely_widths(400_000, 2.0, "small") == (48, 16)
    assert likely_widths(400_000, 2.0, "balanced") == (24, 16)
    assert likely_widths(400_000, 2.0, "fast") == (12, 8)


def test_no_clock_decides_how_long_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A time becomes a number of updates: the more, the longer, and the same in each run."""
    monkeypatch.setattr(training, "TRAINING_NS", 20 * training.TRAINING_NS)
    found = []
    for train in ("1s", "1", "3s"):
        config = EncodeConfig(psnr=45, train=train, timings=False)
        fhash_codec.encode(fronts(), tmp_path / "a.fhz", config, force=True)
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            steps = volume.info["training"]["steps"]
        found.append(((tmp_path / "a.fhz").read_bytes(), steps))
    assert found[0] == (found[0][0], found[1][1])
    assert found[2][1] == pytest.approx(3 * found[0][1], rel=0.02)


@pytest.mark.parametrize("train", ["0s", "-1", "often", "5 m", "2d", "nan", "25h", ""])
def test_a_time_that_is_none_is_refused(train: str) -> None:
    with pytest.raises(InputError, match="allowed: auto, none, or a time"):
        EncodeConfig(train=train)


def test_a_table_that_leaves_its_part_to_the_mlp_takes_fewer_bytes(tmp_path: Path) -> None:
    """And the values have no larger error: the table was coded less by what the MLP adds."""
    source = fronts()
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(psnr=45))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        settings = volume._model._table.settings
    assert figures["psnr"] >= 45
    assert settings.head is not None
    errors, sizes = [], []
    for joint in (0.0, 1.0):
        coded = encode_tile(source, settings, Coding(weight=TRELLIS_WEIGHT, joint=joint))
        decoded = decode_tile(coded.data, source.shape, source.dtype, settings)
        np.testing.assert_array_equal(decoded, coded.decoded)
        errors.append(mse(decoded, source))
        sizes.append(len(coded.data))
    assert errors[1] < errors[0]
    assert sizes[1] < 1.02 * sizes[0]


def test_training_only_ever_wins(tmp_path: Path) -> None:
    """A training that saves nothing leaves no MLP, however long it was asked for."""
    source = np.random.default_rng(0).normal(size=(4, 12, 16, 20)).astype(np.float32)
    sizes = {}
    for train in ("none", "1s"):
        config = EncodeConfig(psnr=40, train=train, timings=False)
        sizes[train] = fhash_codec.encode(source, tmp_path / "a.fhz", config, force=True)["bytes"]
    assert sizes["1s"] <= sizes["none"] + 300  # the header tells the training


def test_least_squares_foretell_in_which_order_heads_gain() -> None:
    """Blurred fronts can be sharpened, noise cannot."""
    source = fronts()
    blurred = (source + np.roll(source, 1, 3) + np.roll(source, -1, 3)) / 3
    noisy = source + np.random.default_rng(0).normal(0, 0.02, source.shape).astype(np.float32)
    gains = [foretold_gain([Pair(decoded, source, None)], 0.0, 1.0) for decoded in (blurred, noisy)]
    assert gains[0] > 3 > LEAST_GAIN
    assert gains[1] < gains[0]
    noise = np.random.default_rng(1).normal(size=(3, 20, 30, 40)).astype(np.float32)
    rounded = np.round(noise * 8) / 8
    assert foretold_gain([Pair(rounded, noise, None)], -4.0, 4.0) < LEAST_GAIN
    assert foretold_gain([Pair(source, source, None)], 0.0, 1.0) == 0


def test_weights_of_a_head() -> None:
    assert weights_of((12, 8)) == 28 * 12 + 12 * 8 + 8


class OneTile:
    """A sample of one tile whose lines along each axis are multiples of one line."""

    allows_bases = True

    def __init__(self) -> None:
        lines = [np.cos(np.arange(n) * 0.7) + 1.5 for n in (6, 9, 12, 20)]
        values = np.einsum("t,z,y,x->tzyx", *lines)
        self.lines, self.tiles = lines, [Tile(values.astype(np.float32), None)]
        self.grams: dict[tuple[int, float], Gram] = {}

    def map_all(self, work: Callable[[Tile], Any]) -> Iterator[Any]:
        yield from map(work, self.tiles)


SETTINGS = TileSettings(
    transform=TransformSpec(axes=(AxisTransform(kind="none"),) * 4),
    step=0.1,
    center=0.0,
    low=0.0,
    high=40.0,
    offsets=(0,) * 6,
    double=False,
)


@pytest.mark.parametrize("axis", range(4))
def test_a_basis_holds_the_lines_of_its_axis(axis: int) -> None:
    sample = OneTile()
    basis = Bases(sample, SETTINGS).along(axis).basis
    assert basis is not None
    assert basis.rank == 1
    vector, line = basis.synthesis.reshape(-1), sample.lines[axis]
    overlap = abs(vector @ line) / np.linalg.norm(vector) / np.linalg.norm(line)
    assert overlap == pytest.approx(1.0, abs=1e-3)


def planes(shape: tuple[int, int, int], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    values = np.random.default_rng(sum(shape)).normal(3.0, 40.0, shape).astype(dtype)
    if values.dtype.kind == "f":
        values.flat[:: max(1, values.size // 5)] = [np.nan, np.inf, -np.inf, 1.0, 0.0, 2.0][
            : len(values.flat[:: max(1, values.size // 5)])
        ]
    return values


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int16])
@pytest.mark.parametrize("shape", [(1, 1, 6), (200, 20, 1), (3, 37, 70), (2, 128, 65), (70, 9, 3)])
def test_lines_are_added_one_after_the_other(
    shape: tuple[int, int, int], dtype: npt.DTypeLike
) -> None:
    values = planes(shape, dtype)
    gram = gram_of(values, 0.3)
    lines = values.astype(np.float64).transpose(1, 0, 2).reshape(shape[1], -1) - 0.3
    lines[~np.isfinite(lines)] = 0.0
    added = np.zeros_like(gram)
    for plane in np.split(lines, shape[0], axis=1):
        for line in plane.T:
            added += line[:, None] * line
    np.testing.assert_array_equal(gram, added)
    # Sums of n products in another order differ by n roundings of the largest sum at most.
    bound = lines.shape[1] * np.finfo(np.float64).eps * np.max(np.sum(lines * lines, axis=1))
    np.testing.assert_allclose(gram, lines @ lines.T, rtol=0, atol=bound)


def priced(values: npt.NDArray[Any], psnr: float) -> TransformSpec:
    """The transform that the planner chooses."""
    with ThreadPoolExecutor(1) as workers:
        task = plan_task(values.astype(np.float32), workers, psnr=psnr)
        settings = first_settings(task, task.blocks)
        return by_prices(task, task.blocks, settings, 0)[1].transform


def test_hats_are_transformed_by_5_3() -> None:
    """A plane, linear between every second vertex of y and x: all details of 5/3 are 0."""
    values = np.zeros((1, 1, 257, 257))
    values[..., ::2, ::2] = np.random.default_rng(0).normal(size=(129, 129))
    values[..., 1::2, ::2] = (values[..., :-1:2, ::2] + values[..., 2::2, ::2]) / 2
    values[..., 1::2] = (values[..., :-1:2] + values[..., 2::2]) / 2
    kinds = [axis.kind for axis in priced(values, 80.0).axes[2:]]
    assert kinds == ["5/3", "5/3"]


def test_few_patterns_get_a_basis_of_their_own() -> None:
    """Each line along x is a sum of two patterns that no wavelet has."""
    rng = np.random.default_rng(1)
    values = rng.normal(size=(8 * 24, 2)) @ rng.normal(size=(2, 40))
    assert priced(values.reshape(1, 8, 24, 40), 60.0).axes[3].kind == "klt"
