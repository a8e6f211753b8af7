"""Input encodings and their models: values, gradients, and training of each."""

from __future__ import annotations

import dataclasses
import sys
import types
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch

from readable_paper import interpolate

from fhash_bench.paper import encodings as engines
from fhash_bench.paper import (
    trained as tcnn,
)
from fhash_bench.paper.data import (
    Arrangement,
    Data,
    arrangement,
    gather_data,
    hash_resolutions,
    tcnn_network,
    tcnn_tables,
)
from fhash_bench.paper.encodings import (
    GatherModel,
    GridLevel,
    HashLevel,
    LatticeModel,
    Level,
    WeightedSum,
    adam_step,
    of_key_frame,
)
from fhash_bench.paper.trained import TrainedEncoding, build, levels_of, paper_grid
from fhash_codec.features.bricks import sample_places
from fhash_codec.paper.engines.parameters import BETA1, BETA2, EPSILON
from fhash_formats.errors import MissingDependencyError
from fhash_formats.series import ArraySeries


def random_points(count: int, sizes: tuple[int, ...]) -> torch.Tensor:
    """Points (n, 4) anywhere between vertices, at whole key frames."""
    random = torch.Generator().manual_seed(1)
    span = torch.tensor(sizes, dtype=torch.float64) - 1
    points = torch.rand(count, 4, generator=random, dtype=torch.float64) * span
    points[:, 0] = points[:, 0].round()
    return points


def test_hash_by_hand() -> None:
    # 5 corners over 9 vertices: vertex (z, y, x) = (2, 5, 8) lies at corner (1, 2.5, 4).
    level = HashLevel(5, 16, (2, 9, 9, 9))
    buckets, weights = level.corners(torch.tensor([[1, 2, 5, 8]], dtype=torch.float64))
    found: dict[int, float] = {}
    for bucket, weight in zip(buckets[0].tolist(), weights[0].tolist(), strict=True):
        if weight > 0:
            found[bucket] = found.get(bucket, 0) + weight
    # x 1, y 2654435761 = ...0001 and z 805459861 = ...0101 in the last four bits.
    # (z, y, x) = (1, 2, 4): 5 ^ 2 ^ 4 = 3; (1, 3, 4): 5 ^ 3 ^ 4 = 2. The table of key frame 1
    # begins at 16.
    assert found == {19: 0.5, 18: 0.5}


def test_hash_in_a_large_table_by_hand() -> None:
    level = HashLevel(256, 1 << 20, (1, 256, 256, 256))
    buckets, weights = level.corners(torch.tensor([[0, 200, 100, 50]], dtype=torch.float64))
    bucket = int(buckets[0, weights[0].argmax()])
    assert bucket == ((200 * 805459861) ^ (100 * 2654435761) ^ 50) % 2**20 == 1041790


def test_collisions_are_counted() -> None:
    assert HashLevel(2, 1 << 20, (1, 9, 9, 9)).collisions() == 0.0
    # 64 corners in 16 buckets: none can be alone in all of them.
    assert HashLevel(4, 16, (1, 9, 9, 9)).collisions() == 1.0


@pytest.mark.parametrize("resolution", [(5, 6, 7), (2, 2, 2), (9, 11, 13)])
def test_dense_grid_equals_grid_sample(resolution: tuple[int, int, int]) -> None:
    sizes = (3, 9, 8, 12)
    level = GridLevel((3, *resolution), sizes, True)
    table = torch.randn(level.size, 2, dtype=torch.float64)
    points = random_points(200, sizes)
    buckets, weights = level.corners(points)
    values = (weights.unsqueeze(-1) * table[buckets]).sum(1)
    span = torch.tensor(sizes[1:], dtype=torch.float64) - 1
    grid = (2 * points[:, 1:] / span - 1).flip(1)
    for key in range(3):
        volume = table.view(3, *resolution, 2)[key].permute(3, 0, 1, 2)
        expected = torch.nn.functional.grid_sample(
            volume[None], grid[None, :, None, None], align_corners=True
        )[0, :, :, 0, 0].T
        chosen = points[:, 0] == key
        torch.testing.assert_close(values[chosen], expected[chosen])


def test_fhash_equals_the_products_tesseract() -> None:
    sizes, resolution = (4, 9, 8, 12), (2, 5, 4, 6)
    level = GridLevel(resolution, sizes, False)
    points = random_points(100, sizes)
    points[:, 0] += 0.25 * (points[:, 0] < 3)
    table = torch.randn(level.size, 2, dtype=torch.float64)
    buckets, weights = level.corners(points)
    assert buckets.shape == (100, 16)
    values = (weights.unsqueeze(-1) * table[buckets]).sum(1)
    torch.testing.assert_close(values, interpolate(table, points, sizes, resolution))


@pytest.mark.parametrize(
    "level",
    [
        GridLevel((3, 4, 1, 6), (3, 9, 1, 12), True),
        GridLevel((2, 4, 1, 6), (3, 9, 1, 12), False),
        HashLevel(8, 64, (3, 9, 1, 12)),
    ],
)
def test_weights_add_up_to_one_and_buckets_are_of_the_level(level: GridLevel | HashLevel) -> None:
    buckets, weights = level.corners(random_points(300, (3, 9, 1, 12)))
    torch.testing.assert_close(weights.sum(1), torch.ones(300, dtype=torch.float64))
    assert weights.min() >= 0
    assert 0 <= buckets.min() <= buckets.max() < level.size


NAMES = ("dense", "dense-multi", "hash", "fhash")
RATES = np.full(100, 0.01)


def levels(name: str, data: Data) -> Sequence[Level]:
    return levels_of(name, data, data.coreset, arrangement("equal", name, data))


def model_of(name: str, data: Data, dtype: torch.dtype = torch.float64) -> GatherModel:
    return GatherModel(
        levels(name, data), data.coreset, RATES, seed=3, device=torch.device("cpu"), dtype=dtype
    )


@pytest.mark.parametrize("name", NAMES)
def test_gradient_equals_differences(name: str, data: Data) -> None:
    model = model_of(name, data)
    random = np.random.default_rng(0)
    with torch.no_grad():  # embeddings near 0 hide errors of the network's gradient
        model.table += torch.from_numpy(random.normal(size=model.table.shape))
    samples = np.arange(0, len(data.coreset.values), 5)
    target = torch.from_numpy(data.coreset.values[samples])

    def loss() -> float:
        values = torch.from_numpy(model.infer(samples).astype(np.float64))
        return float((values - target).square().mean())

    assert loss() > 0.01
    points = model.places[samples].double()

    def exact() -> float:
        return float((model.sample(points) - target).square().mean())

    np.testing.assert_allclose(exact(), loss(), rtol=1e-6)
    gradients = model.gradients(samples)
    for number, gradient in zip(model.numbers, gradients, strict=True):
        flat, slopes = number.detach().view(-1), gradient.reshape(-1)
        steepest = slopes.abs().argsort(descending=True)[:20]
        for place in [*steepest.tolist(), *random.integers(0, len(flat), 5).tolist()]:
            before, step = float(flat[place]), 1e-8  # a longer one may cross a kink of ReLU
            flat[place] = before + step
            high = exact()
            flat[place] = before - step
            low = exact()
            flat[place] = before
            assert float(slopes[place]) == pytest.approx((high - low) / (2 * step), abs=2e-7)


def test_weighted_sum_passes_gradcheck() -> None:
    table = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)
    buckets = torch.randint(0, 7, (5, 4))
    weights = torch.rand(5, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda rows: WeightedSum.apply(rows, buckets, weights), table)


@pytest.mark.parametrize("name", NAMES)
def test_training_lowers_the_error(name: str, data: Data) -> None:
    model = model_of(name, data, torch.float32)
    every = np.arange(len(data.coreset.bricks))
    samples = np.arange(len(data.coreset.values))
    before = np.square(model.infer(samples) - data.coreset.values).mean()
    for _ in range(60):
        model.train(every)
    after = np.square(model.infer(samples) - data.coreset.values).mean()
    assert after < before / 50
    assert 0 < model.moved() <= model.embeddings


@pytest.mark.parametrize("name", ["hash", "fhash"])
def test_kept_corners_and_fresh_ones_train_alike(
    name: str, data: Data, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = model_of(name, data)
    monkeypatch.setattr(engines, "KEPT_BYTES", 0)
    monkeypatch.setattr(engines, "WHOLE", -1.0)  # all buckets are held
    fresh = model_of(name, data)
    assert fresh.rank is None
    assert fresh.tables == kept.tables
    with torch.no_grad():  # initial numbers depend on how many are held
        for number, other in zip(fresh.numbers[1:], kept.numbers[1:], strict=True):
            number.copy_(other)
        table = torch.zeros_like(fresh.table)
        table[kept.rank >= 0 if kept.rank is not None else slice(None)] = kept.table
        fresh.table.copy_(table)
    every = np.arange(len(data.coreset.bricks))
    for _ in range(3):
        kept.train(every)
        fresh.train(every)
    assert kept.moved() == fresh.moved()
    for array, other in zip(kept.arrays(), fresh.arrays(), strict=True):
        np.testing.assert_allclose(array, other, atol=1e-9)


def test_values_at_vertices_are_those_of_samples(data: Data) -> None:
    model = model_of("hash", data, torch.float32)
    model.train(np.arange(len(data.coreset.bricks)))
    samples = np.arange(len(data.coreset.values))
    np.testing.assert_allclose(
        model.sample(model.places.double()).numpy(), model.infer(samples), atol=1e-6
    )


CPU = torch.device("cpu")


def levels_lattice(name: str, data: Data) -> list[GridLevel]:
    found = levels_of(name, data, data.coreset, arrangement("best", name, data))
    return [level for level in found if isinstance(level, GridLevel)]


def same_numbers(lattice: LatticeModel, gather: GatherModel) -> None:
    """Give a gather model in float64 the numbers of a lattice model."""
    arrays = [torch.from_numpy(array).double() for array in lattice.arrays()]
    count = len(lattice.levels)
    table = torch.cat(arrays[:count])
    with torch.no_grad():
        gather.table.copy_(table if gather.rank is None else table[gather.rank >= 0])
        for number, array in zip(gather.numbers[1:], arrays[count:], strict=True):
            number.copy_(array)


@pytest.mark.parametrize("name", ["dense", "dense-multi", "fhash"])
def test_values_and_gradients_are_those_of_the_gather_engine(name: str, data: Data) -> None:
    lattice = LatticeModel(levels_lattice(name, data), data.coreset, RATES, seed=1, device=CPU)
    gather = GatherModel(
        levels_lattice(name, data), data.coreset, RATES, seed=1, device=CPU, dtype=torch.float64
    )
    assert (lattice.tables, lattice.mlp) == (gather.tables, gather.mlp)
    same_numbers(lattice, gather)
    samples, every = np.arange(len(data.coreset.values)), np.arange(len(data.coreset.bricks))
    np.testing.assert_allclose(lattice.infer(samples), gather.infer(samples), atol=1e-6)
    lattice.train(every)
    expected = gather.gradients(samples)
    # After one step Adam's mean is a tenth of the gradient.
    state = lattice.engine.state()
    moments = state["flat_mean"][-lattice.mlp :] * 10
    network = torch.cat(
        [
            torch.column_stack([weight, bias]).flatten()
            for weight, bias in zip(expected[1::2], expected[2::2], strict=True)
        ]
    )
    np.testing.assert_allclose(moments, network, atol=2e-6)
    table = torch.zeros(gather.embeddings, 2, dtype=torch.float64)
    table[slice(None) if gather.rank is None else gather.rank >= 0] = expected[0]
    fine = state["fine_mean"] * 10
    total = float(table[: lattice.levels[0].size].abs().sum())
    assert float(np.abs(fine).sum()) == pytest.approx(total, rel=1e-4)


@pytest.mark.parametrize("name", ["dense", "dense-multi", "fhash"])
def test_training_lowers_the_error_and_sample_agrees(name: str, data: Data) -> None:
    model = LatticeModel(levels_lattice(name, data), data.coreset, RATES, seed=2, device=CPU)
    samples, every = np.arange(len(data.coreset.values)), np.arange(len(data.coreset.bricks))
    before = np.square(model.infer(samples) - data.coreset.values).mean()
    for _ in range(60):
        model.train(every)
    model.settle()
    values = model.infer(samples)
    assert np.square(values - data.coreset.values).mean() < before / 50
    np.testing.assert_allclose(model.sample(model.places.double()).numpy(), values, atol=1e-5)
    assert 0 < model.moved() <= model.embeddings


def test_dense_grid_equals_grid_sample_lattice(data: Data) -> None:
    model = LatticeModel(
        levels_lattice("dense-multi", data), data.coreset, RATES, seed=4, device=CPU
    )
    for _ in range(5):
        model.train(np.arange(len(data.coreset.bricks)))
    model.settle()
    arrays = [torch.from_numpy(array) for array in model.arrays()]
    count, (keys, z, y, x) = len(model.levels), model.levels[0].sizes
    places = model.places
    grid = (2 * places[:, 1:] / (torch.tensor([z, y, x]) - 1) - 1).flip(1).float()
    hidden = []
    for level, table in zip(model.levels, arrays[:count], strict=True):
        volume = table.view(*level.resolution, 2).permute(0, 4, 1, 2, 3)
        of_keys = torch.nn.functional.grid_sample(
            volume, grid.expand(keys, -1, -1)[:, :, None, None], align_corners=True
        )[..., 0, 0]
        hidden.append(of_keys[places[:, 0].long(), :, torch.arange(len(places))])
    values = torch.cat(hidden, 1)
    for number, (weight, bias) in enumerate(zip(arrays[count::2], arrays[count + 1 :: 2])):  # noqa: B905
        values = (values if number == 0 else values.relu()) @ weight.T + bias
    samples = np.arange(len(data.coreset.values))
    np.testing.assert_allclose(model.infer(samples), values[:, 0].numpy(), atol=1e-5)


def test_values_stand_at_their_places(data: Data) -> None:
    places = sample_places(data.coreset)
    at = places[:, 1:] + np.array(data.coreset.box.first)
    found = [data.frames[key][tuple(place)] for key, place in zip(places[:, 0], at, strict=True)]
    np.testing.assert_array_equal(found, data.coreset.values)


def test_key_frames_split_the_samples(data: Data) -> None:
    places = sample_places(data.coreset)
    for key in range(3):
        alone = of_key_frame(data.coreset, key)
        np.testing.assert_array_equal(alone.values, data.coreset.values[places[:, 0] == key])
        expected = places[places[:, 0] == key] * [0, 1, 1, 1]
        np.testing.assert_array_equal(sample_places(alone), expected)
        assert alone.key_frames == (data.key_frames[key],)
        assert alone.box == data.coreset.box


def test_levels_cover_the_box(data: Data) -> None:
    box, keys = data.coreset.box.shape, len(data.key_frames)
    arranged = arrangement("equal", "dense", data)
    (dense,) = levels_of("dense", data, data.coreset, arranged)
    assert dense == GridLevel((keys, *box), (keys, *box), True)
    multi = levels_of("dense-multi", data, data.coreset, arranged)
    assert multi[0] == dense
    assert [level.resolution[0] for level in multi if isinstance(level, GridLevel)] == [keys] * len(
        multi
    )
    hashed = levels_of("hash", data, data.coreset, arranged)
    assert all(isinstance(level, HashLevel) for level in hashed)
    assert len({level.size for level in hashed}) == 1
    assert hashed[0].size < keys * box[0] * box[1] * box[2]


def test_the_same_batches_in_the_protocol_equal(data: Data) -> None:
    orders = []
    for name in ("dense", "hash", "fhash"):
        arranged = arrangement("equal", name, data)
        encoding = build(
            name, data, arranged, steps=4, epochs=1, seed=5, device=torch.device("cpu")
        )
        (part,) = encoding.parts
        orders.append([chosen.tolist() for chosen in part.plan.order(0)])
    assert orders[0] == orders[1] == orders[2]


def test_the_rate_of_the_protocol_best_falls_to_zero(data: Data) -> None:
    rates = {}
    for protocol in ("equal", "best"):
        arranged = arrangement(protocol, "dense", data)
        encoding = build(
            "dense", data, arranged, steps=2, epochs=3, seed=1, device=torch.device("cpu")
        )
        rates[protocol] = encoding.parts[0].plan.rates[1:]
    assert (rates["equal"] == 0.01).all()
    assert (rates["best"][1:] < rates["best"][:-1]).all()
    assert rates["best"][0] < 0.01
    assert abs(rates["best"][-1]) < 1e-12


def test_released_has_the_levels_of_the_shortest_axis(data: Data) -> None:
    arranged = arrangement("released", "fhash", data)
    found = levels_of("fhash", data, data.boxes, arranged)
    assert [level.resolution for level in found if isinstance(level, GridLevel)] == [
        (3, 7, 9, 12),
        (2, 4, 5, 6),
        (2, 2, 3, 3),
    ]
    published = levels_of("fhash", data, data.boxes, arrangement("published", "fhash", data))
    assert len(published) == 4


def test_released_values_are_from_0_to_1_over_the_key_frames(series: ArraySeries) -> None:
    values = np.stack([series.read(step) for step in range(5)])
    values[1] *= 2  # no key frame
    data = gather_data("blob", ArraySeries(values), "interval:0.2:2", "0,2,4")
    arranged = arrangement("released", "fhash", data)
    encoding = build("fhash", data, arranged, steps=1, epochs=1, seed=1, device=torch.device("cpu"))
    (part,) = encoding.parts
    assert float(part.coreset.values.max()) == 1
    assert data.boxes.values.max() == pytest.approx(0.5, abs=0.01)
    at = torch.from_numpy(np.argwhere(data.masks[0]))
    inner = part.model.sample(torch.cat([torch.zeros(len(at), 1), at], 1).double())
    low, high = data.key_range
    torch.testing.assert_close(encoding.sample(0, at), low + (high - low) * inner)


def test_key_frames_start_apart(data: Data) -> None:
    arranged = Arrangement(joint=False, samples="everything", steps=(1,), engine="gather")
    encoding = build("dense", data, arranged, steps=1, epochs=1, seed=1, device=torch.device("cpu"))
    assert [part.plan.seed for part in encoding.parts] == [3, 4, 5]
    first, second, _ = (part.model for part in encoding.parts)
    assert isinstance(first, GatherModel)
    assert isinstance(second, GatherModel)
    assert first.places is second.places  # every vertex is a sample at every key frame
    assert not torch.equal(first.table, second.table)


@pytest.mark.parametrize(
    ("name", "frame", "grid"),
    [
        ("flame", (14, 43, 50), (16, 48, 48)),
        ("shell", (108, 108, 108), (96, 96, 96)),
        ("mine", (10, 20, 30), (10, 20, 30)),
    ],
)
def test_the_papers_grid_at_a_scale(
    name: str, frame: tuple[int, int, int], grid: tuple[int, int, int], data: Data
) -> None:
    empty = ArraySeries(np.zeros((1, *frame), np.float32))
    assert paper_grid(dataclasses.replace(data, name=name, series=empty)) == grid


class StandIn(torch.nn.Module):
    """Stand-in for tiny-cuda-nn's module: the same arguments, the same number of parameters."""

    made: list[dict[str, Any]] = []  # noqa: RUF012

    def __init__(self, inputs: int, outputs: int, encoding: dict, network: dict, seed: int) -> None:
        super().__init__()
        self.made.append(encoding | network | {"inputs": inputs, "outputs": outputs, "seed": seed})
        self.params = torch.nn.Parameter(torch.zeros(COUNT[0]))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return (points @ self.params[:3] + self.params[3])[:, None].half()


COUNT = [0]


def test_one_line_says_what_is_missing(data: Data) -> None:
    reason = tcnn.missing()
    if reason is None:
        pytest.skip("tiny-cuda-nn is here")
    assert "\n" not in reason
    assert reason.startswith("tcnn: ")
    with pytest.raises(MissingDependencyError, match="tiny-cuda-nn"):
        tcnn.TcnnModel(
            of_key_frame(data.coreset, 0),
            np.full(3, 0.01),
            coarsest=4,
            seed=0,
            device=torch.device("cpu"),
        )


def test_training_beside_a_stand_in(data: Data, monkeypatch: pytest.MonkeyPatch) -> None:
    package = types.ModuleType("tinycudann")
    package.NetworkWithInputEncoding = StandIn  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tinycudann", package)
    monkeypatch.setattr(tcnn, "missing", lambda: None)
    coreset = of_key_frame(data.coreset, 0)
    box = coreset.box.shape
    levels = hash_resolutions(box, 4)
    COUNT[0] = tcnn_tables(box, 4, 1) + tcnn_network(len(levels), 1)
    model = tcnn.TcnnModel(
        coreset, np.full(50, 0.01), coarsest=4, seed=0, device=torch.device("cpu")
    )
    made = StandIn.made[-1]
    assert made["n_levels"] == len(levels)
    assert made["base_resolution"] * 2 ** (len(levels) - 1) == levels[0]
    assert (made["n_hidden_layers"], made["n_neurons"]) == (2, 64)
    samples = np.arange(len(coreset.values))
    before = np.square(model.infer(samples) - coreset.values).mean()
    for _ in range(40):
        model.train(np.arange(len(coreset.bricks)))
    assert np.square(model.infer(samples) - coreset.values).mean() < before
    assert model.moved() == 0  # the stand-in has no tables
    COUNT[0] -= 8
    with pytest.raises(MissingDependencyError, match="parameters"):
        tcnn.TcnnModel(coreset, np.full(3, 0.01), coarsest=4, seed=0, device=torch.device("cpu"))


def trained(name: str, protocol: str, data: Data, epochs: int = 2) -> TrainedEncoding:
    arranged = arrangement(protocol, name, data)
    encoding = build(
        name,
        data,
        arranged,
        steps=arranged.steps[0],
        epochs=epochs,
        seed=1,
        device=torch.device("cpu"),
    )
    for epoch in range(epochs):
        encoding.train_epoch(epoch)
    encoding.settle()
    return encoding


def near_masks(data: Data, key: int) -> np.ndarray:
    """Vertices (z, y, x) in the coreset of a key frame or of a neighbour."""
    return np.logical_or.reduce(data.masks[max(key - 1, 0) : key + 2])


@pytest.mark.parametrize(
    ("name", "protocol"),
    [
        ("dense", "published"),
        ("hash", "equal"),
        ("fhash", "published"),
        ("fhash", "released"),
        ("fhash", "best"),
    ],
)
def test_a_frame_holds_the_samples_and_the_background(name: str, protocol: str, data: Data) -> None:
    encoding = trained(name, protocol, data)
    for key, mask in enumerate(data.masks):
        frame = encoding.frame(key)
        trained_on = {"published": mask, "released": mask}.get(protocol, near_masks(data, key))
        if protocol == "published" and name != "fhash":
            trained_on = np.ones_like(mask)
        places = np.argwhere(trained_on)
        at = encoding.sample(key, torch.from_numpy(places)).numpy()
        np.testing.assert_allclose(frame[tuple(places.T)], at, atol=1e-5)
        if protocol != "released":
            assert (frame[~trained_on] == np.float32(data.background)).all()


def test_places_outside_the_box_are_the_background(data: Data) -> None:
    encoding = trained("fhash", "equal", data)
    outside = torch.tensor([[-1.0, 0, 0], [0, 0, 50.0]])
    assert (encoding.sample(0, outside) == np.float32(data.background)).all()


def test_between_key_frames_others_interpolate_values(data: Data) -> None:
    places = torch.tensor([[3.0, 4.0, 5.0], [3.5, 4.0, 4.0]])
    for name in ("dense", "fhash"):
        encoding = trained(name, "equal", data, epochs=4)
        before, after = (encoding.sample(key, places) for key in (0, 1))
        between = encoding.sample(0.5, places)
        linear = torch.allclose(between, (before + after) / 2, atol=1e-6)
        assert linear == (name == "dense")


def test_parameters_count_every_key_frame(data: Data) -> None:
    encoding = trained("dense", "published", data, epochs=1)
    assert encoding.tables == 7 * 9 * 12 * 2 * 3
    # 2 inputs, 2 hidden layers of 64, 1 output, a network for each key frame.
    assert encoding.mlp == 3 * (2 * 64 + 64 + 64 * 64 + 64 + 64 + 1)
    assert sum(array.size for array in encoding.arrays()) == encoding.tables + encoding.mlp
    assert encoding.buckets_used() == 1.0
    assert encoding.samples_an_epoch == 3 * 7 * 9 * 12


def test_a_step_is_that_of_torch() -> None:
    random = torch.Generator().manual_seed(0)
    ours = torch.randn(100, generator=random, dtype=torch.float64)
    theirs = torch.nn.Parameter(ours.clone())
    adam = torch.optim.Adam([theirs], lr=0.01, betas=(BETA1, BETA2), eps=EPSILON, fused=True)
    mean, square = torch.zeros_like(ours), torch.zeros_like(ours)
    for step in range(1, 6):
        gradient = torch.randn(100, generator=random, dtype=torch.float64)
        adam_step(ours, gradient, mean, square, step, 0.01)
        theirs.grad = gradient
        adam.step()
    torch.testing.assert_close(ours, theirs.detach(), rtol=1e-10, atol=1e-12)
