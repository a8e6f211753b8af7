"""A container read like an array."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError, MissingInputError, RegionError
from fhash_codec.value_type import decoded_type
from fhash_formats.container import ContainerWriter
from fhash_formats.series import ArraySeries, Coordinate


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


@pytest.mark.parametrize(
    ("index", "message"),
    [
        (5, "index 5 is outside axis t of 5"),
        (np.s_[0, -10], "index -10 is outside axis z of 9"),
        (np.s_[0, 0, 0, 0, 0], "5 parts"),
        (np.s_[..., 0, ...], "4 axes"),
        ([0, 1], "not by list"),
        (np.s_[0, None], "not by NoneType"),
        (True, "not by bool"),
        (1.5, "not by float"),
    ],
)
def test_other_indices_are_refused(volume, index, message) -> None:
    with pytest.raises(IndexError, match=message):
        volume[index]


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


def test_occupancy_is_the_dilated_feature_and_between_key_frames_that_of_either(
    encoded, volume
) -> None:
    field, _ = encoded
    for step in (0, 2, 4):
        feature = (field[step] >= 0.5) & (field[step] <= 2)
        assert (volume.occupancy(step) >= feature).all()
    np.testing.assert_array_equal(volume.occupancy(1), volume.occupancy(0) | volume.occupancy(2))
    np.testing.assert_array_equal(volume.occupancy(3.5), volume.occupancy(2) | volume.occupancy(4))
    np.testing.assert_array_equal(volume.occupancy(2.0), volume.occupancy(2))


@pytest.mark.parametrize("profile", ["paper", "compact"])
@pytest.mark.parametrize("t", [0, 2.5, 4])
def test_occupancy_of_a_region_is_that_part_of_the_whole(tmp_path, profile, t) -> None:
    field = np.arange(5 * 6 * 7 * 8, dtype=np.float32).reshape(5, 6, 7, 8) % 317
    field[2, 3:, 4] = np.nan
    short = {"epochs": 1, "width": 4} if profile == "paper" else {"effort": 1, "tile": "2x3x4x5"}
    fhash_codec.encode(
        field,
        tmp_path / "a.fhz",
        EncodeConfig(profile=profile, features=("interval:100:150",), dilation=0, **short),
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


@pytest.mark.parametrize(
    ("t", "region", "message"),
    [
        (5, None, "step 5 is outside 0..4"),
        (-0.5, None, "outside 0..4"),
        (float("nan"), None, "outside 0..4"),
        (0, ((0, 10), (0, 1), (0, 1)), "region 0:10 of axis z"),
        (0, ((0, 1), (3, 3), (0, 1)), "region 3:3 of axis y is empty"),
    ],
)
def test_regions_outside_are_refused(volume, t, region, message) -> None:
    with pytest.raises(RegionError, match=message):
        volume.read(t, region)


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


def test_gradients_are_per_vertex_and_per_step(volume) -> None:
    random = np.random.default_rng(0)
    t, z, y, x = (random.random(400) * (n - 1) for n in volume.shape)
    values, gradient = volume.sample(t=t, z=z, y=y, x=x, gradient=True)
    np.testing.assert_array_equal(values, volume.sample(t=t, z=z, y=y, x=x))
    inside = np.isfinite(values)
    assert inside.sum() > 40
    step = 1e-3
    for axis, name in enumerate("tzyx"):
        at = dict(zip("tzyx", (t, z, y, x), strict=True))
        high, low = (
            volume.sample(**{**at, name: np.clip(at[name] + s, 0, volume.shape[axis] - 1)})
            for s in (step, -step)
        )
        difference = (high - low) / (2 * step)
        close = np.isclose(gradient[:, axis], difference, rtol=0.05, atol=5e-3)[
            inside & np.isfinite(difference)
        ]
        # A kink of the network or the border of a cell may lie between the two points.
        assert close.mean() > 0.9, name


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


def test_dates_stand_for_times_where_the_series_has_a_calendar(tmp_path) -> None:
    field = np.arange(2.0)[:, None, None, None] + np.zeros((1, 2, 3, 4))
    for units in ("hours since 2001-02-10", "s"):
        time = Coordinate(name="time", values=np.array([0.0, 12.0]), attributes={"units": units})
        series = ArraySeries(field, coords={"t": time})
        fhash_codec.encode(series, tmp_path / "t.fhz", EncodeConfig(effort=1), force=True)
        dates = np.array(["2001-02-10T03:00", "2001-02-10T12:00"], "datetime64[ns]")
        with fhash_codec.open(tmp_path / "t.fhz") as volume:
            if units == "s":
                with pytest.raises(InputError, match="the times are no dates"):
                    volume.step_of_time(dates[0])
                continue
            assert volume.step_of_time("2001-02-10T03:00") == 0.25
            assert volume.step_of_time(dates[0]) == 0.25
            sampled = volume.sample(time=dates, z=1, y=1, x=1)
            np.testing.assert_array_equal(sampled, volume.sample(t=[0.25, 1], z=1, y=1, x=1))


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
        read = []
        array_type = type(volume.container.arrays["tables/level_1"])
        decode = array_type._decode
        monkeypatch.setattr(
            array_type,
            "_decode",
            lambda self, index, lod: read.append((self.name, index[0])) or decode(self, index, lod),
        )
        volume.read(2)
        assert {node for name, node in read if name == "parts/0.tables.level_1"} == {1}
        assert len([name for name, _ in read if name == "parts/0.occupancy.bits"]) == 1


def test_info_is_json_and_says_what_is_in_the_file(encoded, volume) -> None:
    import json

    info = json.loads(json.dumps(volume.info, allow_nan=False))
    assert info["bytes"] == encoded[1].stat().st_size
    assert info["key_frames"] == [0, 2, 4]
    assert info["raw_bytes"] == encoded[0].nbytes
    assert info["features"] == ["interval:0.5:2"]
    assert volume.verify() == len(info["arrays"])


def test_a_missing_file_is_named(tmp_path) -> None:
    with pytest.raises(MissingInputError, match=r"none\.fhz"):
        fhash_codec.open(tmp_path / "none.fhz")


@pytest.mark.parametrize(
    ("source", "decoded"),
    [
        ("uint8", "float32"),
        ("int16", "float32"),
        ("float16", "float32"),
        ("float32", "float32"),
        ("int32", "float64"),
        ("float64", "float64"),
    ],
)
def test_decoded_values_are_floats_as_wide_as_the_source_needs(source, decoded) -> None:
    assert decoded_type(np.dtype(source)) == np.dtype(decoded)


def test_decoding_a_frame_takes_no_more_memory_for_more_frames(tmp_path) -> None:
    import tracemalloc

    peaks = []
    for steps in (4, 32):
        path = tmp_path / f"{steps}.fhz"
        field = np.random.default_rng(0).random((steps, 16, 24, 24), dtype=np.float32)
        fhash_codec.encode(field, path, EncodeConfig(profile="paper", epochs=1, width=8))
        with fhash_codec.open(path) as volume:
            volume.read(1)
            tracemalloc.start()
            with fhash_codec.open(path) as fresh:
                fresh.read(steps - 1)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    # The directory grows by about a kilobyte a frame; a frame's finest table alone would be 37.
    assert peaks[1] - peaks[0] < 28 * 4_000


def test_what_a_compact_file_leaves_out(tmp_path) -> None:
    """Coordinates are in the header, and every step is a key frame.

    Without occupancy the whole box is in the coreset.
    """
    shape, box = (2, 3, 4, 5), (2, 4, 3)
    header = {
        "required_features": ["transform"],
        "encoder": {"version": "0", "seed": 0},
        "variable": {"name": "v", "units": "", "dtype": "float32", "attributes": {}},
        "domain": {"shape": list(shape)},
        "value_range": [0, 1],
        "background": 0,
        "feature_bounding_box": [[1, 3], [0, 4], [2, 5]],
        "features": ["all"],
        "dilation": 0,
        "coreset_fraction": 0.5,
        "model": {
            "profile": "compact",
            "levels": [[2, *box]],
            "embedding_size": 1,
            "tables": "float32",
            "parameters": 0,
            "head": None,
        },
        "coordinates": {
            "time": {"values": [1, 5]},
            "z": {},
            "y": {"start": 2},
            "x": {"step": 0.5, "name": "lon"},
        },
        "config": {},
        "training": {"seconds": None, "epochs": 0, "device": "cpu"},
        "quality": {},
    }
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        writer.add_whole("tables/level_1", np.zeros((2, *box), dtype=np.float32))
        writer.commit(header)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.coords["x"].name == "lon"
        assert volume.coords["x"].values.tolist() == [0, 0.5, 1, 1.5, 2]
        assert volume.info["key_frames"] == [0, 1]
        assert volume.step_of_time(2) == 0.25
        for t in (0, 0.5):
            occupied = np.zeros(shape[1:], dtype=bool)
            occupied[1:3, 0:4, 2:5] = True
            np.testing.assert_array_equal(volume.occupancy(t), occupied)


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
