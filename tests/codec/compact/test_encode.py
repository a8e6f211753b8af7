"""The compact profile end to end: promises are kept on what is decoded, reads agree with each other, and bytes with themselves."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError, QualityError, RegionError
from fhash_codec.compact.tiles.tiling import parse_tile
from fhash_codec.coreset.features import dilate, parse_feature

FAST = EncodeConfig(effort=1)


def field(shape=(5, 9, 12, 20), dtype=np.float32) -> np.ndarray:
    """A smooth moving field with a little noise, values in about -150 .. 250."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(0).normal(size=shape)
    return (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z) + noise).astype(dtype)


def holes(shape=(5, 9, 12, 20)) -> np.ndarray:
    """A field with NaN at a tenth of its vertices, at a corner of every step, and at all of one step."""
    values = field(shape)
    values[np.random.default_rng(1).random(shape) < 0.1] = np.nan
    values[:, :4, :5, :6] = np.nan
    values[2] = np.inf
    return values


SERIES = {
    "float32": field(),
    "float64": field(dtype=np.float64),
    "int16": field(dtype=np.int16),
    "offset": field(dtype=np.float64) * 1e-3 + 1e5,
    "tiny": field().astype(np.float64) * 1e-200,
    "huge": field().astype(np.float64) * 1e200,
    "with NaN": holes(),
    "one step": field((1, 9, 12, 20)),
    "flat in z": field((5, 1, 12, 20)),
    "flat in y": field((5, 9, 1, 20)),
    "flat in x": field((5, 9, 12, 1)),
    "a column": field((7, 23, 1, 1)),
    "prime": field((3, 7, 11, 13)),
    "two values": (field() > 0).astype(np.uint8),
}


def decoded(path: Path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


def psnr_of(source: np.ndarray, back: np.ndarray) -> float:
    """Over what has a value in both, the range being that of the source."""
    known = np.isfinite(source) & np.isfinite(back)
    difference = back[known].astype(np.float64) - source[known].astype(np.float64)
    finite = source[np.isfinite(source)].astype(np.float64)
    scale = float(finite.max() - finite.min())
    mean = float(((difference / scale) ** 2).mean())
    return math.inf if mean == 0 else -10 * math.log10(mean)


def largest_of(source: np.ndarray, back: np.ndarray) -> float:
    known = np.isfinite(source)
    return float(np.abs(back[known].astype(np.float64) - source[known].astype(np.float64)).max())


@pytest.mark.parametrize("psnr", [30.0, 50.0, 75.0])
@pytest.mark.parametrize("name", SERIES)
def test_a_promised_psnr_is_kept(tmp_path, name, psnr):
    source = SERIES[name]
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, psnr=psnr))
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isnan(back), ~np.isfinite(source))
    reached = psnr_of(source, back)
    assert reached >= psnr
    assert figures["psnr"] is None or figures["psnr"] == pytest.approx(reached, abs=1e-3)
    if name in ("float32", "float64"):
        # And not by giving more than was asked for.
        assert reached < psnr + 1


def test_nothing_promised_is_50_db(tmp_path):
    fhash_codec.encode(SERIES["float32"], tmp_path / "a.fhz", FAST)
    assert 50 <= psnr_of(SERIES["float32"], decoded(tmp_path / "a.fhz")) < 51


@pytest.mark.parametrize(
    "dtype", ["uint8", "int16", "uint16", "int32", "float16", "float32", "float64"]
)
@pytest.mark.parametrize("share", [0.05, 0.001])
def test_a_strict_bound_is_kept_for_every_type(tmp_path, dtype, share):
    source = (field() / 2 + 100).clip(0, 255).astype(dtype)
    span = float(source.max()) - float(source.min())
    figures = fhash_codec.encode(
        source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=share * span)
    )
    assert largest_of(source, decoded(tmp_path / "a.fhz")) <= share * span
    assert figures["max_abs_error"] <= share * span
    fhash_codec.encode(source, tmp_path / "b.fhz", EncodeConfig(effort=1, max_error_rel=share))
    assert largest_of(source, decoded(tmp_path / "b.fhz")) <= share * span


@pytest.mark.parametrize("name", SERIES)
def test_a_strict_bound_is_kept_for_every_series(tmp_path, name):
    source = SERIES[name]
    known = source[np.isfinite(source)]
    bound = 0.01 * (float(known.max()) - float(known.min()))
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=bound))
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isnan(back), ~np.isfinite(source))
    assert largest_of(source, back) <= bound


@pytest.mark.parametrize("dtype", ["int16", "float32", "float64"])
def test_a_bound_of_0_is_lossless(tmp_path, dtype):
    source = field((2, 3, 5, 7), dtype)
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=0.0))
    np.testing.assert_array_equal(decoded(tmp_path / "a.fhz"), source)


@pytest.mark.parametrize("ratio", [8.0, 25.0])
def test_a_ratio_is_met_within_a_tenth(tmp_path, ratio):
    source = field((6, 24, 32, 40))
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, ratio=ratio))
    assert source.nbytes / (tmp_path / "a.fhz").stat().st_size == pytest.approx(ratio, rel=0.1)
    assert figures["ratio"] == pytest.approx(ratio, rel=0.1)


def test_a_ratio_that_cannot_be_is_refused(tmp_path):
    with pytest.raises(InputError, match="leaves no room"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, ratio=1e5))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [0.0, 0.1, -1e30, 1e305, 255])
def test_a_constant_series_is_exact_and_small(tmp_path, value):
    source = np.full((3, 4, 5, 6), value)
    for name, config in {"psnr": FAST, "bound": EncodeConfig(effort=1, max_error=1e-3)}.items():
        fhash_codec.encode(source, tmp_path / f"{name}.fhz", config)
        assert np.abs(decoded(tmp_path / f"{name}.fhz") - source).max() <= (
            1e-3 if name == "bound" else 0
        )


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-160, 5.0])
@pytest.mark.parametrize("promise", [{}, {"ratio": 3.0}, {"max_error_rel": 0.1}], ids=str)
@pytest.mark.parametrize("effort", [2, 5])
def test_a_constant_series_is_exact_with_every_effort_and_promise(tmp_path, value, promise, effort):
    source = np.full((4, 9, 10, 11), value)
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=effort, **promise))
    assert np.array_equal(decoded(tmp_path / "a.fhz"), source)


def test_values_near_the_largest_float_are_kept(tmp_path):
    source = (2 * np.random.default_rng(0).random((2, 4, 5, 6)) - 1) * 1.7e308
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", FAST)
    np.testing.assert_array_equal(decoded(tmp_path / "a.fhz"), source)
    assert figures["rmse"] == 0


def test_a_psnr_out_of_reach_is_said_and_the_file_is_there(tmp_path):
    with pytest.raises(QualityError, match="400 dB were asked for; the file is written"):
        fhash_codec.encode(
            field(dtype=np.float64), tmp_path / "a.fhz", EncodeConfig(effort=1, psnr=400.0)
        )
    assert psnr_of(field(dtype=np.float64), decoded(tmp_path / "a.fhz")) > 120


@pytest.fixture(scope="module")
def feature(tmp_path_factory):
    """A field, and its container of many tiles with vertices outside the coreset."""
    source = field()
    path = tmp_path_factory.mktemp("compact") / "a.fhz"
    config = EncodeConfig(effort=2, features=("interval:20:180",), tile="2x4x5x8", psnr=45.0)
    fhash_codec.encode(source, path, config)
    return source, path


def test_a_feature_counts_alone(feature):
    source, path = feature
    with fhash_codec.open(path) as volume:
        whole = volume[...]
        inside = np.stack([volume.occupancy(t) for t in range(5)])
        assert volume.chunks == (2, 4, 5, 8)
        assert volume.background == pytest.approx(
            source[~inside].astype(np.float64).mean(), rel=1e-5
        )
        assert volume.verify() == len(volume.info["arrays"])
    assert 0.2 < inside.mean() < 0.98
    assert (inside >= (source >= 20) & (source <= 180)).all()
    np.testing.assert_array_equal(np.isfinite(whole), inside)
    assert psnr_of(source, whole) >= 45


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint8"])
@pytest.mark.parametrize("promise", [{"psnr": 45.0}, {"max_error": 2.0}], ids=str)
@pytest.mark.parametrize(
    "text", ["interval:105:1000", "interval:90:110", "isosurface:100", "segmentation:120"]
)
def test_the_occupancy_is_exact_at_every_step(tmp_path, dtype, promise, text):
    source = (field() / 3 + 100).astype(dtype)
    config = EncodeConfig(effort=1, features=(text,), dilation=1, tile="2x4x5x8", **promise)
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    wanted = np.stack(
        [dilate(parse_feature(text).select(frame, step), 1) for step, frame in enumerate(source)]
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["required_features"] == ["transform", "mask"]
        assert "occupancy/mask" not in volume.info["arrays"]
        found = np.stack([volume.occupancy(t) for t in range(5)])
        whole = volume[...]
        assert volume.verify() == len(volume.info["arrays"])
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(np.isfinite(whole), wanted)


def test_features_that_say_nothing_of_values_are_exact_as_well(tmp_path):
    source = field()
    mask = np.random.default_rng(5).random(source.shape) < 0.02
    for number, config in enumerate(
        (
            EncodeConfig(effort=1),
            EncodeConfig(effort=1, dilation=0),
            EncodeConfig(effort=1, features=("interval:150:400", "isosurface:0")),
        )
    ):
        path = tmp_path / f"{number}.fhz"
        fhash_codec.encode(source, path, config, mask=mask)
        selected = mask.copy()
        for text in config.features if config.features != EncodeConfig().features else ():
            selected |= np.stack(
                [parse_feature(text).select(frame, step) for step, frame in enumerate(source)]
            )
        wanted = np.stack([dilate(frame, config.dilation) for frame in selected])
        np.testing.assert_array_equal(np.isfinite(decoded(path)), wanted)


def test_a_feature_of_few_vertices_keeps_the_promise(tmp_path):
    source = np.zeros((4, 8, 10, 12), np.float32)
    source[1, 3, 4, 5:7] = 1.0
    figures = fhash_codec.encode(
        source, tmp_path / "a.fhz", EncodeConfig(effort=2, psnr=45.0, features=("interval:1:1",))
    )
    back = decoded(tmp_path / "a.fhz")
    assert figures["psnr"] is None or figures["psnr"] >= 45
    np.testing.assert_array_equal(np.isfinite(back[1]), dilate(source[1] == 1, 1))
    assert np.isnan(back[[0, 2, 3]]).all()


def test_huge_values_have_an_exact_occupancy_too(tmp_path):
    source = field(dtype=np.float64) * 1e200
    fhash_codec.encode(
        source,
        tmp_path / "a.fhz",
        EncodeConfig(effort=1, features=("interval:1e202:1e300",), dilation=0),
    )
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isfinite(back), source >= 1e202)
    np.testing.assert_array_equal(back[source >= 1e202], source[source >= 1e202])


def test_a_region_of_a_feature_reads_its_tiles_alone(feature):
    """Occupancy and values come from the same bytes: those of the tiles that the region touches."""
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["tables/level_1"]
        before = volume.container.bytes_read
        (z, _), (y, _), (x, _) = volume.box
        region = ((z, z + 3), (y, y + 4), (x, x + 7))
        values = volume.read(2, region)
        read = volume.container.bytes_read - before
        assert read < table.nbytes_stored / 4
        np.testing.assert_array_equal(
            volume.occupancy(2)[tuple(slice(*part) for part in region)], np.isfinite(values)
        )


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_whole_bit_for_bit(feature, index):
    whole = decoded(feature[1])
    with fhash_codec.open(feature[1]) as volume:
        np.testing.assert_array_equal(volume[index], whole[index])


def test_a_small_region_decodes_the_tiles_that_it_touches(feature, monkeypatch):
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["tables/level_1"]
        decode, read = type(table)._decode, []
        monkeypatch.setattr(
            type(table),
            "_decode",
            lambda self, *rest: read.append((self.name, rest[0])) or decode(self, *rest),
        )
        volume.read(2, tuple((low, low + 3) for low, _ in volume.box))
        assert [index for name, index in read if name == table.name] == [(1, 0, 0, 0)]
        volume.read(2)
        assert len({index for name, index in read if name == table.name}) == math.prod(
            table.grid[1:]
        )


def test_samples_at_vertices_are_what_is_read(feature):
    z, y, x = np.meshgrid(range(9), range(12), range(20), indexing="ij")
    with fhash_codec.open(feature[1]) as volume:
        for t in (0, 1, 4):
            np.testing.assert_array_equal(volume.sample(t=t, z=z, y=y, x=x), volume.read(t))
        np.testing.assert_allclose(
            volume.sample(t=2.25, z=z, y=y, x=x), volume.read(2.25), rtol=1e-6, atol=1e-5
        )
        between = 0.75 * volume.read(2).astype(np.float64) + 0.25 * volume.read(3)
        both = np.isfinite(between)
        np.testing.assert_allclose(volume.read(2.25)[both], between[both], rtol=1e-6, atol=1e-5)


def test_gradients_are_differences_of_the_vertices(feature):
    random = np.random.default_rng(0)
    with fhash_codec.open(feature[1]) as volume:
        cells = [random.integers(0, n - 1, 300) for n in volume.shape]
        for axis, name in enumerate("tzyx"):
            at = {other: cell + 0.0 for other, cell in zip("tzyx", cells, strict=True)}
            ends = [
                volume.sample(**{**at, name: cells[axis] + side}).astype(np.float64)
                for side in (0.0, 1.0)
            ]
            _, gradient = volume.sample(**{**at, name: cells[axis] + 0.4}, gradient=True)
            # Between steps a vertex counts that counts at either; what it decodes to at the other is not said.
            known = np.isfinite(gradient[:, axis]) & np.isfinite(ends[0]) & np.isfinite(ends[1])
            assert known.sum() > 30
            np.testing.assert_allclose(
                gradient[known, axis], (ends[1] - ends[0])[known], rtol=1e-5, atol=1e-4
            )


def test_levels_of_detail_are_subsampled_and_near(tmp_path, feature):
    source = field((3, 16, 24, 32))
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=2, tile="3x8x8x16"))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        np.testing.assert_array_equal(volume.read_lod(1, 0), volume.read(1))
        for lod in (1, 2):
            coarse = volume.read_lod(1, lod)
            every = source[1, :: 1 << lod, :: 1 << lod, :: 1 << lod]
            assert coarse.shape == every.shape
            assert np.sqrt(((coarse - every) ** 2).mean()) < 0.1 * np.ptp(source)
        assert volume.read_lod(0, 10).shape == (1, 1, 1)
        for lod, message in (
            (-1, "allowed: 0 to 10"),
            (11, "allowed: 0 to 10"),
            (1.5, "allowed: 0 to 10"),
        ):
            with pytest.raises(InputError, match=message):
                volume.read_lod(0, lod)
        with pytest.raises(InputError, match="between two"):
            volume.read_lod(0.5, 1)
        with pytest.raises(RegionError):
            volume.read_lod(3, 1)
    with fhash_codec.open(feature[1]) as volume:
        every = tuple(slice(low, high, 2) for low, high in volume.box)
        np.testing.assert_array_equal(
            np.isfinite(volume.read_lod(2, 1)), volume.occupancy(2)[every]
        )


@pytest.mark.parametrize("lod", [0, 1, 2, 3])
@pytest.mark.parametrize(
    "region",
    [
        ((0, 9), (0, 12), (0, 20)),
        ((2, 9), (3, 9), (7, 19)),
        ((8, 9), (8, 10), (15, 17)),
        ((0, 1), (0, 1), (0, 1)),
    ],
)
def test_a_region_of_a_level_of_detail_is_that_part_of_the_whole(feature, lod, region):
    with fhash_codec.open(feature[1]) as volume:
        whole = np.full(volume.shape[1:], -1.0, np.float32)
        whole[tuple(slice(low, high, 1 << lod) for low, high in volume.box)] = volume.read_lod(
            3, lod
        )
        inside = [
            [n for n in range(low, high) if first <= n < end and (n - first) % (1 << lod) == 0]
            for (low, high), (first, end) in zip(region, volume.box, strict=True)
        ]
        if not all(inside):
            with pytest.raises(RegionError, match=f"holds no vertex of level of detail {lod}"):
                volume.read_lod(3, lod, region)
            return
        assert [list(part) for part in volume.lod_vertices(lod, region)] == inside
        np.testing.assert_array_equal(volume.read_lod(3, lod, region), whole[np.ix_(*inside)])


def test_a_region_of_a_level_of_detail_decodes_the_tiles_that_it_touches(feature, monkeypatch):
    with fhash_codec.open(feature[1]) as volume:
        table = volume.container.arrays["tables/level_1"]
        decode, read = type(table)._decode, []
        monkeypatch.setattr(
            type(table),
            "_decode",
            lambda self, *rest: read.append((self.name, rest)) or decode(self, *rest),
        )
        (z, _), (y, _), (x, _) = volume.box
        volume.read_lod(2, 1, ((z + 4, z + 7), (y, y + 5), (x + 8, x + 9)))
        assert {rest[0] for name, rest in read if name == table.name} == {(1, 1, 0, 1)}
        with pytest.raises(RegionError, match="region 3:3 of axis y is empty"):
            volume.read_lod(2, 1, ((0, 1), (3, 3), (0, 1)))
        with pytest.raises(RegionError, match="outside 0:9"):
            volume.lod_vertices(1, ((0, 10), (0, 1), (0, 1)))


def test_a_paper_file_has_no_levels_of_detail(encoded):
    with (
        fhash_codec.open(encoded[1]) as volume,
        pytest.raises(InputError, match="paper has no levels of detail"),
    ):
        volume.read_lod(0, 1)


@pytest.mark.parametrize(
    "config",
    [{"effort": 1}, {"effort": 3, "max_error_rel": 0.01}, {"effort": 1, "tile": "2x4x6x8"}],
    ids=str,
)
def test_the_same_input_gives_the_same_bytes_with_any_number_of_threads(
    tmp_path, monkeypatch, config
):
    settings = EncodeConfig(timings=False, **config)
    for count in (1, 2, 2):
        monkeypatch.setattr(
            "fhash_codec.compact.tiles.sample.usable_threads", lambda count=count: count
        )
        fhash_codec.encode(holes(), tmp_path / f"{len(list(tmp_path.iterdir()))}.fhz", settings)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    ("tile", "expected"),
    [("2x4x5x8", (2, 4, 5, 8)), ("99x99x3x99", (5, 9, 3, 20)), ("whole", (5, 9, 12, 20))],
)
def test_tiles_are_those_that_were_asked_for(tmp_path, tile, expected):
    fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, tile=tile))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.chunks == expected
        assert psnr_of(field(), volume[...]) >= 50


@pytest.mark.parametrize("tile", ["", "4x4", "4x4x4x0", "4x4x4x-1", "axbxcxd", "4,4,4,4"])
def test_other_tiles_are_refused(tmp_path, tile):
    with pytest.raises(
        InputError, match=r"allowed: auto, whole, or four whole numbers as in 4x32x32x32"
    ):
        fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, tile=tile))
    assert not list(tmp_path.iterdir())


def test_without_native_code_the_values_are_the_same(tmp_path):
    source = field((2, 4, 5, 6))
    fhash_codec.encode(
        source,
        tmp_path / "a.fhz",
        EncodeConfig(effort=2, max_error_rel=0.01, features=("interval:0:200",)),
    )
    code = (
        "import sys, numpy, fhash_codec; from fhash_formats import native; assert native.library() is None\n"
        "with fhash_codec.open(sys.argv[1]) as volume: numpy.save(sys.argv[2], volume[...])"
    )
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.fhz"), str(tmp_path / "b.npy")],
        env={**os.environ, "FHASH_NATIVE": "0"},
        check=True,
    )
    np.testing.assert_array_equal(np.load(tmp_path / "b.npy"), decoded(tmp_path / "a.fhz"))


def test_more_effort_is_no_larger_and_keeps_the_promise(tmp_path, monkeypatch):
    monkeypatch.setitem(
        __import__("fhash_codec.compact.choices.head", fromlist=["STEPS"]).STEPS, 5, 200
    )
    source = field((4, 12, 16, 16))
    found = [
        fhash_codec.encode(source, tmp_path / f"{n}.fhz", EncodeConfig(effort=n, psnr=45.0))
        for n in (1, 3, 5)
    ]
    assert all(figures["psnr"] >= 45 for figures in found)
    sizes = [figures["bytes"] for figures in found]
    # The header says more where more was done.
    assert sizes[1] < sizes[0]
    assert sizes[2] < 1.15 * sizes[1]
    assert [gain["what"] for gain in found[0]["gains"]] == ["all tiles"]
    assert any(gain["what"].startswith("head") for gain in found[2]["gains"])


@pytest.mark.parametrize("effort", [1, 2])
def test_a_series_larger_than_memory_is_coded_layer_by_layer(tmp_path, monkeypatch, effort):
    """A layer of tiles in time is held at a time; the promise is the same."""
    monkeypatch.setattr("fhash_codec.compact.tiles.blocks.HELD_BYTES", 1000)
    t, z, y, x = np.meshgrid(*(np.linspace(0, 3, n) for n in (9, 6, 20, 17)), indexing="ij")
    values = (np.sin(2 * x + t) * np.cos(y * z)).astype(np.float32)
    figures = fhash_codec.encode(
        values, tmp_path / "a.fhz", EncodeConfig(psnr=40.0, effort=effort, tile="4x6x10x17")
    )
    assert figures["psnr"] >= 40
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.chunks == (4, 6, 10, 17)
        error = volume[...].astype(np.float64) - values
    assert 20 * np.log10(np.ptp(values) / np.sqrt(np.mean(error**2))) >= 40 - 1e-3


@pytest.mark.parametrize("text", ["whole", "200x1000x1000x1"])
def test_a_tile_that_no_reader_would_take_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"at most 134,217,728 are decoded together"):
        parse_tile(text, (200, 1000, 1000, 2))
    assert parse_tile("1x1000x1000x9", (200, 1000, 1000, 2)) == (1, 1000, 1000, 2)
