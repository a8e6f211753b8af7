"""Running many cases in several processes: one that dies or hangs is a failure of its case, and no more."""

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

__all__ = ["LONGEST", "run_cases"]

LONGEST = 600.0
"""Seconds that a case may take."""


def run_cases(
    cases: Sequence[Case],
    *,
    everything: bool = False,
    processes: int | None = None,
    longest: float = LONGEST,
    progress: Progress = silent,
) -> Summary:
    """The results of cases of the catalogue, in their order; with `everything` under the settings of the long set too.

    processes: that work at the same time, by default one for each processor. Progress stage: "testing".
    """
    count = max(1, min(processes or usable_threads(), len(cases)))
    idle: SimpleQueue[_Worker] = SimpleQueue()
    workers = [_Worker(everything) for _ in range(count)]
    for worker in workers:
        idle.put(worker)

    def one(case: Case) -> CaseResult:
        worker = idle.get()
        try:
            return worker.run(case, longest)
        finally:
            idle.put(worker)

    results = []
    pool = ThreadPoolExecutor(count, thread_name_prefix="fhash-selftest")
    try:
        # The processes share the machine already; BLAS and torch read this when they are loaded there.
        with environment(OMP_NUM_THREADS=os.environ.get("OMP_NUM_THREADS", "1")):
            for result in pool.map(one, cases):
                results.append(result)
                progress("testing", len(results), len(cases), result.name)
    finally:
        # After an interruption nothing new begins, and no thread waits for a process.
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.end()
        pool.shutdown()
    return Summary(results=results)


class _Worker:
    """A process that runs cases by their names, made when it is first needed and anew after it died."""

    def __init__(self, everything: bool) -> None:
        self._everything = everything
        self._process: Any = None
        self._pipe: Any = None

    def run(self, case: Case, longest: float) -> CaseResult:
        """The result of a case; that the process died, or took too long, is one."""
        if self._process is None:
            self._start()
        try:
            self._pipe.send(case.name)
            if not self._pipe.poll(longest):
                self._stop()
                return _broken(case, f"took longer than {longest:g} s")
            return CaseResult.from_dict(self._pipe.recv())
        except (EOFError, OSError):
            code = self._stop(patience=5)
            return _broken(case, f"the process ended with {code}")

    def end(self) -> None:
        """End the process, whatever it is at."""
        self._stop()

    def _start(self) -> None:
        # Not forked: this process may have threads, and torch does not survive it.
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, self._everything), daemon=True)
        self._process.start()
        other.close()

    def _stop(self, *, patience: float = 0) -> int | None:
        """End the process, after so many seconds in which it may end by itself; its exit code."""
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
    """Run the cases whose names come in, until the other end closes."""
    from fhash_codec.selftest.cases.catalogue import chosen
    from fhash_codec.selftest.runner import run_case

    try:
        while True:
            (case,) = chosen(names=[pipe.recv()])
            pipe.send(run_case(case, everything=everything).to_dict())
    except (EOFError, OSError, KeyboardInterrupt):
        return
