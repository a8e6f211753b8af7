"""Encoding on a cluster of dask: the plan is made once and sent, workers code parts, one is made.

Each task works in one thread of a worker. The first ones scan a long series, whose figures the
client joins (features/scan.py). Then each codes a part of it (parts.py) and returns the bytes of
its file. The client keeps these in files beside the output and joins them (parts.py). So it holds
the results of a few tasks at a time, and the output is complete or absent. The client needs to have
the methods `submit` and, for arrays of dask, `compute`; dask is not imported.
"""

from __future__ import annotations

import math
import os
import time
from asyncio import CancelledError
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from copy import copy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.appending.parts import Part, encode_part, join_parts
from fhash_codec.appending.series_plan import SeriesPlan, bounded
from fhash_codec.compact.tiles import fits_memory
from fhash_codec.comparison import EncodeReport, report
from fhash_codec.config import EncodeConfig
from fhash_codec.features.features import InTime, parse_feature
from fhash_codec.features.scan import Scan, SpanScan
from fhash_codec.features.selection import Source, mask_files, open_source
from fhash_codec.header import check_name
from fhash_codec.measure.value_range import Ranks
from fhash_codec.progress import Progress, recording, silent, stage
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import ClusterError, InputError
from fhash_formats.series import Series
from fhash_formats.support import files as leftovers
from fhash_formats.support.files import check_output, explained, local_path
from fhash_formats.support.threads import at_most

__all__ = ["HeldSteps", "encode_on_cluster"]

PART_BYTES = 256 << 20
"""Bytes of the values of a task, unless one layer of tiles, or one frame, has more."""
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
) -> EncodeReport:
    """Encode a series on the workers of a dask client; see `fhash_codec.encode`.

    source: a file that all workers see, or a labelled or plain array of dask. The client reads the
        sample of the plan. It also reads all frames once, one after the other, of a series that is
        short, has missing values, or of which features are kept.

    Raises ClusterError where a task fails on the cluster; the others are then cancelled, as they
    are by Ctrl-C.
    """
    path, config = Path(os.path.normpath(path)), bounded(config)
    begun = time.perf_counter()
    check_name(path)
    check_output(path, force)
    with recording() as clock, open_source(source) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        submit = _submit_to(client, source, series)
        known = _scanned(client, submit, series, config, progress)
        plan = SeriesPlan.make(series, config, progress, known)
        with _folder_beside(path) as folder:
            with stage("coding", "parts of the series, on the cluster"):
                parts = _code(client, submit, plan, folder, progress)
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


def run_on_worker(
    work: Callable[..., Any],
    source: str | HeldSteps,
    first: int,
    frames: npt.NDArray[Any] | None,
    *arguments: Any,
) -> Any:
    """The result of `work(series, *arguments)` in one thread, on a worker.

    source: a path, or labels, for which `frames` are those of the steps from `first` on.
    """
    held = source if frames is None or isinstance(source, str) else source.with_steps(first, frames)
    with at_most(1), open_source(held) as series:
        return work(series, *arguments)


def code_part(series: Series, plan: bytes, number: int, of: int) -> bytes:
    """Code a part; the bytes of its file. plan: as `SeriesPlan.to_bytes` returns it."""
    with TemporaryDirectory(prefix="fhash-") as folder:
        file = Path(folder) / "part.fhz"
        known = SeriesPlan.from_bytes(plan)
        encode_part(series, file, None, Part(number=number, of=of), plan=known)
        return file.read_bytes()


Submit = Callable[..., Any]
"""Function (work, steps, *arguments, whole=False) that begins a task and returns its future.

steps: that the task needs. whole: whether it needs all that belongs to the series.
"""


def _submit_to(client: Any, source: Source, series: Series) -> Submit:
    """The way to begin tasks on a source; raises InputError where others cannot read it."""
    if isinstance(source, str | Path):
        local = local_path(source)
        path = str(source) if local is None else os.path.abspath(local)

        def read_file(work: Any, steps: range, *arguments: Any, whole: bool = False) -> Any:
            return client.submit(run_on_worker, work, path, 0, None, *arguments)

        return read_file
    array = series.lazy
    if array is not None:
        labels = {whole: HeldSteps(series, whole=whole) for whole in (False, True)}

        def take_frames(work: Any, steps: range, *arguments: Any, whole: bool = False) -> Any:
            frames = client.compute(array[steps.start : steps.stop])
            first = steps.start
            return client.submit(run_on_worker, work, labels[whole], first, frames, *arguments)

        return take_frames
    raise InputError(
        f"{series.source}: client= codes on other machines, which read a file by its path, or an "
        "array of dask (xarray.open_dataset(..., chunks={})); leave client out for other sources"
    )


def _scanned(
    client: Any, submit: Submit, series: Series, config: EncodeConfig, progress: Progress
) -> tuple[Scan, Ranks] | None:
    """The scan of a long series of which everything is kept, and the ranks of its values.

    None for another series, and for one with missing values: the client scans it by itself.
    """
    if fits_memory(series) or config.features != ("all",):
        return None
    total, frame = series.shape[0], series.dtype.itemsize * math.prod(series.shape[1:])
    length = max(1, PART_BYTES // frame)
    spans = [range(first, min(first + length, total)) for first in range(0, total, length)]
    begin = [lambda span=span: submit(SpanScan, span, span) for span in spans]
    names = [f"the scan of steps {span.start} to {span.stop - 1}" for span in spans]

    def reported(results: Iterator[Any]) -> Iterator[Any]:
        for span, result in zip(spans, results, strict=True):
            progress("scanning", span.stop, total, "")
            yield result

    with (
        stage("scan", "range of all values, on the cluster"),
        closing(_results(begin, names, _threads(client))) as results,
    ):
        return SpanScan.joined(series, reported(results))


def _code(
    client: Any, submit: Submit, plan: SeriesPlan, folder: Path, progress: Progress
) -> list[Path]:
    """Code all parts on the cluster; their files, in a folder."""
    threads, packed, files = _threads(client), plan.to_bytes(), list[Path]()
    parts = _split(plan, threads)
    # A feature of what happens in time looks at the steps beside each step.
    beside = any(isinstance(parse_feature(text), InTime) for text in plan.features)

    def begin(part: Part) -> Any:
        own = plan.steps(part.layers(plan.layers))
        steps = range(max(own.start - beside, 0), min(own.stop + beside, plan.shape[0]))
        whole = part.number == 1
        return submit(code_part, steps, packed, part.number, part.of, whole=whole)

    begins = [lambda part=part: begin(part) for part in parts]
    names = [f"part {part.number}/{part.of}" for part in parts]
    with closing(_results(begins, names, threads)) as results:
        for part, data in zip(parts, results, strict=True):
            files.append(folder / f"{part.number}.fhz")
            _write(files[-1], data)
            progress("coding", part.number, part.of, "parts")
    return files


def _results(
    begin: Sequence[Callable[[], Any]], names: Sequence[str], threads: int
) -> Generator[Any]:
    """Yield the results of tasks in their order, a few of which are under way at a time.

    begin: begins each task, and returns its future. names: of the tasks, for messages. Those under
    way are cancelled where the iteration ends early. Raises ClusterError where one fails.
    """
    waiting = deque[Any]()
    try:
        for number, name in enumerate(names):
            while len(waiting) < AHEAD * threads and number + len(waiting) < len(begin):
                waiting.append(begin[number + len(waiting)]())
            yield _result(waiting[0], name)
            waiting.popleft()
    finally:
        for future in waiting:
            with suppress(Exception):  # of a cluster that is gone
                future.cancel()


def _result(future: Any, name: str) -> Any:
    """The result of a task; raises ClusterError where it failed."""
    try:
        return future.result()
    except (Exception, CancelledError) as error:
        reason = " ".join(str(error).split()) or "no reason is told"
        raise ClusterError(
            f"{name} failed on the cluster: {type(error).__name__}: {reason[:400]}"
        ) from error


def _write(file: Path, data: bytes) -> None:
    """Write a file of the client; raises OutputError."""
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


def _split(plan: SeriesPlan, threads: int) -> list[Part]:
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
