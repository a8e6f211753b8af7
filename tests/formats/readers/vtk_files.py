"""VTK files for the tests of their readers, written and read by VTK itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

TIME = 12.5
"""Field value of every grid."""


def image(
    arrays: dict[str, np.ndarray],
    *,
    cells: bool = False,
    first_vertex: tuple[int, int, int] = (0, 0, 0),
) -> Any:
    """A vtkImageData of arrays (z, y, x) or (z, y, x, components) at its points or cells."""
    data_model = pytest.importorskip("vtkmodules.vtkCommonDataModel")
    first = next(iter(arrays.values()))
    z, y, x = (n + (1 if cells and n > 1 else 0) for n in first.shape[:3])
    grid = data_model.vtkImageData()
    i, j, k = first_vertex
    grid.SetExtent(i, i + x - 1, j, j + y - 1, k, k + z - 1)
    grid.SetOrigin(0.5, -1.0, 2.0)
    grid.SetSpacing(0.25, 0.5, 2.0)
    fill(grid, arrays, cells=cells)
    return grid


def fill(grid: Any, arrays: dict[str, np.ndarray], *, cells: bool = False) -> None:
    """Put arrays and the time into a grid."""
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    holder = grid.GetCellData() if cells else grid.GetPointData()
    for name, values in arrays.items():
        components = values.shape[3] if values.ndim == 4 else 1
        array = support.numpy_to_vtk(values.reshape(-1, components), deep=True)
        array.SetName(name)
        holder.AddArray(array)
    time = support.numpy_to_vtk(np.array([TIME]), deep=True)
    time.SetName("TimeValue")
    grid.GetFieldData().AddArray(time)


def write(path: Path, grid: Any, **options: Any) -> Path:
    """Write a grid with VTK.

    mode: ascii, binary, appended or base64; compressor: ZLib, LZ4, LZMA or None; header: 32 or 64;
    big: big-endian.
    """
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    writer = (
        xml.vtkXMLImageDataWriter() if path.suffix == ".vti" else xml.vtkXMLRectilinearGridWriter()
    )
    writer.SetFileName(str(path))
    writer.SetInputData(grid)
    mode = options.get("mode", "appended")
    {
        "ascii": writer.SetDataModeToAscii,
        "binary": writer.SetDataModeToBinary,
        "appended": writer.SetDataModeToAppended,
        "base64": writer.SetDataModeToAppended,
    }[mode]()
    writer.SetEncodeAppendedData(mode == "base64")
    compressor = options.get("compressor")
    if compressor is None:
        writer.SetCompressorTypeToNone()
    else:
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
    writer.SetBlockSize(512)
    (
        writer.SetHeaderTypeToUInt32
        if options.get("header") == 32
        else writer.SetHeaderTypeToUInt64
    )()
    (writer.SetByteOrderToBigEndian if options.get("big") else writer.SetByteOrderToLittleEndian)()
    assert writer.Write() == 1
    return path


def read(path: Path, name: str, *, cells: bool = False) -> np.ndarray:
    """The values (z, y, x[, components]) of an array, as VTK reads them."""
    xml = pytest.importorskip("vtkmodules.vtkIOXML")
    support = pytest.importorskip("vtkmodules.util.numpy_support")
    reader = (
        xml.vtkXMLImageDataReader() if path.suffix == ".vti" else xml.vtkXMLRectilinearGridReader()
    )
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutput()
    holder = grid.GetCellData() if cells else grid.GetPointData()
    values = support.vtk_to_numpy(holder.GetArray(name))
    x, y, z = (max(n - 1, 1) if cells else n for n in grid.GetDimensions())
    return np.asarray(values.reshape((z, y, x) if values.ndim == 1 else (z, y, x, -1)))
