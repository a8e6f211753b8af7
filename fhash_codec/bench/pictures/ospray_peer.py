"""OSPRay as a peer of the renderer, through its C API, for versions 2 and 3.

It gets the same decoded frame, transfer function and camera. Its renderer `scivis` draws volumes
unlit. Source: ospray.h and OSPEnums.h of OSPRay 3.2, and its documentation of parameters.
"""

from __future__ import annotations

import ctypes
import importlib.util
import time
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.pictures.vtk_peer import Drawn
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import Table
from fhash_formats.errors import InputError

__all__ = ["OsprayPeer", "find_ospray", "load_ospray"]

Single = npt.NDArray[np.float32]
Address = int | None

DATA = 0x8000000 + 100
"""OSP_DATA; other kinds of objects follow it."""
INSTANCE = DATA + 8
"""OSP_INSTANCE."""
VOLUMETRIC_MODEL = DATA + 15
"""OSP_VOLUMETRIC_MODEL."""
FLOAT = 6000
"""OSP_FLOAT."""
VEC3F = 6002
"""OSP_VEC3F."""
BOX1F = 10000
"""OSP_BOX1F."""
RGBA32F = 3
"""OSP_FB_RGBA32F."""
COLOR = 1
"""OSP_FB_COLOR."""
FINISHED = 100000
"""OSP_TASK_FINISHED."""
VERSION_PLACES = (1, 2, 3)
"""Properties of a device: its version's three numbers."""
VERSIONS = (2, 3)
"""Major versions whose C API is the one used here."""

_HANDLE = ctypes.c_void_p
_NAME = ctypes.c_char_p
_REAL = ctypes.c_float
_PROTOTYPES: dict[str, tuple[type | None, tuple[type, ...]]] = {
    "ospInit": (ctypes.c_int, (ctypes.c_void_p, ctypes.c_void_p)),
    "ospGetCurrentDevice": (_HANDLE, ()),
    "ospDeviceGetProperty": (ctypes.c_int64, (_HANDLE, ctypes.c_uint32)),
    "ospDeviceGetLastErrorMsg": (_NAME, (_HANDLE,)),
    "ospNewSharedData": (
        _HANDLE,
        (
            *(ctypes.c_void_p, ctypes.c_uint32),
            *(ctypes.c_uint64, ctypes.c_int64) * 3,
            *(ctypes.c_void_p, ctypes.c_void_p),
        ),
    ),
    **{f"ospNew{kind}": (_HANDLE, (_NAME,)) for kind in ("Volume", "TransferFunction", "Camera")},
    "ospNewRenderer": (_HANDLE, (_NAME,)),
    "ospNewVolumetricModel": (_HANDLE, (_HANDLE,)),
    "ospNewGroup": (_HANDLE, ()),
    "ospNewInstance": (_HANDLE, (_HANDLE,)),
    "ospNewWorld": (_HANDLE, ()),
    "ospNewFrameBuffer": (
        _HANDLE,
        (ctypes.c_int, ctypes.c_int, ctypes.c_uint32, ctypes.c_uint32),
    ),
    "ospSetParam": (None, (_HANDLE, _NAME, ctypes.c_uint32, ctypes.c_void_p)),
    "ospSetFloat": (None, (_HANDLE, _NAME, _REAL)),
    "ospSetVec3f": (None, (_HANDLE, _NAME, _REAL, _REAL, _REAL)),
    "ospSetObject": (None, (_HANDLE, _NAME, _HANDLE)),
    "ospSetObjectAsData": (None, (_HANDLE, _NAME, ctypes.c_uint32, _HANDLE)),
    "ospCommit": (None, (_HANDLE,)),
    "ospRelease": (None, (_HANDLE,)),
    "ospRenderFrame": (_HANDLE, (_HANDLE,) * 4),
    "ospWait": (None, (_HANDLE, ctypes.c_uint32)),
    "ospMapFrameBuffer": (ctypes.c_void_p, (_HANDLE, ctypes.c_uint32)),
    "ospUnmapFrameBuffer": (None, (ctypes.c_void_p, _HANDLE)),
}


def find_ospray(named: str) -> Path:
    """The library that a name stands for: a file, a folder that holds it, or a Python module.

    Raises InputError where there is none.
    """
    path = Path(named)
    if path.is_file():
        return path
    folders = [path] if path.is_dir() else []
    if not folders and named.replace(".", "").isidentifier():
        try:
            spec = importlib.util.find_spec(named)
        except (ImportError, ValueError):
            spec = None
        folders = [] if spec is None else [Path(f) for f in spec.submodule_search_locations or ()]
    for folder in folders:
        for pattern in ("libospray.so*", "lib/libospray.so*", "plugins/libospray.so*"):
            found = sorted(folder.glob(pattern))
            if found:
                return found[0]
    raise InputError(
        f"--ospray {named}: no OSPRay there; give libospray.so of OSPRay 2 or 3, its folder, or a "
        "Python module that holds it"
    )


@cache
def load_ospray(path: Path, threads: int) -> tuple[ctypes.CDLL, str]:
    """The initialised library and its version; raises InputError for a file that is no OSPRay.

    A process initialises OSPRay once, with so many threads.
    """
    try:
        library = ctypes.CDLL(str(path.resolve()))
    except OSError as error:
        raise InputError(f"--ospray {path}: cannot be loaded: {error}") from error
    for name, (result, arguments) in _PROTOTYPES.items():
        function = getattr(library, name, None)
        if function is None:
            raise InputError(
                f"--ospray {path}: it has no {name}, so it is no OSPRay {' or '.join('23')}"
            )
        function.restype, function.argtypes = result, arguments
    words = (ctypes.c_char_p * 3)(b"fhash", f"--osp:num-threads={threads}".encode(), None)
    failed = library.ospInit(ctypes.byref(ctypes.c_int(2)), ctypes.cast(words, ctypes.c_void_p))
    device = library.ospGetCurrentDevice()
    if failed or not device:
        raise InputError(
            f"--ospray {path}: OSPRay does not start (error {failed}); the libraries that its "
            "release holds beside it, such as libospray_module_cpu, must lie there"
        )
    numbers = [library.ospDeviceGetProperty(device, place) for place in VERSION_PLACES]
    version = ".".join(map(str, numbers))
    if numbers[0] not in VERSIONS:
        raise InputError(f"--ospray {path}: OSPRay {version}; versions 2 and 3 are known")
    return library, version


class OsprayPeer:
    """A world of OSPRay with one volume; `look` sets the camera."""

    def __init__(
        self,
        library: ctypes.CDLL,
        values: Single,
        grid: Grid,
        table: Table,
        *,
        size: tuple[int, int],
        step: float,
    ) -> None:
        """Hand over a volume.

        Args:
            library: of `load_ospray`.
            values: (z, y, x) of the whole domain, all finite.
            grid: vertices and spacing of the domain.
            table: transfer function.
            size: pixels across and down.
            step: ray step, in units of the coordinates.
        """
        self.library, self.grid, self.size = library, grid, size
        self._arrays: list[npt.NDArray[np.generic]] = []
        self._objects: list[Address] = []
        turned = tuple(slice(None, None, -1 if part < 0 else 1) for part in grid.spacing[::-1])
        volume = self._new("Volume", b"structuredRegular")
        self._put(volume, b"data", self._data(np.ascontiguousarray(values[turned]), FLOAT))
        self._vector(volume, b"gridOrigin", grid.corners.min(axis=1))
        self._vector(volume, b"gridSpacing", np.abs(grid.spacing))
        library.ospCommit(volume)
        densest = float(table.extinctions.max()) or 1.0
        function = self._new("TransferFunction", b"piecewiseLinear")
        self._put(function, b"color", self._data(table.colours, VEC3F))
        self._put(
            function,
            b"opacity",
            self._data(np.asarray(table.extinctions / densest, np.float32), FLOAT),
        )
        ends = np.array([table.low, table.high], dtype=np.float32)
        library.ospSetParam(function, b"value", BOX1F, ends.ctypes.data)
        library.ospCommit(function)
        model = self._kept(library.ospNewVolumetricModel(volume))
        self._put(model, b"transferFunction", function)
        library.ospSetFloat(model, b"densityScale", densest)
        library.ospCommit(model)
        group = self._kept(library.ospNewGroup())
        library.ospSetObjectAsData(group, b"volume", VOLUMETRIC_MODEL, model)
        library.ospCommit(group)
        instance = self._kept(library.ospNewInstance(group))
        library.ospCommit(instance)
        self._world = self._kept(library.ospNewWorld())
        library.ospSetObjectAsData(self._world, b"instance", INSTANCE, instance)
        library.ospCommit(self._world)
        self._renderer = self._new("Renderer", b"scivis")
        library.ospSetFloat(
            self._renderer, b"volumeSamplingRate", float(np.abs(grid.spacing).min()) / step
        )
        library.ospCommit(self._renderer)
        self._buffer = self._kept(library.ospNewFrameBuffer(*size, RGBA32F, COLOR))
        library.ospCommit(self._buffer)
        self._camera: Address = None

    def look(self, rays: Rays) -> None:
        """Take the camera of rays."""
        library, spacing = self.library, rays.grid.spacing
        up = rays.up * spacing
        half = float(np.linalg.norm(up))
        self._camera = self._new("Camera", b"orthographic" if rays.parallel else b"perspective")
        self._vector(self._camera, b"position", rays.eye * spacing + rays.grid.origin)
        self._vector(self._camera, b"direction", rays.forward * spacing)
        self._vector(self._camera, b"up", up)
        library.ospSetFloat(self._camera, b"aspect", self.size[0] / self.size[1])
        if rays.parallel:
            library.ospSetFloat(self._camera, b"height", 2 * half)
        else:
            library.ospSetFloat(self._camera, b"fovy", 2 * float(np.degrees(np.arctan(half))))
        library.ospCommit(self._camera)

    def draw(self) -> Drawn:
        """Render once, over black."""
        library, (width, height) = self.library, self.size
        begun = time.perf_counter()
        future = library.ospRenderFrame(self._buffer, self._renderer, self._camera, self._world)
        library.ospWait(future, FINISHED)
        seconds = time.perf_counter() - begun
        library.ospRelease(future)
        mapped = library.ospMapFrameBuffer(self._buffer, COLOR)
        if not mapped:
            reason = library.ospDeviceGetLastErrorMsg(library.ospGetCurrentDevice())
            raise InputError(f"OSPRay drew nothing: {(reason or b'').decode(errors='replace')}")
        pixels = (ctypes.c_float * (4 * width * height)).from_address(mapped)
        rgba = np.array(pixels, dtype=np.float32).reshape(height, width, 4)[::-1]
        library.ospUnmapFrameBuffer(mapped, self._buffer)
        drawn = np.rint(255 * np.clip(rgba[..., :3], 0, 1)).astype(np.uint8)
        return Drawn(pixels=drawn, seconds=seconds)

    def close(self) -> None:
        """Release every object."""
        while self._objects:
            self.library.ospRelease(self._objects.pop())
        self._arrays.clear()

    def _new(self, kind: str, name: bytes) -> Address:
        """A new object of a kind; raises InputError where this OSPRay does not have it."""
        return self._kept(getattr(self.library, f"ospNew{kind}")(name))

    def _kept(self, handle: Address) -> Address:
        """A handle that `close` releases."""
        if not handle:
            reason = self.library.ospDeviceGetLastErrorMsg(self.library.ospGetCurrentDevice())
            raise InputError(f"OSPRay refuses: {(reason or b'').decode(errors='replace')}")
        self._objects.append(handle)
        return handle

    def _data(self, array: npt.NDArray[np.generic], kind: int) -> Address:
        """An array as data of OSPRay, shared, so kept; the last axis of VEC3F is the vector."""
        array = np.ascontiguousarray(array, dtype=np.float32)
        self._arrays.append(array)
        counts = array.shape[:-1] if kind == VEC3F else array.shape
        sizes = [(count, 0) for count in (*counts[::-1], 1, 1)[:3]]
        handle = self.library.ospNewSharedData(
            array.ctypes.data, kind, *(number for pair in sizes for number in pair), None, None
        )
        data = self._kept(handle)
        self.library.ospCommit(data)
        return data

    def _put(self, target: Address, name: bytes, value: Address) -> None:
        self.library.ospSetObject(target, name, value)

    def _vector(self, target: Address, name: bytes, value: npt.NDArray[np.float64]) -> None:
        self.library.ospSetVec3f(target, name, *(float(part) for part in value))
