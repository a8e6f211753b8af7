"""Reader of `.fhz` files for ParaView, as a plugin of one file, and grids of VTK.

ParaView loads this file by Tools > Manage Plugins, or as `fhash paraview` says. It needs libfhash,
numpy and ParaView's own Python alone: nothing of this package is imported. The library is that of
the installed package, or the one that the variable FHASH_LIBRARY of the environment names.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

EVEN = 1e-6
"""Share of an axis' extent that its positions may be off evenly spaced ones."""
HIDDEN_POINT = 2
"""Ghost flag of VTK's points that are not drawn."""
HIDDEN_CELL = 32
"""Ghost flag of VTK's cells that are not drawn."""
NUMBER_TYPES = (
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "float16",
    "float32",
    "float64",
)
"""Types by their `fhash_type`, from 1."""


def ascending(positions: Any) -> tuple[Any, int]:
    """Positions (n,) as VTK takes them, and -1 where they were turned for it, else 1.

    Positions that neither ascend nor descend become 0 to n - 1.
    """
    steps = np.diff(positions)
    if np.all(np.isfinite(positions)) and np.all(steps > 0):
        return positions, 1
    if np.all(np.isfinite(positions)) and np.all(steps < 0):
        return positions[::-1], -1
    return np.arange(len(positions), dtype=np.float64), 1


def is_even(positions: Any) -> bool:
    """Whether ascending positions (n,) are evenly spaced."""
    line = np.linspace(positions[0], positions[-1], len(positions))
    return bool(np.max(np.abs(positions - line)) <= EVEN * (positions[-1] - positions[0]))


def vtk_grid(
    fields: list[tuple[str, str, Any]], positions: list[Any], corner: tuple[int, int, int]
) -> Any:
    """A vtkImageData where all axes are even, else a vtkRectilinearGrid.

    fields: name, unit and values (z, y, x) of each; those without a value are NaN, and points
        where all are NaN are hidden, with the cells around them.
    positions: along z, y and x of the whole grid, ascending.
    corner: index (z, y, x) of the fields' first point in the whole grid.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkDataArray, vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkImageData, vtkRectilinearGrid

    extent: list[int] = []  # first and last index along x, y, z
    for first, n in list(zip(corner, fields[0][2].shape))[::-1]:  # noqa: B905
        extent += first, first + n - 1
    grid = vtkImageData() if all(map(is_even, positions)) else vtkRectilinearGrid()
    grid.SetExtent(extent)
    x, y, z = (np.asarray(axis, dtype=np.float64) for axis in positions[::-1])
    if isinstance(grid, vtkImageData):
        grid.SetOrigin(x[0], y[0], z[0])
        grid.SetSpacing([(a[-1] - a[0]) / (len(a) - 1) if len(a) > 1 else 1.0 for a in (x, y, z)])
    else:
        grid.SetXCoordinates(numpy_to_vtk(x[extent[0] : extent[1] + 1], deep=1))
        grid.SetYCoordinates(numpy_to_vtk(y[extent[2] : extent[3] + 1], deep=1))
        grid.SetZCoordinates(numpy_to_vtk(z[extent[4] : extent[5] + 1], deep=1))
    points = grid.GetPointData()
    for name, units, values in fields:
        array = numpy_to_vtk(np.ascontiguousarray(values).ravel(), deep=1)
        array.SetName(name)
        points.AddArray(array)
        if units:
            array.GetInformation().Set(vtkDataArray.UNITS_LABEL(), units)
            told = vtkStringArray()
            told.SetName(name + " units")
            told.InsertNextValue(units)
            grid.GetFieldData().AddArray(told)
    points.SetActiveScalars(fields[0][0])
    hidden = np.logical_and.reduce([np.isnan(values) for _, _, values in fields])
    if not hidden.any():
        return grid
    cells = hidden  # those with a hidden corner: surfaces are drawn of cells
    for axis, n in enumerate(hidden.shape):
        if n > 1:
            cells = np.delete(cells, -1, axis) | np.delete(cells, 0, axis)
    for data, mask, flag in (
        (points, hidden, HIDDEN_POINT),
        (grid.GetCellData(), cells, HIDDEN_CELL),
    ):
        ghosts = numpy_to_vtk(mask.ravel().astype(np.uint8) * flag, deep=1)
        ghosts.SetName("vtkGhostType")
        data.AddArray(ghosts)
    return grid


class _Error(ctypes.Structure):
    _fields_ = (("status", ctypes.c_int32), ("text", ctypes.c_char * 500))


class Variable(ctypes.Structure):
    """Facts of a variable: `fhash_variable`."""

    _fields_ = (
        ("size", ctypes.c_size_t),
        ("name", ctypes.c_char_p),
        ("units", ctypes.c_char_p),
        ("attributes", ctypes.c_char_p),
        ("type", ctypes.c_int32),
        ("levels", ctypes.c_int32),
        ("shape", ctypes.c_int64 * 4),
        ("tile", ctypes.c_int64 * 4),
        ("box", ctypes.c_int64 * 6),
        ("low", ctypes.c_double),
        ("high", ctypes.c_double),
        ("background", ctypes.c_double),
        ("max_error", ctypes.c_double),
        ("psnr", ctypes.c_double),
    )


def _library() -> ctypes.CDLL:
    """libfhash, with the types of its functions. Raises OSError where there is none."""
    root = Path(__file__).resolve().parents[1]
    places = [root / folder / "fhash_formats/native/libfhash.so" for folder in ("", "formats")]
    named = os.environ.get("FHASH_LIBRARY", "")
    path = named or next((str(place) for place in places if place.is_file()), "libfhash.so.1")
    library = ctypes.CDLL(path)
    pointer, number = ctypes.c_void_p, ctypes.c_int32
    library.fhash_context_create.restype = pointer
    library.fhash_context_create.argtypes = (ctypes.c_uint64, number)
    library.fhash_context_destroy.argtypes = (pointer,)
    library.fhash_open_path.argtypes = (pointer, ctypes.c_char_p, pointer, pointer)
    library.fhash_close.argtypes = (pointer,)
    library.fhash_variables.argtypes = (pointer,)
    library.fhash_variable_get.argtypes = (pointer, number, pointer, pointer)
    library.fhash_coordinate.argtypes = (pointer, number, number, pointer, pointer, pointer)
    place = (pointer, number, ctypes.c_double, pointer, number, number)
    library.fhash_read.argtypes = (*place, pointer, pointer)
    return library


class File:
    """An open `.fhz` file, through libfhash. Raises OSError with the library's words.

    Attributes:
        variables: facts of each.
    """

    def __init__(self, path: str) -> None:
        self._library = library = _library()
        self._file = file = ctypes.c_void_p()
        context = ctypes.c_void_p(library.fhash_context_create(0, os.cpu_count() or 1))

        def close() -> None:
            if file:
                library.fhash_close(file)
            library.fhash_context_destroy(context)

        weakref.finalize(self, close)
        self._call("fhash_open_path", context, os.fsencode(path), ctypes.byref(file))
        self._positions: dict[tuple[int, int], Any] = {}
        self.variables = [
            self._variable(number) for number in range(self._library.fhash_variables(self._file))
        ]

    def _call(self, name: str, *arguments: Any) -> None:
        error = _Error()
        if getattr(self._library, name)(*arguments, ctypes.byref(error)):
            raise OSError(error.text.decode("utf-8", "replace"))

    def _variable(self, number: int) -> Variable:
        variable = Variable(ctypes.sizeof(Variable))
        self._call("fhash_variable_get", self._file, number, ctypes.byref(variable))
        return variable

    def positions(self, number: int, axis: int) -> Any:
        """Positions (n,) of a variable along an axis, 0 to 3 for t, z, y, x."""
        if (number, axis) not in self._positions:
            found = np.empty(self.variables[number].shape[axis])
            self._call("fhash_coordinate", self._file, number, axis, found.ctypes.data, None)
            self._positions[number, axis] = found
        return self._positions[number, axis]

    def read(self, number: int, step: float, region: list[int], lod: int) -> Any:
        """Values (z, y, x) of a region z0, z1, y0, y1, x0, x1, of every 2^lod-th vertex.

        They are float64 for sources of float64 and of integers above 16 bits, else float32.
        """
        source = np.dtype(NUMBER_TYPES[self.variables[number].type - 1])
        wide = source.itemsize > (4 if source.kind == "f" else 2)
        stride = 1 << lod
        shape = [
            -(-last // stride) - -(-first // stride)
            for first, last in (region[:2], region[2:4], region[4:])
        ]
        values = np.empty(shape, np.float64 if wide else np.float32)
        kind = NUMBER_TYPES.index(values.dtype.name) + 1
        corners = (ctypes.c_int64 * 6)(*region)
        self._call("fhash_read", self._file, number, step, corners, lod, kind, values.ctypes.data)
        return values


try:
    from paraview.util.vtkAlgorithm import smdomain, smhint, smproperty, smproxy
    from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
except ImportError:  # this package itself imports the file
    pass
else:
    from vtkmodules.vtkCommonCore import vtkDataArraySelection, vtkOutputWindow
    from vtkmodules.vtkCommonDataModel import vtkDataObject, vtkImageData, vtkRectilinearGrid
    from vtkmodules.vtkCommonExecutionModel import vtkAlgorithm

    @smproxy.reader(
        name="FhashReader",
        label="fhash volume",
        extensions="fhz",
        file_description="fhash volumes",
    )
    class FhashReader(VTKPythonAlgorithmBase):
        """ParaView's reader: one grid at a time, with the chosen variables that lie on it."""

        def __init__(self) -> None:
            super().__init__(nInputPorts=0, nOutputPorts=1, outputType="vtkDataSet")
            self._path = ""
            self._lod = self._moving_lod = 0
            self._moving = False
            self._watched: list[Any] = []
            self._file: File | None = None
            self._arrays = vtkDataArraySelection()
            self._arrays.AddObserver("ModifiedEvent", lambda *_: self.Modified())

        @smproperty.stringvector(name="FileName")
        @smdomain.filelist()
        @smhint.filechooser(extensions="fhz", file_description="fhash volumes")
        def SetFileName(self, path: str | None) -> None:
            """Choose the file."""
            if path and path != self._path:
                self._path, self._file = path, None
                self.Modified()

        @smproperty.intvector(name="LevelOfDetail", label="Level Of Detail", default_values=0)
        @smdomain.intrange(min=0, max=10)
        def SetLevelOfDetail(self, lod: int) -> None:
            """Choose how coarse the grid is: every 2^n-th vertex along each axis."""
            if lod != self._lod:
                self._lod = lod
                self.Modified()

        @smproperty.intvector(name="LevelWhileMoving", label="Level While Moving", default_values=0)
        @smdomain.intrange(min=0, max=10)
        def SetLevelWhileMoving(self, lod: int) -> None:
            """Choose the level of detail while a view is turned, where that is coarser."""
            if lod != self._moving_lod:
                self._moving_lod = lod
                self.Modified()

        @smproperty.dataarrayselection(name="Variables")
        def GetVariables(self) -> Any:
            """The selection of variables."""
            return self._arrays

        @smproperty.doublevector(
            name="TimestepValues", information_only="1", si_class="vtkSITimeStepsProperty"
        )
        def GetTimestepValues(self) -> list[float]:
            """The times of the first variable that is chosen."""
            opened = self._opened()
            return [] if opened is None else [float(time) for time in self._times(opened)]

        def _level(self, opened: File) -> int:
            """The level of detail that is asked for, or the last one that the variables have."""
            asked = max(self._lod, self._moving_lod) if self._moving else self._lod
            return min(asked, *(int(opened.variables[n].levels) for n in self._chosen(opened)))

        def _watch(self) -> None:
            """Observe the views of this process, which a server has not."""
            from paraview import servermanager

            if self._moving_lod <= self._lod or servermanager.ActiveConnection is None:
                return
            for view in servermanager.GetRenderViews():
                interactor = view.GetInteractor()
                if interactor is None or interactor in self._watched:
                    continue
                self._watched.append(interactor)
                for event, moving in (
                    ("StartInteractionEvent", True),
                    ("EndInteractionEvent", False),
                ):
                    # before ParaView's own observer, which draws
                    interactor.AddObserver(event, partial(self._turn, view, moving), 1.0)

        def _turn(self, view: Any, moving: bool, *_: Any) -> None:
            """Read at the level of detail of a view that is turned, or no longer is."""
            from paraview import servermanager

            if self._moving_lod <= self._lod or moving == self._moving:
                return
            self._moving = moving
            self.Modified()
            for source in servermanager.ProxyManager().GetProxiesInGroup("sources").values():
                if source.SMProxy.GetClientSideObject() is self:
                    source.SMProxy.MarkDirty(source.SMProxy)
            view.SMProxy.Update()

        def _opened(self) -> File | None:
            """The file, which is opened on the first call; None where that fails."""
            if self._file is None and self._path:
                try:
                    self._file = File(self._path)
                except (OSError, AttributeError) as error:
                    self._say(str(error))
                    return None
                for variable in self._file.variables:
                    self._arrays.AddArray(variable.name.decode())
            return self._file

        def _say(self, text: str) -> None:
            vtkOutputWindow.GetInstance().DisplayErrorText(f"{self._path}: {text}\n")

        def _chosen(self, opened: File) -> list[int]:
            """Numbers of the chosen variables that have the shape of the first of them."""
            every = range(len(opened.variables))
            names = [variable.name.decode() for variable in opened.variables]
            chosen = [n for n in every if self._arrays.ArrayIsEnabled(names[n])] or [0]
            shape = list(opened.variables[chosen[0]].shape)
            on_grid = [n for n in chosen if self._same_grid(opened, chosen[0], n)]
            for n in sorted(set(chosen) - set(on_grid)):
                self._say(f"{names[n]} is not on the grid {shape} of {names[chosen[0]]}: left out")
            return on_grid

        @staticmethod
        def _same_grid(opened: File, one: int, other: int) -> bool:
            axes = [[opened.positions(n, axis) for axis in range(4)] for n in (one, other)]
            return all(map(np.array_equal, *axes))

        def _times(self, opened: File) -> Any:
            times = opened.positions(self._chosen(opened)[0], 0)
            return times if np.all(np.diff(times) > 0) else np.arange(len(times), dtype=float)

        def _axes(self, opened: File) -> list[tuple[Any, int]]:
            """Positions along z, y and x at the level of detail, and how they were turned."""
            first, stride = self._chosen(opened)[0], 1 << self._level(opened)
            return [ascending(opened.positions(first, axis)[::stride]) for axis in (1, 2, 3)]

        def RequestDataObject(self, request: Any, inputs: Any, outputs: Any) -> int:
            """Make the output: an image where the axes are even."""
            opened = self._opened()
            if opened is None:
                return 0
            even = all(is_even(positions) for positions, _ in self._axes(opened))
            kind = vtkImageData if even else vtkRectilinearGrid
            found = outputs.GetInformationObject(0).Get(vtkDataObject.DATA_OBJECT())
            if not isinstance(found, kind):
                outputs.GetInformationObject(0).Set(vtkDataObject.DATA_OBJECT(), kind())
            return 1

        def RequestInformation(self, request: Any, inputs: Any, outputs: Any) -> int:
            """Tell times and extent."""
            opened = self._opened()
            if opened is None:
                return 0
            told, executive = outputs.GetInformationObject(0), self.GetExecutive()
            times = [float(time) for time in self._times(opened)]
            told.Set(executive.TIME_STEPS(), times, len(times))
            told.Set(executive.TIME_RANGE(), [times[0], times[-1]], 2)
            lengths = [len(positions) for positions, _ in self._axes(opened)]
            extent = [end for n in lengths[::-1] for end in (0, n - 1)]
            told.Set(executive.WHOLE_EXTENT(), extent, 6)
            told.Set(vtkAlgorithm.CAN_PRODUCE_SUB_EXTENT(), 1)
            return 1

        def RequestData(self, request: Any, inputs: Any, outputs: Any) -> int:
            """Read the chosen variables at a time, or between two."""
            opened = self._opened()
            if opened is None:
                return 0
            self._watch()
            told, executive = outputs.GetInformationObject(0), self.GetExecutive()
            times = self._times(opened)
            time = times[0]
            if told.Has(executive.UPDATE_TIME_STEP()):
                time = told.Get(executive.UPDATE_TIME_STEP())
            step = float(np.interp(time, times, np.arange(len(times))))
            extent = [0] * 6
            told.Get(executive.UPDATE_EXTENT(), extent)
            try:
                grid = self._grid(opened, step, extent)
            except OSError as error:
                self._say(str(error))
                return 0
            output = told.Get(vtkDataObject.DATA_OBJECT())
            output.ShallowCopy(grid)
            output.GetInformation().Set(vtkDataObject.DATA_TIME_STEP(), time)
            return 1

        def _grid(self, opened: File, step: float, extent: list[int]) -> Any:
            """The grid of an extent x0, x1, y0, y1, z0, z1 of whole numbers, both ends within."""
            axes, level = self._axes(opened), self._level(opened)
            region, turns = [], []
            for (positions, turn), first, last in zip(  # noqa: B905
                axes, extent[4::-2], extent[5::-2]
            ):
                ends = (
                    (first, last)
                    if turn > 0
                    else (
                        len(positions) - 1 - last,
                        len(positions) - 1 - first,
                    )
                )
                region += [ends[0] << level, (ends[1] << level) + 1]
                turns.append(slice(None, None, turn))
            fields = []
            for number in self._chosen(opened):
                variable = opened.variables[number]
                values = opened.read(number, step, region, level)[tuple(turns)]
                fields.append((variable.name.decode(), variable.units.decode(), values))
            corner = (extent[4], extent[2], extent[0])
            return vtk_grid(fields, [positions for positions, _ in axes], corner)
