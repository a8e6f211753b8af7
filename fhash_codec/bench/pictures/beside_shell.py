"""The shell of `orbit` beside VTK, and beside OSPRay where one is named, on one machine, in turns.

All get the same values, transfer function, cameras, steps and number of threads.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from statistics import median
from typing import Protocol

from fhash_codec.bench.pictures.beside_vtk import timed
from fhash_codec.bench.pictures.likeness import black, picture_psnr
from fhash_codec.bench.pictures.orbit import SIDE, shell, view_of_shell
from fhash_codec.bench.pictures.ospray_peer import OsprayPeer
from fhash_codec.bench.pictures.results import Beside
from fhash_codec.bench.pictures.vtk_peer import Drawn, VtkPeer, require_vtk
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, Task
from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.threads import usable_threads

__all__ = ["beside_shell"]


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
        different = [psnr for psnr in likeness if psnr is not None]
        found.append(
            Beside(
                peer=name,
                scene=f"shell of {side}^3",
                shaded=shaded,
                size=size,
                threads=usable_threads(),
                ours_ms=1e3 * median(ours),
                peer_ms=1e3 * max(median(theirs) - median(nothing), 0.0),
                psnr=median(different) if different else None,
            )
        )
        progress("shell", number + 1, len(variants), name)
    return tuple(found)


Made = tuple[Peer, Callable[[], float], Callable[[], str]]
"""A peer, what gives the seconds of a picture of nothing, and what names it once it has drawn."""


@contextmanager
def _vtk(frame: Frame, task: Task) -> Iterator[Made]:
    """VTK's fixed-point ray caster; its window takes time by itself."""
    assert task.table is not None
    make = partial(
        VtkPeer,
        frame.values,
        task.rays.grid,
        task.table,
        unit=1.0,
        size=task.rays.size,
        step=task.step,
        lighting=task.lighting,
        threads=usable_threads(),
    )
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
