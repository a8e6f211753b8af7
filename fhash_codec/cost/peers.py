"""Peers as HDF5 filters: SZ3, SPERR and ZFP in their best layouts, searched for a quality."""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.cost.plan import QUICK, RUNS, Allowance, BudgetSpentError, Facts, Wish
from fhash_codec.cost.results import Encoded
from fhash_codec.measure.errors import Errors
from fhash_codec.measure.value_range import decoded_type
from fhash_codec.progress import Progress
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import Series
from fhash_formats.support.values import Values

LAYOUTS = {
    "frame": "(z, y, x) of each step",
    "plane": "(t, y, x) of each z",
    "series": "(t, z, y, x)",
    "folded": "(t z, y, x), frames folded into z",
    "turned": "(z t, y, x), the steps of each z one after the other",
}
"""Layouts by name, with the axes of their parts."""


def parts_of(values: Values, layout: str) -> Sequence[Values]:
    """The parts of values (t, z, y, x) that are coded apart."""
    steps, planes, *plane = values.shape
    if layout == "frame":
        return list(values)
    if layout == "plane":
        return list(np.moveaxis(values, 1, 0))
    if layout == "folded":
        return [values.reshape(steps * planes, *plane)]
    if layout == "turned":
        return [np.moveaxis(values, 1, 0).reshape(steps * planes, *plane)]
    return [values]


def joined(parts: Sequence[Values], layout: str, shape: tuple[int, ...]) -> Values:
    """Values of `shape` (t, z, y, x) from the parts that `parts_of` gives."""
    steps, planes, *plane = shape
    if layout == "frame":
        return np.stack(parts)
    if layout == "plane":
        return np.stack(parts, axis=1)
    if layout == "turned":
        return np.moveaxis(parts[0].reshape(planes, steps, *plane), 0, 1)
    return np.asarray(parts[0]).reshape(shape)


UNIFORM = 20 * math.log10(math.sqrt(3))
"""dB by which the RMSE of a uniformly distributed error lies below the tolerance."""
EXACT = 400.0
"""PSNR in dB that stands for no error at all."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Figures of a codec at one level.

    psnr: dB over every finite value of all frames, EXACT where nothing differs. max_error: the
    largest difference as a share of the range.
    """

    level: float
    bytes: int
    psnr: float
    max_error: float

    def quality(self, goal: str) -> float:
        """Quality in dB: the PSNR, or for "bound" the largest error on the same scale."""
        if goal == "psnr":
            return self.psnr
        return EXACT if self.max_error == 0 else -20 * math.log10(self.max_error)


class Search:
    """The trials of one variant of a codec."""

    def __init__(
        self, measure: Callable[[float], Trial], *, step: float = 0.0, fixed: bool = False
    ) -> None:
        """Prepare the search.

        Args:
            measure: makes a trial at a level.
            step: levels are multiples of it; 0 for any level.
            fixed: every level gives the same trial.
        """
        self._measure = measure
        self._step = step
        self._fixed = fixed
        self.trials: dict[float, Trial] = {}

    def try_level(self, level: float) -> Trial:
        """The trial at a level, or at the next of the steps above it."""
        level = (
            0.0
            if self._fixed
            else math.ceil(level / self._step - 1e-9) * self._step
            if self._step
            else math.ceil(1e4 * level) / 1e4
        )
        if level not in self.trials:
            self.trials[level] = self._measure(level)
        return self.trials[level]

    def find(
        self, goal: str, asked: float, *, first: float, slack: float, most: int
    ) -> Trial | None:
        """The smallest trial whose quality is at least `asked`, None where no trial reached it.

        The search ends once a trial exceeds `asked` by no more than `slack`.

        Args:
            goal: "psnr" or "bound".
            asked: quality in dB.
            first: level to begin with before any trial.
            slack: dB.
            most: limit of new trials.
        """
        before = len(self.trials)
        last = None
        while len(self.trials) - before < most:
            level = self._next(goal, asked, first, slack)
            if level is None or level == last:
                break
            last = level
            self.try_level(level)
        reached = [trial for trial in self.trials.values() if trial.quality(goal) >= asked]
        return min(reached, key=lambda trial: (trial.bytes, -trial.psnr), default=None)

    def _next(self, goal: str, asked: float, first: float, slack: float) -> float | None:
        """The level to try, None once it is found."""
        if not self.trials:
            return first
        if self._fixed:
            return None
        tried = sorted(self.trials.values(), key=lambda trial: trial.level)
        good = next((trial for trial in tried if trial.quality(goal) >= asked), None)
        bad = next(
            (
                trial
                for trial in reversed(tried)
                if trial.quality(goal) < asked and (good is None or trial.level < good.level)
            ),
            None,
        )
        if good is not None and good.quality(goal) <= asked + slack:
            return None
        aim = asked + slack / 2
        if good is None or bad is None:
            nearest = tried[:2] if good is not None else tried[:-3:-1]
            away = (aim - nearest[0].quality(goal)) / _slope(nearest, goal)
            return nearest[0].level + math.copysign(
                min(max(abs(away), self._step, 0.05), 60.0), away
            )
        if self._step:
            between = round((good.level - bad.level) / self._step)
            return None if between <= 1 else bad.level + between // 2 * self._step
        if good.level - bad.level < 1e-3:
            return None
        share = (aim - bad.quality(goal)) / (good.quality(goal) - bad.quality(goal))
        return bad.level + (good.level - bad.level) * min(max(share, 0.08), 0.92)


def _slope(nearest: list[Trial], goal: str) -> float:
    """dB of quality for each dB of level between two trials, within 0.2 to 4.

    It is 1 for a single trial, and where one trial is exact.
    """
    qualities = [trial.quality(goal) for trial in nearest]
    if len(nearest) < 2 or EXACT in qualities:
        return 1.0
    return min(max((qualities[1] - qualities[0]) / (nearest[1].level - nearest[0].level), 0.2), 4.0)


def trial_of(errors: Errors, level: float, count: int) -> Trial:
    """The Trial that stands for measured errors and a number of bytes."""
    exact = errors.rmse == 0 or errors.psnr is None
    largest = errors.max_abs_error or 0.0
    return Trial(
        level=level,
        bytes=count,
        psnr=EXACT if exact else float(errors.psnr or 0.0),
        max_error=largest / errors.data_range,
    )


Filter = Mapping[str, Any]

LADDER = 20 * math.log10(2)
"""dB between settings that are powers of two apart."""
MAX_CHUNK = 2**31
"""Bytes of the largest chunk; HDF5 allows less than 4 GiB."""


BOTH = ("psnr", "bound")
"""Goals of a peer that is tried for every kind of quality."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One mode and layout of a peer.

    Attributes:
        peer: its name.
        mode: the kind of its setting, for people.
        layout: one of `layouts.LAYOUTS`; a dataset holds one of its parts.
        goals: qualities it is tried for, `psnr`, `bound` or both.
        setting: gives the HDF5 filter for (part of the data, range of the data, level). A level is
            a quality in dB: a uniform tolerance of range * 10^(-level / 20) stands at `level`.
        step: distance in dB of levels that differ at all, 0 for any.
        prepare: changes the values before the filter, at a level.
        chunk: largest length of a chunk along an axis of its layout, None for no limit.
        lossless: there is nothing to set, and values may be of any type and not finite.
    """

    peer: str
    mode: str
    layout: str
    goals: tuple[str, ...]
    setting: Callable[[Values, float, float], Filter]
    step: float = 0.0
    prepare: Callable[[Values, float], Values] | None = None
    chunk: int | None = None
    lossless: bool = False

    @property
    def name(self) -> str:
        """Description such as "SPERR rate, a chunk per frame"."""
        chunks = "a chunk" if self.chunk is None else f"chunks of {self.chunk}"
        return f"{self.peer} {self.mode}, {chunks} per {self.layout}"

    def chunk_shape(self, part: Values) -> tuple[int, ...]:
        """Shape of the chunks of a dataset: all of it, or even parts within the limits."""
        if self.chunk is not None:
            return tuple(-(-n // -(-n // self.chunk)) for n in part.shape)
        first, *others = part.shape
        return (max(1, min(first, MAX_CHUNK * first // part.nbytes)), *others)


def tolerance(data_range: float, level: float) -> float:
    """The absolute error at a level."""
    return data_range * math.pow(10.0, -level / 20)


def peers() -> dict[str, tuple[Variant, ...]]:
    """Every peer by name. Raises MissingDependencyError without hdf5plugin."""
    try:
        plugins = importlib.import_module("hdf5plugin")
    except ImportError as error:
        raise MissingDependencyError(
            "bench rate compares with the codecs of hdf5plugin; pip install 'fhash[bench]'"
        ) from error
    return {
        "SZ3": _sz3(plugins),
        "SPERR": _sperr(plugins),
        "ZFP": _zfp(plugins),
    }


def _sz3(plugins: Any) -> tuple[Variant, ...]:
    def absolute(part: Values, data_range: float, level: float) -> Filter:
        return plugins.SZ3(absolute=tolerance(data_range, level))  # type: ignore[no-any-return]

    return tuple(
        Variant(peer="SZ3", mode="tolerance", layout=layout, goals=BOTH, setting=absolute)
        for layout in ("frame", "plane", "series", "folded")
    )


def _sperr(plugins: Any) -> tuple[Variant, ...]:
    def absolute(part: Values, data_range: float, level: float) -> Filter:
        return plugins.Sperr(absolute=tolerance(data_range, level), swap=True)  # type: ignore[no-any-return]

    def psnr(part: Values, data_range: float, level: float) -> Filter:
        own = max(float(part.max()) - float(part.min()), 1e-9 * data_range)
        quality = max(0.1, level + 20 * math.log10(own / data_range))
        return plugins.Sperr(peak_signal_to_noise_ratio=quality, swap=True)  # type: ignore[no-any-return]

    def rate(part: Values, data_range: float, level: float) -> Filter:
        # Bits a value. Each 6 dB double them, nearly true at low rates; the search does the rest.
        return plugins.Sperr(rate=min(63.9, max(2.0**-15, 2.0 ** (level / 6 - 9))), swap=True)  # type: ignore[no-any-return]

    # At equal PSNR a tolerance costs more bytes than the other modes: it is for bounds alone.
    modes = (("PSNR", "psnr", psnr), ("rate", "psnr", rate), ("tolerance", "bound", absolute))
    return tuple(
        Variant(peer="SPERR", mode=mode, layout=layout, goals=(goal,), setting=setting)
        for mode, goal, setting in modes
        for layout in ("frame", "plane", "folded")
    )


def _zfp(plugins: Any) -> tuple[Variant, ...]:
    def accuracy(part: Values, data_range: float, level: float) -> Filter:
        return plugins.Zfp(accuracy=tolerance(data_range, level))  # type: ignore[no-any-return]

    return tuple(
        Variant(
            peer="ZFP", mode="tolerance", layout=layout, goals=BOTH, setting=accuracy, step=LADDER
        )
        for layout in ("frame", "plane", "series")
    )


@contextmanager
def stored(
    values: Values, variant: Variant, data_range: float, level: float, path: Path | None = None
) -> Iterator[Any]:
    """An open HDF5 file that holds values (t, z, y, x), in memory, or at `path` if one is given.

    Raises InputError for a shape or a setting that the filter refuses.
    """
    import h5py

    if variant.prepare is not None:
        values = variant.prepare(values, level)
    place: dict[str, Any] = {"driver": "core", "backing_store": False} if path is None else {}
    with h5py.File(path or f"{id(values)}.h5", "w", rdcc_nbytes=0, **place) as file:
        try:
            for number, part in enumerate(parts_of(values, variant.layout)):
                filters = variant.setting(part, data_range, level)
                file.create_dataset(
                    str(number),
                    data=part,
                    chunks=variant.chunk_shape(part),
                    track_times=False,
                    **filters,
                )
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{variant.name}: {error}") from error
        yield file


def opened_file(path: Path) -> Any:
    """The file of `stored` at a path, for reading, without a chunk cache; a context manager."""
    import h5py

    return h5py.File(path, "r", rdcc_nbytes=0)


def stored_bytes(file: Any) -> int:
    """Bytes of the chunks alone: the file's own structure is left out, which favours the peers."""
    return sum(int(dataset.id.get_storage_size()) for dataset in file.values())


def read_all(file: Any, variant: Variant, shape: tuple[int, ...]) -> Values:
    """Every value of a series of `shape` (t, z, y, x), decoded."""
    parts = [file[str(number)][...] for number in range(len(file))]
    return joined(parts, variant.layout, shape)


def filled(values: Values) -> Values:
    """Replace each value that is not finite by the nearest finite one before it in its row along x.

    Where there is none before it, by the nearest after it; where a row has none, along y, z and t.
    At least one value must be finite.
    """
    result = values.copy()
    for axis in (3, 2, 1, 0):
        for line in (result, np.flip(result, axis)):
            finite = np.isfinite(line)
            if finite.all():
                return result
            shape = [-1 if number == axis else 1 for number in range(4)]
            places = np.where(finite, np.arange(line.shape[axis]).reshape(shape), 0)
            np.maximum.accumulate(places, axis=axis, out=places)
            line[...] = np.take_along_axis(line, places, axis)
    return result


MAX_BYTES = 1 << 30
"""Largest series for peers, which hold all of it in memory."""
TRIALS = 3
"""New trials for a quality, at most."""
SLACK = 0.5
"""dB above a quality at which its search ends."""
PEER_SHARE = 0.15
"""Share of the time left for encoding that a peer may take at a quality."""
TRIED_LAYOUTS = {
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
            and variant.layout in TRIED_LAYOUTS[wish.codec]
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
        seconds = once = time.perf_counter() - begun
        for _ in range(RUNS - 1 if once < QUICK else 0):
            again = time.perf_counter()
            with stored(self._values, variant, facts.width, level, self._path):
                pass
            seconds = min(seconds, time.perf_counter() - again)
        with opened_file(self._path) as file:
            decoded, count = read_all(file, variant, self._values.shape), stored_bytes(file)
        errors = facts.errors()
        for step, frame in enumerate(decoded):
            errors.add(step, self._series.read(step), frame, facts.mask(step))
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
