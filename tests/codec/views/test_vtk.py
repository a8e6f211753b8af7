"""Volumes in VTK, ParaView and napari: the same positions and the same bits as in Python."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, paraview_reader
from fhash_codec.views import napari_reader
from fhash_formats.errors import MissingDependencyError
from fhash_formats.hdf5 import Transform
from fhash_formats.native import FOLDER
from fhash_formats.series import ArraySeries, Coordinate

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two variables with gaps, north to south, on uneven heights, at uneven times."""
    folder = tmp_path_factory.mktemp("run")
    t, z, y, x = np.meshgrid(*map(np.arange, (4, 9, 24, 40)), indexing="ij", sparse=True)
    values = np.exp(-(9 * (z - 4.5) ** 2 + (y - 11) ** 2 + (x - 15 - 4 * t) ** 2) / 160)
    values = values.astype("f4")
    values[:, :, 3:10, 30:] = np.nan
    coords = {
        "t": Coordinate(name="time", values=np.array([0.0, 1, 3, 7]), attributes={"units": "h"}),
        "z": Coordinate(name="height", values=np.arange(9.0) ** 1.5, attributes={"units": "m"}),
        "y": Coordinate(name="lat", values=60.0 - np.arange(24) / 2, attributes={}),
        "x": Coordinate(name="lon", values=np.arange(40) / 2, attributes={}),
    }
    source = {
        name: ArraySeries(factor * values, name=name, units=units, coords=coords)
        for name, units, factor in (("theta", "K", 1), ("speed", "m s-1", 30))
    }
    path = folder / "run.fhz"
    fhash_codec.encode_dataset(source, path, EncodeConfig(max_error_rel=0.01, effort=1))
    return path


def digest(values: Any) -> str:
    return hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()


def tool(*words: object, **environment: str) -> str:
    """Output of a program."""
    done = subprocess.run(
        [str(word) for word in words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def pvpython() -> list[str]:
    """The words that run pvpython without a screen; skips where it is not installed."""
    # pvpython first opens and closes a connection: the server must not start anew after that, since
    # the next one would be refused meanwhile.
    words = ["xvfb-run", "-a", "-s", "-screen 0 1280x1024x24 -noreset", "pvpython"]
    for word in (words[0], words[-1]):
        if shutil.which(word) is None:
            pytest.skip(f"{word} is not installed")
    return words


def test_paraview_plays_a_file_and_shows_its_bits(run: Path, tmp_path: Path) -> None:
    folder = Path(os.environ.get("FHASH_PARAVIEW", tmp_path))
    folder.mkdir(parents=True, exist_ok=True)
    picture = folder / "paraview.png"
    words = [*pvpython(), HERE / "paraview_script.py", paraview_reader.__file__, run, picture]
    output = tool(*words, PYTHONPATH="")
    result = json.loads(output.split("RESULT ")[1])
    assert result["times"] == result["played"] == [0, 1, 3, 7]
    assert result["names"] == ["theta", "speed"]
    with fhash_codec.open(run) as dataset:
        for name, step in (("first", 0), ("last", 3), ("between", 1.25)):
            shown = result[name]
            assert shown["type"] == "vtkRectilinearGrid"
            assert shown["bounds"] == pytest.approx([0, 19.5, 48.5, 60, 0, 8**1.5])
            values = {each: dataset[each].read(step)[:, ::-1] for each in result["names"]}
            assert shown["digests"] == {each: digest(values[each]) for each in values}
            assert shown["hidden"] == np.isnan(values["theta"]).sum() > 0
            assert shown["fields"] == {"theta units": "K", "speed units": "m s-1"}
        assert result["coarse"]["points"] == 5 * 12 * 20
        assert result["coarsest"]["points"] < result["coarse"]["points"]
        assert result["one"]["digests"] == {"theta": digest(dataset["theta"].read(0)[:, ::-1])}
    assert result["moving"] == [9 * 24 * 40, 3 * 6 * 10, 9 * 24 * 40]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_paraview_says_what_is_damaged(run: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.fhz").write_bytes(run.read_bytes()[:1000])
    with pytest.raises(OSError, match="cut short"):
        paraview_reader.File(str(tmp_path / "cut.fhz"))
    with pytest.raises(OSError, match="cannot be opened"):
        paraview_reader.File(str(tmp_path / "nothing.fhz"))


READ_HDF = """
import sys
from hashlib import sha256
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOHDF import vtkHDFReader
reader = vtkHDFReader()
reader.SetFileName(sys.argv[1])
reader.Update()
values = vtk_to_numpy(reader.GetOutput().GetPointData().GetArray("v"))
print("RESULT", sha256(values.tobytes()).hexdigest())
"""


@pytest.mark.vtk
@pytest.mark.parametrize("program", ["vtk", "paraview"])
def test_vtk_reads_hdf5_through_the_filter(program: str, tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(6, 7, 8)).astype("f4").cumsum(axis=2)
    with h5py.File(tmp_path / "a.vtkhdf", "w") as file:
        group = file.create_group("VTKHDF")
        kind = np.array(b"ImageData", h5py.string_dtype("ascii", 9))
        group.attrs.update({"Version": [1, 0], "Type": kind, "WholeExtent": [0, 7, 0, 6, 0, 5]})
        group.attrs.update({"Origin": [0.0] * 3, "Spacing": [1.0] * 3})
        group.attrs["Direction"] = np.eye(3).ravel()
        points = group.create_group("PointData")
        points.create_dataset("v", data=values, chunks=(3, 7, 8), **Transform(max_error=0.25))
        decoded = points["v"][...]
    (tmp_path / "read.py").write_text(READ_HDF)
    words = [sys.executable] if program == "vtk" else pvpython()
    environment = {"HDF5_PLUGIN_PATH": str(FOLDER), "PYTHONPATH": ""}
    output = tool(*words, tmp_path / "read.py", tmp_path / "a.vtkhdf", **environment)
    assert output.split("RESULT ")[1].strip() == digest(decoded)
    assert np.abs(decoded - values).max() <= 0.25


@pytest.mark.vtk
@pytest.mark.parametrize("lod", [0, 1])
def test_to_vtk_has_the_values_at_their_positions(run: Path, lod: int) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    region = ((2, 8), (4, 21), (30, 39))
    with fhash_codec.open(run) as dataset:
        volume = dataset["speed"]
        grid = volume.to_vtk(2, region, lod)
        expected = (volume.read_lod(2, lod, region) if lod else volume.read(2, region))[:, ::-1]
    assert grid.GetClassName() == "vtkRectilinearGrid"
    assert grid.GetDimensions() == expected.shape[::-1]
    assert grid.GetPoint(0) == pytest.approx((15, 50, 2**1.5))
    assert vtk_to_numpy(grid.GetPointData().GetArray("speed")).tobytes() == expected.tobytes()
    assert grid.GetPointData().GetArray("vtkGhostType").GetRange() == (0, 2)
    assert grid.GetCellData().GetArray("vtkGhostType").GetRange() == (0, 32)


@pytest.mark.vtk
def test_to_vtk_of_even_axes_is_an_image(whole: Path) -> None:
    with fhash_codec.open(whole) as volume:
        image = volume.to_vtk(1.5, ((5, 10), (0, 24), (4, 44)))
    assert image.GetClassName() == "vtkImageData"
    assert image.GetSpacing() == pytest.approx((0.5, 0.5, 250))
    assert image.GetOrigin() == pytest.approx((2, 48.5, 1250))
    assert image.GetPointData().GetArray("vtkGhostType") is None


@pytest.mark.vtk
def test_pyvista_wraps_the_grid(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("pyvista")
    module.wrap = lambda grid: ("wrapped", grid.GetDimensions())
    with fhash_codec.open(whole) as volume:
        monkeypatch.setitem(sys.modules, "pyvista", module)
        assert volume.to_pyvista(0) == ("wrapped", (44, 24, 10))
        monkeypatch.setitem(sys.modules, "pyvista", None)
        with pytest.raises(MissingDependencyError, match="pip install pyvista"):
            volume.to_pyvista(0)
        monkeypatch.setitem(sys.modules, "vtkmodules.vtkCommonCore", None)
        with pytest.raises(MissingDependencyError, match="pip install vtk"):
            volume.to_vtk(0)


def test_napari_gets_a_layer_for_each_variable(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert napari_reader.get_reader("run.zarr") is None
    reader = napari_reader.get_reader(str(run))
    assert reader is not None
    with fhash_codec.open(run) as dataset:
        monkeypatch.setattr(napari_reader, "volumes_of", lambda path: dataset)
        (theta, keywords, kind), (speed, others, _) = reader(str(run))
        assert kind == "image"
        assert [keywords["name"], others["name"]] == ["theta", "speed"]
        assert keywords["scale"] == [1, 1, -0.5, 0.5]
        assert keywords["translate"] == [0, 0, 60, 0]
        low, high = others["contrast_limits"]
        assert low < np.nanmax(speed[1, 4]) <= high
        assert others["metadata"]["units"] == "m s-1"
        assert (theta.ndim, theta.shape) == (4, (4, 9, 24, 40))


def test_the_manifest_of_napari_names_the_reader() -> None:
    manifest = Path(fhash_codec.__file__).parent / "views" / "napari.yaml"
    text = manifest.read_text(encoding="utf-8")
    assert "fhash_codec.views.napari_reader:get_reader" in text
    npe2 = pytest.importorskip("npe2", reason="npe2 is not installed")
    assert npe2.PluginManifest.from_file(manifest).name == "fhash"
