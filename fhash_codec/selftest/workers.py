"""Worker processes for many cases. A process that dies or hangs is a failure of its case only."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from fhash_codec.progress import Progress, silent
from fhash_codec.selftest.case import Case
from fhash_codec.selftest.environment import environment
from fhash_codec.selftest.results import CaseResult, Summary
from fhash_formats.support.threads import usable_threads

__all__ = ["MAX_SECONDS", "run_cases"]

MAX_SECONDS = 600.0
"""Longest time of one case, in seconds."""


def run_cases(
    cases: Sequence[Case],
    *,
    everything: bool = False,
    processes: int | None = None,
    max_seconds: float = MAX_SECONDS,
    progress: Progress = silent,
) -> Summary:
    """The results of cases of the catalogue, in the order of `cases`. Progress stage: "testing".

    Args:
        cases: cases of the catalogue; workers look them up by name.
        everything: whether the additional settings of the long set are run, too.
        processes: number of processes, by default one for each processor.
        max_seconds: max_seconds time of one case, in seconds.
        progress: called after each case.
    """
    count = max(1, min(processes or usable_threads(), len(cases)))
    idle: SimpleQueue[_Worker] = SimpleQueue()
    workers = [_Worker(everything) for _ in range(count)]
    for worker in workers:
        idle.put(worker)

    def run_one(case: Case) -> CaseResult:
        worker = idle.get()
        try:
            return worker.run(case, max_seconds)
        finally:
            idle.put(worker)

    results = []
    pool = ThreadPoolExecutor(count, thread_name_prefix="fhash-selftest")
    try:
        # One thread for each process; BLAS and torch read the variable when they are loaded there.
        with environment(OMP_NUM_THREADS=os.environ.get("OMP_NUM_THREADS", "1")):
            for result in pool.map(run_one, cases):
                results.append(result)
                progress("testing", len(results), len(cases), result.name)
    finally:
        # After an interruption no case is started, and no thread waits for a process.
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.end()
        pool.shutdown()
    return Summary(results=results)


class _Worker:
    """A process that runs cases by name. It starts at the first case, and again after it died."""

    def __init__(self, everything: bool) -> None:
        self._everything = everything
        self._process: Any = None
        self._pipe: Any = None

    def run(self, case: Case, max_seconds: float) -> CaseResult:
        """The result of a case; if the process dies or takes too long, the result says so."""
        if self._process is None:
            self._start()
        try:
            self._pipe.send(case.name)
            if not self._pipe.poll(max_seconds):
                self._stop()
                return _broken(case, f"took longer than {max_seconds:g} s")
            return CaseResult.from_dict(self._pipe.recv())
        except (EOFError, OSError):
            code = self._stop(patience=5)
            return _broken(case, f"the process ended with {code}")

    def end(self) -> None:
        """End the process, even if it is busy."""
        self._stop()

    def _start(self) -> None:
        # Not forked: this process may have threads, and torch does not survive a fork.
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, self._everything), daemon=True)
        self._process.start()
        other.close()

    def _stop(self, *, patience: float = 0) -> int | None:
        """End the process and return its exit code. It has `patience` seconds to end by itself."""
        process, self._process = self._process, None
        if process is None:
            return None
        process.join(patience)
        process.terminate()
        process.join(5)
        if process.exitcode is None:
            process.kill()
            process.join()
        return int(process.exitcode)


def _broken(case: Case, line: str) -> CaseResult:
    return CaseResult(
        name=case.name,
        group=case.group,
        about=case.about,
        under=tuple(case.settings),
        errors=(line,),
    )


def _serve(pipe: Connection, everything: bool) -> None:
    """Run the cases whose names arrive on the pipe, until its other end closes."""
    from fhash_codec.selftest.cases.catalogue import choose_cases
    from fhash_codec.selftest.runner import run_case

    try:
        while True:
            (case,) = choose_cases(names=[pipe.recv()])
            pipe.send(run_case(case, everything=everything).to_dict())
    except (EOFError, OSError, KeyboardInterrupt):
        return
