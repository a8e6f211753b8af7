"""Datasets of an HDF5 file: links and cycles, filters, and files behind virtual datasets."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from stored_series import VALUES, assert_frames, write_hdf5

from fhash_formats.errors import FhashWarning, InputError, MissingDependencyError
from fhash_formats.readers.hdf5 import openpmd_lines
from fhash_formats.readers.registry import list_variables, open_series


def scaled(path: Path, values: np.ndarray, **scales: Any) -> Path:
    """A file of the variable v, whose dimensions have these names and positions."""
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("v", data=values)
        for place, (name, positions) in enumerate(scales.items()):
            file[name] = positions
            file[name].make_scale(name)
            dataset.dims[place].attach_scale(file[name])
    return path


def test_a_fill_value_without_meaning_does_not_bar_raw_values(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES).attrs["_FillValue"] = "none"
    with pytest.raises(InputError, match="--raw-values reads"):
        open_series(tmp_path / "a.h5")
    assert_frames(tmp_path / "a.h5", VALUES, raw_values=True)


def test_links_and_cycles(tmp_path: Path) -> None:
    write_hdf5(tmp_path / "other.h5", far=VALUES[::-1])
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
    with open_series(tmp_path / "a.h5", var="corners", axes="z,y,x") as series:
        assert series.shape == (1, 5, 6, 4)


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
    write_it = (
        f"{imports}; h5py.File(sys.argv[1], 'w').create_dataset("
        "'v', data=numpy.ones((2, 2, 2)), **hdf5plugin.Zstd())"
    )
    read_it = (
        "import sys; from fhash_formats.readers.registry import open_series;"
        " assert open_series(sys.argv[1]).read(0).sum() == 8"
    )
    for script in (write_it, read_it):
        subprocess.run([sys.executable, "-c", script, str(tmp_path / "a.h5")], check=True)


def test_a_source_of_a_virtual_dataset_that_changes_is_refused(tmp_path: Path) -> None:
    write_hdf5(tmp_path / "part.h5", v=VALUES)
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


MESH = {
    "axisLabels": ["z", "y", "x"],
    "gridSpacing": [0.3, 0.2, 0.1],
    "gridGlobalOffset": [3.0, 0.0, 1.0],
    "gridUnitSI": 1e-6,
}


def test_positions_are_in_metres() -> None:
    lines = openpmd_lines(MESH, {"position": [0.5, 0.0, 0.0]}, (2, 3, 4))
    assert list(lines) == ["z", "y", "x"]
    expected = ([3.15, 3.45], [0, 0.2, 0.4], [1, 1.1, 1.2, 1.3])
    for found, values in zip(lines.values(), expected, strict=True):
        np.testing.assert_allclose(found, np.array(values) * 1e-6)


def test_labels_in_the_order_of_fortran_begin_with_the_fastest() -> None:
    mesh = {key: value[::-1] if isinstance(value, list) else value for key, value in MESH.items()}
    c_order, fortran = (
        openpmd_lines({}, given, (2, 3, 4)) for given in (MESH, {**mesh, "dataOrder": "F"})
    )
    assert list(c_order) == list(fortran)
    for name, values in c_order.items():
        np.testing.assert_array_equal(values, fortran[name])


@pytest.mark.parametrize("labels", [None, "zyx", ["z", "y"], ["r", "z", "x"], [1, 2, 3]], ids=str)
def test_what_is_no_mesh_has_no_positions(labels: object) -> None:
    given = {} if labels is None else {**MESH, "axisLabels": labels}
    assert openpmd_lines(given, {}, (2, 3, 4)) == {}


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
    path = write_hdf5(tmp_path / "a.h5", v=VALUES[:, 0])
    with open_series(path, axes=axes) as series:
        assert series.shape == shape
        letters = [axis for axis in "tzyx" if axis in axes]
        expected = (
            VALUES[:, 0].transpose([axes.split(",").index(axis) for axis in letters]).reshape(shape)
        )
        np.testing.assert_array_equal(np.stack(list(series.frames())), expected)


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
    lengths = {"lon": 6, "lat": 5, "lev": 3, "when": 4}
    scales = {name: np.arange(n) * 0.5 + at for at, (name, n) in enumerate(lengths.items())}
    path = scaled(tmp_path / "a.h5", VALUES.T, **scales)
    with h5py.File(path, "a") as file:
        file["when"].attrs["units"] = "days since 2000-01-01"
    with open_series(path) as series:
        assert series.shape == VALUES.shape
        assert [series.coords[axis].name for axis in "tzyx"] == ["when", "lev", "lat", "lon"]
        np.testing.assert_array_equal(series.coords["t"].values, np.arange(4) * 0.5 + 3)
        assert series.coords["t"].attributes == {"units": "days since 2000-01-01"}
        np.testing.assert_array_equal(series.read(2), VALUES[2])


PACKED = [
    ("f4", {"_FillValue": np.float32(1e20)}),
    ("f8", {"missing_value": 1e20}),
    ("i2", {"_FillValue": np.int16(-32768)}),
    ("i4", {"_FillValue": np.array([-9999], "i4"), "missing_value": np.int32(7)}),
    ("i2", {"_FillValue": np.int16(-99), "scale_factor": 0.01, "add_offset": 273.15}),
    ("i2", {"scale_factor": np.float32(0.01), "add_offset": np.float32(2)}),
    ("i2", {"scale_factor": np.array([0.5], "f4")}),
    ("i4", {"scale_factor": np.float32(0.01), "add_offset": np.float32(2)}),
    ("u1", {"add_offset": np.float32(-3)}),
    ("i1", {"_Unsigned": "true", "_FillValue": np.int8(-1)}),
    ("u1", {"_Unsigned": "false", "_FillValue": np.uint8(255)}),
]


@pytest.mark.parametrize(("stored", "attributes"), PACKED)
def test_packing_and_fill_values_are_those_of_the_same_bytes_in_netcdf(
    tmp_path: Path, stored: str, attributes: dict[str, Any]
) -> None:
    values = (np.arange(60) % 50).astype(stored).reshape(3, 4, 5)
    fill = attributes.get("_FillValue", attributes.get("missing_value"))
    if fill is not None:
        values[1, 2] = fill
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = values
        file["v"].attrs.update({**attributes, "units": "K"})
    shutil.copy(tmp_path / "a.h5", tmp_path / "a.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of several fill values
        dataset = xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf", phony_dims="sort")
    with dataset:
        expected = dataset["v"].to_numpy()
    assert fill is None or np.isnan(expected[1, 2]).all()
    for name in ("a.h5", "a.nc"):
        assert_frames(tmp_path / name, expected[None])
        with open_series(tmp_path / name) as series:
            assert series.attributes == {"units": "K"}
        assert_frames(tmp_path / name, values[None], raw_values=True)


@pytest.mark.parametrize("name", ["a.h5", "a.nc"])
def test_units_never_stand_beside_packed_counts(tmp_path: Path, name: str) -> None:
    with h5py.File(tmp_path / name, "w") as file:
        file["v"] = np.ones((3, 4, 5), "i2")
        file["v"].attrs.update({"scale_factor": 0.5, "units": "K", "long_name": "warmth"})
        file["w"] = np.ones((3, 4, 5), "i2")
        file["w"].attrs.update({"_FillValue": np.int16(-9), "units": "K"})
    with open_series(tmp_path / name, var="v") as series:
        assert (series.units, series.dtype) == ("K", np.float64)
    with open_series(tmp_path / name, var="v", raw_values=True) as series:
        assert (series.units, series.attributes) == ("", {"long_name": "warmth"})
        assert series.dtype == np.int16
    with open_series(tmp_path / name, var="w", raw_values=True) as series:
        assert series.units == "K"


def test_integers_with_a_fill_value_say_what_the_file_has(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = np.ones((3, 4, 5), "i1")
        file["v"].attrs["_FillValue"] = np.int8(-100)
    with open_series(tmp_path / "a.h5") as series:
        assert (series.dtype, series.source_dtype, series.fill) == (np.float32, np.int8, -100)
    with open_series(tmp_path / "a.h5", raw_values=True) as series:
        assert (series.dtype, series.source_dtype, series.fill) == (np.int8, None, None)


def test_a_user_block_before_the_signature(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.dat", "w", userblock_size=1024) as file:
        file["v"] = VALUES
    assert_frames(tmp_path / "a.dat", VALUES)


@pytest.mark.parametrize("keep", [20, 600, 1500])
def test_a_truncated_file_is_one_line(tmp_path: Path, keep: int) -> None:
    path = write_hdf5(tmp_path / "a.h5", v=VALUES)
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


def test_a_closed_series_is_refused(tmp_path: Path) -> None:
    series = open_series(write_hdf5(tmp_path / "a.h5", v=VALUES))
    series.close()
    with pytest.raises(InputError, match="step 0 of v cannot be read"):
        series.read(0)


FIELDS = np.dtype([("rho", ">f4"), ("v", [("x", "f8"), ("y", "f8")]), ("E", "f4", (3,))])


def test_fields_of_compound_types_are_variables(tmp_path: Path) -> None:
    state = np.zeros((4, 12, 13, 14), FIELDS)
    state["rho"], state["v"]["y"] = np.arange(4)[:, None, None, None], 7
    state["E"] = np.arange(3)
    path = write_hdf5(tmp_path / "a.h5", out__state=state)
    for var in ("out/state.rho", "state.rho", "rho"):
        assert_frames(path, state["rho"], var=var)
    assert_frames(path, state["v"]["y"], var="state.v.y")
    assert_frames(path, state["E"][..., 2], var="E", select={"dim4": 2})
    with pytest.raises(InputError, match=r"state\.E has 5 dimensions .*--select dim4=0"):
        open_series(path, var="E")
    with pytest.raises(InputError, match=r"holds 3 variables: out/state\.rho .*state\.v\.x"):
        open_series(path)


def write_steps(path: Path, form: str, attributes: list[dict[str, Any]]) -> Path:
    """One group a step, in an order of names that is not that of the numbers."""
    with h5py.File(path, "w") as file:
        for step, given in enumerate(attributes):
            place = form.format(8 + step)
            file[place] = VALUES[step]
            file[place.split("/fields")[0].rpartition("/density")[0] or place].attrs.update(given)
    return path


@pytest.mark.parametrize("form", ["Step#{}/density", "timestep_{:04}/density", "plt{}/density"])
def test_one_group_a_step_is_a_series(tmp_path: Path, form: str) -> None:
    path = write_steps(tmp_path / "a.h5", form, [{"Time": 0.5 * step} for step in range(4)])
    assert_frames(path, VALUES)
    with open_series(path) as series:
        assert series.name == "density"
        np.testing.assert_array_equal(series.coords["t"].values, [0, 0.5, 1, 1.5])
    with open_series(path, var=form.format(9)) as series:
        np.testing.assert_array_equal(series.read(0), VALUES[1])
        assert series.shape[0] == 1


def test_numbers_of_steps_stand_for_times_that_are_missing(tmp_path: Path) -> None:
    path = write_steps(tmp_path / "a.h5", "Step#{}/density", [{"Time": 1.0}, {}, {}])
    with open_series(path) as series:
        assert (series.coords["t"].name, series.coords["t"].values.tolist()) == ("step", [8, 9, 10])


def test_openpmd_axes_positions_and_times(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for step in range(4):
            group = file.create_group(f"data/{100 * step}")
            group.attrs.update({"time": 2.0 * step, "timeUnitSI": 1e-15, "dt": 1.0})
            for name in ("x", "y"):
                group[f"fields/E/{name}"] = VALUES[step].T * (1 if name == "x" else 2)
                group[f"fields/E/{name}"].attrs["position"] = [0.5, 0.0, 0.0]
            group["fields/E"].attrs.update(
                axisLabels=[b"x", b"y", b"z"],
                gridSpacing=[0.1, 0.2, 0.3],
                gridGlobalOffset=[1.0, 0.0, 0.0],
                gridUnitSI=1e-6,
                dataOrder="C",
            )
    assert_frames(path, VALUES * 2, var="E/y")
    with open_series(path, var="fields/E/x") as series:
        np.testing.assert_allclose(series.coords["t"].values, [0, 2e-15, 4e-15, 6e-15])
        assert series.coords["t"].attributes == {"units": "s"}
        np.testing.assert_allclose(
            series.coords["x"].values, (1 + 0.1 * (np.arange(6) + 0.5)) * 1e-6
        )
        np.testing.assert_allclose(series.coords["z"].values, 0.3e-6 * np.arange(3))
        assert series.coords["x"].attributes == {"units": "m"}


def test_labels_and_positions_select(tmp_path: Path) -> None:
    path = scaled(
        tmp_path / "a.h5",
        np.stack([VALUES, VALUES * 2]),
        member=np.array([b"r1", b"r2"]),
        time=np.arange(4.0),
        lev=np.array([1000.0, 850.0, 500.0]),
        lat=np.arange(5.0),
        lon=np.arange(6.0),
    )
    assert_frames(path, VALUES * 2, select={"member": "r2"}, var="v")
    assert_frames(path, VALUES * 2, select={"member": -1})
    with pytest.raises(InputError, match=r"--select member=r9 is no index 0\.\.1, or .* r1, r2"):
        open_series(path, select={"member": "r9"})
    with open_series(path, select={"member": 0, "lev": "850.0"}) as series:
        assert series.shape == (4, 1, 5, 6)
        np.testing.assert_array_equal(series.read(3)[0], VALUES[3, 1])
        assert series.coords["z"].values.tolist() == [850.0]
        assert series.attributes["selection"] == "member=0, lev=1"


def test_the_listing_of_a_file(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["flow"] = np.zeros((16, 24, 24, 3), "f4")
        file["flow"].attrs["units"] = "m/s"
        file["run/T"] = np.zeros((2, 5, 6, 7, 8))
        file["note"] = "text"
    flow, note, warmth = list_variables(tmp_path / "a.h5")
    assert (flow.name, flow.shape, flow.dtype, flow.units) == (
        "flow",
        (16, 24, 24, 3),
        "float32",
        "m/s",
    )
    assert flow.options == (
        ("--var", "flow", "--axes", "t,z,y,x"),
        ("--var", "flow", "--select", "dim3=0"),
    )
    assert (note.options, note.problem) == ((), "0 dimensions (); 2 to 4 can be read") or (
        note.problem.startswith("values of type")
    )
    assert warmth.options == (("--var", "run/T", "--select", "dim0=0"),)
    assert [axis for _, axis in warmth.dimensions] == ["select", "t", "z", "y", "x"]


def test_steps_of_one_series_must_be_alike(tmp_path: Path) -> None:
    path = write_steps(tmp_path / "a.h5", "step_{}/density", [{}, {}, {}])
    with h5py.File(path, "a") as file:
        file["step_8/x"] = file["step_9/x"] = np.arange(6.0)
        file["step_10/x"] = np.arange(6.0) + 1
    with pytest.raises(
        InputError, match=r"step_10/density has other coordinates along x than step_8/density"
    ):
        open_series(path)
    with h5py.File(path, "w") as file:
        for step in range(2):
            file[f"step_{step}/v"] = np.ones((3, 4, 5), "i2")
        file["step_1/v"].attrs["_FillValue"] = np.int16(-9)
    with pytest.raises(InputError, match=r"step_1/v has values of type float32, step_0/v of type"):
        open_series(path)
    assert_frames(path, np.ones((2, 3, 4, 5), "i2"), raw_values=True)
    with h5py.File(path, "w") as file:
        for step in range(2):
            file[f"step_{step}/v"] = np.ones((3, 4, 5), "i2")
            file[f"step_{step}/v"].attrs["units"] = f"{step} m"
    with pytest.raises(InputError, match="holds 2 variables"):
        open_series(path)


def test_times_that_are_written_as_dates_are_counted(tmp_path: Path) -> None:
    texts = [b"2020-01-01T00:00", b"2020-01-01T06:00", b"2020-01-02", b"2020-01-03"]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rho"] = np.zeros((4, 3, 5, 6), "f4")
        file["time"] = np.array(texts)
    with open_series(tmp_path / "a.h5") as series:
        assert series.coords["t"].values.tolist() == [0, 6, 24, 48]
        assert series.coords["t"].attributes["units"] == "hours since 2020-01-01"


def test_datasets_beside_a_variable_are_kept_and_the_others_named(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.attrs["code"] = "Athena"
        file["rho"] = file["other"] = np.ones((5, 8, 10, 12), "f4")
        file["time"], file["x"] = np.arange(5.0) / 2, np.linspace(0, 1, 12)
    with open_series(path, var="rho") as series:
        assert series.metadata is None  # positions, and a field of its own
    with h5py.File(path, "a") as file:
        file["params/gamma"], file["params/name"] = 1.4, "Stoß 7"
        file["names"], file["x_faces"] = np.array([b"ab", b"c"]), np.linspace(0, 1, 13)
        file["large"], file["flag"] = np.zeros(3000), True
        file["link"] = np.array([file["rho"].ref], h5py.ref_dtype)
    with open_series(path, var="rho") as series:
        told = r"beside rho is kept: flag \(values of type bool\), large .*, link \("
        with pytest.warns(FhashWarning, match=told):
            metadata = series.metadata
    assert metadata is not None
    assert metadata.attributes == {"code": "Athena"}
    assert metadata.dimensions == {"time": "t", "z": "z", "y": "y", "x": "x"}
    found = {each.name: each.values.tolist() for each in metadata.variables}
    assert found == {
        "time": (np.arange(5.0) / 2).tolist(),
        "x": np.linspace(0, 1, 12).tolist(),
        "names": [b"ab", b"c"],
        "params_gamma": 1.4,
        "params_name": "Stoß 7",
        "x_faces": np.linspace(0, 1, 13).tolist(),
    }
    assert [each.dimensions for each in metadata.variables if each.name == "x"] == [("x",)]
