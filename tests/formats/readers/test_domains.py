"""Formats of microscopy, medicine, simulations, weather and seismics, by the libraries that own
them; data at URLs."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import nibabel
import numpy as np
import pytest
import xarray as xr
import zarr
from range_server import RangeServer
from test_grids import VALUES, positions

from fhash_formats.errors import FhashWarning, InputError, MissingDependencyError
from fhash_formats.readers.registry import list_variables, open_series

CELLS = np.stack([VALUES, -VALUES], axis=1)
"""(t, c, z, y, x)"""


def ome_zarr(path: Path, version: str, *, letters: str = "tczyx", **more: Any) -> zarr.Group:
    """An image of two levels by the specification of NGFF."""
    kinds = {"t": ("time", "second"), "c": ("channel", None)}
    listed = [(axis, *kinds.get(axis, ("space", "micrometer"))) for axis in letters]
    scale, shift = [2.0, 1, 0.5, 0.25, 0.125], [0.0, 0, 3, 2, 1]
    coarse = [{"type": "scale", "scale": [2.0, 1, 0.5, 0.5, 0.25]}]
    fine = [{"type": "scale", "scale": scale}, {"type": "translation", "translation": shift}]
    scales = {
        "axes": [
            {"name": name, "type": kind} | ({} if unit is None else {"unit": unit})
            for name, kind, unit in listed
        ],
        "datasets": [
            {"path": "0", "coordinateTransformations": fine},
            {"path": "1", "coordinateTransformations": coarse},
        ],
        "coordinateTransformations": [{"type": "scale", "scale": [3.0, 1, 2, 2, 2]}],
    } | more
    told = {
        "multiscales": [scales],
        "omero": {"channels": [{"label": "DAPI"}, {"label": "GFP/488"}]},
    }
    group = zarr.open_group(path, mode="w", zarr_format=2 if version == "0.4" else 3)
    group.attrs.update(told if version == "0.4" else {"ome": {"version": version, **told}})
    group.create_array("0", data=CELLS, chunks=(1, 1, 4, 5, 6))
    group.create_array("1", data=CELLS[..., ::2, ::2])
    return group


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_ome_zarr(tmp_path: Path, version: str) -> None:
    path = tmp_path / "cells.ome.zarr"
    labels = ome_zarr(path, version).create_group("labels").create_group("nuclei")
    labels.attrs.update(zarr.open_group(path).attrs)
    labels.create_array("0", data=CELLS.astype("i4"))
    names = [each.name for each in list_variables(path)]
    assert names == ["cells.DAPI", "cells.GFP_488"]
    values, ends, units = positions(path, var="GFP_488")
    np.testing.assert_array_equal(values, -VALUES)
    assert ends == {"t": [0, 6], "z": [6, 7], "y": [4, 4.5], "x": [2, 2.25]}
    assert units == ["second", "micrometer", "micrometer", "micrometer"]
    with open_series(path, var="GFP_488") as series:
        assert {each.name for each in series.metadata.variables} == {"time", "z", "y", "x"}
    for place, wishes in ((path, {"var": "1"}), (path / "1", {})):
        values, ends, _ = positions(place, select={"channel": 0}, **wishes)
        np.testing.assert_array_equal(values, VALUES[..., ::2, ::2])
        assert ends == {"t": [0, 6], "z": [0, 1], "y": [0, 1], "x": [0, 0.5]}
    nuclei = positions(path, var="labels_nuclei.DAPI")[0]
    np.testing.assert_array_equal(nuclei, VALUES.astype("i4"))


def test_ome_zarr_of_several_images_and_old_axes(tmp_path: Path) -> None:
    for place in ("A/1/0", "A/2/0"):
        ome_zarr(tmp_path / "plate.zarr" / place, "0.4")
    for place in ("", "A", "A/1", "A/2"):
        zarr.open_group(tmp_path / "plate.zarr" / place, mode="a", zarr_format=2)
    names = [each.name for each in list_variables(tmp_path / "plate.zarr")]
    assert names == [f"A_{n}_0.{name}" for n in (1, 2) for name in ("DAPI", "GFP_488")]
    # without axes they are t, c, z, y, x
    path = tmp_path / "old.zarr"
    ome_zarr(path, "0.4", letters="")
    np.testing.assert_array_equal(positions(path, var="old.DAPI")[0], VALUES)


@pytest.mark.parametrize(
    "wrong",
    [
        {"datasets": [{}]},
        {"datasets": [{"path": "0", "coordinateTransformations": [{"type": "rotation"}]}]},
        {"datasets": [{"path": "0", "coordinateTransformations": [{"type": "scale"}]}]},
        {"coordinateTransformations": [{"type": "scale", "scale": [1, 1, 0, 1, 1]}]},
        {"axes": [{"name": "z"}]},
        {"axes": 7},
    ],
)
def test_ome_zarr_of_wrong_metadata_is_refused(tmp_path: Path, wrong: dict[str, Any]) -> None:
    ome_zarr(tmp_path / "a.zarr", "0.5", **wrong)
    with pytest.raises(InputError, match=r"a\.zarr"):
        open_series(tmp_path / "a.zarr", var="a.DAPI")


FINE = np.random.default_rng(3).normal(size=(4, 6, 8)).astype(np.float32)
"""A grid (z, y, x) of 2 x 3 x 2 blocks of 2 x 2 x 4 cells."""
BLOCK = (2, 2, 4)
PLACES = np.random.default_rng(4).permutation(list(np.ndindex(2, 3, 2)))
"""Blocks in no order, by their places along z, y and x."""
BLOCKS = np.stack(
    [
        FINE[tuple(slice(p * n, p * n + n) for p, n in zip(place, BLOCK, strict=True))]
        for place in PLACES
    ]
)


def athena(path: Path, time: float = 0.25, **changes: Any) -> None:
    """A file as Athena++ writes it (src/outputs/athena_hdf5.cpp): x from 0 on, y 1, z 2."""
    told = {
        "Coordinates": np.bytes_("cartesian"),
        "DatasetNames": np.array(["prim", "B"], "S21"),
        "MaxLevel": 0,
        "MeshBlockSize": np.array(BLOCK[::-1], "i4"),
        "NumCycles": 7,
        "NumMeshBlocks": len(PLACES),
        "NumVariables": np.array([2, 1], "i4"),
        "RootGridSize": np.array(FINE.shape[::-1], "i4"),
        "RootGridX1": np.array([0, 4, 1], "f8"),
        "RootGridX2": np.array([1, 4, 1], "f8"),
        "RootGridX3": np.array([2, 4, 1], "f8"),
        "Time": time,
        "VariableNames": np.array(["rho", "press", "Bcc1"], "S21"),
    } | changes
    with h5py.File(path, "w") as file:
        file.attrs.update(told)
        file["Levels"] = np.zeros(len(PLACES), "i4")
        file["LogicalLocations"] = PLACES[:, ::-1].astype("i8")
        file["prim"] = np.stack([BLOCKS, 2 * BLOCKS]).astype(">f4")
        file["B"] = -BLOCKS[None]
        for n in range(3):
            axis = 2 - n
            edges = n + 0.5 * (PLACES[:, axis, None] * BLOCK[axis] + np.arange(BLOCK[axis] + 1))
            file[f"x{n + 1}f"] = edges.astype("f4")
            file[f"x{n + 1}v"] = ((edges[:, 1:] + edges[:, :-1]) / 2).astype("f4")


HALVES = {"z": [2.25, 2.75], "y": [1.25, 1.75], "x": [0.25, 0.75]}


def test_athena(tmp_path: Path) -> None:
    for step in range(2):
        athena(tmp_path / f"a.{step:05d}.athdf", time=0.25 * step)
    assert [n.name for n in list_variables(tmp_path / "a.00000.athdf")] == ["rho", "press", "Bcc1"]
    values, ends, _ = positions(tmp_path / "a.0000?.athdf", var="press")
    np.testing.assert_array_equal(values, np.stack([2 * FINE] * 2))
    assert ends == {"t": [0, 0.25], **HALVES}
    with open_series(tmp_path / "a.00000.athdf", var="Bcc1", axes="z,y,x") as series:
        np.testing.assert_array_equal(series.read(0), -FINE)


def flash(path: Path, time: float = 0.25, *, flat: bool = False) -> None:
    """A file as FLASH 4 writes it, with the parents of its blocks.

    flat: whether it has two dimensions.
    """
    leaves = PLACES[PLACES[:, 0] == 0] if flat else PLACES
    values = BLOCKS[PLACES[:, 0] == 0][:, :1] if flat else BLOCKS
    axes = 2 if flat else 3
    low = leaves[:, ::-1][:, :axes] * np.array([2.0, 1, 1])[:axes] + np.arange(axes)
    boxes = np.stack([low, low + np.array([2.0, 1, 1])[:axes]], axis=2)
    parent = np.stack([boxes.min((0, 2)), boxes.max((0, 2))], axis=1)
    with h5py.File(path, "w") as file:
        file["unknown names"] = np.array([["dens"], ["h1  "]], "S4")
        file["node type"] = np.array([2] + [1] * len(leaves), "i4")
        file["refine level"] = np.array([1] + [2] * len(leaves), "i4")
        file["bounding box"] = np.concatenate([parent[None], boxes]).astype("f4")
        file["dens"] = np.concatenate([np.zeros_like(values[:1]), values])
        file["h1  "] = np.concatenate([np.zeros_like(values[:1]), -values])
        table = np.array([(b"time".ljust(80), time), (b"dt".ljust(80), 9.0)], "S80,f8")
        table.dtype.names = ("name", "value")
        file["real scalars"] = table


def test_flash(tmp_path: Path) -> None:
    for step in range(2):
        flash(tmp_path / f"run_hdf5_plt_cnt_000{step}", time=0.25 * step)
    pattern = tmp_path / "run_hdf5_plt_cnt_????"
    assert [n.name for n in list_variables(pattern)] == ["dens", "h1"]
    values, ends, _ = positions(pattern, var="h1")
    np.testing.assert_array_equal(values, np.stack([-FINE] * 2))
    assert ends == {"t": [0, 0.25], **HALVES}
    flash(tmp_path / "flat", flat=True)
    values, ends, _ = positions(tmp_path / "flat", var="dens")
    np.testing.assert_array_equal(values[0], FINE[:1])
    assert (ends["y"], ends["x"], len(ends["z"])) == (HALVES["y"], HALVES["x"], 1)


FAB = "FAB ((8, ({0} 11 52 0 1 12 0 1023)),({1}, ({2})))"


def plotfile(path: Path, time: float = 0.25, *, kind: str = "<f8", ghosts: int = 0) -> None:
    """A plotfile as AMReX writes it (Src/Base/AMReX_PlotFileUtil.cpp), two files of values."""

    def box(first: Any, last: Any) -> str:
        texts = [",".join(map(str, np.asarray(each)[::-1])) for each in (first, last, [0, 0, 0])]
        return f"(({texts[0]}) ({texts[1]}) ({texts[2]}))"

    size, count = np.dtype(kind).itemsize, len(PLACES)
    order = range(size, 0, -1) if kind[0] == "<" else range(1, size + 1)
    head = FAB.format(8 * size, size, " ".join(map(str, order)))
    (path / "Level_0").mkdir(parents=True)
    corners = PLACES * BLOCK
    where, boxes = [], []
    for number, first in enumerate(corners):
        last = first + BLOCK - 1
        boxes.append(box(first, last))
        values = np.pad(np.stack([BLOCKS[number], -BLOCKS[number]]), [(0, 0)] + [(ghosts,) * 2] * 3)
        with (path / "Level_0" / f"Cell_D_0000{number % 2}").open("ab") as file:
            where.append(f"FabOnDisk: Cell_D_0000{number % 2} {file.tell()}")
            file.write(f"{head}{box(first - ghosts, last + ghosts)} 2\n".encode())
            file.write(values.astype(kind).tobytes())
    domain = box([0, 0, 0], np.array(FINE.shape) - 1)
    cells = ["1", "1", "2", str(ghosts), f"({count} 0", *boxes, ")", str(count), *where, ""]
    (path / "Level_0" / "Cell_H").write_text("\n".join(cells) + "\n")
    low = [(corners[n] * 0.5 + [2, 1, 0])[::-1] for n in range(count)]
    edges = [f"{a} {a + 0.5 * n}" for each in low for a, n in zip(each, BLOCK[::-1], strict=True)]
    lines = ["HyperCLaw-V1.1", "2", "density", "x velocity", "3", str(time), "0", "0 1 2 "]
    lines += ["4 4 4 ", "", f"{domain} ", "7 ", "0.5 0.5 0.5 ", "0", "0", f"0 {count} {time}", "7"]
    (path / "Header").write_text("\n".join([*lines, *edges, "Level_0/Cell"]) + "\n")


def test_coordinates_that_are_not_cartesian_are_told(tmp_path: Path) -> None:
    athena(tmp_path / "a.athdf", Coordinates=np.bytes_("spherical_polar"))
    with pytest.warns(FhashWarning, match="coordinates are spherical_polar"):
        open_series(tmp_path / "a.athdf", var="rho").close()
    plotfile(tmp_path / "plt")
    header = tmp_path / "plt" / "Header"
    header.write_text(header.read_text().replace("0.5 0.5 0.5 \n0\n", "0.5 0.5 0.5 \n1\n"))
    with pytest.warns(FhashWarning, match="coordinates are cylindrical"):
        open_series(tmp_path / "plt", var="density").close()


@pytest.mark.parametrize("kind", ["<f8", "<f4", ">f8"])
@pytest.mark.parametrize("ghosts", [0, 2])
def test_plotfiles_of_amrex(tmp_path: Path, kind: str, ghosts: int) -> None:
    for step in range(2):
        plotfile(tmp_path / f"plt0000{step}", 0.25 * step, kind=kind, ghosts=ghosts)
    assert [n.name for n in list_variables(tmp_path / "plt00001")] == ["density", "x velocity"]
    values, ends, _ = positions(tmp_path / "plt?????", var="x velocity")
    np.testing.assert_array_equal(values, np.stack([-FINE] * 2))
    assert ends == {"t": [0, 0.25], **HALVES}


def test_several_levels_are_refused_with_a_way(tmp_path: Path) -> None:
    athena(tmp_path / "a.athdf")
    flash(tmp_path / "a_hdf5_chk_0000")
    for name, key in (("a.athdf", "Levels"), ("a_hdf5_chk_0000", "refine level")):
        with h5py.File(tmp_path / name, "a") as file:
            file[key][-1] = 5
    plotfile(tmp_path / "plt0")
    header = (tmp_path / "plt0" / "Header").read_text()
    (tmp_path / "plt0" / "Header").write_text(header.replace("0.25\n0\n", "0.25\n1\n", 1))
    for name in ("a.athdf", "a_hdf5_chk_0000", "plt0"):
        with pytest.raises(InputError, match=rf"{name}: it has 2 levels .*covering_grid.*encode"):
            open_series(tmp_path / name)


def test_simulations_that_are_cut_are_refused(tmp_path: Path) -> None:
    athena(tmp_path / "a.athdf")
    flash(tmp_path / "a_plt_cnt_0000")
    plotfile(tmp_path / "plt0")
    files = {each: "plt0" for each in sorted((tmp_path / "plt0").rglob("[HC]*")) if each.is_file()}
    files |= {tmp_path / name: name for name in ("a.athdf", "a_plt_cnt_0000")}
    wanted = {"a.athdf": "rho", "a_plt_cnt_0000": "dens", "plt0": "x velocity"}
    assert len(files) == 6
    for file, name in files.items():
        whole, path = file.read_bytes(), tmp_path / name
        for count in range(0, len(whole) - 1, 37):
            file.write_bytes(whole[:count])
            with pytest.raises(InputError, match=name), open_series(path, var=wanted[name]) as cut:
                cut.read(0)
        file.write_bytes(whole)


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        ("Header", "(7,5,3)", "(7,5,4)", "its boxes are"),
        ("Header", "Level_0/Cell", "../plt0/Level_0/Cell", "may lie elsewhere"),
        ("Header", "\n2\n", "\n9999999\n", ""),
        ("Level_0/Cell_H", "Cell_D_00001", "../Cell_D_00001", "may lie elsewhere"),
        ("Level_0/Cell_H", "((0,0,0) (3,1,1)", "((0,0,0) (9999999999,1,1)", "too large"),
        ("Level_0/Cell_H", "((0,0,0) (3,1,1)", "((4,0,0) (7,1,1)", "another box"),
        ("Level_0/Cell_D_00000", " (0,0,0)) 2", " (0,1,0)) 2", "nodes"),
        ("Level_0/Cell_D_00000", "(8, (8 7", "(2, (8 7", "no values"),
    ],
)
def test_plotfiles_that_lie_are_refused(
    tmp_path: Path, file: str, old: str, new: str, told: str
) -> None:
    plotfile(tmp_path / "plt0")
    path = tmp_path / "plt0" / file
    text = path.read_bytes()
    assert old.encode() in text
    path.write_bytes(text.replace(old.encode(), new.encode()))
    with pytest.raises(InputError, match=rf"plt0.*{told}"):
        open_series(tmp_path / "plt0", var="density")


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("LogicalLocations", np.zeros_like(PLACES), "overlap"),
        ("LogicalLocations", PLACES * 2, "leave cells"),
        ("LogicalLocations", PLACES * 2**62, "too large"),
        ("LogicalLocations", PLACES * -(2**63), "too large"),
        ("x1v", np.arange(4 * len(PLACES)).reshape(-1, 4), "different positions"),
        ("prim", np.zeros((2, 3)), "does not hold 2 variables"),
        ("MeshBlockSize", [4, 2, 0], "empty"),
        ("RootGridSize", [4, 6, 4], "ghost"),
        ("DatasetNames", None, "DatasetNames"),
    ],
)
def test_athena_that_lies_is_refused(tmp_path: Path, key: str, value: Any, told: str) -> None:
    path = tmp_path / "a.athdf"
    athena(path)
    with h5py.File(path, "a") as file:
        place = file if key in file else file.attrs
        del place[key]
        if value is not None:
            place[key] = value
    with pytest.raises(InputError, match=rf"a\.athdf.*{told}"):
        open_series(path, var="rho")


MINC = "minc-2.0/image/0/image"


def minc(
    path: Path, stored: np.ndarray, ends: np.ndarray, order: str = "tzyx", **more: Any
) -> None:
    """A MINC2 file; ends: least and greatest value, of all or of each slice."""
    names = [{"t": "time"}.get(axis, f"{axis}space") for axis in order]
    with h5py.File(path, "w") as file:
        image = file.create_dataset(MINC, data=stored)
        image.attrs["dimorder"] = np.bytes_(",".join(names))
        for key, each in more.items():
            image.attrs[key] = each
        for name, values in zip(("image-min", "image-max"), ends, strict=True):
            each = file.create_dataset(f"minc-2.0/image/0/{name}", data=values)
            each.attrs["dimorder"] = np.bytes_(",".join(names[: np.ndim(values)]))
        for n, (name, length) in enumerate(zip(names, stored.shape, strict=True)):
            each = file.create_dataset(f"minc-2.0/dimensions/{name}", data=0)
            each.attrs["start"], each.attrs["step"] = 10.0 * n, n + 1.5
            each.attrs["length"] = length
            each.attrs["units"] = np.bytes_("s" if name == "time" else "mm")
            if name != "time":
                each.attrs["direction_cosines"] = np.eye(3)["xyz".index(name[0])]


@pytest.mark.parametrize("scales", [(), (3,), (3, 4)])
@pytest.mark.parametrize("kind", ["u1", "i2"])
def test_minc(tmp_path: Path, scales: tuple[int, ...], kind: str) -> None:
    stored = np.random.default_rng(1).integers(0, 200, VALUES.shape).astype(kind)
    ends = np.random.default_rng(2).normal(size=(2, *scales)) + np.reshape(
        [-2, 2], (2, *[1] * len(scales))
    )
    minc(tmp_path / "a.mnc", stored, ends, valid_range=[0.0, 200.0])
    values, at, units = positions(tmp_path / "a.mnc")
    np.testing.assert_array_equal(values, nibabel.load(tmp_path / "a.mnc").get_fdata())
    assert at == {"t": [0, 1.5], "z": [10, 12.5], "y": [20, 23.5], "x": [30, 34.5]}
    assert units == ["s", "mm", "mm", "mm"]
    np.testing.assert_array_equal(positions(tmp_path / "a.mnc", raw_values=True)[0], stored)
    minc(tmp_path / "a.mnc", stored, ends, valid_range=[50.0, 150.0])
    values = positions(tmp_path / "a.mnc")[0]
    outside = (stored < 50) | (stored > 150)
    expected = nibabel.load(tmp_path / "a.mnc").get_fdata()
    np.testing.assert_array_equal(values, np.where(outside, np.nan, expected))


@pytest.mark.parametrize(
    "name", ["minc2_4d", "minc2-4d-d", "small", "minc2-no-att", "minc2_1_scale"]
)
def test_minc_of_its_own_programs(name: str) -> None:
    path = Path(nibabel.__file__).parent / "tests" / "data" / f"{name}.mnc"
    values, at, _ = positions(path)
    expected = nibabel.load(path)
    # nibabel leaves axes in the order of the file: t, z, y, x, or t, x, y, z
    turned = (
        expected.get_fdata().transpose(0, 3, 2, 1) if name == "minc2-4d-d" else expected.get_fdata()
    )
    np.testing.assert_array_equal(values, turned.reshape(values.shape))
    assert [at[axis][0] for axis in "xyz"] == expected.affine[:3, 3].tolist()
    with pytest.raises(InputError, match="MINC1"):
        open_series(path.with_name("tiny.mnc"))


def test_minc_of_floats_and_other_orders(tmp_path: Path) -> None:
    path = tmp_path / "a.mnc"
    minc(path, VALUES[0].transpose(1, 2, 0), np.array([0.0, 1.0]), "yxz")
    with h5py.File(path, "a") as file:
        file["minc-2.0/dimensions/xspace"].attrs["direction_cosines"] = [0.8, 0.6, 0]
    with pytest.warns(FhashWarning, match="turned against"):
        values, at, _ = positions(path)
    np.testing.assert_array_equal(values[0], VALUES[0])
    assert at == {"t": [0], "z": [20, 23.5], "y": [0, 1.5], "x": [10, 12.5]}


def test_minc_that_cannot_be_right_is_refused(tmp_path: Path) -> None:
    path, stored, ends = tmp_path / "a.mnc", VALUES.astype("i2"), np.array([0.0, 1.0])
    minc(path, stored, ends)
    for gone in ("minc-2.0/image/0/image-max", "minc-2.0/image/0/image-min"):
        minc(path, stored, ends)
        with h5py.File(path, "a") as file:
            del file[gone]
        with pytest.raises(InputError, match=r"a\.mnc"):
            open_series(path)
    for wrong in ({"valid_range": [0.0, 1e9]}, {"valid_range": [3.0, 3.0]}, {"dimorder": b"z"}):
        minc(path, stored, ends, **wrong)
        with pytest.raises(InputError, match=r"a\.mnc"):
            open_series(path)
    minc(path, stored, np.zeros((2, 2)))
    with pytest.raises(InputError, match="does not scale slices"):
        open_series(path)
    minc(path, stored.astype(h5py.enum_dtype({"grey": 1, "white": 2}, "i2")), ends)
    with pytest.raises(InputError, match="labels of an enumeration"):
        open_series(path)


@pytest.mark.parametrize("engine", ["BP4", "BP5"])
def test_adios(tmp_path: Path, engine: str) -> None:
    adios2 = pytest.importorskip("adios2")
    path = tmp_path / "a.bp"
    io = adios2.Adios().declare_io("a")
    io.set_engine(engine)
    with adios2.Stream(io, str(path), "w") as stream:
        for step in range(3):
            stream.begin_step()
            for block in range(2):  # two blocks of each array
                part = np.ascontiguousarray(VALUES[step, :, :, 3 * block : 3 * block + 3])
                stream.write("fields/rho", part, (4, 5, 6), [0, 0, 3 * block], part.shape)
            stream.write("time", np.float64(0.5 * step))
            grown = np.zeros((4, 5, 6 + step))
            stream.write("grown", grown, grown.shape, [0, 0, 0], grown.shape)
            if step == 0:
                stream.write(
                    "mask", np.arange(30, dtype="u1").reshape(5, 6), (5, 6), [0, 0], (5, 6)
                )
                stream.write_attribute("units", "kg m-3", "fields/rho")
                stream.write_attribute("title", "a run")
            stream.end_step()
    values, ends, _ = positions(path, var="rho")
    np.testing.assert_array_equal(values, VALUES)
    assert ends["t"] == [0, 0.5]
    with pytest.raises(InputError, match="grown has another shape"):
        positions(path, var="grown")
    with open_series(path, var="rho") as series:
        assert (series.name, series.units) == ("rho", "kg m-3")
        assert series.metadata is None or series.metadata.file == "a.bp"
    mask = positions(path, var="mask")[0]
    np.testing.assert_array_equal(mask[0, 0], np.arange(30).reshape(5, 6))
    assert list(tmp_path.iterdir()) == [path]
    for name in ("md.idx", "md.0", "data.0"):
        whole = (path / name).read_bytes()
        ends_of = (-32, -1) if name != "data.0" else ()  # nobody reads those of the values
        for count in (0, 57, len(whole) // 2, *(len(whole) + n for n in ends_of)):
            (path / name).write_bytes(whole[:count])
            with pytest.raises(InputError, match=r"a\.bp"), open_series(path, var="rho") as series:
                list(series.frames())
        (path / name).write_bytes(whole)


def segy(path: Path, *, sorting: int = 2, offsets: int = 1, flat: bool = False) -> None:
    """A SEG-Y file of the first step, (inline, crossline, sample) = (y, x, z)."""
    segyio = pytest.importorskip("segyio")
    spec = segyio.spec()
    spec.format, spec.sorting = 5, sorting
    spec.samples = np.arange(4) * 4.0 + 100
    spec.ilines, spec.xlines = np.arange(5) * 2 + 10, np.arange(6) + 300
    spec.offsets = np.arange(offsets) + 1
    values = VALUES[0].transpose(1, 2, 0)
    places = [(i, x) for i in range(5) for x in range(6)]
    if sorting == 1:
        places.sort(key=lambda place: place[1])
    if flat:
        spec = segyio.spec()
        spec.format, spec.samples, spec.tracecount = 5, np.arange(4) * 4.0 + 100, 6
        places = [(2, x) for x in range(6)]
    with segyio.create(str(path), spec) as file:
        file.bin[segyio.BinField.Interval] = 4000
        for n, (i, x) in enumerate(place for place in places for _ in range(offsets)):
            file.header[n] = {
                segyio.TraceField.INLINE_3D: 0 if flat else 2 * i + 10,
                segyio.TraceField.CROSSLINE_3D: 0 if flat else x + 300,
                segyio.TraceField.offset: n % offsets + 1,
                segyio.TraceField.DelayRecordingTime: 100,
                segyio.TraceField.TRACE_SAMPLE_INTERVAL: 4000,
            }
            file.trace[n] = np.ascontiguousarray(values[i, x])


@pytest.mark.parametrize("sorting", [1, 2])
def test_segy(tmp_path: Path, sorting: int) -> None:
    path = tmp_path / "a.sgy"
    segy(path, sorting=sorting)
    values, ends, units = positions(path)
    np.testing.assert_array_equal(values[0], VALUES[0])
    assert ends == {"t": [0], "z": [100, 104], "y": [10, 12], "x": [300, 301]}
    assert units[1] == "ms"
    segy(path, flat=True)
    np.testing.assert_array_equal(positions(path)[0][0], VALUES[0][:, 2:3])
    segy(path, sorting=sorting, offsets=2)
    with pytest.raises(InputError, match=r"a\.sgy: its 60 traces make no regular grid"):
        open_series(path)
    segy(path, sorting=sorting)
    segyio = pytest.importorskip("segyio")
    with segyio.open(str(path), "r+", ignore_geometry=True) as file:
        file.header[17] = {segyio.TraceField.INLINE_3D: 10, segyio.TraceField.CROSSLINE_3D: 300}
    with pytest.raises(InputError, match="make no regular grid"):
        open_series(path)


def test_segy_that_is_cut_is_refused(tmp_path: Path) -> None:
    segy(tmp_path / "a.sgy")
    whole, cut = (tmp_path / "a.sgy").read_bytes(), tmp_path / "cut.sgy"
    for count in range(0, len(whole), 37):
        cut.write_bytes(whole[:count])
        with pytest.raises(InputError), open_series(cut) as series:
            series.read(0)


@pytest.mark.parametrize(
    ("name", "module", "extra"),
    [("a.sgy", "segyio", "segy"), ("a.grb", "cfgrib", "grib"), ("a.bp", "adios2", "adios")],
)
def test_a_library_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, module: str, extra: str
) -> None:
    (tmp_path / name).write_bytes(b"GRIB" if extra == "grib" else b"?")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=rf"{module}: pip install 'fhash\[{extra}\]'"):
        open_series(tmp_path / name)


def message(values: np.ndarray, **keys: Any) -> bytes:
    """A message of GRIB 2 on a grid (latitude, longitude) of 10 degrees."""
    eccodes = pytest.importorskip("eccodes")
    y, x = values.shape
    ends = {"latitudeOfFirst": 60.0, "longitudeOfFirst": 0.0}
    ends |= {"latitudeOfLast": 70.0 - 10 * y, "longitudeOfLast": 10.0 * x - 10}
    told = {"Ni": x, "Nj": y, "bitsPerValue": 24, "dataDate": 20200101, "dataTime": 0}
    told |= {f"{key}GridPointInDegrees": each for key, each in ends.items()}
    told |= {f"{axis}DirectionIncrementInDegrees": 10.0 for axis in "ij"}
    made = eccodes.codes_grib_new_from_samples("regular_ll_pl_grib2")
    for key, each in (told | keys).items():
        eccodes.codes_set(made, key, each)
    eccodes.codes_set_values(made, values.ravel().astype(float))
    found: bytes = eccodes.codes_get_message(made)
    eccodes.codes_release(made)
    return found


def grib(path: Path) -> None:
    """Temperatures on levels of pressure and near the ground, of three steps of a forecast."""
    with path.open("wb") as file:
        for step in range(3):
            for n, level in enumerate((1000, 850, 700, 500)):
                place = {"typeOfLevel": "isobaricInhPa", "level": level, "step": 6 * step}
                file.write(message(VALUES[step, n] + 280, shortName="t", **place))
                file.write(message(VALUES[step, n], shortName="u", **place))
            near = {"typeOfLevel": "heightAboveGround", "level": 2, "step": 6 * step}
            file.write(message(VALUES[step, 0] + 290, shortName="2t", **near))


def test_grib(tmp_path: Path) -> None:
    pytest.importorskip("cfgrib")
    path = tmp_path / "a.grib2"
    grib(path)
    names = ["heightAboveGround/t2m", "isobaricInhPa/t", "isobaricInhPa/u"]
    assert [each.name for each in list_variables(path)] == names
    values, ends, units = positions(path, var="u")
    np.testing.assert_allclose(values, VALUES, atol=1e-5)
    assert (ends["z"], ends["y"], ends["x"]) == ([1000, 850], [60, 50], [0, 10])
    assert units[0].startswith(("seconds since", "hours"))
    assert ends["t"][1] - ends["t"][0] == (6 if units[0] == "hours" else 6 * 3600)
    with open_series(path, var="t2m") as series:
        assert (series.units, series.shape, series.coords["z"].values) == ("K", (3, 1, 5, 6), [2])
        np.testing.assert_allclose(series.read(2)[0], VALUES[2, 0] + 290, atol=1e-4)
        assert series.metadata is not None
    assert list(tmp_path.iterdir()) == [path]


def test_grib_that_is_cut_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("cfgrib")
    path, part = tmp_path / "a.grib2", message(VALUES[0, 0], shortName="t")
    for count in range(4, len(part), 37):
        path.write_bytes(part + part[:count])
        with pytest.raises(InputError, match=r"a\.grib2"), open_series(path) as series:
            series.read(0)


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[tuple[xr.Dataset, str, RangeServer]]:
    """A dataset, the URL of a folder with it as a.nc and a.zarr, and their server."""
    packed = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype("f4")
    packed[1, 2] = np.nan
    made = xr.Dataset(
        {"u": (("time", "lev", "lat", "lon"), packed, {"units": "m/s"}), "w": ("lev", [1.0, 2, 3])},
        coords={
            "time": ("time", [0.5, 1, 2, 4], {"units": "days since 2001-01-01"}),
            "lat": ("lat", np.arange(5.0), {"units": "degrees_north"}),
        },
        attrs={"title": "elsewhere"},
    )
    encoding = {"u": {"dtype": "i2", "scale_factor": 1e-3, "_FillValue": np.int16(-32768)}}
    made.to_netcdf(tmp_path / "a.nc", engine="h5netcdf", encoding=encoding)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of consolidated metadata, which are no part of Zarr 3
        made.to_zarr(tmp_path / "a.zarr", encoding=encoding, consolidated=True)
    with RangeServer() as server:
        url = server.put("bucket/a.nc", (tmp_path / "a.nc").read_bytes())
        for file in (tmp_path / "a.zarr").rglob("*"):
            if file.is_file():
                server.put(f"bucket/{file.relative_to(tmp_path).as_posix()}", file.read_bytes())
        yield made, url.removesuffix("/a.nc"), server


@pytest.mark.parametrize("name", ["a.nc", "a.zarr"])
@pytest.mark.parametrize("way", ["http", "s3"])
def test_data_at_a_url_are_those_of_the_file(
    elsewhere: tuple[xr.Dataset, str, RangeServer],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    name: str,
    way: str,
) -> None:
    _, folder, _ = elsewhere
    if way == "s3":
        stores = pytest.importorskip("obstore.fsspec")
        stores.FsspecStore.clear_instance_cache()  # of other servers
        monkeypatch.setenv("AWS_ENDPOINT", folder.removesuffix("/bucket"))
        for key, value in (("SKIP_SIGNATURE", "true"), ("ALLOW_HTTP", "true"), ("REGION", "x")):
            monkeypatch.setenv(f"AWS_{key}", value)
        folder = "s3://bucket"
    with open_series(f"{folder}/{name}") as there, open_series(tmp_path / name) as here:
        for one, other in zip(there.frames(), here.frames(), strict=True):
            np.testing.assert_array_equal(one, other)
        assert there.name == here.name == "u"
        assert there.dtype == here.dtype
        assert there.coords["t"].values.tolist() == [0.5, 1, 2, 4]
        assert there.coords["t"].attributes == here.coords["t"].attributes
        assert there.metadata.attributes == here.metadata.attributes
        assert {each.name for each in there.metadata.variables} == {
            each.name for each in here.metadata.variables
        }
    ours, theirs = list_variables(f"{folder}/{name}"), list_variables(tmp_path / name)
    assert {each.name: each for each in ours} == {each.name: each for each in theirs}


def test_a_url_without_data(elsewhere: tuple[xr.Dataset, str, RangeServer]) -> None:
    _, folder, server = elsewhere
    server.put("bucket/b.nc", b"nothing of the kind")
    with pytest.raises(InputError, match=r"run\.fhz: data at a URL are"):
        open_series(f"{folder}/run.fhz")
    for name in ("b.nc", "c.nc", "c.zarr"):
        with pytest.raises(InputError, match=f"{name} cannot be read"):
            open_series(f"{folder}/{name}")
