"""Pictures of an animation that several processes render, each every n-th one.

A process sends a picture and waits until it is taken before it renders its next one, so that no
more pictures than processes wait in memory. The processes leave Ctrl-C to the one that started
them, which ends them.
"""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import warnings
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection

from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scene.scene import Scene
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import Location
from fhash_formats.errors import FhashError, FhashWarning, InputError
from fhash_formats.support.threads import usable_threads

__all__ = ["rendered_by_workers"]

PATIENCE = 5.0
"""Seconds that a process may take to end after it is told to."""


@dataclass(frozen=True, kw_only=True)
class _Job:
    """The work of one process.

    Attributes:
        place: of the container, to be opened again.
        variable: which one of it, where it has several.
        digest: `Container.digest` of it, so that no other file is rendered.
        scenes: of its pictures, in order.
        threads: that it may use.
    """

    place: Location
    variable: str | None
    digest: str
    scenes: tuple[Scene, ...]
    threads: int


def rendered_by_workers(
    volume: Volume, scenes: Sequence[Scene], processes: int
) -> Generator[Image, None, None]:
    """Render scenes in several processes; yield the pictures in the order of the scenes.

    Close the generator to end the processes. Raises what rendering raises, and FhashError where a
    process ends by itself, as for want of memory.
    """
    # Without a fork: a copy of a process with threads may hang.
    context = get_context("spawn")
    threads = max(1, usable_threads() // processes)
    workers, ends = [], []
    try:
        for first in range(processes):
            here, there = context.Pipe(duplex=False)
            job = _job(volume, scenes[first::processes], threads)
            worker = context.Process(target=_work, args=(there, job), daemon=True)
            with _interrupts_ignored():
                worker.start()
            there.close()  # so that an end of the process is an end of the pipe
            workers.append(worker)
            ends.append(here)
        for number in range(len(scenes)):
            yield _received(ends[number % processes])
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join(PATIENCE)
            if worker.is_alive():
                worker.kill()
                worker.join()
        for end in ends:
            end.close()


def _job(volume: Volume, scenes: Sequence[Scene], threads: int) -> _Job:
    """The work of a process that draws scenes; raises InputError for a volume of an open file."""
    return _Job(
        place=dataclasses.replace(volume.container.reopening(), digest=None),
        variable=volume.variable,
        digest=volume.container.digest,
        scenes=tuple(scenes),
        threads=threads,
    )


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """A context that ignores Ctrl-C; processes that start in it ignore it for ever.

    Elsewhere than in the main thread, which alone may say so, nothing changes: `_work` says so too.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _received(end: Connection) -> Image:
    """The next picture of a process; warns of what it warned of and raises what it raised."""
    try:
        result, told = end.recv()
    except (EOFError, OSError) as error:
        raise FhashError(
            "a process that renders ended by itself, perhaps for want of memory; "
            "take fewer 'processes'"
        ) from error
    for text in told:
        warnings.warn(text, FhashWarning, stacklevel=3)
    if isinstance(result, BaseException):
        raise result
    assert isinstance(result, Image)
    return result


def _work(end: Connection, job: _Job) -> None:
    """Render the scenes of a job and send each picture, or what was raised, with the warnings."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["FHASH_THREADS"] = str(job.threads)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", FhashWarning)
            try:
                for image in _images(job):
                    end.send((image, _texts(told)))
            except (FhashError, OSError, MemoryError) as error:
                end.send((error, _texts(told)))
    except (BrokenPipeError, ConnectionResetError):
        return  # nobody waits for the pictures any more


def _images(job: _Job) -> Generator[Image, None, None]:
    """Render the scenes of a job; raises InputError where the container is another one now."""
    with open_volume(job.place, variable=job.variable) as volume:
        if volume.container.digest != job.digest:
            raise InputError(
                f"{volume.path}: the file changed while it was rendered; render it again"
            )
        renderer = Renderer(volume)
        for scene, upcoming in zip(job.scenes, (*job.scenes[1:], None), strict=True):
            image = renderer.render(scene, upcoming=upcoming)
            yield dataclasses.replace(image, counters=dict(image.counters), scene=dict(image.scene))


def _texts(told: list[warnings.WarningMessage]) -> list[str]:
    """The texts of warnings of fhash; the list is emptied."""
    texts = [str(each.message) for each in told if issubclass(each.category, FhashWarning)]
    told.clear()
    return texts
