"""Plan of `fhash cost`: what is tried, on which part of the series, and in how much time."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.config import EncodeConfig, options_beyond
from fhash_codec.cost.results import DEFAULT, NETWORK, TRAINING, LeftOut, seconds_text
from fhash_codec.features.features import Extent
from fhash_codec.features.selection import select_features
from fhash_codec.measure.errors import Errors, find_bulk
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import FhashError
from fhash_formats.series import Series, StepsSeries

QUICK = 0.2
"""Seconds below which an encoding is repeated: one run of so short a time is mostly noise."""
RUNS = 3
"""Runs of such an encoding; the fastest counts, as the least disturbed one."""
OVERRUN = 0.25
"""Share of its time by which work that has begun may exceed it."""


class BudgetSpentError(Exception):
    """The end of work whose time is over, with why; it never leaves this room."""


class Allowance:
    """A number of seconds that is spent part by part.

    Attributes:
        seconds: all of them.
        left_out: what was not measured so far, and why.
        interrupted: whether Ctrl-C ended the measurements.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.perf_counter) -> None:
        """Begin to spend; clock gives seconds."""
        self.seconds, self._clock = seconds, clock
        self._begun = clock()
        self._end = seconds
        self.left_out: list[LeftOut] = []
        self.interrupted = False

    @property
    def spent(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._begun

    @property
    def left(self) -> float:
        """Seconds until the end of the present part, 0 at least."""
        return max(self._end - self.spent, 0.0)

    def part(self, share: float) -> None:
        """Begin a part that may take a share, 0 to 1, of all seconds that are left."""
        self._end = self.spent + share * max(self.seconds - self.spent, 0.0)

    def has(self, what: str, seconds: float, *, share: float = 1.0) -> bool:
        """Whether work of some seconds fits in a share of what is left of the part.

        Where it does not, it is noted as left out; where it does, an older note of it is dropped.
        """
        if self.interrupted:
            self.leave_out(what, "interrupted")
            return False
        allowed = share * self.left
        if seconds <= allowed and allowed > 0:
            self.left_out = [entry for entry in self.left_out if entry.what != what]
            return True
        why = f"needs about {seconds:.3g} s; {allowed:.3g} s were left for it"
        self.leave_out(what, why, late=True)
        return False

    def leave_out(self, what: str, why: str, *, late: bool = False) -> None:
        """Note what is not measured, in place of an older note; late: time alone is wanting."""
        self.left_out = [entry for entry in self.left_out if entry.what != what]
        self.left_out.append(LeftOut(what=what, why=why, late=late))

    @contextmanager
    def work(self, what: str) -> Iterator[None]:
        """A block of work; noted as left out where it fails, its time is over or Ctrl-C comes."""
        try:
            yield
        except BudgetSpentError as error:
            self.leave_out(what, str(error), late=True)
        except FhashError as error:
            self.leave_out(what, str(error))
        except KeyboardInterrupt:
            self.interrupted = True
            self.leave_out(what, "interrupted")

    def guard(self, progress: Progress, *, share: float = 1.0) -> Progress:
        """A progress callback that raises BudgetSpentError where its time is over.

        share: share of what is left of the part now; OVERRUN of it is added.
        """
        given = share * self.left * (1 + OVERRUN)
        end = self.spent + given

        def guarded(stage: str, done: int, total: int, note: str) -> None:
            progress(stage, done, total, note)
            if self.spent > end:
                raise BudgetSpentError(
                    f"stopped after {seconds_text(given)}, its share of the time"
                )

        return guarded


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Figures of a series.

    Attributes:
        value_range, bulk: in data units; bulk is of the coreset; None where its middle 98 %
            have no width.
        missing: number of values that are not finite.
        coreset: the vertices whose errors count; None for all.
        sample: whether the values are a sample, and `value_range` is that of the whole series.
        decibels: width of that range over that of the sample, 0 or more.
    """

    value_range: ValueRange
    bulk: ValueRange | None
    missing: int
    raw_bytes: int
    coreset: Extent | None = None
    sample: bool = False
    decibels: float = 0.0

    @property
    def width(self) -> float:
        """Width of the range, in data units."""
        return self.value_range.high - self.value_range.low

    @property
    def scale(self) -> float:
        """Power of two that brings differences of values near 1."""
        return power_of_two(self.width)

    def errors(self) -> Errors:
        """Errors without a frame yet."""
        return Errors(self.width, self.bulk)

    def mask(self, step: int) -> npt.NDArray[np.bool_] | None:
        """Mask (z, y, x) of the vertices whose errors count at a step; None for all."""
        if self.coreset is None:
            return None
        mask = np.zeros(self.coreset.domain, dtype=np.bool_)
        mask[self.coreset.box.slices()] = self.coreset.mask(step)
        return mask


EVERYTHING = ("all",)
"""Features of a series that is encoded in whole."""


def facts_of(series: Series, progress: Progress, features: tuple[str, ...] = EVERYTHING) -> Facts:
    """Scan a series; raises InputError for one without a finite value or vertex of the features."""
    selected = select_features(series, EncodeConfig(features=features), progress)
    scanned, value_range = selected.scanned, selected.scanned.value_range
    count = prod(series.shape)
    facts = Facts(
        value_range=value_range,
        bulk=None,
        missing=count - scanned.finite_count,
        raw_bytes=count * series.dtype.itemsize,
        coreset=None if "all" in features else selected.extent,
    )

    def counted_values() -> Iterator[npt.NDArray[Any]]:
        for step, frame in enumerate(series.frames()):
            mask = facts.mask(step)
            yield frame if mask is None else frame[mask]

    bulk = find_bulk(counted_values, value_range, whole=series.dtype.kind in "iu")
    return replace(facts, bulk=bulk)


MIN_STEPS = 8
"""Steps that a part keeps at least where the series has them: time is what is compressed, too."""


class CroppedSeries(Series):
    """Some steps and a region of another series, which closes it."""

    def __init__(self, series: Series, steps: range, region: Box) -> None:
        """Take steps, and a region (z, y, x) in vertices of the domain."""
        self.series, self.steps, self.region = series, steps, region
        self.source, self.name, self.units = series.source, series.name, series.units
        self.dtype, self.attributes, self.files = series.dtype, series.attributes, series.files
        self.inherit(series)
        self.shape = (len(steps), *region.shape)
        ends = {"t": (steps[0], steps[-1] + 1), **dict(zip("zyx", region, strict=True))}
        self.coords = {
            axis: replace(series.coords[axis], values=series.coords[axis].values[slice(*span)])
            for axis, span in ends.items()
        }

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        return np.ascontiguousarray(self.series.read(self.steps[step])[self.region.slices()])

    def check(self) -> None:
        self.series.check()

    def close(self) -> None:
        self.series.close()


def cropped(series: Series, vertices: int, around: Box | None = None) -> Series:
    """The series itself, or a part of it with at most about as many vertices as given.

    Steps in the middle are taken first, down to MIN_STEPS; then all axes in space are shortened
    alike around the middle of the domain, or of a part of it.
    """
    steps, *space = series.shape
    if prod(series.shape) <= vertices:
        return series
    kept = max(min(MIN_STEPS, steps), min(steps, vertices // prod(space)))
    lengths = _shortened(space, vertices / kept)
    first = (steps - kept) // 2
    starts = [
        min(max((low + high - length) // 2, 0), n - length)
        for n, length, (low, high) in zip(
            space, lengths, Box.of_shape(space) if around is None else around, strict=True
        )
    ]
    region = Box.of_shape(lengths).shift(starts)
    return CroppedSeries(series, range(first, first + kept), region)


def _shortened(space: Sequence[int], vertices: float) -> list[int]:
    """Lengths of a box of about so many vertices, in the proportions of another one."""
    if prod(space) <= vertices:
        return list(space)
    free = [n for n in space if n > 1]
    share = (vertices / prod(space)) ** (1 / len(free)) if free else 1.0
    return [max(1, round(n * share)) if n > 1 else 1 for n in space]


def described(series: Series) -> str:
    """The part of the source that a series is, in words."""
    if not isinstance(series, CroppedSeries | StepsSeries):
        return "the whole series"
    share = 100 * prod(series.shape) / prod(series.series.shape)
    steps = f"{series.shape[0]} of {series.series.shape[0]} steps"
    ends = zip("zyx", series.region, strict=True) if isinstance(series, CroppedSeries) else ()
    region = "".join(f", {axis} {low}:{high}" for axis, (low, high) in ends)
    return f"a sample, {share:.2g} % of the series: {steps}{region}"


PEERS = ("SZ3", "SPERR", "ZFP")
"""Peers that are measured where their package is there."""


@dataclass(frozen=True, kw_only=True)
class Wish:
    """An encoding to be measured.

    Attributes:
        codec: the preset, or a peer.
        group: the curve that it belongs to.
        config: settings; None for a peer.
        target: PSNR in dB that a peer is set to.
    """

    codec: str
    group: str
    config: EncodeConfig | None = None
    target: float = 0.0

    @property
    def name(self) -> str:
        """The encoding in words."""
        if self.config is None:
            return f"{self.codec}, {self.target:g} dB"
        if self.config.max_error_rel is not None:
            return f"{self.group}, error within {100 * self.config.max_error_rel:g} %"
        if self.config.psnr is not None:
            return f"{self.group}, {self.config.psnr:g} dB"
        if self.group == TRAINING:
            return f"{TRAINING} {self.config.train}"
        return NETWORK if self.config.published else DEFAULT

    @property
    def always(self) -> bool:
        """Whether it is measured whatever the time: the default settings."""
        return self.name == DEFAULT


def options_of(config: EncodeConfig) -> str:
    """Options of `fhash encode` that give settings, for a shell; empty for the defaults."""
    words = []
    for option, value in options_beyond(vars(config), vars(EncodeConfig())):
        text = f"{value:.12g}" if isinstance(value, float) else f"{value}"
        words += [option] if value is None else [option, shlex.quote(text)]
    return " ".join(words)


def wishes(features: tuple[str, ...] = EVERYTHING) -> Iterator[Wish]:
    """Every encoding, in the order in which they are measured: the default settings first."""

    def own(effort: int, psnr: float | None = None, error: float | None = None) -> Wish:
        config = EncodeConfig(features=features, effort=effort, psnr=psnr, max_error_rel=error)
        return Wish(codec=config.preset, group=f"effort {effort}", config=config)

    def training(train: str) -> Wish:
        config = EncodeConfig(features=features, train=train)
        return Wish(codec=config.preset, group=TRAINING, config=config)

    def peers(target: float) -> Iterator[Wish]:
        for name in PEERS:
            yield Wish(codec=name, group=name, target=target)

    # Of an effort high accuracies come first: lower ones that take longer are measured again.
    yield own(5)
    yield from (own(1, psnr=target) for target in (60.0, 50.0))
    # A peer takes several times the time that is shown for it, since it is led to its target.
    yield from peers(50.0)
    yield from map(training, ("none", "2s"))
    # The rows of the advice: the fastest and the default of each, and then what may be smaller.
    yield own(1, psnr=40.0)
    yield from (own(5, psnr=target) for target in (60.0, 40.0))
    network = EncodeConfig(preset="published", features=features)
    yield Wish(codec=network.preset, group=NETWORK, config=network)
    yield training("10s")
    for target in (60.0, 40.0):
        yield from peers(target)
    for share in (0.01, 0.001):
        yield from (own(effort, error=share) for effort in (1, 5))
    for target in (60.0, 50.0, 40.0):
        yield own(3, psnr=target)
    for share in (0.01, 0.001):
        yield own(3, error=share)
    yield from peers(70.0)
    for effort in (1, 3):
        yield own(effort, psnr=70.0)
    for effort in (2, 7, 9):
        yield own(effort, psnr=50.0)
