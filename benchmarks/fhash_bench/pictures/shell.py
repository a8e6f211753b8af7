"""Shell in 256 x 256 x 256 vertices: an orbit about it, and VTK and OSPRay beside."""

from __future__ import annotations

import ctypes
import importlib.util
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fhash_bench.pictures.results import Beside, Switch
from fhash_bench.pictures.vtk import Drawn, VtkPeer, median_psnr, require_vtk, timed
from fhash_codec.cost.uses import black, picture_psnr
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Lighting, Marched, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.support.threads import usable_threads
from fhash_formats.support.values import Single

SIDE = 256
"""Vertices along each axis."""
LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.2, specular_power=16.0, lamp=None)


def shell(side: int) -> npt.NDArray[np.float32]:
    """A wavy shell about the middle, float32 (z, y, x), 0 far from it and 1 on it."""
    axis = np.linspace(-1, 1, side, dtype=np.float32)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)
    radius = np.sqrt(x * x + y * y + z * z) + 0.03 * np.sin(9 * x) * np.cos(8 * y + 3 * z)
    return np.asarray(np.exp(-(((radius - 0.7) / 0.04) ** 2)), dtype=np.float32)


def orbit(turns: int, size: int, side: int | None = None) -> tuple[Switch, ...]:
    """Measure pictures of an orbit, unlit and lit, with bricks found anew and with bricks kept.

    Args:
        turns: pictures of an orbit, and so runs of each median.
        size: pixels along both sides.
        side: vertices along each axis; SIDE if None.
    """
    side = SIDE if side is None else side
    frame = Frame(values=shell(side), first=(0, 0, 0))
    kept = Bricks.of(frame)
    found = []
    for shaded in (False, True):
        tasks = [view_of_shell(side, size, 360 * turn / turns, shaded) for turn in range(turns)]
        anew: list[float] = []
        again: list[float] = []
        pictures: list[Marched] = []
        march(frame, tasks[0], bricks=kept)
        for task in tasks:
            fresh = Bricks.of(frame)
            for bricks, times in ((fresh, anew), (kept, again)):
                begun = time.perf_counter()
                pictures.append(march(frame, task, bricks=bricks))
                times.append(1e3 * (time.perf_counter() - begun))
        found.append(
            Switch(
                name=f"shell of {side}^3, {'lit' if shaded else 'unlit'}: bricks kept",
                off_ms=median(anew),
                on_ms=median(again),
                counters_off=dict(pictures[-2].counters),
                counters_on=dict(pictures[-1].counters),
                psnr=None,
            )
        )
    return tuple(found)


def view_of_shell(side: int, size: int, azimuth: float, shaded: bool) -> Task:
    """A view of the shell, of which what lies above a tenth is seen."""
    grid = Grid(counts=(side,) * 3, origin=np.zeros(3), spacing=np.ones(3))
    values = np.linspace(0.0, 1.0, 1001)
    return Task(
        rays=Rays.of(Camera(azimuth=azimuth, elevation=10.0), grid, (size, size)),
        step=0.5,
        threshold=1 / 1024,
        table=Table(
            low=0.0,
            high=1.0,
            colours=np.stack([values, 0.5 * values, 1 - values], axis=-1).astype(np.float32),
            extinctions=0.3 * np.clip((values - 0.1) / 0.9, 0.0, 1.0),
        ),
        lighting=LIGHTING if shaded else None,
        shaded=shaded,
    )


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
        model = self._checked(library.ospNewVolumetricModel(volume))
        self._put(model, b"transferFunction", function)
        library.ospSetFloat(model, b"densityScale", densest)
        library.ospCommit(model)
        group = self._checked(library.ospNewGroup())
        library.ospSetObjectAsData(group, b"volume", VOLUMETRIC_MODEL, model)
        library.ospCommit(group)
        instance = self._checked(library.ospNewInstance(group))
        library.ospCommit(instance)
        self._world = self._checked(library.ospNewWorld())
        library.ospSetObjectAsData(self._world, b"instance", INSTANCE, instance)
        library.ospCommit(self._world)
        self._renderer = self._new("Renderer", b"scivis")
        library.ospSetFloat(
            self._renderer, b"volumeSamplingRate", float(np.abs(grid.spacing).min()) / step
        )
        library.ospCommit(self._renderer)
        self._buffer = self._checked(library.ospNewFrameBuffer(*size, RGBA32F, COLOR))
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
        return self._checked(getattr(self.library, f"ospNew{kind}")(name))

    def _checked(self, handle: Address) -> Address:
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
        data = self._checked(handle)
        self.library.ospCommit(data)
        return data

    def _put(self, target: Address, name: bytes, value: Address) -> None:
        self.library.ospSetObject(target, name, value)

    def _vector(self, target: Address, name: bytes, value: npt.NDArray[np.float64]) -> None:
        self.library.ospSetVec3f(target, name, *(float(part) for part in value))


class Peer(Protocol):
    """A renderer with a volume."""

    def look(self, rays: Rays) -> None:
        """Take the camera of rays."""
        ...

    def draw(self) -> Drawn:
        """Render once."""
        ...

    def close(self) -> None:
        """Release what is held."""
        ...


def beside_shell(
    turns: int,
    size: int,
    ospray: tuple[ctypes.CDLL, str] | None = None,
    progress: Progress = silent,
) -> tuple[Beside, ...]:
    """Draw an orbit about the shell here and by each peer, unlit and lit; OSPRay draws it unlit.

    Args:
        turns: pictures of an orbit, and so runs of each median.
        size: pixels along both sides.
        ospray: of `load_ospray`; None without it.
        progress: is told about each orbit.

    Raises MissingDependencyError where there is no peer at all.
    """
    try:
        require_vtk()
        variants = [("VTK", False), ("VTK", True)]
    except MissingDependencyError:
        if ospray is None:
            raise
        variants = []
    variants += [] if ospray is None else [("OSPRay", False)]
    side = SIDE
    frame = Frame(values=shell(side), first=(0, 0, 0))
    bricks, found = Bricks.of(frame), []
    for number, (name, shaded) in enumerate(variants):
        tasks = [view_of_shell(side, size, 360 * turn / turns, shaded) for turn in range(turns)]
        make = partial(_vtk, frame, tasks[0])
        if name == "OSPRay":
            assert ospray is not None
            make = partial(_ospray, frame, tasks[0], ospray)
        with make() as (peer, empty, version):
            march(frame, tasks[0], bricks=bricks)
            peer.look(tasks[0].rays)
            peer.draw()
            ours, theirs, nothing, likeness = [], [], [], []
            for task in tasks:
                marched, seconds = timed(partial(march, frame, task, bricks=bricks))
                ours.append(seconds)
                peer.look(task.rays)
                drawn = peer.draw()
                theirs.append(drawn.seconds)
                nothing.append(empty())
                likeness.append(picture_psnr(black(marched.rgba), drawn.pixels, 255.0))
            name = version()
        found.append(
            Beside(
                peer=name,
                scene=f"shell of {side}^3",
                shaded=shaded,
                size=size,
                threads=usable_threads(),
                ours_ms=1e3 * median(ours),
                peer_ms=1e3 * max(median(theirs) - median(nothing), 0.0),
                psnr=median_psnr(likeness),
            )
        )
        progress("shell", number + 1, len(variants), name)
    return tuple(found)


Made = tuple[Peer, Callable[[], float], Callable[[], str]]
"""A peer, what gives the seconds of a picture of nothing, and what names it once it has drawn."""


@contextmanager
def _vtk(frame: Frame, task: Task) -> Iterator[Made]:
    """VTK's fixed-point ray caster; its window takes time by itself."""
    make = partial(VtkPeer, frame.values, task, unit=1.0, threads=usable_threads())
    peer, window = make(), make(empty=True)
    try:
        window.draw()
        yield peer, lambda: window.draw().seconds, lambda: peer.version.partition(",")[0]
    finally:
        window.close()
        peer.close()


@contextmanager
def _ospray(frame: Frame, task: Task, ospray: tuple[ctypes.CDLL, str]) -> Iterator[Made]:
    """OSPRay's renderer `scivis`."""
    assert task.table is not None
    library, version = ospray
    peer = OsprayPeer(
        library,
        frame.values,
        task.rays.grid,
        task.table,
        size=task.rays.size,
        step=task.step,
    )
    try:
        yield peer, lambda: 0.0, lambda: f"OSPRay {version}"
    finally:
        peer.close()
