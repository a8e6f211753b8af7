"""`fhash decode`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import xarray as xr
from command_line import Fhash, Refused

import fhash_codec
from fhash_cli.commands.decode import RegionOptions, Selection, Statistics, convert
from fhash_codec import EncodeConfig
from fhash_codec.progress import silent
from fhash_formats.errors import InputError
from fhash_formats.readers.registry import open_series


@pytest.fixture(scope="module")
def counts(tmp_path_factory) -> tuple[np.ndarray, str]:
    """Counts of a moving front, and a file of those above 3."""
    values = np.arange(10) + np.arange(2)[:, None, None, None] + np.arange(4)[:, None]
    values = np.broadcast_to(values, (2, 3, 4, 10)).astype("i2")
    path = tmp_path_factory.mktemp("counts") / "a.fhz"
    config = EncodeConfig(max_error=0.0, features=("interval:4:99",), dilation=0, effort=1)
    fhash_codec.encode(values, path, config)
    return values, str(path)


@pytest.mark.parametrize("suffix", ["npy", "h5", "nc", "zarr"])
def test_every_format_keeps_the_type_and_says_what_the_fill_value_is(
    fhash, counts, tmp_path, suffix
) -> None:
    values, path = counts
    out = tmp_path / f"a.{suffix}"
    done = fhash("decode", path, "--fill", "-7", "-o", str(out))
    assert done.exit_code == 0, done.output
    expected = np.where(values > 3, values, -7)
    if suffix == "npy":
        decoded = np.load(out)
    elif suffix == "zarr":
        import zarr

        array = zarr.open_group(out, mode="r")["values"]
        decoded, fill = array[...], array.attrs["_FillValue"]
        assert fill == -7
    else:
        import h5py

        with h5py.File(out) as file:
            decoded = file["values"][...]
            assert np.ravel(file["values"].attrs["_FillValue"]).tolist() == [-7]
            assert file["values"].attrs["_FillValue"].dtype == np.int16
    assert decoded.dtype == np.int16
    np.testing.assert_array_equal(decoded, expected)
    if suffix == "nc":
        with open_series(out) as series:
            np.testing.assert_array_equal(series.read(1), np.where(values > 3, values, np.nan)[1])


def test_without_a_fill_value_floats_come_and_one_line_says_why(fhash, counts, tmp_path) -> None:
    values, path = counts
    out = str(tmp_path / "a.npy")
    done = fhash("decode", path, "-o", out)
    assert done.exit_code == 0
    assert "come as float32: some vertices have no value; --fill V keeps int16" in done.output
    np.testing.assert_array_equal(np.load(out), np.where(values > 3, values, np.nan))


def test_a_fill_value_that_does_not_fit_is_refused_and_nothing_written(
    fhash, counts, tmp_path
) -> None:
    out = tmp_path / "a.npy"
    command = ["decode", counts[1], "--dtype", "int8", "--fill", "300", "-o", str(out)]
    done = fhash(*command)
    assert done.exit_code == 2
    assert "does not fit int8" in done.output
    assert not out.exists()


def test_few_integers_are_pointed_to_the_lossless_way(fhash, tmp_path) -> None:
    labels = np.random.default_rng(0).integers(0, 65, (2, 4, 9, 10)).astype("u1")
    np.save(tmp_path / "few.npy", labels % 65)
    np.save(tmp_path / "more.npy", labels * 2)
    words = ["--effort", "1", "--psnr", "20", "-o"]
    few = fhash("encode", tmp_path / "few.npy", *words, tmp_path / "few.fhz")
    more = fhash("encode", tmp_path / "more.npy", *words, tmp_path / "more.fhz")
    assert "--max-error 0 keeps each exactly" in few.stderr
    assert "--max-error 0" not in more.stderr
    words = ["--effort", "1", "--max-error", "0.4", "-o"]
    exact = fhash("encode", tmp_path / "few.npy", *words, tmp_path / "exact.fhz")
    assert "--max-error 0" not in exact.stderr
    assert "every value exact" in exact.stdout


def test_integers_of_64_bits_are_converted_as_such() -> None:
    integers = np.array([2**60 + 1, 2**60 + 3])
    frame = np.array([2.0**60, np.nan])
    kinds = [np.dtype("i8"), np.dtype("u8")]
    for kind in kinds:
        found = convert(frame, kind, fill=7, integers=integers)
        assert found.tolist() == [2**60 + 1, 7]
    assert convert(frame[:1], np.dtype("i4"), integers=integers[:1]).tolist() == [2**31 - 1]
    assert convert(frame[:1], np.dtype("u8"), integers=-integers[:1]).tolist() == [0]


def decoded(volume: fhash_codec.Volume, **options: Any) -> tuple[Selection, np.ndarray, Statistics]:
    selection = Selection.of(volume, RegionOptions(**options))
    frames = np.stack(list(selection.frames(volume, statistics := Statistics(), silent)))
    return selection, frames, statistics


def test_the_source_s_own_fill_value_counts_where_the_type_has_it(run: Path) -> None:
    with fhash_codec.open(run) as volume:
        assert isinstance(volume, fhash_codec.Volume)
        for own, taken in ((-9, -9), (1e300, None), (0.5, None)):
            types = replace(volume.value_type, fill=own)
            with patch.object(volume, "value_type", types):
                assert Selection.of(volume, RegionOptions(dtype="int16")).fill == taken


@pytest.fixture(scope="module")
def whole(run: Path) -> np.ndarray:
    with fhash_codec.open(run) as volume:
        return np.asarray(volume)


def saved(fhash: Fhash, run: Path, output: Path, *words: object) -> np.ndarray:
    result = fhash("decode", run, "-o", output, *words)
    assert (result.exit_code, result.stderr) == (0, "")
    return np.load(output)


@pytest.mark.parametrize(
    ("words", "index"),
    [
        ([], np.s_[:]),
        (["--t", "1"], np.s_[1:2]),
        (["--t", "-1"], np.s_[-1:]),
        (["--t", "::2"], np.s_[::2]),
        (["--t", "-2:"], np.s_[-2:]),
        (["--roi", "1:3,:,-4:-1"], np.s_[:, 1:3, :, -4:-1]),
        (["--t", "0:2", "--roi", ":4,2:3,5:"], np.s_[0:2, :4, 2:3, 5:]),
        (["--box", "0.5:1.25,:,4:9"], np.s_[:, 1:3, :, 1:7]),
        (["--box", ":,2:2,:"], np.s_[:, :, 2:3, :]),
        (["--box", ":,:,6.5:"], np.s_[:, :, :, 0:4]),
        (["--time", "4", "--time", "0"], np.s_[[2, 0]]),
    ],
)
def test_a_region_is_that_part_of_the_whole(
    fhash: Fhash, run: Path, whole: np.ndarray, tmp_path: Path, words: list[str], index: object
) -> None:
    np.testing.assert_array_equal(saved(fhash, run, tmp_path / "out.npy", *words), whole[index])


def test_statistics_are_those_of_the_region(
    fhash: Fhash, run: Path, whole: np.ndarray, tmp_path: Path
) -> None:
    report = json.loads(fhash("decode", run, "--t", "1", "--roi", "2:5,:,:", "--json").stdout)
    part = whole[1:2, 2:5]
    assert report["min"] == np.nanmin(part)
    assert report["max"] == np.nanmax(part)
    assert report["mean"] == pytest.approx(np.nanmean(part, dtype=float))
    assert report["inside_fraction"] == (~np.isnan(part)).mean()
    assert (report["shape"], report["steps"], report["region"]) == (
        [1, 3, 7, 8],
        [1.0],
        [[2, 5], [0, 7], [0, 8]],
    )
    filled = json.loads(
        fhash(
            "decode", run, "--t", "1", "--roi", "2:5,:,:", "--outside", "background", "--json"
        ).stdout
    )
    assert filled["inside_fraction"] == report["inside_fraction"]
    assert list(tmp_path.iterdir()) == []


def test_conversions_that_would_lose_a_value_are_refused() -> None:
    with pytest.raises(InputError, match="add --outside background"):
        convert(np.array([1.0, np.nan]), np.dtype(np.int16))
    with pytest.raises(InputError, match="does not fit float16"):
        convert(np.array([1.0, 1e6]), np.dtype(np.float16))
    assert np.isnan(convert(np.array([np.nan]), np.dtype(np.float16))).all()


def test_a_value_that_the_data_lack_is_not_blamed_on_an_option(
    refused: Refused, fhash: Fhash, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="the data have no value") as caught:
        convert(np.array([1.0, np.nan]), np.dtype(np.uint8), background=True)
    assert "--outside" not in str(caught.value)
    values = np.arange(120, dtype=np.float32).reshape(2, 3, 4, 5)
    values[0, 0, 0, 0] = np.nan
    np.save(tmp_path / "gap.npy", values)
    assert (
        fhash(
            "encode", tmp_path / "gap.npy", "-o", tmp_path / "run.fhz", "--effort", "1", "-q"
        ).exit_code
        == 0
    )
    assert "the data have no value" in refused(
        2, "decode", tmp_path / "run.fhz", "--outside", "background", "--dtype", "uint8"
    )


@pytest.mark.parametrize("suffix", ["vtp", "ply"])
def test_an_isosurface_is_written_in_physical_positions(
    fhash: Fhash, run: Path, tmp_path: Path, suffix: str
) -> None:
    result = fhash(
        "decode", run, "--t", "1", "--isosurface", "8", "-o", tmp_path / f"s.{suffix}", "--json"
    )
    assert (result.exit_code, result.stderr) == (0, "")
    assert json.loads(result.stdout)["paths"] == [str(tmp_path / f"s.{suffix}")]
    if suffix == "ply":
        head, _, body = (tmp_path / "s.ply").read_bytes().partition(b"end_header\n")
        count = int(head.split(b"element vertex ")[1].split()[0])
        vertices = np.frombuffer(body[: 24 * count], "<f8").reshape(count, 3)
        with fhash_codec.open(run) as volume:
            for column, axis in enumerate("xyz"):
                ends = np.sort(volume.coords[axis].values[[0, -1]])
                assert np.all((vertices[:, column] >= ends[0]) & (vertices[:, column] <= ends[1]))
            z, y, x = (
                np.interp(
                    vertices[:, column],
                    *(
                        part[:: -1 if axis == "x" else 1]
                        for part in (volume.coords[axis].values, np.arange(n))
                    ),
                )
                for column, axis, n in ((2, "z", 6), (1, "y", 7), (0, "x", 8))
            )
            np.testing.assert_allclose(volume.sample(t=1, z=z, y=y, x=x), 8, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--t", "0", "-o", "s.npy"], "cannot write a surface with the suffix '.npy'"),
        (["-o", "s.ply"], "of one step; 3 were chosen"),
        (["--t", "0"], "give -o s.vtp or -o s.ply"),
        (["--t", "0", "-o", "s.ply", "--dtype", "float64"], "no --dtype"),
        (["--t", "0", "-o", "s.ply", "--roi", ":1,:,:"], "two vertices along each axis"),
    ],
)
def test_isosurfaces_that_cannot_be_written(
    refused: Refused,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in refused(2, "decode", run, "--isosurface", "8", *words)
    assert "no surface of the value 1000" in refused(
        2, "decode", run, "--isosurface", "1000", "--t", "0", "-o", "s.ply"
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
def test_a_part_comes_back_as_that_part_of_the_source(
    fhash: Fhash, tmp_path: Path, suffix: str
) -> None:
    import xarray as xr

    lat = np.linspace(50, 55, 6, dtype="f4")
    source = xr.Dataset(
        {
            "tas": (
                ("lon", "time", "lat"),
                np.arange(168, dtype="f4").reshape(7, 4, 6),
                {"units": "K"},
            ),
            "lat_bnds": (("lat", "bnds"), np.stack([lat - 0.5, lat + 0.5], axis=1)),
        },
        {
            "time": ("time", np.array([0, 1, 3, 4], "i4"), {"units": "hours since 2001-01-01"}),
            "month": ("time", np.array(["a", "b", "c", "d"], dtype=object)),
            "lat": ("lat", lat, {"bounds": "lat_bnds", "units": "degrees_north"}),
            "height": ((), 2.0, {"units": "m"}),
        },
        {"title": "a source", "Conventions": "CF-1.8"},
    )
    source.to_netcdf(tmp_path / "source.nc", engine="h5netcdf")
    fhash("encode", tmp_path / "source.nc", "-o", tmp_path / "a.fhz", "--effort", "1")
    options = {"engine": "zarr"} if suffix == "zarr" else {"engine": "h5netcdf"}
    out = tmp_path / f"a.{suffix}"
    for selection, places in (
        ([], {}),
        (
            ["--t", "1:4:2", "--roi", ":,1:3,2:6"],
            {"time": slice(1, 4, 2), "lat": slice(1, 3), "lon": slice(2, 6)},
        ),
    ):
        fhash("decode", tmp_path / "a.fhz", "-o", out, "--force", *selection)
        with (
            xr.open_dataset(tmp_path / "source.nc", engine="h5netcdf") as whole,
            xr.open_dataset(out, **options) as found,
        ):
            wanted = whole.isel(places)
            assert np.abs(wanted["tas"] - found["tas"]).max() < 5
            if places:
                # the source has no longitudes, and the part says which vertices it has
                assert found["lon"].values.tolist() == [2, 3, 4, 5]
                found = found.drop_vars("lon")
            history = found.attrs.pop("history")
            assert "fhash encode source.nc" in history
            same = found.assign(tas=found["tas"].copy(data=wanted["tas"].values))
            xr.testing.assert_identical(wanted, same)
    # between two steps the time is known, and nothing else along it
    fhash("decode", tmp_path / "a.fhz", "-o", out, "--force", "--time", "2")
    with xr.open_dataset(out, **options, decode_times=False) as found:
        assert found["time"].values.tolist() == [2]
        assert found["time"].attrs["units"] == "hours since 2001-01-01"
        assert "month" not in found.variables
        assert "height" in found.coords


def test_figures_and_files_of_integers_far_from_zero_are_exact(
    fhash: Fhash, tmp_path: Path
) -> None:
    values = np.arange(2**64 - 960, 2**64, dtype=np.uint64).reshape(2, 6, 8, 10)
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(max_error=0.0, effort=1))
    for more, shown in (((), values), (("--lod", "1"), values[:, ::2, ::2, ::2])):
        result = fhash(
            "decode", tmp_path / "a.fhz", "-o", tmp_path / "a.npy", "--force", "--json", *more
        )
        report = json.loads(result.stdout)
        found = np.load(tmp_path / "a.npy")
        assert found.dtype == values.dtype
        assert (report["min"], report["max"]) == (int(found.min()), int(found.max()))
        assert found.shape == shown.shape
        assert found.min() >= values.min()
        if not more:
            assert (found == values).all()
            assert report["mean"] == 2**64 - 480


@pytest.mark.parametrize(
    ("longitudes", "box", "chosen"),
    [
        (np.arange(300.0, 420, 2) % 360, "350:20", slice(25, 41)),
        (np.arange(300.0, 420, 2) % 360, "-10:20", slice(25, 41)),
        (np.arange(300.0, 420, 2) % 360, "350:380", slice(25, 41)),
        (np.arange(300.0, 420, 2) % 360, "350:", slice(25, 60)),
        (np.arange(-179.0, 180, 2), "350:2", slice(85, 91)),
        (np.arange(1.0, 360, 2), "-340:-330", slice(10, 15)),
        (np.arange(1.0, 360, 2), "-10:20", "two boxes, 350:359 and 1:20"),
        (np.arange(1.0, 360, 2), "350:20", "two boxes, 350:359 and 1:20"),
        (np.arange(10.0, 60, 2), "350:20", "positions 10 to 58"),
    ],
)
def test_a_box_of_longitudes(
    fhash: Fhash, tmp_path: Path, longitudes: np.ndarray, box: str, chosen: slice | str
) -> None:
    values = np.arange(longitudes.size, dtype="f4") + np.zeros((3, 1), "f4")
    xr.DataArray(
        values,
        dims=("lat", "lon"),
        coords={
            "lat": ("lat", [0.0, 1, 2], {"units": "degrees_north"}),
            "lon": ("lon", longitudes, {"units": "degrees_east"}),
        },
        name="v",
    ).to_netcdf(tmp_path / "a.nc")
    words = ["--max-error", "0", "--quiet"]
    assert fhash("encode", tmp_path / "a.nc", "-o", tmp_path / "a.fhz", *words).exit_code == 0
    out = tmp_path / "a.npy"
    done = fhash("decode", tmp_path / "a.fhz", "-o", out, "--box", f":,:,{box}", "--quiet")
    if isinstance(chosen, str):
        assert (done.exit_code, chosen in done.stderr) == (2, True)
    else:
        np.testing.assert_array_equal(np.load(out)[0, 0], values[:, chosen])
