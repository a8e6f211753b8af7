"""VTK as a peer of the renderer, through its own volume mappers.

It gets the same decoded frame, transfer function, camera and steps.
"""

from __future__ import annotations

import importlib
import os
import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import Lighting, Table
from fhash_formats.errors import MissingDependencyError

__all__ = ["MAPPERS", "VtkPeer", "require_vtk"]

Single = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.uint8]

MAPPERS = ("cpu", "gpu")
"""vtkFixedPointVolumeRayCastMapper, and the mapper for graphics cards, which software OpenGL also
runs."""
POINTS = 2048
"""Points of the transfer functions that VTK is given."""
MODULES = {
    "vtkCommonCore": ("vtkLogger", "vtkUnsignedCharArray", "vtkVersion"),
    "vtkCommonDataModel": ("vtkImageData", "vtkPiecewiseFunction"),
    "vtkRenderingCore": (
        "vtkColorTransferFunction",
        "vtkRenderer",
        "vtkRenderWindow",
        "vtkVolume",
        "vtkVolumeProperty",
    ),
    "vtkRenderingOpenGL2": (),
    "vtkRenderingVolume": ("vtkFixedPointVolumeRayCastMapper",),
    "vtkRenderingVolumeOpenGL2": ("vtkOpenGLGPUVolumeRayCastMapper",),
    "util.numpy_support": ("numpy_to_vtk", "vtk_to_numpy"),
}


def require_vtk() -> SimpleNamespace:
    """Import the names of VTK that are used here; raises MissingDependencyError."""
    loaded_names = {}
    try:
        for module, names in MODULES.items():
            loaded = importlib.import_module(f"vtkmodules.{module}")
            loaded_names.update({name: getattr(loaded, name) for name in names})
    except ImportError as error:
        raise MissingDependencyError(
            "comparing with VTK needs it: pip install 'fhash[bench]'"
        ) from error
    return SimpleNamespace(**loaded_names)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Bytes (H, W, 3) over black, the first row the top, and the seconds of `Render`."""

    pixels: Pixels
    seconds: float


class VtkPeer:
    """A window of VTK with one volume; what it shows is set by `look`, `load` and `shade`."""

    def __init__(
        self,
        values: Single,
        grid: Grid,
        table: Table,
        *,
        unit: float,
        size: tuple[int, int],
        step: float,
        mapper: str = "cpu",
        lighting: Lighting | None = None,
        threads: int | None = None,
        empty: bool = False,
    ) -> None:
        """Open a window.

        Args:
            values: (z, y, x) of the whole domain, all finite.
            grid: vertices and spacing of the domain.
            table: transfer function.
            unit: length that VTK's opacities refer to, in units of the coordinates.
            size: pixels across and down.
            step: ray step, in units of the coordinates.
            mapper: one of MAPPERS.
            lighting: light from the camera; None for an unlit volume.
            threads: threads of the `cpu` mapper.
            empty: the window shows nothing.
        """
        self.vtk = vtk = require_vtk()
        self.grid = grid
        self.image = vtk.vtkImageData()
        nx, ny, nz = grid.counts
        self.image.SetDimensions(nx, ny, nz)
        self.image.SetSpacing(*(abs(float(part)) for part in grid.spacing))
        self.image.SetOrigin(*(float(min(part)) for part in grid.corners))
        self.load(values)
        self.mapper = self._mapper(mapper, step, threads)
        self.property = vtk.vtkVolumeProperty()
        self.property.SetInterpolationTypeToLinear()
        self.property.SetScalarOpacityUnitDistance(unit)
        self._give(table, unit)
        self.shade(lighting)
        volume = vtk.vtkVolume()
        volume.SetMapper(self.mapper)
        volume.SetProperty(self.property)
        self.renderer = vtk.vtkRenderer()
        if not empty:
            self.renderer.AddVolume(volume)
        self.renderer.SetBackground(0, 0, 0)
        # VTK warns of every display that it tries in vain.
        vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)
        self.window = vtk.vtkRenderWindow()
        if not self.window.SupportsOpenGL():
            raise MissingDependencyError(
                "VTK finds no OpenGL;"
                " install a software one such as Mesa's EGL (libegl1, libgl1-mesa-dri)"
            )
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetSize(*size)
        self.window.AddRenderer(self.renderer)

    def _mapper(self, name: str, step: float, threads: int | None) -> Any:
        """One of MAPPERS with a fixed ray step, for the image."""
        mapper = (
            self.vtk.vtkFixedPointVolumeRayCastMapper()
            if name == "cpu"
            else self.vtk.vtkOpenGLGPUVolumeRayCastMapper()
        )
        mapper.SetInputData(self.image)
        mapper.AutoAdjustSampleDistancesOff()
        mapper.SetSampleDistance(step)
        if name == "cpu":
            mapper.SetInteractiveSampleDistance(step)
            mapper.LockSampleDistanceToInputSpacingOff()
            mapper.SetNumberOfThreads(threads or os.cpu_count() or 1)
        else:
            mapper.SetUseJittering(False)
        return mapper

    def load(self, values: Single) -> None:
        """Another frame; the mapper takes it up when it draws."""
        turned = np.ascontiguousarray(
            values[
                tuple(slice(None, None, -1 if part < 0 else 1) for part in self.grid.spacing[::-1])
            ]
        )
        scalars = self.vtk.numpy_to_vtk(turned.ravel(), deep=1)
        self.image.GetPointData().SetScalars(scalars)
        self.image.Modified()

    def shade(self, lighting: Lighting | None) -> None:
        """Light from the camera, or none."""
        self.property.SetShade(lighting is not None)
        if lighting is not None:
            self.property.SetAmbient(lighting.ambient)
            self.property.SetDiffuse(lighting.diffuse)
            self.property.SetSpecular(lighting.specular)
            self.property.SetSpecularPower(lighting.specular_power)

    def look(self, rays: Rays) -> None:
        """Take the camera of rays."""
        spacing = rays.grid.spacing
        eye = rays.eye * spacing + rays.grid.origin
        forward, up = rays.forward * spacing, rays.up * spacing
        half = float(np.linalg.norm(up))
        distance = float(np.linalg.norm(rays.grid.corners.mean(axis=1) - eye))
        camera = self.renderer.GetActiveCamera()
        camera.SetPosition(*eye)
        camera.SetFocalPoint(*(eye + forward * distance))
        camera.SetViewUp(*(up / half))
        camera.SetParallelProjection(rays.parallel)
        if rays.parallel:
            camera.SetParallelScale(half)
        else:
            camera.SetViewAngle(2 * float(np.degrees(np.arctan(half))))
        self.renderer.ResetCameraClippingRange()

    def draw(self) -> Drawn:
        """Render once."""
        self.window.Modified()
        begun = time.perf_counter()
        self.window.Render()
        seconds = time.perf_counter() - begun
        width, height = self.window.GetSize()
        data = self.vtk.vtkUnsignedCharArray()
        self.window.GetPixelData(0, 0, width - 1, height - 1, 0, data, 0)
        pixels = self.vtk.vtk_to_numpy(data).reshape(height, width, 3)[::-1]
        return Drawn(pixels=np.ascontiguousarray(pixels), seconds=seconds)

    @property
    def version(self) -> str:
        """Versions of VTK and of the OpenGL that it uses."""
        lines = str(self.window.ReportCapabilities()).splitlines()
        graphics = next(
            (
                line.partition(":")[2].strip()
                for line in lines
                if line.startswith("OpenGL renderer string")
            ),
            "no OpenGL",
        )
        return f"VTK {self.vtk.vtkVersion.GetVTKVersion()}, {graphics}"

    def _give(self, table: Table, unit: float) -> None:
        """The transfer function as VTK has them: colours, and opacities after the unit distance."""
        values = np.linspace(table.low, table.high, POINTS)
        entries = np.linspace(table.low, table.high, len(table.extinctions))
        opacities = -np.expm1(-np.interp(values, entries, table.extinctions) * unit)
        shades = np.stack(
            [np.interp(values, entries, channel) for channel in table.colours.T], axis=-1
        )
        colour, opacity = self.vtk.vtkColorTransferFunction(), self.vtk.vtkPiecewiseFunction()
        for value, shade, share in zip(values, shades, opacities, strict=True):
            colour.AddRGBPoint(float(value), *(float(channel) for channel in shade))
            opacity.AddPoint(float(value), float(share))
        self.property.SetColor(colour)
        self.property.SetScalarOpacity(opacity)

    def close(self) -> None:
        """Release the window."""
        self.window.Finalize()
