"""A container read like an array, here or elsewhere."""

from __future__ import annotations

import io
import pickle
from itertools import product
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from reference import value_between

import fhash_codec
from fhash_codec import EncodeConfig, InputError, RegionError
from fhash_codec.compact import model as compact_model
from fhash_codec.compact.model import equal_places
from fhash_codec.features.features import dilate
from fhash_codec.measure.value_range import decoded_type
from fhash_codec.volume import Volume, feature_names, holds_features_apart, only_features, rounded
from fhash_formats.container import StoredArray
from fhash_formats.series import ArraySeries, Coordinate

LOW, HIGH = "interval:0:0.2", "interval:0.8:1"
KEY_FRAMES = (0, 2, 3)


def ramp() -> np.ndarray:
    """Values that rise along x from 0 to 1, and fall along y a little with time."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 5, 6, 24)), indexing="ij")
    return np.clip(x - 0.05 * t * y + 0 * z, 0, 1).astype(np.float32)


@pytest.fixture(scope="module", params=["float16", "transform", "plain"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with plain tables, one with coded tables, and that one in plain numbers."""
    path = tmp_path_factory.mktemp("apart") / "two.fhz"
    config = EncodeConfig(
        preset="published",
        features=(LOW, HIGH),
        key_frames="0,2,3",
        epochs=2,
        width=8,
        tables="float16" if request.param == "float16" else "transform",
    )
    fhash_codec.encode(ramp(), path, config)
    if request.param == "plain":
        fhash_codec.export_plain(path, path.with_name("plain.fhz"))
        return path.with_name("plain.fhz")
    return path


@pytest.mark.parametrize("feature", [LOW, HIGH])
def test_a_feature_alone_has_its_own_coreset_and_the_same_values(run, feature) -> None:
    low, high = (np.float32(end) for end in feature.split(":")[1:])
    source = ramp()
    masks = [dilate((source[step] >= low) & (source[step] <= high), 1) for step in range(4)]
    with fhash_codec.open(run) as volume:
        alone = only_features(volume, [feature])
        assert holds_features_apart(volume)
        assert feature_names(alone) == [feature]
        for step in KEY_FRAMES:
            np.testing.assert_array_equal(alone.occupancy(step), masks[step])
            expected = np.where(masks[step], volume.read(step), np.float32(np.nan))
            np.testing.assert_array_equal(alone.read(step), expected)
        np.testing.assert_array_equal(alone.occupancy(1), masks[0] | masks[2])
        again = pickle.loads(pickle.dumps(alone))
        np.testing.assert_array_equal(again.read(2), alone.read(2))
        again.close()


def test_all_features_together_are_the_volume_itself(run) -> None:
    with fhash_codec.open(run) as volume:
        assert only_features(volume, [HIGH, LOW]) is volume
        for step in range(4):
            apart = [only_features(volume, [name]).occupancy(step) for name in (LOW, HIGH)]
            np.testing.assert_array_equal(apart[0] | apart[1], volume.occupancy(step))


def test_features_that_a_file_lacks_or_has_merged_are_refused(run, tmp_path) -> None:
    with fhash_codec.open(run) as volume, pytest.raises(InputError, match="is none of its feat"):
        only_features(volume, ["interval:0:0.3"])
    path = tmp_path / "merged.fhz"
    fhash_codec.encode(ramp(), path, EncodeConfig(features=(LOW, HIGH), effort=1))
    with fhash_codec.open(path) as volume, pytest.raises(InputError, match="are merged"):
        only_features(volume, [LOW])


def test_many_features_are_apart_in_coded_files_too(tmp_path) -> None:
    features = tuple(f"interval:{n / 10:g}:{n / 10 + 0.05:g}" for n in range(9))
    config = EncodeConfig(
        preset="published", features=features, epochs=1, width=4, dilation=0, tables="transform"
    )
    path, plain = tmp_path / "many.fhz", tmp_path / "plain.fhz"
    fhash_codec.encode(ramp(), path, config)
    fhash_codec.export_plain(path, plain)
    for name in (path, plain):
        with fhash_codec.open(name) as volume:
            assert volume.container.arrays["occupancy"].shape[0] == 9
            source = ramp()[2]
            for feature in (features[0], features[-1]):
                low, high = (np.float32(end) for end in feature.split(":")[1:])
                np.testing.assert_array_equal(
                    only_features(volume, [feature]).occupancy(2),
                    (source >= low) & (source <= high),
                )


QUICK = {"effort": 1, "timings": False}


def labels(dtype: str = "i2") -> np.ndarray:
    """Four labels in blocks that move along x."""
    x = (np.arange(12) + np.arange(3)[:, None, None, None]) // 3
    return np.broadcast_to(x * 7 + np.arange(5)[:, None] // 2, (3, 4, 5, 12)).astype(dtype)


class Holed(ArraySeries):
    """Integers with missing values, as a reader gives them: floats, NaN where the fill was."""

    def __init__(self, values: np.ndarray, fill: int | None) -> None:
        holes = np.zeros(values.shape, bool)
        holes[:, 1, 2:4, 3:6] = True
        super().__init__(np.where(holes, np.nan, values).astype(decoded_type(values.dtype)))
        self.source_dtype, self.fill = values.dtype, fill
        self.stored = np.where(holes, -1 if fill is None else fill, values).astype(values.dtype)


@pytest.mark.parametrize("dtype", ["i1", "u2", "i4", "i8", "u8"])
@pytest.mark.parametrize("promise", [{"max_error": 0.0}, {"max_error": 0.49}, {"max_error": 0.9}])
def test_a_bound_below_one_keeps_integers_exactly(tmp_path, dtype, promise) -> None:
    values = labels(dtype)
    if values.dtype.itemsize == 8:
        values += np.array(2**60 + 1, dtype)
    figures = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(**promise, **QUICK))
    assert figures["max_abs_error"] == 0
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert (volume.dtype, volume.fill) == (values.dtype, 0)
        np.testing.assert_array_equal(volume[...], values)
        np.testing.assert_array_equal(volume[1, :, ::-2, 3], values[1, :, ::-2, 3])
        assert volume[...].dtype == np.asarray(volume).dtype == values.dtype
        assert volume.read(1).dtype == volume.read_lod(1, 1).dtype == decoded_type(values.dtype)
        assert volume.values(0.5).dtype == decoded_type(values.dtype)


def test_vertices_without_a_value_need_a_fill_value(tmp_path) -> None:
    config = EncodeConfig(max_error=0.0, features=("interval:7:15",), dilation=0, **QUICK)
    fhash_codec.encode(labels(), tmp_path / "a.fhz", config)
    inside = (labels() >= 7) & (labels() <= 15)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert (volume.dtype, volume.fill) == (np.float32, None)
        np.testing.assert_array_equal(volume[...], np.where(inside, labels(), np.nan))
    with fhash_codec.open(tmp_path / "a.fhz", fill=-5) as volume:
        assert (volume.dtype, volume.fill) == (np.int16, -5)
        np.testing.assert_array_equal(volume[...], np.where(inside, labels(), -5))
        background = volume.values(0, outside="background")
        assert set(background[~inside[0]].tolist()) == {round(volume.background)}
    with fhash_codec.open(tmp_path / "a.fhz", fill=0.5) as volume:
        assert (volume.dtype, volume.fill) == (np.float32, 0.5)
        np.testing.assert_array_equal(volume[...], np.where(inside, labels(), 0.5))


@pytest.mark.parametrize("promise", [{"max_error": 0.0}, {"max_error": 3.0}, {"psnr": 30.0}])
@pytest.mark.parametrize("fill", [-100, None])
def test_missing_integers_come_back_as_the_fill_value_of_the_source(
    tmp_path, promise, fill
) -> None:
    series = Holed(labels("i1"), fill)
    figures = fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(**promise, **QUICK))
    assert figures["raw_bytes"] == labels("i1").nbytes
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert "missing" not in volume.container.arrays
        assert volume.dtype == (np.float32 if fill is None else np.int8)
        gaps = np.isnan(volume.read(0))
        np.testing.assert_array_equal(gaps, np.isnan(series.read(0)))
        np.testing.assert_array_equal(np.isnan(volume.read(0, outside="background")), gaps)
        if fill is not None:
            assert (volume[0][gaps] == fill).all()
        if promise == {"max_error": 0.0} and fill is not None:
            np.testing.assert_array_equal(volume[...], series.stored)


def test_floats_have_nan_unless_a_fill_value_is_asked_for(tmp_path) -> None:
    series = ArraySeries(np.where(labels() == 7, np.nan, labels()).astype("f4"))
    series.fill = 1e20
    fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(max_error=0.5, **QUICK))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["variable"]["fill"] == 1e20
        assert np.isnan(volume[...]).any()
        assert volume.fill is None
    with fhash_codec.open(tmp_path / "a.fhz", fill=-1) as volume:
        np.testing.assert_array_equal(volume[...] == -1, np.isnan(series.values))
        assert volume[...].dtype == np.float32
        assert (volume.values(0.5) == -1).sum() >= (volume[0] == -1).sum()


@pytest.mark.parametrize("dtype", ["i1", "u1", "i4", "i8", "u8"])
def test_rounding_stays_within_the_type(dtype) -> None:
    limits = np.iinfo(dtype)
    ends = np.array([float(limits.min), float(limits.max), np.nan, 2.4, 1e300, -1e300])
    whole = rounded(ends, np.dtype(dtype))
    assert whole.dtype == np.dtype(dtype)
    assert whole[0] == whole[5] == limits.min
    assert int(whole[1]) == int(whole[4]) >= limits.max - 2 ** max(limits.bits - 53, 0)
    assert whole[2:4].tolist() == [0, 2]


@pytest.fixture
def volume(encoded):
    with fhash_codec.open(encoded[1]) as volume:
        yield volume


def test_it_looks_like_an_array(encoded, volume) -> None:
    field, path = encoded
    assert (volume.shape, volume.dtype, volume.ndim, volume.size, len(volume)) == (
        field.shape,
        np.float32,
        4,
        field.size,
        5,
    )
    assert volume.dims == ("t", "z", "y", "x")
    assert volume.path == path
    assert np.asarray(volume).shape == field.shape
    assert np.asarray(volume, dtype=np.float64).dtype == np.float64
    assert "values" in repr(volume)
    with pytest.raises(ValueError, match="without a copy"):
        np.array(volume, copy=False)


INDICES = [
    np.s_[0],
    np.s_[-1],
    np.s_[1:4],
    np.s_[...],
    np.s_[:, 3],
    np.s_[..., 5],
    np.s_[2, 1:5, ::-1, 3:17:4],
    np.s_[::-2, -3:, 4, 7],
    np.s_[4, 8, 11, 19],
    np.s_[1, ..., 2:3],
    np.s_[3:1],
    np.s_[np.int64(2), 2:2],
]


@pytest.mark.parametrize("index", INDICES, ids=str)
def test_any_part_holds_the_same_bits_as_that_slice_of_the_whole(volume, index) -> None:
    part, values = volume[index], volume[...]
    np.testing.assert_array_equal(part, values[index])
    assert part.dtype == values.dtype


def test_outside_the_coreset_stands_nan_or_the_background(encoded, volume) -> None:
    field, _ = encoded
    for step in range(5):
        occupied = volume.occupancy(step)
        assert 0.2 < occupied.mean() < 0.95
        np.testing.assert_array_equal(np.isfinite(volume.read(step)), occupied)
        filled = volume.read(step, outside="background")
        assert (filled[~occupied] == np.float32(volume.background)).all()
        np.testing.assert_array_equal(filled[occupied], volume.read(step)[occupied])
        if step in (0, 2, 4):
            assert np.abs(filled - field[step])[occupied].mean() < 0.15
    with pytest.raises(InputError, match="outside is 'zero'; allowed: nan, background"):
        volume.read(0, outside="zero")


@pytest.mark.parametrize("preset", ["published", "default"])
@pytest.mark.parametrize("t", [0, 2.5, 4])
def test_occupancy_of_a_region_is_that_part_of_the_whole(tmp_path, preset, t) -> None:
    field = np.arange(5 * 6 * 7 * 8, dtype=np.float32).reshape(5, 6, 7, 8) % 317
    field[2, 3:, 4] = np.nan
    plain = {"epochs": 1, "width": 4, "tables": "float16"}
    short = plain if preset == "published" else {"effort": 1, "tile": "2x3x4x5"}
    fhash_codec.encode(
        field,
        tmp_path / "a.fhz",
        EncodeConfig(preset=preset, features=("interval:100:150",), dilation=0, **short),
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        occupied = volume.occupancy(t)
        assert 0 < occupied.mean() < 0.5
        for region in (
            ((0, 6), (0, 7), (0, 8)),
            ((2, 5), (1, 6), (3, 4)),
            ((5, 6), (6, 7), (7, 8)),
            ((0, 1), (0, 1), (0, 1)),
        ):
            np.testing.assert_array_equal(
                volume.occupancy(t, region), occupied[tuple(slice(*part) for part in region)]
            )
        with pytest.raises(RegionError, match="axis x"):
            volume.occupancy(t, ((0, 6), (0, 7), (0, 9)))


def test_sampling_at_vertices_gives_the_decoded_values(volume) -> None:
    z, y, x = np.meshgrid(range(9), range(12), range(20), indexing="ij")
    for t in (0, 1, 3.25, 4):
        np.testing.assert_allclose(volume.sample(t=t, z=z, y=y, x=x), volume.read(t), atol=1e-6)


def test_sampling_between_vertices_needs_its_whole_cell(volume) -> None:
    occupied = volume.occupancy(2)
    z, y, x = (p + 0.5 for p in np.meshgrid(range(8), range(11), range(19), indexing="ij"))
    cell = np.lib.stride_tricks.sliding_window_view(occupied, (2, 2, 2)).all(axis=(3, 4, 5))
    np.testing.assert_array_equal(np.isfinite(volume.sample(t=2, z=z, y=y, x=x)), cell)
    # On a face only the face's own vertices count.
    face = occupied[:, :-1, :-1] & occupied[:, 1:, :-1] & occupied[:, :-1, 1:] & occupied[:, 1:, 1:]
    values = volume.sample(t=2, z=np.arange(9)[:, None, None], y=y[:1], x=x[:1])
    np.testing.assert_array_equal(np.isfinite(values), face)


def test_sampling_outside_the_domain_is_nan_and_broadcasts(volume) -> None:
    values = volume.sample(t=0, z=[[-0.1], [8.1]], y=5, x=np.arange(3))
    assert values.shape == (2, 3)
    assert np.isnan(values).all()
    with pytest.raises(RegionError):
        volume.sample(t=4.5, z=0, y=0, x=0)
    for both in ({}, {"t": 1, "time": 1}):
        with pytest.raises(InputError, match="either t"):
            volume.sample(z=0, y=0, x=0, **both)


@pytest.mark.parametrize("times", [[2.0, 3.0, 4.0, 30.0, 31.0], [31.0, 30.0, 4.0, 3.0, 2.0]])
def test_physical_times_may_be_uneven_and_descend(tmp_path, times) -> None:
    field = np.linspace(0, 1, 5, dtype=np.float32)[:, None, None, None] * np.ones(
        (5, 2, 3, 4), np.float32
    )
    series = ArraySeries(
        field,
        coords={"t": Coordinate(name="time", values=np.array(times), attributes={"units": "h"})},
    )
    fhash_codec.encode(series, tmp_path / "t.fhz", EncodeConfig(effort=1))
    with fhash_codec.open(tmp_path / "t.fhz") as volume:
        assert volume.coords["t"].attributes == {"units": "h"}
        assert volume.step_of_time(17.0) == pytest.approx(2.5 if times[0] == 2 else 1.5)
        np.testing.assert_array_equal(volume.sample(time=times, z=1, y=1, x=1), volume[:, 1, 1, 1])
        with pytest.raises(RegionError):
            volume.step_of_time(31.5)


def test_times_that_do_not_ascend_are_warned_of_and_steps_stand_for_them(tmp_path) -> None:
    series = ArraySeries(
        np.random.default_rng(0).random((3, 2, 3, 4)),
        coords={"t": Coordinate(name="time", values=np.array([0.0, 0.0, 1.0]))},
    )
    with pytest.warns(fhash_codec.FhashWarning, match="do not strictly ascend"):
        fhash_codec.encode(series, tmp_path / "t.fhz", EncodeConfig(effort=1))
    with fhash_codec.open(tmp_path / "t.fhz") as volume:
        assert volume.key_times.key_index(1.5) == 1.5
        with pytest.raises(InputError, match="ask for a step"):
            volume.step_of_time(0.5)


def test_it_pickles_by_path(encoded, volume) -> None:
    copy = pickle.loads(pickle.dumps(volume))
    np.testing.assert_array_equal(copy[3], volume[3])
    copy.close()


def test_decoding_a_frame_reads_only_its_time_nodes(encoded, monkeypatch) -> None:
    with fhash_codec.open(encoded[1]) as volume:
        asked, read = [], StoredArray.read

        def recorded(array, region=None):
            asked.append((array.name, region))
            return read(array, region)

        monkeypatch.setattr(StoredArray, "read", recorded)
        volume.read(2)
        steps = [region[0] for name, region in asked if name == "table_1"]
        assert steps
        assert all(step == slice(1, 2) for step in steps)
        assert len([name for name, _ in asked if name == "occupancy"]) == 1


def wind(dtype: str) -> np.ndarray:
    """Speeds that touch zero along moving fronts."""
    t, _, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 6, 14, 15)), indexing="ij")
    noise = np.random.default_rng(0).normal(0, 0.3, t.shape)
    return np.maximum(20 * np.sin(5 * x + 3 * t + y) + noise, 0.1).astype(dtype)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("promise", [{"max_error": 0.8}, {"max_error_rel": 0.01}, {"psnr": 30.0}])
def test_no_value_leaves_the_range_of_the_series(tmp_path, dtype, promise) -> None:
    values = wind(dtype)
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(effort=1, **promise))
    points = np.random.default_rng(1).uniform(0, 1, (3, 500)) * [[5], [13], [14]]
    times = np.random.default_rng(2).uniform(0, 2, 500)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        read = [volume[...], volume.read(0.3), volume.read(1.7), volume.read_lod(1, 1)]
        read.append(volume.sample(t=times, z=points[0], y=points[1], x=points[2]))
    for decoded in read:
        assert values.min() <= decoded.min()
        assert decoded.max() <= values.max()


LATTICE = (5, 6, 7, 9)


def waves(shape: tuple[int, ...] = LATTICE) -> np.ndarray:
    """Values of order 100 with noise."""
    t, z, y, x = np.indices(shape)
    noise = np.random.default_rng(0).normal(size=shape)
    return np.asarray(100 * np.sin(x / 3 + t / 2) * np.cos(y / 4) + 5 * z + noise)


def gappy() -> np.ndarray:
    """The waves without some values, each at one step alone."""
    values = waves().astype(np.float32)
    values[np.random.default_rng(1).random(LATTICE) < 0.02] = np.nan
    return values


LATTICES = {
    "float32": (waves().astype(np.float32), {}),
    "float64": (waves(), {}),
    "int16": (waves().astype(np.int16), {}),
    "gappy": (gappy(), {}),
    "feature": (waves().astype(np.float32), {"features": ("interval:-20:200",), "dilation": 0}),
    "labels": (np.rint(waves() / 40).astype(np.float32), {"max_error": 0.0}),
    "one step": (waves((1, 6, 7, 9)), {}),
    "flat": (waves((5, 6, 1, 9)), {}),
}


def points_in(shape: tuple[int, ...], count: int) -> list[np.ndarray]:
    """Steps and positions z, y and x: anywhere, on vertices and faces, and outside the domain."""
    random = np.random.default_rng(2)
    points = [random.uniform(0, n - 1, count) for n in shape]
    for along, n in zip(points, shape, strict=True):
        whole = random.random(count) < 0.3
        along[whole] = np.rint(along[whole])
        along[:2] = 0, n - 1
    for along, n in zip(points[1:], shape[1:], strict=True):
        along[-20:] += random.uniform(-n, n, 20)
    return points


def between(values: np.ndarray, point: list[float], rule: str) -> float:
    """The value at a point between vertices (t, z, y, x); those without weight do not matter."""
    step, *space = point
    low = [min(floor(p), max(n - 2, 0)) for p, n in zip(space, values.shape[1:], strict=True)]
    total = 0.0
    for corner in product((0, 1), repeat=3):
        weight = 1.0
        for p, i, up in zip(space, low, corner, strict=True):
            weight *= p - i if up else 1 - (p - i)
        if weight:
            z, y, x = (i + up for i, up in zip(low, corner, strict=True))
            alone = values[:, z, y, x].tolist()
            total += weight * value_between(alone, range(len(alone)), step, rule)
    return total


@pytest.fixture(scope="module", params=LATTICES)
def lattice(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    values, settings = LATTICES[request.param]
    path = tmp_path_factory.mktemp("points") / "a.fhz"
    bound = {"effort": 1, "tile": "2x3x4x4", "max_error": 0.5}
    fhash_codec.encode(values, path, EncodeConfig(**{**bound, **settings}))
    return path


def test_points_have_the_bits_of_a_sum_over_the_vertices_around_them(
    lattice: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compact_model, "BLOCK", 50)
    with fhash_codec.open(lattice) as volume:
        values = volume[...].astype(volume.float_dtype)
        t, z, y, x = points_in(volume.shape, 700)
        found = volume.sample(t=t, z=z, y=y, x=x)
        with_slopes, slopes = volume.sample(t=t, z=z, y=y, x=x, gradient=True)
        low, high = map(volume.float_dtype.type, volume.value_range.floats)
        rule = volume.info["model"].get("between", {}).get("rule", "linear")
    expected = np.full(t.size, np.nan, found.dtype)
    for number, (step, *place) in enumerate(zip(t, z, y, x, strict=True)):
        if all(0 <= p <= n - 1 for p, n in zip(place, values.shape[1:], strict=True)):
            expected[number] = between(values, [step, *place], rule)
    assert_array_equal(found, np.clip(expected, low, high))
    assert_array_equal(with_slopes, found)
    assert 300 < np.isfinite(found).sum() <= 700 - 10
    assert np.isfinite(slopes[np.isfinite(found)]).any(axis=0).all()


def test_a_point_alone_has_the_bits_that_it_has_among_others(lattice: Path) -> None:
    with fhash_codec.open(lattice) as volume:
        points = dict(zip("tzyx", points_in(volume.shape, 60), strict=True))
        together = volume.sample(**points, gradient=True)
        for number in range(60):
            one = {axis: along[number] for axis, along in points.items()}
            assert_array_equal(volume.sample(**one), together[0][number])
            for alone, among in zip(volume.sample(**one, gradient=True), together, strict=True):
                assert_array_equal(alone, among[number])


@pytest.mark.parametrize("gradient", [False, True])
def test_each_step_is_read_once_and_each_point_gathered_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gradient: bool
) -> None:
    """The work grows with points plus steps, not with their product."""
    path = tmp_path / "a.fhz"
    config = EncodeConfig(effort=1, tile="1x3x4x4", max_error=0.5)
    fhash_codec.encode(waves().astype(np.float32), path, config)
    steps, asked, gathered = [], [], []

    def recorded(owner: Any, name: str, told: list[Any], what: Any) -> None:
        original = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *args: told.append(what(*args)) or original(*args))

    recorded(StoredArray, "read", steps, lambda _, region: range(5)[region[0]])
    recorded(Volume, "occupancy", asked, lambda _, step, region: (floor(step), -floor(-step)))
    recorded(compact_model, "_corners", gathered, lambda _, places, *rest: places[0].size)
    monkeypatch.setattr(compact_model, "BLOCK", 64)
    t, z, y, x = (
        np.clip(p, 0, n - 1) for p, n in zip(points_in(LATTICE, 900), LATTICE, strict=True)
    )
    with fhash_codec.open(path) as volume:
        volume.sample(t=t, z=z, y=y, x=x, gradient=gradient)
    assert steps == [range(n, n + 1) for n in range(5)]
    assert len(asked) == len(set(asked)) == 5 + 4
    assert sum(gathered) == 900
    assert max(gathered) == 64


@pytest.mark.parametrize("most", [1, 200, 70_000, 1 << 40])
def test_places_of_equal_numbers(most: int) -> None:
    random = np.random.default_rng(3)
    numbers = random.choice(random.integers(0, most, 9), 400)
    others = random.integers(0, 2, 400)
    seen = []
    for places in equal_places(numbers, others):
        seen.append((numbers[places[0]], others[places[0]]))
        equal = (numbers == seen[-1][0]) & (others == seen[-1][1])
        assert_array_equal(np.sort(places), np.flatnonzero(equal))
    assert seen == sorted(set(zip(numbers, others, strict=True)))
    assert list(equal_places(numbers[:0])) == []


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of noise, which makes large tiles: 12 of 1 x 16 x 16 x 16."""
    noise = np.random.default_rng(1).normal(size=(2, 16, 32, 48)).astype(np.float32)
    path = tmp_path_factory.mktemp("remote") / "noise.fhz"
    config = EncodeConfig(effort=1, max_error=1e-6, tile="1x16x16x16", without=("ssim",))
    fhash_codec.encode(noise, path, config)
    return path


@pytest.fixture
def url(path: Path, range_server) -> str:
    return range_server.put("noise.fhz", path.read_bytes())


def test_requests_and_bytes(path, url, range_server) -> None:
    """The limits that docs/howto/remote.md promises."""
    with fhash_codec.open(path) as here, fhash_codec.open(url) as volume:
        assert here.container.size > 120_000
        assert here.chunks == (1, 16, 16, 16)
        requests, size = range_server.taken()
        assert requests <= 3
        assert size <= 64_000
        tile = (0, slice(0, 16), slice(16, 32), slice(16, 32))
        assert_array_equal(volume[tile], here[tile])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= 16_000
        assert_array_equal(volume[tile], here[tile])
        assert range_server.taken() == (0, 0)
        assert_array_equal(volume[1], here[1])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= here.container.size / 2
        assert_array_equal(volume[:], here[:])
        assert range_server.taken()[0] <= 2
        assert volume.verify() == here.verify()
        volume.close()


def test_levels_of_detail_ask_for_all_tiles_at_once(path, url, range_server) -> None:
    with fhash_codec.open(path) as here, fhash_codec.open(url) as volume:
        range_server.taken()
        assert_array_equal(volume.read_lod(0, 2), here.read_lod(0, 2))
        assert range_server.taken()[0] == 1
        assert_array_equal(volume.tables[1][0, :8, :8, :8, 0], here.tables[1][0, :8, :8, :8, 0])


@pytest.mark.parametrize("preset", ["published", "default"])
def test_both_models_equal_the_file_at_hand(encoded, path, range_server, preset) -> None:
    path = encoded[1] if preset == "published" else path
    url = range_server.put("run.fhz", path.read_bytes())
    with fhash_codec.open(path) as here, fhash_codec.open(url) as volume:
        assert range_server.taken()[0] <= 3
        assert_array_equal(volume[:], here[:])
        points = {"t": [0.5], "z": [2.2], "y": [7.7], "x": [9.1]}
        assert_array_equal(volume.sample(**points), here.sample(**points))
        assert {**volume.info, "path": ""} == {**here.info, "path": ""}
        assert volume.describe()


def test_a_file_that_changes_is_noticed(path, url, range_server) -> None:
    data = path.read_bytes()
    with fhash_codec.open(url) as volume:
        assert np.isfinite(volume[0, 0, :4, :4]).all()
        range_server.put("noise.fhz", data[::-1])
        with pytest.raises(InputError, match="the file changed since it was opened; open it again"):
            volume[1]


def test_a_volume_of_a_url_pickles_with_its_options(path, range_server) -> None:
    range_server.token = "Bearer 1"
    url = range_server.put("run.fhz", path.read_bytes())
    options = {"headers": {"Authorization": "Bearer 1"}}
    with fhash_codec.open(url, fill=-1.0, storage_options=options) as volume:
        assert volume.path == url
        assert url in repr(volume)
        data = pickle.dumps(volume)
        with pickle.loads(data) as copy:
            assert_array_equal(copy[0, 0], volume[0, 0])
            assert copy.fill == -1.0
    range_server.put("run.fhz", path.read_bytes()[:-1])
    with pytest.raises(fhash_codec.FhashError):
        pickle.loads(data)


def test_a_pickled_volume_is_not_another_file(path, encoded, tmp_path) -> None:
    place = tmp_path / "run.fhz"
    place.write_bytes(path.read_bytes())
    with fhash_codec.open(place) as volume:
        data = pickle.dumps(volume)
    place.write_bytes(encoded[1].read_bytes())
    with pytest.raises(InputError, match="another file is there than was opened before"):
        pickle.loads(data)


def test_open_files(path) -> None:
    with fhash_codec.open(path) as here, open(path, "rb") as file:
        with fhash_codec.open(file) as volume, fhash_codec.open(io.BytesIO(path.read_bytes())) as b:
            assert_array_equal(volume[1], here[1])
            assert_array_equal(b[1], here[1])
            with pytest.raises(InputError, match="open it by its path or URL"):
                pickle.dumps(volume)
        assert not file.closed
