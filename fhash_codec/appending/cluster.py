"""Encoding on a cluster of dask: the plan is made once and sent, workers code parts, one is made.

Each task is a part of the series (parts.py), coded by one thread of a worker, which returns the
bytes of its file. The client keeps these in files beside the output and joins them (merging.py). So
it holds a few parts at a time, and the output is complete or absent. Of the client this needs
`submit` and, for arrays of dask, `compute`; dask is not imported.
"""

from __future__ import annotations

import math
import os
import time
from asyncio import CancelledError
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import copy
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.merging import join_parts
from fhash_codec.appending.parts import Part, encode_part
from fhash_codec.appending.series_plan import SeriesPlan, bounded
from fhash_codec.config import EncodeConfig
from fhash_codec.container_name import check_name
from fhash_codec.coreset.features import InTime, parse_feature
from fhash_codec.coreset.lazy import LazyFrames
from fhash_codec.coreset.selection import Source, mask_files, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.report import report
from fhash_codec.stage_clock import recording, stage
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import ClusterError, InputError
from fhash_formats.series import Series
from fhash_formats.support import leftovers
from fhash_formats.support.atomic import check_output, explained
from fhash_formats.support.locations import local_path
from fhash_formats.support.threads import at_most

__all__ = ["HeldSteps", "code_part", "encode_on_cluster"]

PART_BYTES = 256 << 20
"""Bytes of the values of a part, unless one layer of tiles has more."""
PARTS_PER_THREAD = 4
"""Parts for each thread of the cluster, where there are layers enough: threads are not equally
fast."""
AHEAD = 2
"""Parts that are under way or wait for the client, for each thread of the cluster."""
UNKNOWN_THREADS = 8
"""Threads that a cluster is taken to have where it does not tell, or has none yet."""


def encode_on_cluster(
    source: Source,
    path: str | Path,
    config: EncodeConfig,
    client: Any,
    *,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Encode a series on the workers of a dask client; see `fhash_codec.encode`.

    source: a file that all workers see, or a labelled or plain array of dask. The client reads all
        frames of it once for their range, one after the other, and the sample of the plan.

    Raises ClusterError where a part fails on the cluster; the other parts are then cancelled, as
    they are by Ctrl-C.
    """
    path, config = Path(os.path.normpath(path)), bounded(config)
    begun = time.perf_counter()
    check_name(path)
    check_output(path, force)
    with recording() as clock, open_source(source) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        jobs = _jobs_of(source, series)
        plan = SeriesPlan.make(series, config, progress)
        with _folder_beside(path) as folder:
            with stage("coding", "parts of the series, on the cluster"):
                parts = _code(client, jobs, plan, folder, progress)
            series.check()
            with stage("writing", "the parts become one file"):
                joined = join_parts(parts, path, force=force, progress=progress)
        with open_volume(path) as volume:
            seconds = time.perf_counter() - begun
            figures = report(volume, joined.quality, seconds=seconds, files=series.files)
    return {**figures, "stages": clock.to_list()}


class HeldSteps(Series):
    """The labels of a series, and some of its steps in memory; it can be sent to other processes.

    Attributes:
        first: number of the first of these steps.
        values: frames (steps, z, y, x) from that one on.
    """

    def __init__(self, series: Series, *, whole: bool) -> None:
        """Take the labels of a series; with `whole` all that belongs to it in its source."""
        self.source, self.name, self.units = series.source, series.name, series.units
        self.dtype, self.shape, self.coords = series.dtype, series.shape, dict(series.coords)
        self.attributes = dict(series.attributes)
        self.inherit(series)
        if whole and series.metadata is not None:
            self.metadata = series.metadata
        self.first, self.values = 0, np.empty((0, *series.shape[1:]), series.dtype)

    def with_steps(self, first: int, values: npt.NDArray[Any]) -> HeldSteps:
        """The same labels with the frames of some steps, from `first` on."""
        other = copy(self)
        other.first, other.values = first, values
        return other

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        if not 0 <= step - self.first < len(self.values):
            raise InputError(f"{self.source}: step {step} was not sent to this worker")
        return np.ascontiguousarray(self.values[step - self.first], dtype=self.dtype)


def code_part(
    source: str | HeldSteps,
    plan: bytes,
    number: int,
    of: int,
    first: int = 0,
    frames: npt.NDArray[Any] | None = None,
) -> bytes:
    """Code a part in one thread, on a worker; the bytes of its file.

    source: a path, or labels, for which `frames` are those of the steps from `first` on.
    plan: as `SeriesPlan.to_bytes` returns it.
    """
    if isinstance(source, HeldSteps):
        assert frames is not None
        source = source.with_steps(first, frames)
    with TemporaryDirectory(prefix="fhash-") as folder, at_most(1):
        file = Path(folder) / "part.fhz"
        known = SeriesPlan.from_bytes(plan)
        encode_part(source, file, None, Part(number=number, of=of), plan=known)
        return file.read_bytes()


class _FileJobs:
    """Tasks that read a file, which has the same path on all workers."""

    def __init__(self, place: str) -> None:
        self._place = place

    def submit(self, client: Any, plan: SeriesPlan, packed: bytes, part: Part) -> Any:
        """Begin to code a part; its future."""
        return client.submit(code_part, self._place, packed, part.number, part.of)


class _ArrayJobs:
    """Tasks that get the frames of a dask array from tasks that compute them on the workers."""

    def __init__(self, series: Series, lazy: LazyFrames) -> None:
        self._first = HeldSteps(series, whole=True)
        self._others = HeldSteps(series, whole=False)
        self._lazy = lazy

    def submit(self, client: Any, plan: SeriesPlan, packed: bytes, part: Part) -> Any:
        """Begin to code a part; its future."""
        steps = plan.steps(part.layers(plan.layers))
        # A feature of what happens in time looks at the steps beside each step.
        beside = any(isinstance(parse_feature(text), InTime) for text in plan.features)
        first = max(steps.start - beside, 0)
        frames = client.compute(self._lazy.array[first : steps.stop + beside])
        labels = self._first if part.number == 1 else self._others
        return client.submit(code_part, labels, packed, part.number, part.of, first, frames)


def _jobs_of(source: Source, series: Series) -> _FileJobs | _ArrayJobs:
    """The tasks for a source; raises InputError for one that other machines cannot read."""
    if isinstance(source, str | Path):
        local = local_path(source)
        return _FileJobs(str(source) if local is None else os.path.abspath(local))
    lazy = getattr(series, "lazy", None)
    if isinstance(lazy, LazyFrames):
        return _ArrayJobs(series, lazy)
    raise InputError(
        f"{series.source}: client= codes on other machines, which read a file by its path, or an "
        "array of dask (xarray.open_dataset(..., chunks={})); leave client out for other sources"
    )


def _code(
    client: Any, jobs: _FileJobs | _ArrayJobs, plan: SeriesPlan, folder: Path, progress: Progress
) -> list[Path]:
    """Code all parts on the cluster, a few of them at a time; their files, in a folder."""
    threads = _threads(client)
    parts = _parts(plan, threads)
    packed, waiting, files = plan.to_bytes(), deque[Any](), list[Path]()
    begin = partial(jobs.submit, client, plan, packed)
    try:
        for part in parts[: AHEAD * threads]:
            waiting.append(begin(part))
        for part in parts:
            data = _result(waiting[0], part)
            waiting.popleft()
            file = folder / f"{part.number}.fhz"
            _write(file, data)
            files.append(file)
            if part.number + AHEAD * threads <= part.of:
                waiting.append(begin(parts[part.number + AHEAD * threads - 1]))
            progress("coding", part.number, part.of, "parts")
    finally:
        for future in waiting:
            with suppress(Exception):  # of a cluster that is gone
                future.cancel()
    return files


def _result(future: Any, part: Part) -> bytes:
    """The file of a part; raises ClusterError where it could not be made."""
    try:
        data = future.result()
    except (Exception, CancelledError) as error:
        reason = " ".join(str(error).split()) or "no reason is told"
        raise ClusterError(
            f"part {part.number}/{part.of} failed on the cluster: {type(error).__name__}: "
            f"{reason[:400]}"
        ) from error
    if not isinstance(data, bytes):
        raise ClusterError(
            f"part {part.number}/{part.of}: the cluster returned {type(data).__name__}; results of "
            "client.submit(...).result() are needed"
        )
    return data


def _write(file: Path, data: bytes) -> None:
    try:
        file.write_bytes(data)
    except OSError as error:
        raise explained(file, error) from error


def _threads(client: Any) -> int:
    """Threads of all workers of a cluster."""
    try:
        told = client.nthreads()
    except AttributeError:
        return UNKNOWN_THREADS
    return (sum(told.values()) if isinstance(told, Mapping) else 0) or UNKNOWN_THREADS


def _parts(plan: SeriesPlan, threads: int) -> list[Part]:
    """The parts of a series, for a cluster of some threads."""
    item = np.dtype(plan.labels["dtype"]).itemsize
    by_size = -(-math.prod(plan.shape) * item // PART_BYTES)
    count = min(plan.layers, max(by_size, PARTS_PER_THREAD * threads))
    return [Part(number=number, of=count) for number in range(1, count + 1)]


@contextmanager
def _folder_beside(path: Path) -> Iterator[Path]:
    """A folder for parts beside the output, removed at the end.

    That of a killed process is removed by the next writer of the output.
    """
    target = Path(os.path.realpath(path))
    folder = target.with_name(leftovers.new_stem(target.name) + leftovers.PARTIAL)
    try:
        folder.mkdir()
    except OSError as error:
        raise explained(path, error) from error
    try:
        yield folder
    finally:
        leftovers.remove(folder)
