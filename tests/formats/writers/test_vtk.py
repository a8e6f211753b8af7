"""Surfaces of triangles as .vtp and .ply, and grids in VTK's formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from regions import region_of

from fhash_formats.errors import InputError, OutputError, OutputExistsError
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_check, save_region
from fhash_formats.writers.vtk import Mesh, check_mesh_output, save_mesh

MESH = Mesh(
    vertices=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1e9, 0.0], [0.1, 0.2, 0.3]]),
    triangles=np.array([[0, 1, 2], [2, 1, 3]]),
    name='a<b & "c"\nd',
    value=0.1,
    time=2.5,
)


def test_ply(tmp_path: Path) -> None:
    assert save_mesh(tmp_path / "s.ply", MESH) == tmp_path / "s.ply"
    head, _, body = (tmp_path / "s.ply").read_bytes().partition(b"end_header\n")
    assert head.decode("ascii").splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        'comment a<b & "c"_d = 0.1 at time 2.5',
        "element vertex 4",
        "property double x",
        "property double y",
        "property double z",
        "element face 2",
        "property list uchar int vertex_indices",
    ]
    np.testing.assert_array_equal(np.frombuffer(body[:96], "<f8").reshape(4, 3), MESH.vertices)
    faces = np.frombuffer(body[96:], [("count", "u1"), ("vertices", "<i4", (3,))])
    assert faces["count"].tolist() == [3, 3]
    np.testing.assert_array_equal(faces["vertices"], MESH.triangles)


def parse(path: Path) -> tuple[ElementTree.Element, dict[str, np.ndarray]]:
    """The XML of a file, and its appended arrays by name, in their order, which leave no gap."""
    head, mark, rest = path.read_bytes().partition(b'<AppendedData encoding="raw">\n_')
    appended, _, tail = rest.rpartition(b"\n</AppendedData>\n</VTKFile>\n")
    assert tail == b""
    root = ElementTree.fromstring(head + mark + b"</AppendedData></VTKFile>")
    told = [root.get(key) for key in ("byte_order", "header_type", "version")]
    assert told == ["LittleEndian", "UInt64", "1.0"]
    arrays, end = {}, 0
    for array in root.iter("DataArray"):
        if array.get("format") == "appended":
            offset = int(array.get("offset", ""))
            assert offset == end
            end = offset + 8 + int.from_bytes(appended[offset : offset + 8], "little")
            dtype = np.dtype(array.get("type", "").lower()).newbyteorder("<")
            arrays[array.get("Name", "")] = np.frombuffer(appended[offset + 8 : end], dtype)
    assert end == len(appended)
    return root, arrays


def times(root: ElementTree.Element) -> list[float]:
    fields = root.iter("DataArray")
    return [float(field.text or "") for field in fields if field.get("Name") == "TimeValue"]


def test_vtp(tmp_path: Path) -> None:
    root, found = parse(save_mesh(tmp_path / "s.vtp", MESH))
    np.testing.assert_array_equal(found["Points"], MESH.vertices.ravel())
    np.testing.assert_array_equal(found["connectivity"], MESH.triangles.ravel())
    assert found["offsets"].tolist() == [3, 6]
    assert found['a<b & "c"_d'].tolist() == [0.1] * 4
    assert times(root) == [2.5]
    (piece,) = root.findall("PolyData/Piece")
    assert (piece.get("NumberOfPoints"), piece.get("NumberOfPolys")) == ("4", "2")


@pytest.mark.vtk
@pytest.mark.parametrize("suffix", ["vtp", "ply"])
def test_vtk_reads_them(tmp_path: Path, suffix: str) -> None:
    module, name = {
        "vtp": ("vtkmodules.vtkIOXML", "vtkXMLPolyDataReader"),
        "ply": ("vtkmodules.vtkIOPLY", "vtkPLYReader"),
    }[suffix]
    reader = getattr(pytest.importorskip(module), name)()
    save_mesh(tmp_path / f"s.{suffix}", MESH)
    reader.SetFileName(str(tmp_path / f"s.{suffix}"))
    reader.Update()
    surface = reader.GetOutput()
    assert (surface.GetNumberOfPoints(), surface.GetNumberOfPolys()) == (4, 2)
    np.testing.assert_allclose(
        [surface.GetPoint(number) for number in range(4)], MESH.vertices, rtol=1e-6
    )


def test_what_stands_in_the_way(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"surface with the suffix '\.stl'; use one of \.vtp, \.ply"
    ):
        check_mesh_output(tmp_path / "s.stl")
    save_mesh(tmp_path / "s.PLY", MESH)
    with pytest.raises(OutputExistsError, match="exists"):
        save_mesh(tmp_path / "s.PLY", MESH)
    save_mesh(tmp_path / "s.PLY", MESH, force=True)
    with pytest.raises(InputError, match="is the input itself"):
        save_mesh(tmp_path / "s.PLY", MESH, force=True, sources=[tmp_path / "s.PLY"])
    with pytest.raises(OutputError, match="does not exist"):
        save_mesh(tmp_path / "none" / "s.ply", MESH)
    assert [path.name for path in tmp_path.iterdir()] == ["s.PLY"]


EVEN = {
    "t": [0.1, 0.4, 347921.000277],
    "z": [2.0, 2.5],
    "y": [-1.0, 0.0, 1.0, 2.0],
    "x": [10.0, 10.5, 11.0],
}
UNEVEN = {**EVEN, "x": [1.0, 2.0, 4.0]}
DATA = np.arange(72, dtype="f4").reshape(3, 2, 4, 3)
ONE = DATA[:1, :1]


def one(values: dict[str, list[float]] = EVEN, **changes: Any) -> Region:
    """The region of ONE."""
    return region_of({**values, "t": [3.5], "z": [2.0]}, **changes)


def test_an_image(tmp_path: Path) -> None:
    paths = save_region(tmp_path / "out.vti", one(units="m/s"), ONE)
    assert paths == [tmp_path / "out.vti"]
    root, arrays = parse(paths[0])
    (image,) = root.findall("ImageData")
    assert image.attrib == {
        "WholeExtent": "0 2 0 3 0 0",
        "Origin": "10.0 -1.0 2.0",
        "Spacing": "0.5 1.0 1.0",
    }
    assert [piece.get("Extent") for piece in image.findall("Piece")] == ["0 2 0 3 0 0"]
    assert [points.get("Scalars") for points in image.findall("Piece/PointData")] == ["wind"]
    assert [key.text for key in image.findall("Piece/PointData/DataArray/InformationKey")] == [
        "m/s"
    ]
    assert times(root) == [3.5]
    assert list(arrays) == ["wind"]
    np.testing.assert_array_equal(arrays["wind"], ONE.ravel())  # x fastest


@pytest.mark.parametrize("suffix", [".vti", ".vtr"])
def test_several_steps_are_a_collection_with_their_times(tmp_path: Path, suffix: str) -> None:
    paths = save_region(tmp_path / f"my run{suffix}", region_of(EVEN), DATA)
    assert [path.name for path in paths] == [
        *(f"my run_000{step}{suffix}" for step in range(3)),
        "my run.pvd",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    rows = ElementTree.parse(paths[-1]).getroot().findall("Collection/DataSet")
    assert [row.get("file") for row in rows] == [path.name for path in paths[:-1]]
    assert [float(row.get("timestep", "")) for row in rows] == EVEN["t"]
    for step, path in enumerate(paths[:-1]):
        root, arrays = parse(path)
        np.testing.assert_array_equal(arrays["wind"], DATA[step].ravel())
        assert times(root) == [EVEN["t"][step]]


@pytest.mark.parametrize(("positions", "suffix"), [(EVEN, ".vti"), (UNEVEN, ".vtr")])
def test_a_collection_by_name_takes_the_grid_that_fits(
    tmp_path: Path, positions: dict[str, list[float]], suffix: str
) -> None:
    paths = save_region(tmp_path / "out.pvd", one(positions), ONE)
    assert [path.name for path in paths] == [f"out_0000{suffix}", "out.pvd"]


def test_a_rectilinear_grid_keeps_uneven_positions_exactly(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.vtr", one(UNEVEN), ONE)
    root, arrays = parse(path)
    assert root[0].attrib == {"WholeExtent": "0 2 0 3 0 0"}
    assert list(arrays) == ["wind", "x", "y", "z"]
    assert len(root.findall("RectilinearGrid/Piece/Coordinates/DataArray")) == 3
    np.testing.assert_array_equal(arrays["wind"], ONE.ravel())
    for axis in "xyz":
        np.testing.assert_array_equal(arrays[axis], UNEVEN[axis][: 1 if axis == "z" else None])


@pytest.mark.parametrize("turned", ["x", "y", "z", "zx", "zyx"])
@pytest.mark.parametrize("suffix", [".vti", ".vtr", ".vtkhdf"])
def test_descending_axes_are_turned_round(tmp_path: Path, suffix: str, turned: str) -> None:
    ascending = {**EVEN, "t": [3.5]}
    (plain,) = save_region(tmp_path / f"plain{suffix}", region_of(ascending), DATA[:1])
    descending = {
        axis: values[::-1] if axis in turned else values for axis, values in ascending.items()
    }
    flipped = DATA[:1, *(slice(None, None, -1 if axis in turned else 1) for axis in "zyx")]
    (path,) = save_region(tmp_path / f"turned{suffix}", region_of(descending), flipped)
    assert path.read_bytes() == plain.read_bytes()


def test_names_and_units_are_escaped(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.vti", one(name="a<b & \"c'\x01", units="<m>"), ONE)
    root, _ = parse(path)
    (array,) = root.findall("ImageData/Piece/PointData/DataArray")
    assert array.get("Name") == "a<b & \"c'_"
    assert [key.text for key in array] == ["<m>"]
    paths = save_region(tmp_path / "<&\"'>.pvd", one(), ONE)
    assert [row.get("file") for row in ElementTree.parse(paths[1]).getroot().iter("DataSet")] == [
        paths[0].name
    ]


@pytest.mark.parametrize(
    ("positions", "suffix", "message"),
    [
        (UNEVEN, ".vti", r"coordinate 'x' of x is not evenly spaced, as \.vti needs; use \.vtr"),
        (UNEVEN, ".vtkhdf", r"coordinate 'x' of x is not evenly spaced, as \.vtkhdf needs"),
        ({**EVEN, "y": [0.0, 2.0, 1.0, 3.0]}, ".vtr", "neither ascends nor descends"),
        ({**EVEN, "y": [0.0, 1.0, 1.0, 3.0]}, ".pvd", "neither ascends nor descends"),
        ({**EVEN, "y": [0.0, 1.0, np.nan, 3.0]}, ".vtr", "neither ascends nor descends"),
        ({**EVEN, "z": [np.nan]}, ".vti", "not evenly spaced"),
        ({**EVEN, "z": [1.0, 1.0]}, ".vtkhdf", "not evenly spaced"),
        ({**EVEN, "t": [0.0, np.nan, 1.0]}, ".vti", "times are not all finite"),
        ({**EVEN, "t": [0.0, np.nan, 1.0]}, ".vtkhdf", "times are not all finite"),
    ],
)
def test_grids_that_vtk_has_not(
    tmp_path: Path, positions: dict[str, list[float]], suffix: str, message: str
) -> None:
    described = region_of(positions)
    frames = np.zeros(described.shape, "f4")
    with pytest.raises(InputError, match=message) as caught:
        save_region(tmp_path / f"out{suffix}", described, frames)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=message):
        save_check(tmp_path / f"out{suffix}", False, described)
    assert list(tmp_path.iterdir()) == []


def test_a_file_name_that_a_collection_cannot_list(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="control characters"):
        save_region(tmp_path / "a\nb.pvd", region_of(EVEN), DATA)


@pytest.mark.parametrize("existing", ["out_0001.vti", "out.pvd"])
def test_any_file_of_a_collection_that_exists_stops_it(tmp_path: Path, existing: str) -> None:
    (tmp_path / existing).write_text("old")
    with pytest.raises(OutputExistsError, match=existing.replace(".", r"\.")):
        save_region(tmp_path / "out.vti", region_of(EVEN), DATA)
    assert [path.name for path in tmp_path.iterdir()] == [existing]
    save_region(tmp_path / "out.vti", region_of(EVEN), DATA, force=True)
    assert len(list(tmp_path.iterdir())) == 4


def test_the_structure_of_the_specification(tmp_path: Path) -> None:
    assert save_region(tmp_path / "out.vtkhdf", region_of(EVEN, units="m/s"), DATA) == [
        tmp_path / "out.vtkhdf"
    ]
    with h5py.File(tmp_path / "out.vtkhdf") as file:
        group = file["VTKHDF"]
        assert group.attrs["Version"].tolist() == [2, 0]
        assert group.attrs["Type"] == b"ImageData"
        kind = h5py.h5a.open(group.id, b"Type").get_type()
        assert (kind.is_variable_str(), kind.get_cset(), kind.get_size()) == (
            False,
            h5py.h5t.CSET_ASCII,
            9,
        )
        assert group.attrs["WholeExtent"].tolist() == [0, 2, 0, 3, 0, 1]
        assert group.attrs["Origin"].tolist() == [10.0, -1.0, 2.0]
        assert group.attrs["Spacing"].tolist() == [0.5, 1.0, 0.5]
        assert group.attrs["Direction"].tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        steps = group["Steps"]
        assert steps.attrs["NSteps"] == 3
        assert steps["Values"][:].tolist() == EVEN["t"]
        assert steps["PointDataOffsets/wind"][:].tolist() == [0, 1, 2]
        values = group["PointData/wind"]
        np.testing.assert_array_equal(values, DATA)
        assert (values.dtype, values.attrs["units"]) == (np.dtype("<f4"), "m/s")


@pytest.mark.vtk
@pytest.mark.parametrize("steps", [3, 1])
@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "u1", "i2", "i8"])
def test_vtk_reads_every_step(tmp_path: Path, dtype: str, steps: int) -> None:
    io = pytest.importorskip("vtkmodules.vtkIOHDF")
    pipeline = pytest.importorskip(
        "vtkmodules.vtkCommonExecutionModel"
    ).vtkStreamingDemandDrivenPipeline
    arrays = pytest.importorskip("vtkmodules.util.numpy_support")
    data = DATA[:steps].astype(dtype)
    positions = {**EVEN, "t": EVEN["t"][:steps]}
    save_region(tmp_path / "out.vtkhdf", region_of(positions, name="a/b", dtype=data.dtype), data)
    reader = io.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "out.vtkhdf"))
    reader.UpdateInformation()
    if steps > 1:
        assert [*reader.GetOutputInformation(0).Get(pipeline.TIME_STEPS())] == EVEN["t"]
    for step in range(steps):
        reader.UpdateTimeStep(EVEN["t"][step])
        image = reader.GetOutputDataObject(0)
        assert image.GetDimensions() == (3, 4, 2)
        assert image.GetOrigin() == (10.0, -1.0, 2.0)
        assert image.GetSpacing() == (0.5, 1.0, 0.5)
        found = arrays.vtk_to_numpy(image.GetPointData().GetArray("a_b"))
        np.testing.assert_array_equal(found, data[step].ravel())
    if steps == 1:
        assert image.GetFieldData().GetArray("TimeValue").GetTuple1(0) == EVEN["t"][0]


def test_one_step_is_of_the_first_version(tmp_path: Path) -> None:
    save_region(tmp_path / "out.vtkhdf", region_of({**EVEN, "t": [4.0]}), DATA[:1])
    with h5py.File(tmp_path / "out.vtkhdf") as file:
        group = file["VTKHDF"]
        assert group.attrs["Version"].tolist() == [1, 0]
        assert sorted(group) == ["FieldData", "PointData"]
        assert group["FieldData/TimeValue"][:].tolist() == [4.0]
