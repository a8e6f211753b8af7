"""The paper profile's tables through the coder of the compact profile: what it costs is what is said, and less than it saves."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, QualityError
from fhash_codec.coreset.occupancy import unpack
from fhash_codec.coreset.selection import open_source
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.paper.points import input_slopes
from fhash_codec.paper.regions import decode_region
from fhash_codec.paper.selection import select
from fhash_codec.paper.storage import finest_frame, mix_components
from fhash_codec.paper.tables.bricks import Bricks
from fhash_codec.paper.tables.codings import squared_weights
from fhash_codec.paper.tables.loss import Samples
from fhash_codec.paper.tables.step import MAX_LOSS
from fhash_codec.paper.tables.tiles import tile_shape
from fhash_codec.paper.tables.trained_tables import corners, spread, trained_tables
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import DamagedFileError, InputError

CODED = EncodeConfig(profile="paper", epochs=6, width=16, tables="transform")


def field(shape=(5, 9, 12, 20)) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(np.float32)


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


@pytest.fixture(scope="module", params=["all", "feature", "one", "three"])
def pair(request, tmp_path_factory):
    """The figures and paths of one training, its tables as float32 and coded."""
    more = {
        "all": {},
        "feature": {"features": ("interval:50:200",), "dilation": 0},
        "one": {"embedding_size": 1, "hidden_layers": 0, "fold": 3},
        "three": {"embedding_size": 3, "key_frames": "0,2,4", "features": ("interval:20:300",)},
    }[request.param]
    folder = tmp_path_factory.mktemp("coded")
    config = replace(CODED, **more)
    found = {}
    for name, tables in {"exact": "float32", "coded": "transform"}.items():
        found[name] = (
            fhash_codec.encode(field(), folder / f"{name}.fhz", replace(config, tables=tables)),
            folder / f"{name}.fhz",
        )
    return found


def test_the_loss_is_within_its_limit_and_what_is_said(pair):
    (exact, _), (coded, path) = pair["exact"], pair["coded"]
    loss = exact["psnr"] - coded["psnr"]
    assert exact["tables_loss_db"] is None
    assert coded["tables_loss_db"] <= MAX_LOSS + 1e-4
    if len(coded["key_frames"]) == 5:
        assert coded["tables_loss_db"] == pytest.approx(loss, abs=2e-4)
    else:
        # Steps between key frames are wrong by more, which coding does not change.
        assert loss <= MAX_LOSS
    with fhash_codec.open(path) as volume:
        assert volume.info["model"]["tables_loss_db"] == coded["tables_loss_db"]
        assert volume.info["model"]["tables"] == "transform"
        assert volume.info["required_features"] == ["transform"]
        assert coded["bytes"] < 0.75 * exact["bytes"]
        assert volume.verify() == len(volume.info["arrays"])
    with fhash_codec.open(path) as volume, fhash_codec.open(pair["exact"][1]) as other:
        for t in (0, 1.5, 4):
            np.testing.assert_array_equal(volume.occupancy(t), other.occupancy(t))


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_whole_bit_for_bit(pair, index):
    path = pair["coded"][1]
    whole = decoded(path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[index], whole[index])


def test_points_and_times_between_are_as_smooth_as_before(pair):
    random = np.random.default_rng(0)
    points = {
        axis: random.random(300) * (n - 1) for axis, n in zip("tzyx", field().shape, strict=True)
    }
    with fhash_codec.open(pair["coded"][1]) as volume, fhash_codec.open(pair["exact"][1]) as other:
        values, slopes = volume.sample(**points, gradient=True)
        expected = other.sample(**points)
        known = np.isfinite(expected)
        assert known.sum() > 30
        np.testing.assert_array_equal(known, np.isfinite(values))
        assert np.isfinite(slopes[known]).all()
        span = float(np.ptp(field()))
        assert np.sqrt(np.mean((values - expected)[known] ** 2)) < 0.05 * span


def test_a_promise_is_kept_and_no_more(tmp_path):
    source = field()
    free = fhash_codec.encode(source, tmp_path / "a.fhz", replace(CODED, epochs=30))
    wanted = free["psnr"] - 6.0
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", replace(CODED, epochs=30, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.5
    assert figures["bytes"] < 0.97 * free["bytes"]
    assert figures["tables_loss_db"] == pytest.approx(6.0, abs=0.6)
    with pytest.raises(QualityError) as missed:
        fhash_codec.encode(source, tmp_path / "c.fhz", replace(CODED, epochs=1, psnr=150.0))
    # Out of reach anyway: then only the usual loss is taken.
    assert missed.value.figures["tables_loss_db"] <= MAX_LOSS + 1e-4


@pytest.mark.parametrize(
    "shape", [(1, 1, 1, 1), (3, 1, 1, 1), (1, 1, 1, 7), (2, 2, 2, 2), (7, 3, 5, 11)]
)
def test_every_shape_comes_back(tmp_path, shape):
    source = np.random.default_rng(0).random(shape, dtype=np.float32)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", CODED)
    back = decoded(tmp_path / "a.fhz")
    assert back.shape == shape
    assert np.isfinite(back).all()
    assert figures["max_abs_error"] == pytest.approx(np.abs(back - source).max(), rel=1e-5)


def test_a_constant_series_comes_back_exactly(tmp_path):
    figures = fhash_codec.encode(np.full((3, 4, 5, 6), 7.25), tmp_path / "a.fhz", CODED)
    assert (decoded(tmp_path / "a.fhz") == 7.25).all()
    assert figures["rmse"] == 0


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("a.fhz", "b.fhz"):
        fhash_codec.encode(
            field((3, 6, 7, 8)), tmp_path / name, replace(CODED, epochs=2, timings=False)
        )
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


def test_it_is_read_without_torch_and_without_native_code_to_the_same_tables(tmp_path, pair):
    code = (
        "import sys, numpy, fhash_codec; from fhash_formats import native; assert native.library() is None\n"
        "with fhash_codec.open(sys.argv[1]) as volume:\n"
        "    table = volume._model.network.tables[0]\n"
        "    numpy.savez(sys.argv[2], table.read(tuple(slice(0, n) for n in table.shape)), volume.read(1))\n"
        "assert 'torch' not in sys.modules\n"
    )
    path = pair["coded"][1]
    command = [sys.executable, "-c", code, str(path), str(tmp_path / "a.npz")]
    subprocess.run(command, env={**os.environ, "FHASH_NATIVE": "0"}, check=True)
    with np.load(tmp_path / "a.npz") as found, fhash_codec.open(path) as volume:
        table = volume._model.network.tables[0]
        np.testing.assert_array_equal(
            found["arr_0"], table.read(tuple(slice(0, n) for n in table.shape))
        )
        np.testing.assert_array_equal(found["arr_1"], volume.read(1))


def rewritten(path, target, mixing) -> None:
    """A container of the same arrays, not coded, with other attributes of one component of the finest level."""
    with Container.open(path) as container, ContainerWriter(target) as writer:
        for name, array in container.arrays.items():
            attributes = mixing if name == "tables/level_1/component_2" else dict(array.attributes)
            writer.add_whole(name, array.read(), attributes=attributes)
        writer.commit(container.header)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("small") / "a.fhz"
    fhash_codec.encode(field((3, 4, 5, 6)), path, replace(CODED, epochs=2))
    return path


def test_coded_or_not_the_components_mean_the_same(tmp_path, small):
    with Container.open(small) as container:
        mixing = dict(container.arrays["tables/level_1/component_2"].attributes)
    rewritten(small, tmp_path / "a.fhz", mixing)
    np.testing.assert_array_equal(decoded(tmp_path / "a.fhz"), decoded(small))


@pytest.mark.parametrize(
    "mixing",
    [{}, {"mixing": 1.0}, {"mixing": [1.0]}, {"mixing": [1.0, "2"]}, {"mixing": [1.0, 2.0, 3.0]}],
    ids=str,
)
def test_a_mixing_of_other_numbers_is_refused(tmp_path, small, mixing):
    with pytest.raises(InputError, match="array tables/level_1/component_2 attribute mixing"):
        rewritten(small, tmp_path / "a.fhz", mixing)


def test_a_mixing_beyond_float32_is_damage(tmp_path, small):
    rewritten(small, tmp_path / "a.fhz", {"mixing": [1e308, 0.0]})
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        pytest.raises(DamagedFileError, match="not finite"),
    ):
        volume.read(0)


def test_mixing_adds_the_components_from_the_first_on():
    random = np.random.default_rng(0)
    parts, mixing = (
        [random.random((3, 4), dtype=np.float32) for _ in range(3)],
        random.random((3, 3), dtype=np.float32),
    )
    expected = np.stack(
        [(parts[0] * m[0] + parts[1] * m[1]) + parts[2] * m[2] for m in mixing.T], axis=-1
    )
    np.testing.assert_array_equal(mix_components(parts, mixing), expected)
    assert mix_components(parts, mixing).dtype == np.float32


@pytest.mark.parametrize(("length", "resolution"), [(1, 1), (5, 3), (5, 5), (9, 2), (20, 7)])
def test_corners_and_weights_are_those_of_the_interpolation(length, resolution):
    position = np.arange(length) * (resolution - 1) / max(length - 1, 1)
    first, last = corners(length, resolution)
    np.testing.assert_array_equal(first, np.floor(position + 1e-12))
    np.testing.assert_array_equal(last, np.ceil(position - 1e-12))
    weights = np.zeros((length, resolution))
    for row, at, before, after in zip(weights, position, first, last, strict=True):
        row[before] += 1 - (at - before)
        row[after] += at - before
    assert squared_weights(length, resolution) == pytest.approx((weights**2).sum(axis=1).mean())
    for seed in range(5):
        mask = np.random.default_rng(seed).random((2, length)) < 0.3
        np.testing.assert_array_equal(
            spread(mask, 1, resolution), ((weights > 0).T[None] & mask[:, None]).any(axis=2)
        )


def test_nothing_that_counts_is_left_out(tmp_path):
    """The values of the coreset do not change with what stands where nothing counts."""
    config = replace(CODED, features=("interval:100:200",), dilation=0)
    with open_source(field()) as series:
        selected = select(series, config, lambda *rest: None, None)
    architecture, coreset = selected.architecture, selected.coreset
    random = np.random.default_rng(0)
    size = architecture.embedding_size
    fine = random.random(
        (len(coreset.bricks), size, math.prod(coreset.brick_shape)), dtype=np.float32
    )
    tables = [
        random.random((math.prod(level), size), dtype=np.float32)
        for level in architecture.levels[1:]
    ]
    bricks = Bricks(coreset)
    trained = trained_tables(architecture, coreset, bricks, fine, tables)
    layers = tuple(
        (
            random.standard_normal(shape).astype(np.float32),
            random.random(shape[0], dtype=np.float32),
        )
        for shape in architecture.layer_shapes
    )

    def network(fill: float) -> Network:
        whole = [tuple(slice(0, n) for n in table.shape) for table in trained]
        kept = [
            np.where(table.needed(part[:4])[..., None], table.read(part), np.float32(fill))
            for table, part in zip(trained, whole, strict=True)
        ]
        assert sum(int((values == fill).sum()) for values in kept) > 100
        return Network(
            levels=architecture.levels,
            embedding_size=size,
            tables=[ArrayTable(values) for values in kept],
            layers=layers,
            box_size=architecture.box_size,
            key_frames=architecture.key_frames,
        )

    one, other = network(5.0), network(-7.0)
    samples = Samples(coreset, bricks, tile_shape(architecture.levels[0]))
    box = tuple((0, n) for n in architecture.box_size)
    for key in range(5):
        mask, values = bricks.mask(key, box), bricks.samples(key, box)
        np.testing.assert_array_equal(mask, unpack(coreset.occupancy[key], architecture.box_size))
        for part in (((1, 4), (0, 3), (7, 11)), ((3, 4), (5, 6), (2, 3))):
            inner = tuple(slice(*span) for span in part)
            np.testing.assert_array_equal(bricks.mask(key, part), mask[inner])
            np.testing.assert_array_equal(bricks.samples(key, part), values[inner])
            np.testing.assert_array_equal(
                bricks.embeddings(fine, key, part), finest_frame(coreset, fine, key)[inner]
            )
        np.testing.assert_array_equal(
            decode_region(one, key, box)[mask], decode_region(other, key, box)[mask]
        )
        (z0, z1), (y0, y1), (x0, x1) = coreset.box
        np.testing.assert_array_equal(
            values[mask],
            selected.scanned.value_range.to_unit(field()[key, z0:z1, y0:y1, x0:x1][mask]),
        )
    squares, count = samples.squares(one, list(samples.counts))
    assert count == coreset.values.size == sum(int(bricks.mask(key, box).sum()) for key in range(5))
    direct = 0.0
    for key in range(5):
        mask, values = bricks.mask(key, box), bricks.samples(key, box)
        unit = np.clip(decode_region(one, key, box).astype(np.float64), 0, 1)
        direct += float(((unit - values)[mask] ** 2).sum())
    assert squares == pytest.approx(direct)
    assert sum(samples.counts.values()) == count
    some = samples.choose(count // 3)
    assert (
        0
        < sum(samples.counts[index] for index in some)
        <= max(count // 3, max(samples.counts.values()))
    )


def test_slopes_by_the_embeddings_are_differences():
    architecture = Architecture.for_box((4, 6, 9), 3, width=8)
    random = np.random.default_rng(0)
    tables = [
        random.standard_normal((*level, 2)).astype(np.float32) for level in architecture.levels
    ]
    layers = tuple(
        (random.standard_normal((n, m)).astype(np.float32) / 4, random.random(n, dtype=np.float32))
        for m, n in pairwise([architecture.inputs, 8, 1])
    )

    def network() -> Network:
        sources = [ArrayTable(table) for table in tables]
        levels, box = architecture.levels, architecture.box_size
        return Network(
            levels=levels,
            embedding_size=2,
            tables=sources,
            layers=layers,
            box_size=box,
            key_frames=3,
        )

    points = np.array([[0, 1, 2, 2], [3, 0, 1, 2], [5, 4, 0, 1], [8, 0, 3, 7]], dtype=np.float64)
    slopes = input_slopes(network(), points)
    assert slopes.shape == (architecture.inputs, 4)
    box = tuple((0, n) for n in architecture.box_size)
    for number, table in enumerate(tables):
        for e in range(2):
            # The whole level shifted: every interpolated embedding shifts by as much.
            values = []
            for shift in (1e-3, -1e-3):
                table[..., e] += np.float32(shift)
                values.append(
                    [
                        decode_region(network(), key, box)[z, y, x]
                        for key, z, y, x in points.T.astype(int)
                    ]
                )
                table[..., e] -= np.float32(shift)
            difference = np.subtract(*values) / 2e-3
            close = np.isclose(slopes[2 * number + e], difference, atol=5e-3, rtol=0.02)
            assert close.sum() >= 3  # a kink of the network may lie between


def test_other_readers_see_what_is_needed(pair):
    with Container.open(pair["coded"][1]) as container:
        json.dumps(container.header)
        size = container.header["model"]["embedding_size"]
        names = [name for name in container.arrays if name.startswith("tables/")]
        assert len(names) == size * len(container.header["model"]["levels"])
        assert container.arrays["tables/level_1/component_1"].shape == tuple(
            container.header["model"]["levels"][0]
        )
