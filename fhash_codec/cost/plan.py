"""Plan of `fhash cost`: what is tried, on which part of the series, and in how much time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.results import LeftOut
from fhash_codec.features.scan import scan
from fhash_codec.measure.errors import Errors, find_bulk
from fhash_codec.measure.value_range import ValueRange, power_of_two
from fhash_codec.progress import Progress
from fhash_formats.errors import FhashError
from fhash_formats.series import Series

OVERRUN = 0.25
"""Share of its time by which work that has begun may exceed it."""


class BudgetSpentError(Exception):
    """The end of work whose time is over; it never leaves this room."""


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

    def part(self, end: float) -> None:
        """Begin a part that ends at a share of all seconds, 0 to 1."""
        self._end = end * self.seconds

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
        except BudgetSpentError:
            self.leave_out(what, "took longer than its share of the time; stopped", late=True)
        except FhashError as error:
            self.leave_out(what, str(error))
        except KeyboardInterrupt:
            self.interrupted = True
            self.leave_out(what, "interrupted")

    def guard(self, progress: Progress, *, share: float = 1.0) -> Progress:
        """A progress callback that raises BudgetSpentError where its time is over.

        share: share of what is left of the part now; OVERRUN of it is added.
        """
        end = self.spent + share * self.left * (1 + OVERRUN)

        def guarded(stage: str, done: int, total: int, note: str) -> None:
            progress(stage, done, total, note)
            if self.spent > end:
                raise BudgetSpentError

        return guarded


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Figures of a series.

    Attributes:
        value_range, bulk: in data units; bulk is None where the middle 98 % have no width.
        missing: number of values that are not finite.
    """

    value_range: ValueRange
    bulk: ValueRange | None
    missing: int
    raw_bytes: int

    @property
    def width(self) -> float:
        """Width of the range, in data units."""
        return self.value_range.high - self.value_range.low

    @property
    def scale(self) -> float:
        """Power of two that brings differences of values near 1."""
        return power_of_two(self.width)

    @property
    def scaled_width(self) -> float:
        """Width of the range after scaling."""
        return self.width * self.scale

    def errors(self) -> Errors:
        """Errors without a frame yet."""
        return Errors(self.width, self.bulk)


def facts_of(series: Series, progress: Progress) -> Facts:
    """Scan a series; raises InputError for one without a finite value."""
    scanned = scan(series, progress)
    value_range = scanned.value_range
    bulk = find_bulk(lambda: series.frames(), value_range, whole=series.dtype.kind in "iu")
    count = prod(series.shape)
    return Facts(
        value_range=value_range,
        bulk=bulk,
        missing=count - scanned.finite_count,
        raw_bytes=count * series.dtype.itemsize,
    )


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
    if not isinstance(series, CroppedSeries):
        return "the whole series"
    share = prod(series.shape) / prod(series.series.shape)
    region = ", ".join(
        f"{axis} {low}:{high}" for axis, (low, high) in zip("zyx", series.region, strict=True)
    )
    first, end = series.steps[0], series.steps[-1] + 1
    return f"a crop, {share:.2%} of the series: steps {first}:{end}, {region}"


PEERS = ("SZ3", "SPERR", "ZFP")
"""Peers that are measured where their package is there."""
EPOCHS = (2, 3, 5, 10, 20, 50)
"""Epochs of the profile paper, of which the largest number that fits is trained after a first."""


@dataclass(frozen=True, kw_only=True)
class Wish:
    """An encoding to be measured.

    Attributes:
        codec: "compact", "paper" or a peer.
        group: the curve that it belongs to.
        config: settings; None for a peer, and for "paper", whose epochs follow from the time.
        target: PSNR in dB that a peer is set to.
    """

    codec: str
    group: str
    config: EncodeConfig | None = None
    target: float = 0.0

    @property
    def options(self) -> str:
        """Options of `fhash encode` that give the encoding; empty for a peer and the defaults."""
        if self.config is None:
            return ""
        default = EncodeConfig()
        return " ".join(
            f"--{name.replace('_', '-')} {value:g}"
            if isinstance(value, float)
            else f"--{name.replace('_', '-')} {value}"
            for name, value in vars(self.config).items()
            if value != getattr(default, name)
        )

    @property
    def name(self) -> str:
        """The encoding in words."""
        if self.config is None:
            return f"{self.codec}, {self.target:g} dB" if self.target else self.codec
        if self.codec == "paper":
            count = self.config.epochs
            return f"paper, {count} epoch" + ("s" if count > 1 else "")
        promise = next(
            (
                text
                for value, text in (
                    (self.config.psnr, f"{self.config.psnr or 0:g} dB"),
                    (
                        self.config.max_error_rel,
                        f"error within {100 * (self.config.max_error_rel or 0):g} %",
                    ),
                )
                if value is not None
            ),
            "the default promise",
        )
        return f"{self.group}, {promise}"


def wishes() -> Iterator[Wish]:
    """Every encoding, in the order in which they are measured."""
    yield _psnr(1, 50)
    yield from _peers(50)
    yield _psnr(3, 50)
    yield Wish(codec="compact", group="compact, effort 5", config=EncodeConfig())
    yield Wish(codec="paper", group="paper")
    # Peers take several times the time that is shown for them, since each is led to its target.
    for effort in (1, 3):
        for target in (40, 60):
            yield _psnr(effort, target)
    for target in (40, 60):
        yield from _peers(target)
    for target in (45, 70):
        yield _psnr(1, target)
        yield from _peers(target)
        yield _psnr(3, target)
    for target in (40, 60):
        yield _psnr(5, target)
    for share in (0.01, 0.001):
        yield Wish(
            codec="compact",
            group="compact, effort 3",
            config=EncodeConfig(effort=3, max_error_rel=share),
        )
    yield _psnr(2, 50)
    yield _psnr(5, 45)
    yield _psnr(7, 50)
    yield _psnr(9, 50)


def paper_config(epochs: int) -> EncodeConfig:
    """Settings of the published model, trained for some epochs."""
    return EncodeConfig(profile="paper", epochs=epochs)


def _psnr(effort: int, target: float) -> Wish:
    return Wish(
        codec="compact",
        group=f"compact, effort {effort}",
        config=EncodeConfig(effort=effort, psnr=float(target)),
    )


def _peers(target: float) -> Iterator[Wish]:
    for name in PEERS:
        yield Wish(codec=name, group=name, target=float(target))
