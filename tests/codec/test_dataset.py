"""`Dataset`: volumes by name, closed together, that pickle by their path; and `open`."""

from __future__ import annotations

import inspect
import json
import math
import os
import pickle
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import zarr
from cf_files import smooth
from untrained_heads import field, some_head, with_head

import fhash_codec
from fhash_codec import (
    Dataset,
    EncodeConfig,
    InputError,
    Volume,
    comparison,
)
from fhash_codec import (
    dataset as shared_volumes,
)
from fhash_codec.boxes import Box
from fhash_codec.compact.model import CompactModel
from fhash_codec.comparison import DecodedFrames, bytes_on_disk
from fhash_codec.dataset import acquire, release, volumes_of
from fhash_codec.features.occupancy import morton_index, pack
from fhash_codec.paper.model import PaperModel
from fhash_codec.volume import open as open_volume
from fhash_codec.volume_model import interpolable, open_model
from fhash_formats.container import Container
from fhash_formats.container.stored import StoredArray
from fhash_formats.errors import MissingInputError
from fhash_formats.series import ArraySeries

Arrays = dict[str, npt.NDArray[np.float32]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Arrays, Path]:
    """Two arrays, and the path of the container of both."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 4, 9, 12)), indexing="ij")
    arrays = {
        "v": np.sin(5 * x + t).astype(np.float32),
        "a/u": (np.cos(4 * y) * z).astype(np.float32),
    }
    path = tmp_path_factory.mktemp("dataset") / "run.fhz"
    fhash_codec.encode_dataset(arrays, path, EncodeConfig(effort=1, max_error=0.01))
    return arrays, path


def test_a_dataset_is_a_mapping_of_volumes(run: tuple[Arrays, Path]) -> None:
    arrays, path = run
    with fhash_codec.open(path) as dataset:
        assert isinstance(dataset, Dataset)
        assert isinstance(dataset, Mapping)
        assert (list(dataset), len(dataset), "v" in dataset, "w" in dataset) == (
            ["v", "a/u"],
            2,
            True,
            False,
        )
        assert repr(dataset) == f"<fhash Dataset v, a/u of {path}>"
        for name, volume in dataset.items():
            assert (volume.variable, volume.name, volume.shape) == (name, name, (3, 4, 9, 12))
            assert dataset[name] is volume
            np.testing.assert_allclose(volume[...], arrays[name], atol=0.01)
        assert dataset.verify() == len(dataset.container.arrays)
        with pytest.raises(KeyError, match="no variable 'w'; it holds v, a/u"):
            dataset["w"]
        dataset["v"].close()
        assert dataset["a/u"][0].shape == (4, 9, 12)
    with pytest.raises(InputError, match="closed"):
        dataset["v"].container.arrays["table_1"].read()


def test_one_variable_is_opened_by_name(run: tuple[Arrays, Path]) -> None:
    arrays, path = run
    for opened in (open_volume(path, variable="a/u"), fhash_codec.open(path, variable="a/u")):
        assert isinstance(opened, Volume)
        with opened as volume:
            np.testing.assert_allclose(volume[...], arrays["a/u"], atol=0.01)
        with pytest.raises(InputError, match="closed"):
            volume.container.arrays["table_1"].read()
    with pytest.raises(InputError, match=r"several variables, v, a/u; choose one"):
        open_volume(path)
    for opening in (open_volume, fhash_codec.open):
        with pytest.raises(InputError, match="no variable 'w'; it holds v, a/u"):
            opening(path, variable="w")


def test_datasets_and_their_volumes_pickle_by_path(run: tuple[Arrays, Path]) -> None:
    _, path = run
    with fhash_codec.open(path, fill=-1) as dataset:
        again = pickle.loads(pickle.dumps(dataset))
        volume = pickle.loads(pickle.dumps(dataset["a/u"]))
        with again, volume:
            assert list(again) == list(dataset)
            assert (again["v"].fill, volume.fill, volume.variable) == (-1, -1, "a/u")
            np.testing.assert_array_equal(volume[1], dataset["a/u"][1])


QUICK = EncodeConfig(effort=1, psnr=30, without=("ssim",))


@pytest.fixture(scope="module")
def run_shared_volumes(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("shared") / "run.fhz"
    fhash_codec.encode(smooth(2, 4, 5, 6), path, QUICK)
    return path


def test_a_file_is_opened_once(run_shared_volumes: Path) -> None:
    first, second = acquire(str(run_shared_volumes)), acquire(str(run_shared_volumes))
    assert first is second
    assert list(first.volumes) == ["values"]
    assert first.is_of_this_process()
    with volumes_of(str(run_shared_volumes))["values"] as other:
        assert other is not first.volumes["values"]


def test_the_last_user_closes_it(run_shared_volumes: Path) -> None:
    handle = acquire(str(run_shared_volumes))
    volume = handle.volumes["values"]
    release(handle)
    volume.read(0)
    del handle
    with pytest.raises(InputError, match="closed"):
        volume.container.verify()


def test_another_state_of_the_file_is_another_volume(
    tmp_path: Path, run_shared_volumes: Path
) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes(run_shared_volumes.read_bytes())
    handle = acquire(str(path))
    assert acquire(str(path), None, handle.digest) is handle
    fhash_codec.encode(smooth(3, 4, 5, 6), path, QUICK, force=True)
    assert acquire(str(path)).volumes["values"].shape == (3, 4, 5, 6)
    with pytest.raises(InputError, match="another file"):
        acquire(str(path), None, handle.digest)


def test_few_files_stay_open(run_shared_volumes: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(shared_volumes, "KEPT", 2)
    for number in range(4):
        path = tmp_path / f"{number}.fhz"
        path.write_bytes(run_shared_volumes.read_bytes())
        acquire(str(path))
    assert len(shared_volumes._kept) == 2
    assert len(shared_volumes._open) <= 3


def test_a_forked_process_opens_the_file_again(run_shared_volumes: Path, monkeypatch) -> None:
    handle = acquire(str(run_shared_volumes))
    parent = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: parent + 1)
    assert not handle.is_of_this_process()
    assert acquire(str(run_shared_volumes)) is not handle


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError):
        acquire(str(tmp_path / "none.fhz"))


GOLDEN = Path(__file__).resolve().parents[1] / "golden"
PAPER = ["paper-feature", "paper-linear-uint8", "paper-transform"]
COMPACT = ["compact-psnr", "compact-mask", "compact-clip", "compact-labels"]


@pytest.fixture(params=[*PAPER, *COMPACT])
def golden(request: Any) -> Iterator[Volume]:
    with fhash_codec.open(GOLDEN / f"{request.param}.fhz") as volume:
        yield volume


def arrays(volume: Volume) -> dict[str, Any]:
    """Every array of a file as zarr reads it: (values, attributes)."""
    with zarr.storage.ZipStore(volume.path, mode="r") as store:
        members = zarr.open_group(store, mode="r").members(max_depth=None)
        names = {array.name: name for name, array in volume.container.arrays.items()}
        return {
            names[path]: (array[...], dict(array.attrs))
            for path, array in members
            if isinstance(array, zarr.Array)
        }


def test_bits_are_the_mask_in_ragged_morton_order(golden: Volume) -> None:
    step = 1
    mask = golden.container.arrays and golden._model.occupied(  # without missing values
        int(golden.key_times.key_index(step)),
        int(np.ceil(golden.key_times.key_index(step))),
        fhash_codec.volume.Box.of_shape(golden.box.shape),
    )
    bits = golden.occupancy_bits(step)
    assert bits.dtype == np.uint8
    np.testing.assert_array_equal(bits, pack(mask))
    z, y, x = np.indices(golden.box.shape)
    number = morton_index(z, y, x, golden.box.shape)
    np.testing.assert_array_equal(bits[number >> 3] >> (7 - (number & 7)) & 1, mask)


def test_points_have_the_values_of_sample(golden: Volume) -> None:
    points = np.array([[0, 1, 2, 3], [1.5, 2.25, 3, 4.5], [4, 0, 0, 0]], dtype=np.float64)
    t, z, y, x = points.T
    expected = golden.sample(t=t, z=z, y=y, x=x)
    np.testing.assert_array_equal(golden.model(points), expected)
    np.testing.assert_array_equal(golden.model(points[None]), expected[None])
    for shape in ((), (3,), (2, 3)):
        with pytest.raises(InputError, match="t, z, y and x"):
            golden.model(np.zeros(shape))


def test_a_lattice_is_the_table_and_its_low_passes(tmp_path: Path) -> None:
    values = field()
    config = EncodeConfig(effort=2, psnr=60.0, tile="2x9x15x14")
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.mlp.layers == ()
        assert volume.mlp.activation == ""
        shapes = [table.shape for table in volume.tables]
        assert shapes == [
            (2, 9, 30, 28, 1), (2, 5, 15, 14, 1), (2, 3, 8, 7, 1), (2, 2, 4, 4, 1), (2, 1, 2, 2, 1),
        ]  # fmt: skip
        np.testing.assert_array_equal(volume.tables[0][..., 0], volume[...])
        for lod, table in enumerate(volume.tables[1:], start=1):
            np.testing.assert_array_equal(table[1, ..., 0], volume.read_lod(1, lod))


def test_a_head_makes_the_values_of_the_table(tmp_path: Path) -> None:
    head = some_head()
    path = with_head(tmp_path / "a.fhz", head)
    with fhash_codec.open(path) as volume:
        mlp = volume.mlp
        assert mlp.activation == "leaky"
        assert mlp.constants == {"sigma": 0.125, "low": -1.5, "high": 1.25}
        for layer, (weights, biases) in zip(head.layers, mlp.layers, strict=True):
            np.testing.assert_array_equal(weights, layer.weights * np.float64(layer.weight_scale))
            np.testing.assert_array_equal(biases, layer.biases * np.float64(layer.bias_scale))
            assert weights.dtype == biases.dtype == np.float32
        table = volume.tables[0][..., 0]
        assert not np.array_equal(table, volume[...])
        for start in (0, 15):  # two tiles along y: a head looks at its own tile
            tile = np.ascontiguousarray(table[:, :, start : start + 15])
            np.testing.assert_array_equal(head.apply(tile), volume[:, :, start : start + 15])


BOX = Box((1, 5), (0, 4), (2, 6))


def occupied_at(step: float, region: Box) -> npt.NDArray[np.bool_]:
    """A coreset that differs from step to step; between two steps a vertex must be in both."""
    steps = {math.floor(step), math.ceil(step)}
    masks = [np.random.default_rng(number).random((6, 6, 7)) < 0.9 for number in steps]
    return np.logical_and.reduce(masks)[region.slices()]


def test_a_point_needs_the_vertices_of_its_cell_that_have_weight() -> None:
    random = np.random.default_rng(5)
    steps = np.concatenate([random.integers(0, 3, 150), random.random(150) * 2])
    space = [np.round(2 * random.uniform(-0.5, 6.5, steps.size)) / 2 for _ in range(3)]
    inside = interpolable(BOX, steps, steps, space, occupied_at)
    expected = []
    for step, *point in zip(steps, *space, strict=True):
        in_box = all(first <= p <= end - 1 for p, (first, end) in zip(point, BOX, strict=True))
        corners = product(*({math.floor(p), math.ceil(p)} for p in point))
        expected.append(
            in_box
            and all(
                occupied_at(step, Box.of((vertex, vertex + 1) for vertex in corner)).all()
                for corner in corners
            )
        )
    assert 10 < sum(expected) < steps.size - 100
    np.testing.assert_array_equal(inside, expected)


REGIONS = [
    Box.of_shape((5, 6, 7)),
    Box((1, 4), (2, 3), (0, 7)),
    Box((4, 5), (5, 6), (6, 7)),
]
SETTINGS = {
    "compact": {"effort": 1, "tile": "2x3x4x4"},
    "paper": {
        "preset": "published",
        "tables": "float16",
        "epochs": 2,
        "width": 8,
        "key_frames": "0,1,3",
    },
    "coded": {"preset": "published", "epochs": 2, "width": 8, "tables": "transform"},
}


@pytest.fixture(scope="module", params=SETTINGS)
def named_model(request, tmp_path_factory):
    """A model whose box is 5 x 6 x 7, with vertices outside the coreset."""
    field = np.random.default_rng(0).random((4, 7, 8, 9))
    field[:, [0, -1]], field[:, :, [0, -1]], field[..., [0, -1]] = -1, -1, -1
    path = tmp_path_factory.mktemp("model") / "a.fhz"
    fhash_codec.encode(
        field,
        path,
        EncodeConfig(features=("interval:0.2:1",), dilation=0, **SETTINGS[request.param]),
    )
    with Container.open(path) as container:
        yield request.param, open_model(container)


def test_each_preset_has_its_model(named_model) -> None:
    name, model = named_model
    assert isinstance(model, CompactModel if name == "compact" else PaperModel)
    assert tuple(model.chunks) == ((2, 3, 4, 4) if name == "compact" else (1, 7, 8, 9))
    for method in ("occupied", "read", "read_lod", "sample", "sample_with_gradient"):
        both = [getattr(kind, method) for kind in (CompactModel, PaperModel)]
        assert len({len(inspect.signature(each).parameters) for each in both}) == 1


@pytest.mark.parametrize("region", REGIONS, ids=str)
def test_regions_are_parts_of_the_whole(named_model, region) -> None:
    _, model = named_model
    inner = region.slices()
    for first, last in ((0, 0), (1, 2)):
        occupied = model.occupied(first, last, REGIONS[0])
        assert 0 < occupied.mean() < 1
        np.testing.assert_array_equal(model.occupied(first, last, region), occupied[inner])
        key = (first + last) / 2
        values = model.read(key, REGIONS[0], occupied)
        assert values.dtype == np.float64
        part = model.read(key, region, occupied[inner])
        np.testing.assert_array_equal(part[occupied[inner]], values[inner][occupied[inner]])


def test_points_at_vertices_are_the_region_and_slopes_have_the_same_values(named_model) -> None:
    _, model = named_model
    occupied = model.occupied(1, 1, REGIONS[0])
    places = np.argwhere(occupied).T.astype(np.float64)
    keys = np.ones(places.shape[1])
    values = model.sample(keys, list(places))
    np.testing.assert_allclose(values, model.read(1, REGIONS[0], occupied)[occupied], atol=1e-5)
    again, slopes = model.sample_with_gradient(keys, list(places))
    np.testing.assert_allclose(again, values, atol=1e-6)
    assert slopes.shape == (len(values), 4)
    assert slopes.dtype == np.float64


def test_diff_refuses_another_shape(field, encoded) -> None:
    with pytest.raises(InputError, match=r"shape \(4, 8, 10, 18\)"):
        fhash_codec.diff(ArraySeries(field()), encoded[1])


def test_a_volume_is_equal_to_its_own_decoded_values(encoded) -> None:
    """The coreset has no error; the background stands outside, where the decoded values are NaN."""
    with fhash_codec.open(encoded[1]) as volume:
        figures = fhash_codec.diff(volume[...], encoded[1])
    assert (figures["rmse"], figures["max_abs_error"], figures["psnr"]) == (0, 0, None)
    assert figures["quality"]["rmse_domain"] == 0
    assert len(figures["quality"]["per_step"]) == 5


@pytest.mark.parametrize("steps_held", [1, 2, 3, 100])
@pytest.mark.parametrize("dtype", ["f4", "i8"])
def test_layers_beyond_the_cache_are_decoded_together(
    field, tmp_path, monkeypatch, dtype, steps_held
) -> None:
    path, source = tmp_path / "a.fhz", (100 * field()).astype(dtype)
    config = EncodeConfig(max_error=2, effort=1, tile="3x8x10x9")
    fhash_codec.encode(source, path, config)
    layers: list[int] = []
    usual = StoredArray.read

    def watched(self, region=None):
        if len(self.shape) == 4:
            layers.append(region[0].start // 3)
        return usual(self, region)

    with fhash_codec.open(path) as volume:
        frames = [volume.values(step) if dtype == "i8" else volume.read(step) for step in range(4)]
    frame = frames[0].size * volume.float_dtype.itemsize
    monkeypatch.setattr(comparison, "LAYER_BYTES", steps_held * frame)
    monkeypatch.setattr(StoredArray, "read", watched)
    with fhash_codec.open(path) as volume:
        volume.container.cache_bytes = 1
        read = DecodedFrames(volume, exact=dtype == "i8").read
        for step in range(4):
            np.testing.assert_array_equal(read(range(step, step + 1))[0], frames[step])
        np.testing.assert_array_equal(read(range(1, 2))[0], frames[1])
    assert set(layers) == {0, 1}
    if steps_held >= 3:
        assert layers == [0, 1, 0]  # the first layer comes again


def test_the_figures_are_those_of_the_file(field, tmp_path) -> None:
    source = field()
    config = EncodeConfig(
        preset="published",
        tables="float16",
        features=("interval:50:200",),
        epochs=8,
        width=16,
        timings=True,
    )
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        back = volume[...].astype(np.float64)
    inside = np.isfinite(back)
    error = (back - source)[inside]
    span = float(source.max()) - float(source.min())
    assert figures["rmse"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-6)
    assert figures["psnr"] == pytest.approx(
        20 * np.log10(span / np.sqrt((error**2).mean())), abs=1e-4
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        everywhere = np.where(inside, back, volume.background) - source
        assert volume.background == pytest.approx(source[~inside].mean(), rel=1e-5)
        assert figures["psnr"] * (1 - 1e-5) <= volume.info["quality"]["psnr"] <= figures["psnr"]
    assert figures["psnr_domain"] == pytest.approx(
        20 * np.log10(span / np.sqrt((everywhere**2).mean())), abs=1e-4
    )
    assert figures["bytes"] == (tmp_path / "a.fhz").stat().st_size
    assert figures["ratio"] == source.nbytes / figures["bytes"]
    assert figures["coreset_fraction"] == pytest.approx(inside.mean())
    assert [point["epoch"] for point in figures["curve"]] == list(range(1, 9))
    json.dumps(figures, allow_nan=False)
    again = fhash_codec.diff(source, tmp_path / "a.fhz")
    for name in ("psnr", "rmse", "max_abs_error", "psnr_domain", "ssim", "bytes", "key_frames"):
        assert again[name] == figures[name], name


def test_the_source_is_counted_as_it_lies_on_disk(tmp_path: Path) -> None:
    folder = tmp_path / "a.zarr" / "c"
    folder.mkdir(parents=True)
    (folder / "0").write_bytes(b"12345")
    (folder.parent / "zarr.json").write_bytes(b"{}")
    (tmp_path / "b.raw").write_bytes(b"123")
    assert bytes_on_disk([folder.parent]) == 7
    assert bytes_on_disk([folder.parent, tmp_path / "b.raw"]) == 10
    assert bytes_on_disk([]) is None
    assert bytes_on_disk([tmp_path / "gone"]) is None


@pytest.mark.parametrize("feature", ["all", "interval:0.2:9"])
def test_a_variable_that_is_another_bit_by_bit_is_stored_once(tmp_path, feature: str) -> None:
    one = np.random.default_rng(0).normal(size=(3, 4, 10, 12)).astype("f4")
    config = EncodeConfig(max_error=0.05, features=(feature,))
    sources = {"a": one, "b": one.copy(), "c": one + 1}
    two, three = tmp_path / "two.fhz", tmp_path / "three.fhz"
    less = fhash_codec.encode_dataset({"a": one, "c": one + 1}, two, config)
    report = fhash_codec.encode_dataset(sources, three, config)
    assert report["bytes"] < less["bytes"] + 200
    assert sum(report["split"].values()) == report["bytes"]
    assert report["variables"]["a"]["bytes"] == report["variables"]["b"]["bytes"]
    with fhash_codec.open(three) as dataset:
        assert list(dataset) == ["a", "b", "c"]
        values = {name: np.asarray(volume) for name, volume in dataset.items()}
        dataset.container.verify()
    np.testing.assert_array_equal(values["a"], values["b"])
    inside = ~np.isnan(values["c"])
    assert np.abs(values["c"] - sources["c"])[inside].max() <= 0.05
