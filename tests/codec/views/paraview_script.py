"""Steps of pvpython with a container: `pvpython paraview_script.py PLUGIN RUN.fhz PICTURE.png`.

Prints an object: types, names, times, and of some times bounds and digests of the values.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from typing import Any

if not hasattr(inspect, "getargspec"):  # ParaView 5.11 on Python 3.11
    inspect.getargspec = inspect.getfullargspec  # type: ignore[attr-defined]

from paraview import simple
from vtkmodules.util.numpy_support import vtk_to_numpy

PLUGIN, RUN, PICTURE = sys.argv[1:]


def shown(reader: Any, time: float) -> dict[str, Any]:
    """Bounds, size, digests and hidden points at a time."""
    reader.UpdatePipeline(time)
    grid = reader.SMProxy.GetClientSideObject().GetOutputDataObject(0)
    points, fields = grid.GetPointData(), grid.GetFieldData()
    arrays = {
        points.GetArrayName(n): vtk_to_numpy(points.GetArray(n))
        for n in range(points.GetNumberOfArrays())
    }
    hidden = arrays.pop("vtkGhostType", None)
    return {
        "type": grid.GetClassName(),
        "bounds": grid.GetBounds(),
        "points": grid.GetNumberOfPoints(),
        "digests": {
            name: hashlib.sha256(values.tobytes()).hexdigest() for name, values in arrays.items()
        },
        "hidden": 0 if hidden is None else int((hidden == 2).sum()),
        "fields": {
            fields.GetArrayName(n): fields.GetAbstractArray(n).GetValue(0)
            for n in range(fields.GetNumberOfArrays())
        },
    }


simple.LoadPlugin(PLUGIN, ns=globals())
reader = simple.OpenDataFile(RUN)
reader.UpdatePipeline()
times = list(reader.TimestepValues)
result: dict[str, Any] = {"times": times, "names": list(reader.Variables.Available)}
result["first"] = shown(reader, times[0])
result["last"] = shown(reader, times[-1])
result["between"] = shown(reader, 0.75 * times[1] + 0.25 * times[2])
reader.LevelOfDetail = 1
result["coarse"] = shown(reader, times[0])
reader.LevelOfDetail = 10
result["coarsest"] = shown(reader, times[0])
reader.LevelOfDetail = 0
reader.Variables = result["names"][:1]
result["one"] = shown(reader, times[0])
scene = simple.GetAnimationScene()
scene.UpdateAnimationUsingDataTimeSteps()
view = simple.CreateView("RenderView")
view.ViewSize = [500, 400]
display = simple.Show(reader, view)
display.SetRepresentationType("Surface")
simple.ColorBy(display, ("POINTS", result["names"][0]))
display.RescaleTransferFunctionToDataRange(False)
display.SetScalarBarVisibility(view, True)
view.ResetCamera()
simple.GetActiveCamera().Azimuth(30)
simple.GetActiveCamera().Elevation(30)
played = []
for _ in times:
    simple.Render(view)
    played.append(view.ViewTime)
    scene.GoToNext()
result["played"] = played


def points() -> int:
    """Points of the reader's output now."""
    output = reader.SMProxy.GetClientSideObject().GetOutputDataObject(0)
    return int(output.GetNumberOfPoints())


reader.LevelWhileMoving = 2
simple.Render(view)
result["moving"] = [points()]
interactor = view.GetInteractor()
interactor.LeftButtonPressEvent()
result["moving"].append(points())
interactor.LeftButtonReleaseEvent()
result["moving"].append(points())
simple.SaveScreenshot(PICTURE, view)
print("RESULT " + json.dumps(result))
