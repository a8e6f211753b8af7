"""Surfaces of triangles as .vtp and .ply."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from fhash_formats.errors import InputError, OutputError, OutputExistsError
from fhash_formats.writers.mesh import Mesh, check_mesh_output, save_mesh

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


def test_vtp(tmp_path: Path) -> None:
    save_mesh(tmp_path / "s.vtp", MESH)
    head, mark, rest = (
        (tmp_path / "s.vtp").read_bytes().partition(b'<AppendedData encoding="raw">\n_')
    )
    appended, _, tail = rest.rpartition(b"\n</AppendedData>\n</VTKFile>\n")
    assert tail == b""
    root = ElementTree.fromstring(head + mark + b"</AppendedData></VTKFile>")
    found, end = {}, 0
    for array in root.iter("DataArray"):
        if array.get("format") == "appended":
            offset = int(array.get("offset", ""))
            assert offset == end
            end = offset + 8 + int.from_bytes(appended[offset : offset + 8], "little")
            kind = array.get("type", "").lower()
            found[array.get("Name")] = np.frombuffer(
                appended[offset + 8 : end], np.dtype(kind).newbyteorder("<")
            )
    assert end == len(appended)
    np.testing.assert_array_equal(found["Points"], MESH.vertices.ravel())
    np.testing.assert_array_equal(found["connectivity"], MESH.triangles.ravel())
    assert found["offsets"].tolist() == [3, 6]
    assert found['a<b & "c"_d'].tolist() == [0.1] * 4
    assert [field.text for field in root.iter("DataArray") if field.get("Name") == "TimeValue"] == [
        "2.5"
    ]
    (piece,) = root.findall("PolyData/Piece")
    assert (piece.get("NumberOfPoints"), piece.get("NumberOfPolys")) == ("4", "2")


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
