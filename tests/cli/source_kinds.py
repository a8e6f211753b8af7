"""Small sources of each kind that users have, with what they hold in plain numpy."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
import zarr

T, Z, Y, X = 3, 4, 5, 6
GRID = np.mgrid[0:T, 0:Z, 0:Y, 0:X].astype(np.float64)
WAVE = np.sin(GRID[0] / 2 + GRID[1] / 3) * np.cos(GRID[2] / 4) + GRID[3] / 8
DAYS = "days since 2001-02-03"
TIME = np.array([0.5, 1.5, 4.0])
LEVELS = np.array([5.0, 20.0, 100.0, 5000.0])
EVEN = {"z": 2.0 + 0.5 * np.arange(Z), "y": -1.0 + np.arange(Y), "x": 10.0 + 0.25 * np.arange(X)}


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A source and what it holds.

    Attributes:
        path: what `fhash encode` is given.
        values: (t, z, y, x), NaN where a value is missing.
        suffix: of the export that users of this kind want.
        coords: positions by axis, as far as the source gives them.
        options: of `fhash encode` and `fhash info`.
        units: of the values; None where the source has none.
        time: attributes of the times that the source gives.
        dtype: type that decoding gives.
        exact: whether every value is to come back as it was.
    """

    path: Path
    values: np.ndarray
    suffix: str
    coords: dict[str, np.ndarray] = field(default_factory=dict)
    options: tuple[str, ...] = ()
    units: str | None = None
    time: dict[str, str] = field(default_factory=dict)
    dtype: str = "float32"
    exact: bool = False


KINDS: dict[str, Callable[[Path], Kind]] = {}


def kind(make: Callable[[Path], Kind]) -> Callable[[Path], Kind]:
    """Add a function that writes a source to KINDS."""
    KINDS[make.__name__] = make
    return make


def labelled(values: np.ndarray, dims: str, coords: dict[str, Any], **attributes: Any) -> Any:
    """A dataset of `v`, with coordinates by dimension as (values, attributes)."""
    names = dims.split()
    columns = {name: (name, *column) for name, column in coords.items()}
    return xr.Dataset({"v": (names, values, attributes)}, coords=columns)


@kind
def packed_netcdf(folder: Path) -> Kind:
    stored = np.round((WAVE + 1) * 1000).astype("i2")
    stored[0, 1, :2] = -32768
    axes = {"time": (TIME, {"units": DAYS}), "lev": (LEVELS, {"units": "hPa", "axis": "Z"})}
    packing = {"scale_factor": 0.001, "add_offset": -1.0, "_FillValue": np.int16(-32768)}
    values = np.where(stored == -32768, np.nan, stored * 0.001 - 1.0)
    path = folder / "a b.nc"
    labelled(stored, "time lev y x", axes, units="K", **packing).to_netcdf(path, engine="h5netcdf")
    coords, time = {"t": TIME, "z": LEVELS}, {"units": DAYS}
    return Kind(
        path=path, values=values, suffix=".nc", coords=coords, units="K", time=time,
        dtype="float64",
    )  # fmt: skip


@kind
def ocean(folder: Path) -> Kind:
    lat, lon = np.linspace(60.0, 50.0, Y), 355.0 + np.arange(X)
    axes = {
        "time": (TIME, {"units": DAYS, "calendar": "standard"}),
        "depth": (LEVELS, {"units": "m", "positive": "down", "axis": "Z"}),
        "lat": (lat, {"units": "degrees_north"}),
        "lon": (lon, {"units": "degrees_east"}),
    }
    values = WAVE.astype("f4")
    values[:, 2:, :2] = np.nan
    path = folder / "ocean.nc"
    labelled(values, "time depth lat lon", axes, units="degC").to_netcdf(path, engine="h5netcdf")
    coords, time = {"t": TIME, "z": LEVELS, "y": lat, "x": lon}, axes["time"][1]
    return Kind(path=path, values=values, suffix=".nc", coords=coords, units="degC", time=time)


@kind
def noleap(folder: Path) -> Kind:
    time, days = {"units": "days since 2000-01-01", "calendar": "noleap"}, np.array([58.0, 59, 424])
    path = folder / "model.nc"
    dataset = labelled(WAVE.astype("f4"), "time z y x", {"time": (days, time)})
    dataset.to_netcdf(path, engine="scipy")
    return Kind(path=path, values=WAVE, suffix=".nc", coords={"t": days}, time=time)


@kind
def flat(folder: Path) -> Kind:
    lat = np.linspace(-10.0, 10.0, Y)
    axes = {"time": (TIME, {"units": DAYS}), "lat": (lat, {"units": "degrees_north"})}
    path = folder / "flat.nc"
    labelled(WAVE[:, 0].astype("f4"), "time lat lon", axes).to_netcdf(path, engine="h5netcdf")
    coords, time = {"t": TIME, "y": lat}, {"units": DAYS}
    return Kind(path=path, values=WAVE[:, :1], suffix=".nc", coords=coords, time=time)


@kind
def labels(folder: Path) -> Kind:
    stored = np.round(WAVE * 3).astype("i1")
    stored[:, :, 0] = -100
    path = folder / "basin.nc"
    dataset = labelled(stored, "time z y x", {}, _FillValue=np.int8(-100))
    dataset.to_netcdf(path, engine="h5netcdf")
    values = np.where(stored == -100, np.nan, stored)
    return Kind(path=path, values=values, suffix=".nc", dtype="int8", exact=True)


@kind
def ensemble(folder: Path) -> Kind:
    members = np.stack([WAVE, WAVE + 1, WAVE * 2]).astype("f4")
    path = folder / "ens.nc"
    axes = {"time": (TIME, {"units": DAYS})}
    labelled(members, "member time z y x", axes).to_netcdf(path, engine="h5netcdf")
    return Kind(
        path=path,
        values=WAVE * 2,
        suffix=".nc",
        coords={"t": TIME},
        options=("--select", "member=2"),
        time={"units": DAYS},
    )


@kind
def vector(folder: Path) -> Kind:
    path = folder / "flow.h5"
    with h5py.File(path, "w") as file:
        file["velocity"] = np.stack([WAVE, 2 * WAVE, 3 * WAVE], axis=-1).astype("f4")
    options = ("--select", "dim4=1")
    return Kind(path=path, values=2 * WAVE, suffix=".h5", options=options)


@kind
def step_groups(folder: Path) -> Kind:
    path = folder / "steps.h5"
    with h5py.File(path, "w") as file:
        for step in range(T):
            group = file.create_group(f"Step#{step}")
            group.attrs["Time"] = TIME[step]
            group["rho"] = WAVE[step].astype("f4")
    return Kind(path=path, values=WAVE, suffix=".h5", coords={"t": TIME})


@kind
def openpmd(folder: Path) -> Kind:
    path = folder / "data.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"openPMD": "1.1.0", "basePath": "/data/%T/", "meshesPath": "fields/"})
        for step in range(T):
            base = file.create_group(f"data/{step * 100}")
            base.attrs.update({"time": TIME[step], "dt": 1.0, "timeUnitSI": 1e-3})
            rho = base.create_dataset("fields/rho", data=WAVE[step].astype("f4"))
            rho.attrs.update({"axisLabels": ["z", "y", "x"], "gridUnitSI": 1.0, "unitSI": 1.0})
            rho.attrs.update({"gridSpacing": [0.5, 1.0, 0.25], "position": [0.0, 0.0, 0.0]})
            rho.attrs["gridGlobalOffset"] = [EVEN[axis][0] for axis in "zyx"]
    time = {"units": "s"}
    return Kind(path=path, values=WAVE, suffix=".h5", coords={**EVEN, "t": TIME * 1e-3}, time=time)


@kind
def compound(folder: Path) -> Kind:
    state = np.zeros(WAVE.shape, [("rho", "f4"), ("p", "f8")])
    state["rho"], state["p"] = WAVE, WAVE * 1e5
    path = folder / "state.h5"
    with h5py.File(path, "w") as file:
        file["state"] = state
    return Kind(
        path=path, values=WAVE * 1e5, suffix=".h5", options=("--var", "state.p"), dtype="float64"
    )


def vtk_grid(path: Path, values: np.ndarray, time: float, *, uneven: bool = False) -> Path:
    """A .vti or .vtr file in ascii with the array `u`, a second one, and a time."""
    z, y, x = values.shape
    extent = f"0 {x - 1} 0 {y - 1} 0 {z - 1}"
    name = "RectilinearGrid" if uneven else "ImageData"
    text = " ".join(map(repr, values.ravel().tolist()))
    axes = {"x": EVEN["x"], "y": EVEN["y"], "z": LEVELS}
    columns = "".join(
        f'<DataArray type="Float64" format="ascii">{" ".join(map(repr, axes[axis].tolist()))}'
        "</DataArray>"
        for axis in "xyz"
    )
    array = '<DataArray type="Float64" Name="{}" format="ascii">{}</DataArray>'
    path.write_text(
        f'<VTKFile type="{name}" version="1.0"><{name} WholeExtent="{extent}"'
        + ("" if uneven else ' Origin="10 -1 2" Spacing="0.25 1 0.5"')
        + f'><FieldData><DataArray type="Float64" Name="TimeValue" NumberOfTuples="1"'
        f' format="ascii">{time}</DataArray></FieldData><Piece Extent="{extent}"><PointData>'
        + array.format("u", text)
        + array.format("w", text)
        + "</PointData>"
        + (f"<Coordinates>{columns}</Coordinates>" if uneven else "")
        + f"</Piece></{name}></VTKFile>"
    )
    return path


@kind
def vti(folder: Path) -> Kind:
    path = vtk_grid(folder / "a.vti", WAVE[0], 4.0)
    coords = {**EVEN, "t": np.array([4.0])}
    return Kind(
        path=path, values=WAVE[:1], suffix=".vti", coords=coords, options=("--var", "w"),
        dtype="float64",
    )  # fmt: skip


@kind
def vtr(folder: Path) -> Kind:
    path = vtk_grid(folder / "a.vtr", WAVE[0], 4.0, uneven=True)
    coords = {**EVEN, "z": LEVELS, "t": np.array([4.0])}
    return Kind(
        path=path, values=WAVE[:1], suffix=".vtr", coords=coords, options=("--var", "u"),
        dtype="float64",
    )  # fmt: skip


@kind
def pvd(folder: Path) -> Kind:
    rows = []
    for step in range(T):
        vtk_grid(folder / f"s{step}.vti", WAVE[step], TIME[step])
        rows.append(f'<DataSet timestep="{TIME[step]}" file="s{step}.vti"/>')
    (folder / "run.pvd").write_text(
        f'<VTKFile type="Collection"><Collection>{"".join(rows)}</Collection></VTKFile>'
    )
    return Kind(
        path=folder / "run.pvd", values=WAVE, suffix=".pvd", coords={**EVEN, "t": TIME},
        options=("--var", "u"), dtype="float64",
    )  # fmt: skip


@kind
def vtkhdf(folder: Path) -> Kind:
    path = folder / "a.vtkhdf"
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs.update({"Version": [2, 0], "Type": np.bytes_(b"ImageData")})
        root.attrs.update({"WholeExtent": [0, X - 1, 0, Y - 1, 0, Z - 1]})
        root.attrs.update({"Origin": [10.0, -1.0, 2.0], "Spacing": [0.25, 1.0, 0.5]})
        root.attrs["Direction"] = np.eye(3).ravel()
        root["PointData/u"] = WAVE.astype("f4")
        root["Steps/Values"] = TIME
        root["Steps"].attrs["NSteps"] = T
    return Kind(path=path, values=WAVE, suffix=".vtkhdf", coords={**EVEN, "t": TIME})


def nrrd_text(path: str | None) -> str:
    lines = [
        "NRRD0005", "type: float", "dimension: 3", f"sizes: {X} {Y} {Z}", "endian: big",
        "encoding: raw", "space dimension: 3", "space origin: (10,-1,2)",
        "space directions: (0.25,0,0) (0,1,0) (0,0,0.5)", 'space units: "mm" "mm" "mm"',
    ]  # fmt: skip
    return "\n".join([*lines, *([] if path is None else [f"data file: {path}"])]) + "\n"


@kind
def nrrd(folder: Path) -> Kind:
    path = folder / "a.nrrd"
    path.write_bytes(f"{nrrd_text(None)}\n".encode() + WAVE[0].astype(">f4").tobytes())
    return Kind(path=path, values=WAVE[:1], suffix=".raw", coords=EVEN)


@kind
def nhdr(folder: Path) -> Kind:
    (folder / "values.bin").write_bytes(WAVE[0].astype(">f4").tobytes())
    path = folder / "a.nhdr"
    path.write_text(nrrd_text("values.bin"))
    return Kind(path=path, values=WAVE[:1], suffix=".raw", coords=EVEN)


def meta_text(data: str) -> bytes:
    return (
        f"ObjectType = Image\nNDims = 3\nDimSize = {X} {Y} {Z}\nElementType = MET_FLOAT\n"
        "BinaryDataByteOrderMSB = False\nOffset = 10 -1 2\nElementSpacing = 0.25 1 0.5\n"
        f"ElementDataFile = {data}\n"
    ).encode()


@kind
def mha(folder: Path) -> Kind:
    path = folder / "a.mha"
    path.write_bytes(meta_text("LOCAL") + WAVE[0].astype("<f4").tobytes())
    return Kind(path=path, values=WAVE[:1], suffix=".raw", coords=EVEN)


@kind
def mhd(folder: Path) -> Kind:
    path = folder / "a.mhd"
    (folder / "a.zraw").write_bytes(WAVE[0].astype("<f4").tobytes())
    path.write_bytes(meta_text("a.zraw"))
    return Kind(path=path, values=WAVE[:1], suffix=".raw", coords=EVEN)


@kind
def tif(folder: Path) -> Kind:
    import pytest

    tifffile = pytest.importorskip("tifffile")
    values = np.round(WAVE * 100 + 200).astype("u2")
    tifffile.imwrite(folder / "a.tif", values, metadata={"axes": "TZYX"}, imagej=True)
    return Kind(path=folder / "a.tif", values=values, suffix=".npy", dtype="uint16")


@kind
def raw(folder: Path) -> Kind:
    path = folder / f"rho_{X}x{Y}x{Z}x{T}_float32_be.raw"
    path.write_bytes(WAVE.astype(">f4").tobytes())
    return Kind(path=path, values=WAVE, suffix=".raw")


@kind
def npy(folder: Path) -> Kind:
    np.save(folder / "a.npy", np.asfortranarray(WAVE.astype(">f8")))
    return Kind(path=folder / "a.npy", values=WAVE, suffix=".npy", dtype="float64")


def cf_values(stored: np.ndarray) -> np.ndarray:
    return np.where(stored == -9999, np.nan, stored * 0.01 + 5)


CF = {"units": "K", "scale_factor": 0.01, "add_offset": 5.0, "_FillValue": np.int32(-9999)}


def counts() -> np.ndarray:
    stored = np.round(WAVE * 100).astype("i4")
    stored[1, 2, 3] = -9999
    return stored


@kind
def cf_hdf5(folder: Path) -> Kind:
    stored = counts()
    path = folder / "cf.h5"
    with h5py.File(path, "w") as file:
        file["v"] = stored
        file["v"].attrs.update(CF)
        for place, (name, values) in enumerate({"time": TIME, "z": LEVELS}.items()):
            file[name] = values
            file[name].make_scale(name)
            file["v"].dims[place].attach_scale(file[name])
        file["time"].attrs["units"] = DAYS
    return Kind(
        path=path, values=cf_values(stored), suffix=".h5", coords={"t": TIME, "z": LEVELS},
        units="K", time={"units": DAYS}, dtype="float64",
    )  # fmt: skip


@kind
def cf_zarr(folder: Path) -> Kind:
    stored = counts()
    path = folder / "cf.zarr"
    group = zarr.open_group(path, mode="w", zarr_format=2)
    array = group.create_array("v", shape=stored.shape, dtype=stored.dtype, fill_value=-9999)
    array[...] = stored
    array.attrs.update(json.loads(json.dumps({**CF, "_FillValue": -9999})))
    array.attrs["_ARRAY_DIMENSIONS"] = ["time", "z", "y", "x"]
    time = group.create_array("time", shape=(T,), dtype="f8")
    time[...] = TIME
    time.attrs.update({"units": DAYS, "_ARRAY_DIMENSIONS": ["time"]})
    return Kind(
        path=path, values=cf_values(stored), suffix=".zarr", coords={"t": TIME}, units="K",
        time={"units": DAYS}, dtype="float64",
    )  # fmt: skip


@kind
def plain_zarr(folder: Path) -> Kind:
    path = folder / "a.zarr"
    dataset = labelled(
        WAVE.astype("f4"), "time z y x", {"time": (TIME, {"units": DAYS}), "z": (LEVELS, {})},
        units="m s-1",
    )  # fmt: skip
    dataset.to_zarr(path, zarr_format=3, consolidated=False)
    return Kind(
        path=path, values=WAVE, suffix=".zarr", coords={"t": TIME, "z": LEVELS}, units="m s-1",
        time={"units": DAYS},
    )  # fmt: skip
