"""HDF5: finding the dataset, its axes and coordinates; frames equal the stored array; every refusal."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from fhash_formats import open_series
from fhash_formats.errors import InputError, MissingDependencyError

VALUES = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float32)


def write(path: Path, **arrays: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name.replace("__", "/")] = array
    return path


def assert_frames(path: Path, expected: np.ndarray, **options: Any) -> None:
    with open_series(path, **options) as series:
        assert series.shape == expected.shape
        assert series.dtype == expected.dtype.newbyteorder("=")
        assert series.dtype.isnative
        for step, frame in enumerate(series.frames()):
            assert frame.dtype == series.dtype
            assert frame.flags.c_contiguous
            np.testing.assert_array_equal(frame, expected[step])


@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", ">f8", "f2", "u1", ">u2", "i4", ">i8", "u8"])
@pytest.mark.parametrize("chunks", [None, (1, 3, 5, 6), (2, 2, 3, 4), (4, 3, 5, 6)])
def test_every_frame_of_every_type_and_chunking(
    tmp_path: Path, dtype: str, chunks: tuple[int, ...] | None
) -> None:
    values = (VALUES * 50 + 100).astype(dtype)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(
            "v",
            data=values,
            chunks=chunks,
            compression="gzip" if chunks else None,
            shuffle=bool(chunks),
        )
    assert_frames(tmp_path / "a.h5", values)


@pytest.mark.parametrize("order", list(itertools.permutations("tzyx"))[::3])
@pytest.mark.parametrize("chunked", [False, True])
def test_any_order_of_axes(tmp_path: Path, order: tuple[str, ...], chunked: bool) -> None:
    stored = VALUES.transpose(["tzyx".index(axis) for axis in order])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=stored, chunks=(2, 2, 2, 2) if chunked else None)
    assert_frames(tmp_path / "a.h5", VALUES, axes=",".join(order))


@pytest.mark.parametrize(
    ("axes", "shape"),
    [
        ("t,y,x", (4, 1, 5, 6)),
        ("x,y,t", (6, 1, 5, 4)),
        ("z,y,x", (1, 4, 5, 6)),
        ("t,z,x", (4, 5, 1, 6)),
    ],
)
def test_axes_left_out_have_length_1(tmp_path: Path, axes: str, shape: tuple[int, ...]) -> None:
    path = write(tmp_path / "a.h5", v=VALUES[:, 0])
    with open_series(path, axes=axes) as series:
        assert series.shape == shape
        letters = [axis for axis in "tzyx" if axis in axes]
        expected = (
            VALUES[:, 0].transpose([axes.split(",").index(axis) for axis in letters]).reshape(shape)
        )
        np.testing.assert_array_equal(np.stack(list(series.frames())), expected)


def test_3_dimensions_are_one_step(tmp_path: Path) -> None:
    with open_series(write(tmp_path / "a.h5", v=VALUES[0])) as series:
        assert series.shape == (1, 3, 5, 6)
        np.testing.assert_array_equal(series.read(0), VALUES[0])


def test_attributes_and_units(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("group/sub/speed", data=VALUES)
        dataset.attrs["units"] = np.bytes_(b"m/s")
        dataset.attrs["level"] = np.float32(0.5)
        dataset.attrs["odd"] = np.nan
        dataset.attrs["sizes"] = np.arange(3)
        dataset.attrs["note"] = "caf\u00e9"
        dataset.attrs["link"] = dataset.ref
        dataset.attrs["pair"] = np.array([(1, 2.0)], dtype=[("a", "i4"), ("b", "f4")])
        dataset.attrs["none"] = h5py.Empty("f4")
    with open_series(tmp_path / "a.h5") as series:
        assert (series.name, series.units) == ("speed", "m/s")
        assert series.attributes == {
            "units": "m/s",
            "level": 0.5,
            "odd": "NaN",
            "sizes": [0, 1, 2],
            "note": "caf\u00e9",
        }


def test_coordinates_from_dimension_scales(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("v", data=VALUES.transpose(3, 2, 1, 0))
        for place, (name, length) in enumerate((("lon", 6), ("lat", 5), ("lev", 3), ("when", 4))):
            file[name] = np.arange(length) * 0.5 + place
            file[name].make_scale(name)
            dataset.dims[place].attach_scale(file[name])
        file["when"].attrs["units"] = "days since 2000-01-01"
    with open_series(tmp_path / "a.h5") as series:
        assert series.shape == VALUES.shape
        assert [series.coords[axis].name for axis in "tzyx"] == ["when", "lev", "lat", "lon"]
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(4) * 0.5 + 3)
        assert series.coords["t"].attributes == {"units": "days since 2000-01-01"}
        np.testing.assert_array_equal(series.read(2), VALUES[2])


def test_coordinates_beside_the_dataset_then_in_the_root(tmp_path: Path) -> None:
    times = np.array([347921.1, 347921.2, 347921.3, 347999.0])
    path = write(
        tmp_path / "a.h5",
        run__v=VALUES,
        time=times,
        run__x1v=np.arange(6.0) * 2,
        x2v=np.zeros(9),
        lev=np.arange(3),
        x=np.arange(5),
    )
    with open_series(path) as series:
        np.testing.assert_array_equal(series.coords["t"].values, times)
        assert series.coords["x"].name == "x1v"
        np.testing.assert_array_equal(series.coords["z"].values, [0, 1, 2])
        np.testing.assert_array_equal(
            series.coords["y"].values, np.arange(5)
        )  # x2v has another length
        assert series.coords["y"].name == "y"
        assert all(series.coords[axis].values.dtype == np.float64 for axis in "tzyx")


def test_a_length_alone_is_no_meaning(tmp_path: Path) -> None:
    with open_series(write(tmp_path / "a.h5", v=VALUES, weights=np.arange(4) + 10.0)) as series:
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(4))


def test_a_coordinate_that_contradicts_the_assumed_order_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", v=VALUES.transpose(3, 2, 1, 0), time=np.arange(4.0))
    with pytest.raises(InputError, match=r"time has 4 values.*--axes"):
        open_series(path)
    with open_series(path, axes="x,y,z,t") as series:
        np.testing.assert_array_equal(series.read(3), VALUES[3])


def test_integers_that_floats_cannot_tell_apart_are_refused_as_coordinates(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", v=VALUES, time=2**60 + np.arange(4))
    with pytest.raises(InputError, match="time has values that 64-bit floats cannot tell apart"):
        open_series(path)


def test_several_datasets_need_a_choice(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", density=VALUES, gas__pressure=VALUES * 2, time=np.arange(4.0))
    with pytest.raises(
        InputError,
        match=r"holds 2 variables: density \(4, 3, 5, 6\), gas/pressure \(4, 3, 5, 6\); choose one with --var",
    ):
        open_series(path)
    for name in ("gas/pressure", "/gas/pressure", "pressure"):
        assert_frames(path, VALUES * 2, var=name)
    with pytest.raises(
        InputError, match=r"no variable 'presure'; it holds gas/pressure .*, density"
    ):
        open_series(path, var="presure")
    path = write(tmp_path / "b.h5", a__v=VALUES, b__v=VALUES)
    with pytest.raises(InputError, match="means 2 variables"):
        open_series(path, var="v")


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros(3), "1 dimensions"),
        (np.zeros((3, 4)), "2 dimensions"),
        (np.zeros((1, 2, 3, 4, 5)), r"5 dimensions \(1, 2, 3, 4, 5\)"),
        (np.float64(1), "0 dimensions"),
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.zeros((2, 2, 2), [("a", "i4"), ("b", "f4")]), "compound"),
        (np.full((2, 2, 2), b"word"), "text"),
        (np.zeros((2, 2, 2), bool), "boolean.*--feature mask"),
        (np.zeros((2, 0, 2)), "length 0"),
        (np.zeros((2, 2, 2), np.longdouble), "float128|longdouble"),
    ],
)
def test_unsuitable_datasets_are_described(tmp_path: Path, array: Any, words: str) -> None:
    path = write(tmp_path / "a.h5", odd=array)
    with pytest.raises(InputError, match=rf"no variable of 3 or 4 dimensions.*odd: .*({words})"):
        open_series(path)
    with pytest.raises(InputError, match=rf"variable odd has .*({words})"):
        open_series(path, var="odd")


def test_a_file_without_datasets(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no array at all"):
        open_series(write(tmp_path / "a.h5"))


def test_scales_and_bounds_are_no_candidates_but_can_be_named(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = VALUES
        file["corners"] = np.zeros((5, 6, 4))
        file["lat2d"] = np.zeros((5, 6))
        file["lat2d"].attrs["bounds"] = "corners"
        file["scale"] = np.zeros((2, 2, 2))
        file["scale"].make_scale("scale")
    with open_series(tmp_path / "a.h5") as series:
        assert series.name == "v"
    with open_series(tmp_path / "a.h5", var="corners") as series:
        assert series.shape == (1, 5, 6, 4)


def test_links_and_cycles(tmp_path: Path) -> None:
    write(tmp_path / "other.h5", far=VALUES[::-1])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["z_group/v"] = VALUES
        file["a_soft"] = h5py.SoftLink("/z_group/v")
        file["z_group/again"] = file["z_group/v"]
        file["z_group/round"] = file["/"]
        file["dangling"] = h5py.SoftLink("/nothing")
        file["gone"] = h5py.ExternalLink("missing.h5", "/v")
    assert_frames(tmp_path / "a.h5", VALUES)
    assert_frames(tmp_path / "a.h5", VALUES, var="a_soft")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["linked"] = h5py.ExternalLink("other.h5", "/far")
    assert_frames(tmp_path / "b.h5", VALUES[::-1])


def test_fill_values_and_packing_mean_nothing_in_plain_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = VALUES
        file["v"].attrs["_FillValue"] = VALUES[0, 0, 0, 0]
        file["v"].attrs["scale_factor"] = 2.0
    with pytest.warns(
        UserWarning,
        match="v has the attributes scale_factor, _FillValue; its values are read as they stand",
    ):
        assert_frames(tmp_path / "a.h5", VALUES)


def test_a_user_block_before_the_signature(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.dat", "w", userblock_size=1024) as file:
        file["v"] = VALUES
    assert_frames(tmp_path / "a.dat", VALUES)


@pytest.mark.parametrize("keep", [20, 600, 1500])
def test_a_truncated_file_is_one_line(tmp_path: Path, keep: int) -> None:
    path = write(tmp_path / "a.h5", v=VALUES)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match="cannot be read as HDF5") as caught:
        open_series(path)
    assert "\n" not in str(caught.value)


def test_a_damaged_chunk_names_the_step(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("v", data=VALUES, chunks=(1, 3, 5, 6), compression="gzip")
        place = dataset.id.get_chunk_info_by_coord((2, 0, 0, 0))
    damaged = bytearray(path.read_bytes())
    damaged[place.byte_offset + 4 : place.byte_offset + 40] = bytes(36)
    path.write_bytes(damaged)
    with open_series(path) as series:
        np.testing.assert_array_equal(series.read(1), VALUES[1])
        with pytest.raises(InputError, match="step 2 of v cannot be read") as caught:
            series.read(2)
        assert "\n" not in str(caught.value)


def test_a_file_that_changes_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", v=VALUES)
    with open_series(path) as series:
        series.read(0)
        os.utime(path, ns=(1, 1))
        with pytest.raises(InputError, match="changed while it was being read"):
            series.read(1)
    with open_series(path) as series:
        os.truncate(path, path.stat().st_size - 10)
        with pytest.raises(InputError, match=r"changed while it was being read.*bytes before"):
            series.read(0)


def test_a_closed_series_is_refused(tmp_path: Path) -> None:
    series = open_series(write(tmp_path / "a.h5", v=VALUES))
    series.close()
    with pytest.raises(InputError, match="step 0 of v cannot be read"):
        series.read(0)


def test_a_missing_filter_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, compression="gzip")
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "hdf5plugin", None)
        with pytest.raises(
            MissingDependencyError, match=r"filter deflate \(id 1\).*fhash\[formats\]"
        ):
            open_series(tmp_path / "a.h5")
    monkeypatch.setitem(sys.modules, "hdf5plugin", sys)
    with pytest.raises(
        InputError, match=r"deflate \(id 1\), which neither h5py nor hdf5plugin has"
    ):
        open_series(tmp_path / "a.h5")


def test_filters_of_hdf5plugin_are_loaded_when_needed(tmp_path: Path) -> None:
    imports = "import h5py, hdf5plugin, numpy, sys"
    write_it = f"{imports}; h5py.File(sys.argv[1], 'w').create_dataset('v', data=numpy.ones((2,2,2)), **hdf5plugin.Zstd())"
    read_it = "import sys; from fhash_formats import open_series; assert open_series(sys.argv[1]).read(0).sum() == 8"
    for script in (write_it, read_it):
        subprocess.run([sys.executable, "-c", script, str(tmp_path / "a.h5")], check=True)


def test_a_virtual_dataset_without_its_source_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "part.h5", v=VALUES)
    layout = h5py.VirtualLayout(shape=VALUES.shape, dtype="f4")
    layout[:] = h5py.VirtualSource("part.h5", "v", shape=VALUES.shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_virtual_dataset("v", layout)
    assert_frames(tmp_path / "a.h5", VALUES)
    (tmp_path / "part.h5").unlink()
    with pytest.raises(InputError, match=r"draws on part.h5, which is not there"):
        open_series(tmp_path / "a.h5")


def test_a_source_of_a_virtual_dataset_that_changes_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "part.h5", v=VALUES)
    layout = h5py.VirtualLayout(shape=VALUES.shape, dtype="f4")
    layout[:] = h5py.VirtualSource("part.h5", "v", shape=VALUES.shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_virtual_dataset("v", layout)
    with open_series(tmp_path / "a.h5") as series:
        series.read(0)
        series.check()
        os.utime(tmp_path / "part.h5", ns=(1, 1))
        for look in (series.check, lambda: series.read(1)):
            with pytest.raises(InputError, match=r"part\.h5 changed while it was being read"):
                look()


def test_a_chunk_of_many_steps_is_decompressed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, chunks=(3, 3, 5, 6), compression="gzip")
    asked = []
    original = h5py.Dataset.__getitem__
    monkeypatch.setattr(
        h5py.Dataset, "__getitem__", lambda self, args: asked.append(args) or original(self, args)
    )
    with open_series(tmp_path / "a.h5") as series:
        asked.clear()
        frames = list(series.frames())
    assert [ranges[0] for ranges in asked] == [slice(0, 3), slice(3, 4)]
    np.testing.assert_array_equal(np.stack(frames), VALUES)


def test_what_is_kept_of_a_chunk_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "fhash_formats.readers.common.file_series.SLAB_BYTES", 2 * VALUES[0].nbytes + 1
    )
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, chunks=(4, 3, 5, 6))
    with open_series(tmp_path / "a.h5") as series:
        frame = series.read(1)
        assert series._slab is not None
        assert series._slab[1].shape[0] == 2
        frame[:] = 0  # a frame is the caller's own
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)


def test_packing_in_plain_hdf5_is_warned_of(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = np.arange(24, dtype="i2").reshape(2, 3, 4)
        file["v"].attrs.update(
            {"scale_factor": 0.5, "missing_value": np.int16(3), "add_offset": 0.0}
        )
    with pytest.warns(
        UserWarning,
        match=r"^v has the attributes scale_factor, missing_value; .* a file named \.nc is unpacked$",
    ):
        open_series(tmp_path / "a.h5").close()
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["v"].attrs.update(
            {"scale_factor": 1, "missing_value": np.nan, "_FillValue": np.array([np.nan])}
        )
    open_series(tmp_path / "a.h5").close()
