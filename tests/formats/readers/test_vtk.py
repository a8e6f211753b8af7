"""VTK: XML documents and their arrays, lists of files with times, and VTKHDF."""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import vtk_files
from stored_series import frames

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers import vtk_document
from fhash_formats.readers.registry import open_series
from fhash_formats.readers.variables import SeveralVariablesError
from fhash_formats.readers.vtk_document import Document, VtkArrays
from fhash_formats.series import Coordinate
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_region

VALUES = np.random.default_rng(0).normal(size=(3, 2, 3, 4)).astype("f4")
ROW = '<DataSet timestep="{}" part="{}" file="{}"/>'


def grids(folder: Path) -> None:
    """Three steps step_0.vti to step_2.vti, with the times 0, 1 and 2 in them."""
    for step, frame in enumerate(VALUES):
        coords = {
            axis: Coordinate(name=axis, values=np.arange(float(n)))
            for axis, n in zip("zyx", frame.shape, strict=True)
        }
        coords["t"] = Coordinate(name="time", values=np.array([float(step)]))
        region = Region(name="u", dtype=frame.dtype, shape=(1, *frame.shape), coords=coords)
        save_region(folder / f"step_{step}.vti", region, [frame])


def pvd(folder: Path, *rows: tuple[object, object, str]) -> Path:
    path = folder / "run.pvd"
    body = "".join(ROW.format(*row) for row in rows)
    path.write_text(f'<VTKFile type="Collection"><Collection>{body}</Collection></VTKFile>')
    return path


def test_steps_are_in_the_order_of_their_times(tmp_path: Path) -> None:
    grids(tmp_path)
    path = pvd(tmp_path, (10, 0, "step_2.vti"), (5.5, 0, "step_0.vti"), (7, 0, "step_1.vti"))
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [5.5, 7, 10]
        assert series.name == "u"
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)
        assert set(series.files) == {path, *tmp_path.glob("*.vti")}
        path.write_text(path.read_text() + " ")
        with pytest.raises(InputError, match=r"run\.pvd changed"):
            series.check()


def test_files_of_paraview_series(tmp_path: Path) -> None:
    grids(tmp_path)
    path = tmp_path / "run.vti.series"
    rows = [{"name": f"step_{step}.vti", "time": 0.5 * step} for step in range(3)]
    path.write_text(json.dumps({"file-series-version": "1.0", "files": rows}))
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [0, 0.5, 1]
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)
    path.write_text("[1, 2]")
    with pytest.raises(InputError, match="is not a list of files"):
        open_series(path)
    path.write_text("{")
    with pytest.raises(InputError, match=r"run\.vti\.series"):
        open_series(path)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 0, "step_0.vti"), (0, 1, "step_1.vti")], "step_0.vti and step_1.vti for the time 0"),
        ([("soon", 0, "step_0.vti")], "the time 'soon' is no number"),
        ([("nan", 0, "step_0.vti")], "no finite number"),
        ([(0, 0, "mesh.vtu")], r"lists mesh\.vtu; \.vti, \.vtr, \.pvti and \.pvtr can be read"),
        ([(0, 0, "")], "names no file"),
        ([], "lists no file"),
    ],
)
def test_lists_that_are_no_series(
    tmp_path: Path, rows: list[tuple[object, object, str]], message: str
) -> None:
    grids(tmp_path)
    (tmp_path / "mesh.vtu").write_text('<VTKFile type="UnstructuredGrid"/>')
    with pytest.raises(InputError, match=message) as caught:
        open_series(pvd(tmp_path, *rows))
    assert "run.pvd" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"run\.pvd names .*gone\.vti, which is not there"):
        open_series(pvd(tmp_path, (0, 0, "gone.vti")))


def test_no_pattern_joins_lists(tmp_path: Path) -> None:
    grids(tmp_path)
    pvd(tmp_path, (0, 0, "step_0.vti"))
    with pytest.raises(InputError, match="cannot be one of a pattern"):
        open_series(tmp_path / "*.pvd")


RNG = np.random.default_rng(0)
ARRAYS = {
    "rho": RNG.normal(size=(3, 4, 5)).astype("f4"),
    "velocity": RNG.normal(size=(3, 4, 5, 3)),
    "label": RNG.integers(-128, 127, (3, 4, 5)).astype("i1"),
    "count": RNG.integers(0, 2**63, (3, 4, 5)).astype("u8"),
}

SMALL = """<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt32">
<ImageData WholeExtent="0 2 0 1 0 0" Origin="0 0 0" Spacing="1 1 1" {grid}>
<Piece Extent="0 2 0 1 0 0"><PointData>
<DataArray type="Float32" Name="u" format="ascii" {array}>{values}</DataArray>
</PointData></Piece></ImageData></VTKFile>"""


def small(path: Path, *, grid: str = "", array: str = "", values: str = "0 1 2 3 4 5") -> Path:
    """A plane of 2 x 3 vertices in text."""
    path.write_text(SMALL.format(grid=grid, array=array, values=values))
    return path


@pytest.mark.vtk
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("header", [32, 64])
@pytest.mark.parametrize("compressor", [None, "ZLib", "LZ4", "LZMA"])
@pytest.mark.parametrize("mode", ["ascii", "binary", "appended", "base64"])
def test_values_are_those_of_vtk(
    tmp_path: Path, mode: str, compressor: str | None, header: int, big: bool
) -> None:
    if compressor == "LZ4":
        pytest.importorskip("lz4.block")
    grid = vtk_files.image(ARRAYS, first_vertex=(2, -1, 0))
    path = tmp_path / "a.vti"
    vtk_files.write(path, grid, mode=mode, compressor=compressor, header=header, big=big)
    for name, component in (("rho", None), ("velocity", 1), ("label", None), ("count", None)):
        expected = vtk_files.read(path, name)
        var = name if component is None else f"{name}.y"
        expected = expected if component is None else expected[..., component]
        with open_series(path, var=var) as series:
            assert series.name == var
            assert series.dtype == ARRAYS[name].dtype
            assert series.read(0).tobytes() == expected.tobytes()
            assert series.coords["t"].values.tolist() == [vtk_files.TIME]
            assert series.coords["x"].values.tolist() == [1.0, 1.25, 1.5, 1.75, 2.0]
            assert series.coords["y"].values.tolist() == [-1.5, -1.0, -0.5, 0.0]
            assert series.coords["z"].values.tolist() == [2.0, 4.0, 6.0]


@pytest.mark.vtk
def test_cells_lie_between_the_points(tmp_path: Path) -> None:
    path = vtk_files.write(tmp_path / "a.vti", vtk_files.image(ARRAYS, cells=True))
    with open_series(path, var="rho") as series:
        np.testing.assert_array_equal(series.read(0), vtk_files.read(path, "rho", cells=True))
        assert series.coords["x"].values.tolist() == [0.625, 0.875, 1.125, 1.375, 1.625]


@pytest.mark.vtk
def test_a_layer_of_cells_lies_in_its_plane(tmp_path: Path) -> None:
    path = vtk_files.write(
        tmp_path / "a.vti", vtk_files.image({"u": ARRAYS["rho"][:1]}, cells=True)
    )
    with open_series(path) as series:
        assert series.shape == (1, 1, 4, 5)
        assert series.coords["z"].values.tolist() == [2.0]


@pytest.mark.vtk
def test_components_by_name_and_by_number(tmp_path: Path) -> None:
    path = vtk_files.write(tmp_path / "a.vti", vtk_files.image({"v": ARRAYS["velocity"]}))
    with open_series(path, var="v.2") as series:
        assert series.name == "v.z"
        np.testing.assert_array_equal(series.read(0), ARRAYS["velocity"][..., 2])
    with pytest.raises(SeveralVariablesError, match=r"v\.x .*v\.z .*choose one with") as caught:
        open_series(path)
    assert caught.value.names == ("v.x", "v.y", "v.z")
    with pytest.raises(InputError, match=r"has no variable 'v\.3'"):
        open_series(path, var="v.3")


@pytest.mark.vtk
def test_points_and_cells_of_one_name(tmp_path: Path) -> None:
    grid = vtk_files.image({"u": ARRAYS["rho"]})
    vtk_files.fill(grid, {"u": ARRAYS["rho"][:2, :3, :4]}, cells=True)
    path = vtk_files.write(tmp_path / "a.vti", grid)
    with open_series(path, var="CellData/u") as series:
        assert (series.name, series.shape) == ("u", (1, 2, 3, 4))
    with pytest.raises(InputError, match=r"PointData/u .*CellData/u"):
        open_series(path, var="u")


@pytest.mark.vtk
def test_rectilinear_grids(tmp_path: Path) -> None:
    model = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    grid = model.vtkRectilinearGrid()
    grid.SetDimensions(5, 4, 3)
    axes = {"X": [0, 1, 3, 4, 8], "Y": [-1, 0, 2, 9], "Z": [5, 6, 9]}
    for axis, values in axes.items():
        array = support.numpy_to_vtk(np.array(values, dtype="f8"), deep=True)
        getattr(grid, f"Set{axis}Coordinates")(array)
    vtk_files.fill(grid, {"u": ARRAYS["rho"]})
    path = vtk_files.write(tmp_path / "a.vtr", grid, mode="binary", compressor="ZLib")
    with open_series(path) as series:
        np.testing.assert_array_equal(series.read(0), vtk_files.read(path, "u"))
        assert [series.coords[axis.lower()].values.tolist() for axis in axes] == list(axes.values())


def test_pieces_are_put_together(tmp_path: Path) -> None:
    path = tmp_path / "a.vti"
    piece = (
        '<Piece Extent="{0} {1} 0 0 0 1"><PointData><DataArray type="Int16" Name="u"'
        ' format="ascii">{2}</DataArray></PointData></Piece>'
    )
    text = '<VTKFile type="ImageData"><ImageData WholeExtent="0 3 0 0 0 1">{}</ImageData></VTKFile>'
    both = piece.format(0, 1, "0 1 4 5") + piece.format(1, 3, "1 2 3 5 6 7")
    path.write_text(text.format(both))
    with open_series(path) as series:
        assert series.read(0).tolist() == [[[0, 1, 2, 3]], [[4, 5, 6, 7]]]
    path.write_text(text.format(piece.format(0, 1, "0 1 4 5")))
    with pytest.raises(InputError, match="leave at least 4 values"):
        open_series(path)
    path.write_text(text.format(piece.format(0, 1, "0 1 4 5") * 2))
    with open_series(path) as series, pytest.raises(InputError, match="leave 4 values"):
        series.read(0)


@pytest.mark.vtk
@pytest.mark.parametrize("ghosts", [0, 1])
def test_files_of_pieces_are_one_grid(tmp_path: Path, ghosts: int) -> None:
    xml = pytest.importorskip("vtkmodules.vtkIOParallelXML")
    core = pytest.importorskip("vtkmodules.vtkImagingCore")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    wavelet, whole = core.vtkRTAnalyticSource(), core.vtkRTAnalyticSource()
    for source in (wavelet, whole):
        source.SetWholeExtent(-4, 4, -3, 3, -2, 2)
    writer = xml.vtkXMLPImageDataWriter()
    writer.SetInputConnection(wavelet.GetOutputPort())
    writer.SetNumberOfPieces(3)
    writer.SetEndPiece(2)
    writer.SetGhostLevel(ghosts)
    writer.SetFileName(str(tmp_path / "a b.pvti"))
    assert writer.Write() == 1
    whole.Update()
    values = support.vtk_to_numpy(whole.GetOutput().GetPointData().GetScalars())
    with open_series(tmp_path / "a b.pvti", var="RTData") as series:
        np.testing.assert_array_equal(series.read(0).ravel(), values)
        assert series.coords["z"].values.tolist() == [-2, -1, 0, 1, 2]
        assert len(series.files) == 4
        (tmp_path / "a b_1.vti").write_bytes(b"")
        with pytest.raises(InputError, match="changed while it was being read"):
            series.read(0)
    (tmp_path / "a b_1.vti").unlink()
    with pytest.raises(MissingInputError, match=r"a b_1\.vti, which is not there"):
        open_series(tmp_path / "a b.pvti", var="RTData")


PARALLEL = """<VTKFile type="PImageData"><PImageData WholeExtent="0 3 0 0 0 0" {}>
<Piece Extent="0 1 0 0 0 0" Source="0.vti"/><Piece Extent="1 3 0 0 0 0" Source="1.vti"/>
</PImageData></VTKFile>"""
PART = """<VTKFile type="ImageData"><ImageData WholeExtent="{0}" Spacing="2 1 1" {3}>
<Piece Extent="{0}"><PointData><DataArray type="Float32" Name="{1}" format="ascii">{2}</DataArray>
</PointData></Piece></ImageData></VTKFile>"""


def test_a_list_of_pieces_says_less_than_they_do(tmp_path: Path) -> None:
    turned = 'Direction="-1 0 0 0 1 0 0 0 1"'
    (tmp_path / "a.pvti").write_text(PARALLEL.format('Origin="5 0 0" Spacing="2 1 1"'))
    (tmp_path / "0.vti").write_text(PART.format("0 1 0 0 0 0", "u", "0 1", turned))
    (tmp_path / "1.vti").write_text(PART.format("1 3 0 0 0 0", "u", "1 2 3", turned))
    with open_series(tmp_path / "a.pvti") as series:
        assert series.read(0).tolist() == [[[0, 1, 2, 3]]]
        assert series.coords["x"].values.tolist() == [5, 3, 1, -1]


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (PART.format("1 3 0 0 0 0", "v", "1 2 3", ""), "array 'v' of 1 components where another"),
        (PART.format("1 4 0 0 0 0", "u", "1 2 3 4", ""), "lies outside the grid"),
        (PARALLEL.format(""), r"1\.vti: it holds VTK data of the kind PImageData; ImageData can"),
        ("", r"1\.vti: it is cut or no XML"),
    ],
)
def test_pieces_that_do_not_fit_are_refused(tmp_path: Path, second: str, message: str) -> None:
    (tmp_path / "a.pvti").write_text(PARALLEL.format(""))
    (tmp_path / "0.vti").write_text(PART.format("0 1 0 0 0 0", "u", "0 1", ""))
    (tmp_path / "1.vti").write_text(second)
    with pytest.raises(InputError, match=message):
        open_series(tmp_path / "a.pvti")


def test_units_are_read(tmp_path: Path) -> None:
    key = '<InformationKey name="UNITS_LABEL" location="vtkDataArray">m/s</InformationKey>'
    with open_series(small(tmp_path / "a.vti", values=f"{key}0 1 2 3 4 5")) as series:
        assert series.units == "m/s"
        assert series.read(0).tolist() == [[[0, 1, 2], [3, 4, 5]]]


def test_padding_behind_the_size_is_taken(tmp_path: Path) -> None:
    # the size encoded by itself, as some writers other than VTK do
    text = small(tmp_path / "a.vti").read_text().replace('format="ascii"', 'format="binary"')
    values = "GAAAAA==" + "AAAAAAAAgD8AAABAAABAQAAAgEAAAKBA"
    (tmp_path / "a.vti").write_text(text.replace("0 1 2 3 4 5</", f"{values}</"))
    with open_series(tmp_path / "a.vti") as series:
        assert series.read(0).tolist() == [[[0, 1, 2], [3, 4, 5]]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"grid": 'Direction="0 1 0 1 0 0 0 0 1"'}, "turned against the axes"),
        ({"values": "0 1 2"}, "5 bytes of text, not 6 values"),
        ({"values": "0 1 2 3 4 5 6"}, "7 numbers, 6 are needed"),
        ({"values": "0 1 2 3 4 x"}, "x"),
        ({"values": "0 1 2 3 4 " + "1" * 100}, "text stands where numbers are needed"),
        ({"array": 'NumberOfComponents="0"'}, "'0' components"),
        ({"array": 'NumberOfComponents="2"'}, r"u\.0 .*u\.1"),
    ],
)
def test_unsuitable_grids(tmp_path: Path, change: dict[str, str], message: str) -> None:
    path = small(tmp_path / "a.vti", **change)
    with pytest.raises(InputError, match=message) as caught, open_series(path) as series:
        series.read(0)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="ImageData" ', 'type="PolyData" ', "data of the kind PolyData"),
        ("LittleEndian", "MiddleEndian", "byte order is 'MiddleEndian'"),
        ('UInt32">', 'UInt32" compressor="vtkOther">', "compressor is 'vtkOther'"),
        ('WholeExtent="0 2 0 1 0 0"', 'WholeExtent="0 2 0 1"', "not six whole numbers"),
        ('Piece Extent="0 2', 'Piece Extent="0 9', "lies outside the grid"),
        ('WholeExtent="0 2', 'WholeExtent="0 -1', "lies outside the grid|empty grid"),
        ("Float32", "String", "integers and floats"),
        ("</VTKFile>", "", "cut or no XML"),
        ("<VTKFile", "<!DOCTYPE a><VTKFile", "document type"),
        ('Spacing="1 1 1"', 'Spacing="1 0 1"', "spacing 0.0 along y"),
        ('Origin="0 0 0"', 'Origin="nan 0 0"', "both must be finite"),
    ],
)
def test_other_files_are_refused_in_one_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = small(tmp_path / "a.vti")
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=message) as caught, open_series(path) as series:
        series.read(0)
    assert "\n" not in str(caught.value)


def _cut(data: bytes) -> bytes:
    return data[: len(data) - 80]


def _huge(data: bytes) -> bytes:
    return re.sub(rb'Extent="2 6 -1 2 0 2"', b'Extent="0 99999 0 99999 0 99999"', data)


def _flipped(data: bytes) -> bytes:
    begin = data.index(b"_", data.index(b"<AppendedData")) + 1
    harmed = bytes(byte ^ 0xFF for byte in data[begin : begin + 60])
    return data[:begin] + harmed + data[begin + 60 :]


@pytest.mark.vtk
@pytest.mark.parametrize("damage", [_cut, _huge, _flipped])
@pytest.mark.parametrize("compressor", [None, "ZLib", "LZMA"])
@pytest.mark.parametrize("mode", ["appended", "base64"])
def test_damaged_files_end_in_one_line(
    tmp_path: Path, mode: str, compressor: str | None, damage: Callable[[bytes], bytes]
) -> None:
    options: dict[str, Any] = {"mode": mode, "compressor": compressor}
    grid = vtk_files.image({"u": ARRAYS["rho"]}, first_vertex=(2, -1, 0))
    grid.GetFieldData().Initialize()
    path = vtk_files.write(tmp_path / "a.vti", grid, **options)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError) as caught, open_series(path) as series:
        series.read(0)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.vtk
def test_a_file_that_only_begins_is_refused(tmp_path: Path) -> None:
    whole = vtk_files.write(
        tmp_path / "a.vti", vtk_files.image({"u": ARRAYS["rho"]}), compressor="ZLib"
    ).read_bytes()
    for length in range(100, len(whole) - 40, 97):
        (tmp_path / "b.vti").write_bytes(whole[:length])
        with pytest.raises(InputError), open_series(tmp_path / "b.vti") as series:
            series.read(0)


def test_lz4_names_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = small(tmp_path / "a.vti")
    path.write_text(path.read_text().replace('32">', '32" compressor="vtkLZ4DataCompressor">'))
    monkeypatch.setitem(__import__("sys").modules, "lz4.block", None)
    with pytest.raises(ImportError, match=r"a\.vti.* needs lz4: pip install 'fhash\[formats\]'"):
        open_series(path)


def write(path: Path, arrays: dict[str, np.ndarray], **options: Any) -> Path:
    """A file of datasets such as "PointData/u"; options `times`, `offsets` and attributes."""
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        attributes = {
            "Version": [2, 0],
            "Type": np.bytes_(b"ImageData"),
            "WholeExtent": [1, 4, 0, 2, -1, 0],
            "Origin": [0.0, 10.0, 1.0],
            "Spacing": [0.5, 1.0, 2.0],
            "Direction": np.eye(3).ravel(),
            **options.get("attributes", {}),
        }
        for name, value in attributes.items():
            if value is not None:
                root.attrs[name] = value
        for name, values in arrays.items():
            root[name] = values
        if "times" in options:
            root["Steps/Values"] = np.array(options["times"], dtype="f8")
            root["Steps"].attrs["NSteps"] = options.get("count", len(options["times"]))
        for name, values in options.get("offsets", {}).items():
            root[f"Steps/{name}"] = values
    return path


def test_a_series_with_times_and_positions(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtkhdf", {"PointData/u": VALUES}, times=[3.0, 4.5, 9.0])
    with open_series(path) as series:
        assert (series.name, series.shape) == ("u", VALUES.shape)
        assert series.coords["t"].values.tolist() == [3, 4.5, 9]
        assert series.coords["x"].values.tolist() == [0.5, 1, 1.5, 2]
        assert series.coords["y"].values.tolist() == [10, 11, 12]
        assert series.coords["z"].values.tolist() == [-1, 1]
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)


def test_one_step_without_times_whatever_its_suffix(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf", {"PointData/u": VALUES[0]}, attributes={"Version": [1, 0]})
    with open_series(path) as series:
        assert series.shape == (1, *VALUES.shape[1:])
        np.testing.assert_array_equal(series.read(0), VALUES[0])
        assert series.coords["x"].values.tolist() == [0.5, 1, 1.5, 2]


def test_vectors_and_cells(tmp_path: Path) -> None:
    vector = RNG.normal(size=(3, 2, 3, 4, 3))
    cells = RNG.integers(0, 9, (3, 1, 2, 3)).astype("u1")
    arrays = {"PointData/v": vector, "CellData/label": cells, "CellData/vtkGhostType": cells}
    path = write(tmp_path / "a.vtkhdf", arrays, times=[0, 1, 2])
    np.testing.assert_array_equal(frames(path, var="v.y"), vector[..., 1])
    np.testing.assert_array_equal(frames(path, var="v.2"), vector[..., 2])
    with open_series(path, var="label") as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), cells)
        assert series.coords["x"].values.tolist() == [0.75, 1.25, 1.75]
        assert series.coords["z"].values.tolist() == [0]
    with pytest.raises(InputError, match=r"4 variables: v\.x .*label \(3, 1, 2, 3\); choose"):
        open_series(path)


def test_steps_may_share_an_entry(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.vtkhdf",
        {"PointData/u": VALUES[:2]},
        times=[0, 1, 2, 3],
        offsets={"PointDataOffsets/u": [1, 0, 0, 1]},
    )
    np.testing.assert_array_equal(frames(path), VALUES[[1, 0, 0, 1]])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"attributes": {"Type": np.bytes_(b"PolyData")}}, "type PolyData; ImageData can be read"),
        ({"attributes": {"Direction": [0, 1, 0, 1, 0, 0, 0, 0, 1]}}, "turned against the axes"),
        ({"attributes": {"Spacing": [1.0, np.nan, 1.0]}}, "Spacing has not 3 numbers"),
        ({"attributes": {"Origin": None}}, "Origin has not 3 numbers"),
        ({"attributes": {"WholeExtent": [0, 9, 0, 2, 0, 1]}}, "does not fit the grid"),
        ({"times": [0, 1, 2], "count": 4}, "4 steps and has the times of 3"),
        ({"times": [0, 1, 2, 3]}, "do not fit its 3 entries"),
        ({"times": [0, 1], "offsets": {"PointDataOffsets/u": [0, 3]}}, "do not fit its 3 entries"),
    ],
)
def test_files_that_do_not_fit(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "a.vtkhdf", {"PointData/u": VALUES}, **{"times": [0, 1, 2], **options})
    with pytest.raises(InputError, match=message) as caught:
        open_series(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


SIX = np.arange(6, dtype="<f4")


def arrays(folder: Path, stored: bytes, compressor: str = "", encoding: str = "raw") -> VtkArrays:
    """A file of one appended array."""
    extra = f' compressor="{compressor}"' if compressor else ""
    head = f'<VTKFile type="ImageData" header_type="UInt32"{extra}>'
    head += '<DataArray type="Float32" Name="u" format="appended" offset="0"/>'
    head += f'<AppendedData encoding="{encoding}">_'
    data = base64.b64encode(stored) if encoding == "base64" else stored
    (folder / "a.vti").write_bytes(head.encode() + data + b"</AppendedData></VTKFile>")
    return VtkArrays(folder / "a.vti", Document(folder / "a.vti"))


def read(found: VtkArrays, count: int = 6) -> np.ndarray:
    (element,) = found.document.root.children
    found.check(element, count)
    return found.read(element, count)


def blocks(*sizes: int, block: int = 16, last: int = 8, data: bytes | None = None) -> bytes:
    """Compressed values with a header that may lie."""
    raw = SIX.tobytes()
    parts = [zlib.compress(raw[:16]), zlib.compress(raw[16:])]
    header = struct.pack("<3I", 2, block, last)
    stored = sizes or tuple(map(len, parts))
    return header + struct.pack(f"<{len(stored)}I", *stored) + (data or b"".join(parts))


ZLIB = "vtkZLibDataCompressor"


@pytest.mark.parametrize(
    ("stored", "compressor", "message"),
    [
        (struct.pack("<I", 20) + SIX.tobytes(), "", "has 20 bytes, not 24 for the grid"),
        (struct.pack("<I", 24) + b"123", "", "is cut|cut"),
        (b"", "", "is cut|not 24 for the grid"),
        (blocks(block=2**31), ZLIB, "not 24 for the grid"),
        (blocks(last=17), ZLIB, "not 24 for the grid"),
        (blocks(5, 2**31), ZLIB, "is cut"),
        (blocks(5, 5), ZLIB, "cannot be decompressed"),
        (struct.pack("<3I", 2**32 - 1, 0, 0), ZLIB, "not 24 for the grid"),
    ],
)
def test_sizes_that_do_not_fit(
    tmp_path: Path, stored: bytes, compressor: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read(arrays(tmp_path, stored, compressor))


def test_blocks_that_promise_more_than_zlib_can_hold(tmp_path: Path) -> None:
    header = struct.pack("<4I", 1, 1032 * 10 + 4, 0, 10)
    with pytest.raises(InputError, match="blocks that hold fewer bytes"):
        read(arrays(tmp_path, header + bytes(10), ZLIB), count=1032 * 10 // 4 + 1)
    header = struct.pack("<4I", 1, 1032 * 10, 0, 10)
    with pytest.raises(InputError, match="cannot be decompressed"):
        read(arrays(tmp_path, header + bytes(10), ZLIB), count=1032 * 10 // 4)


def test_base64_that_is_damaged(tmp_path: Path) -> None:
    found = arrays(tmp_path, struct.pack("<I", 24) + SIX.tobytes(), encoding="base64")
    data = found.path.read_bytes()
    place = data.index(b">_") + 5
    found.path.write_bytes(data[:place] + b"\xff" + data[place + 1 :])
    with pytest.raises(InputError, match="base64 text is damaged"):
        read(VtkArrays(found.path, Document(found.path)))


def parsed(folder: Path, text: str) -> Document:
    (folder / "a.vti").write_bytes(text.encode())
    return Document(folder / "a.vti")


@pytest.mark.parametrize(
    "inside",
    ["  1 2 3\n", "{} 1 2 3 ", "1 2 3{}", "{}{}\n1 2 3", "<Key><Value>7</Value></Key>1 2 3"],
)
def test_the_text_of_an_array_lies_between_its_keys(tmp_path: Path, inside: str) -> None:
    key = '<InformationKey name="UNITS_LABEL">m/s</InformationKey>'
    text = f"<VTKFile><DataArray Name='a>b'>{inside.replace('{}', key)}</DataArray></VTKFile>"
    (array,) = parsed(tmp_path, text).root.all("DataArray")
    assert array.start is not None
    assert text[array.start : array.stop].split() == ["1", "2", "3"]
    assert {each.note for each in array.all("InformationKey")} <= {"m/s"}


def test_long_text_is_not_kept_and_its_end_is_right(tmp_path: Path) -> None:
    numbers = "\n".join(map(str, range(100_000)))
    text = f"<VTKFile><DataArray>{numbers}</DataArray><DataArray>5</DataArray></VTKFile>"
    first, second = parsed(tmp_path, text).root.children
    assert text[first.start : first.stop] == numbers
    assert text[second.start : second.stop] == "5"
    assert first.note == ""


def test_appended_data_begin_behind_the_underscore(tmp_path: Path) -> None:
    text = '<VTKFile><A/><AppendedData encoding="base64" >\n  _<&\0'
    document = parsed(tmp_path, text)
    assert document.appended == text.index("_") + 1
    assert (document.encoding, document.size) == ("base64", len(text))
    assert [child.name for child in document.root.children] == ["A"]
    closed = parsed(tmp_path, f"{text}\n</AppendedData>\n</VTKFile>")
    assert closed.size == len(text) + 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cut or no XML"),
        ("<VTKFile><A>", "cut or no XML"),
        ("<VTKFile></B>", "cut or no XML"),
        ("no XML", "cut or no XML"),
        ("<VTKFile><AppendedData>", "do not begin with '_'"),
        ("<VTKFile><AppendedData", "cut or no XML"),
        ("<VTKFile><AppendedData>x_", "do not begin with '_'"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><VTKFile>&b;</VTKFile>", "document type"),
    ],
)
def test_what_is_no_such_file(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parsed(tmp_path, text)


def test_the_number_of_elements_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vtk_document, "MAX_ELEMENTS", 10)
    assert len(parsed(tmp_path, f"<V>{'<A/>' * 9}</V>").root.children) == 9
    with pytest.raises(InputError, match="more than 10 elements"):
        parsed(tmp_path, f"<V>{'<A/>' * 10}</V>")
