"""Other codecs in `fhash cost`: SZ3, SPERR and ZFP at a few qualities, each trial timed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.rate.peers import (
    Variant,
    filled,
    opened_file,
    peers,
    read_all,
    stored,
    stored_bytes,
)
from fhash_codec.bench.rate.search import EXACT, UNIFORM, Search, Trial, trial_of
from fhash_codec.cost.allowance import Allowance, BudgetSpentError
from fhash_codec.cost.facts import Facts
from fhash_codec.cost.plan import Wish
from fhash_codec.cost.results import Encoded
from fhash_codec.progress import Progress
from fhash_codec.volume import decoded_type
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import Series

__all__ = ["PeerEncodings"]

MAX_BYTES = 1 << 30
"""Largest series for peers, which hold all of it in memory."""
TRIALS = 3
"""New trials for a quality, at most."""
SLACK = 0.5
"""dB above a quality at which its search ends."""
PEER_SHARE = 0.15
"""Share of the time left for encoding that a peer may take at a quality."""
LAYOUTS = {
    "SZ3": ("frame", "series"),
    "SPERR": ("frame", "plane"),
    "ZFP": ("frame", "series"),
}
"""Layouts of each peer that are tried; `fhash bench rate` tries more."""
USUAL_RATE = 20e6
"""Bytes a second of a peer that was not measured yet."""


class PeerEncodings:
    """Peers on one series.

    A search sets each peer to a PSNR over all frames. Its first quality tries all layouts and keeps
    the smallest.

    Attributes:
        points: what was measured.
    """

    def __init__(
        self, series: Series, facts: Facts, folder: Path, allowance: Allowance, progress: Progress
    ) -> None:
        """Prepare; nothing is read yet.

        folder: place of a file, which the caller removes.
        """
        self._series, self._facts, self._path = series, facts, folder / "peer.h5"
        self._allowance, self._progress = allowance, progress
        self._values: npt.NDArray[Any] | None = None
        self._searches: dict[str, list[tuple[Variant, Search]]] = {}
        self._trials: dict[tuple[str, float], Encoded] = {}
        self._seconds: dict[str, float] = {}
        self._missing_told = False
        self._done: set[str] = set()
        self._end = 0.0
        self.points: list[Encoded] = []

    def measure(self, wish: Wish) -> None:
        """Measure a peer at a quality, once, where there is time for it."""
        if wish.name in self._done:
            return
        if not self._prepared(wish):
            return
        expected = self._seconds.get(wish.codec, self._facts.raw_bytes / USUAL_RATE)
        searches = self._searches[wish.codec]
        if not self._allowance.has(wish.name, expected * len(searches)):
            return
        self._end = self._allowance.spent + PEER_SHARE * self._allowance.left
        self._progress("comparing", 0, 1, wish.name)
        found: list[tuple[Variant, Search, Trial]] = []
        with self._allowance.work(wish.name):
            for variant, search in searches:
                trial = self._find(variant, search, wish.target)
                if trial is not None:
                    found.append((variant, search, trial))
        self._progress("comparing", 1, 1, wish.name)
        if found:
            variant, search, best = min(
                found, key=lambda entry: (entry[2].psnr < wish.target, entry[2].bytes)
            )
            self._done.add(wish.name)
            self._searches[wish.codec] = [(variant, search)]
            point = self._trials[variant.name, best.level]
            if point not in self.points:
                self.points.append(point)

    def _prepared(self, wish: Wish) -> bool:
        """Whether a peer can be measured; the values are read for the first one."""
        if wish.codec in self._searches:
            return True
        if self._missing_told:
            return False
        try:
            if self._facts.raw_bytes > MAX_BYTES:
                raise InputError("the series is held in memory for them, and has more than 1 GiB")
            variants = peers()
        except (MissingDependencyError, InputError) as error:
            self._allowance.leave_out("SZ3, SPERR, ZFP", str(error))
            self._missing_told = True
            return False
        if self._values is None:
            self._values = self._read()
        self._searches[wish.codec] = [
            (variant, self._search(variant))
            for variant in variants[wish.codec]
            if "psnr" in variant.goals
            and variant.mode != "rate"
            and variant.layout in LAYOUTS[wish.codec]
        ]
        return True

    def _read(self) -> npt.NDArray[Any]:
        values = np.stack(list(self._series.frames()))
        floats = np.asarray(values, dtype=decoded_type(values.dtype))
        return filled(floats) if self._facts.missing else floats

    def _search(self, variant: Variant) -> Search:
        return Search(lambda level: self._trial(variant, level), step=variant.step)

    def _find(self, variant: Variant, search: Search, target: float) -> Trial | None:
        """The smallest trial that reaches a PSNR in dB; the closest where time does not allow it.

        None where no trial was made.
        """
        first = target - UNIFORM if variant.mode == "tolerance" else target
        try:
            found = search.find("psnr", target, first=first, slack=SLACK, most=TRIALS)
        except InputError as error:
            self._allowance.leave_out(f"{variant.name}, {target:g} dB", str(error))
            return None
        except BudgetSpentError:
            found = None
        trials = search.trials.values()
        return found or min(trials, key=lambda trial: abs(trial.psnr - target), default=None)

    def _trial(self, variant: Variant, level: float) -> Trial:
        """Encode, decode and measure at a level; raises BudgetSpentError where time is over."""
        if self._allowance.spent > self._end and self._trials:
            raise BudgetSpentError
        assert self._values is not None
        facts = self._facts
        begun = time.perf_counter()
        with stored(self._values, variant, facts.width, level, self._path):
            pass
        seconds = time.perf_counter() - begun
        with opened_file(self._path) as file:
            decoded, count = read_all(file, variant, self._values.shape), stored_bytes(file)
        errors = facts.errors()
        for step, frame in enumerate(decoded):
            errors.add(step, self._series.read(step), frame)
        self._seconds[variant.peer] = time.perf_counter() - begun
        trial = trial_of(errors, level, count)
        bulk = errors.bulk_quality()
        exact = trial.psnr == EXACT
        self._trials[variant.name, trial.level] = Encoded(
            name=f"{variant.name}, {trial.psnr:.1f} dB",
            codec=variant.peer,
            group=variant.peer,
            seconds=seconds,
            bytes=count,
            ratio=facts.raw_bytes / count,
            psnr=None if exact else trial.psnr,
            psnr_bulk=None if bulk is None else bulk.psnr,
            max_abs_error=errors.max_abs_error,
            exact=exact,
        )
        return trial
