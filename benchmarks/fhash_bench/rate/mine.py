"""Fidelity of fhash and its peers on one series, at equal PSNR and at equal bytes."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

import fhash_codec
from fhash_bench.rate.fidelity import Fidelity, decibels, fidelity, power_spectrum, range_of, rms
from fhash_bench.rate.peers import (
    AnyVariant,
    PeerFiles,
    all_filters,
    folder_of,
    programs,
    spent,
    there_and_back,
)
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.peers import EXACT, UNIFORM, Search, Trial, Variant, filled
from fhash_codec.cost.plan import cropped, described
from fhash_codec.cost.prediction import Predictor
from fhash_codec.devices import machine
from fhash_codec.measure.value_range import decoded_type
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError, MissingDependencyError, QualityError
from fhash_formats.series import ArraySeries, Series
from fhash_formats.support.threads import at_most
from fhash_formats.support.values import Double, Values

OWN = "fhash"
"""Name of fhash among the codecs."""
FILTERS = ("SPERR", "SZ3", "ZFP")
"""Peers that are HDF5 filters."""
BUDGET = 120.0
"""Seconds that are spent by default."""
PROBED_VERTICES = 1 << 18
"""Vertices of the crop from which the seconds of fhash are predicted."""
LEAST_VERTICES = 1 << 15
"""Vertices that are measured at least, as 32 x 32 x 32: less has no spectrum."""
PEER_SECONDS = 12e-6
"""Seconds a vertex of all trials of SPERR, SZ3 and ZFP, and of the measures; on a 2.5 GHz core."""
TRIALS = 8
"""Trials of a variant for a goal, at most."""
SLACK = {"psnr": 0.05, "bytes": 20 * math.log10(1.01)}
"""dB above a goal at which a search ends; for bytes, of their amount: 1 %."""
EQUAL = 1.01
"""Ratio of two figures up to which they count as equal."""
GOALS = {"psnr": "at equal PSNR", "bytes": "at equal bytes"}
"""Comparisons in words."""
MEASURES = {
    "bytes": "bytes",
    "psnr": "PSNR, dB",
    "max_error": "largest error, share of the range",
    "gradient_error": "gradient: RMSE / RMS",
    "spectrum_ratio": "spectrum: power of the worst octave, decoded / source",
    "largest_error": "largest value: error, share of the range",
    "smallest_error": "smallest value: error, share of the range",
    "place_error": "position of the maximum: error, vertices",
    "surface_mean": "isosurface: mean distance, vertices",
    "surface_95": "isosurface: 95th percentile, vertices",
    "seams": "seams: RMSE at borders / elsewhere",
    "encode_seconds": "encoding, seconds of one core",
    "decode_seconds": "decoding, seconds of one core",
}
"""Measures in words."""
NOTES = (
    "equal PSNR: fhash is encoded for a PSNR, and each peer reaches at least the PSNR that fhash"
    " reached; equal bytes: each peer gets at least the bytes of fhash, mostly less than 1 % more",
    "of each peer the layout with the fewest bytes at equal PSNR counts",
    "ZFP rounds its tolerance to a power of two; data are scaled before it, so that it meets a goal"
    " as closely as the others",
    "bytes of fhash are the whole file, those of a peer its chunks alone; seconds are those of one"
    " core from memory, and those of fhash include the check of its promise",
    "of data too large for the budget, steps and vertices in the middle are measured",
    "gradient, extrema and seams: all steps; spectrum and isosurface: the middle step",
    "spectrum: Hann window, octaves of wave numbers with more than a millionth of the power; the"
    " octave whose ratio is farthest from 1",
    "largest and smallest value: of the worst step; position of the maximum: mean over the steps",
    "isosurface: distance from the vertices of marching cubes to the other surface, both ways",
    "seams: the two planes at each border of tiles of fhash; peers have no border there, and their"
    " ratio is that of the data",
    "loss: a peer is more than 1 % better; factors are of the error, the bytes or the seconds",
)


@dataclass(frozen=True, kw_only=True)
class MineRow(Fidelity):
    """Figures of a codec in one comparison."""

    goal: Annotated[str, "what is equal, `psnr` or `bytes`"]
    codec: Annotated[str, "`fhash` or a peer"]
    setting: Annotated[str, "its mode and layout"]
    bytes: Annotated[int, "of the file, or of a peer's chunks"]
    encode_seconds: Annotated[float, "of one core"]
    decode_seconds: Annotated[float, "of one core"]


class Verdict(TypedDict):
    """fhash beside the best peer in one measure."""

    goal: Annotated[str, "what is equal, `psnr` or `bytes`"]
    measure: Annotated[str, "name of the figure"]
    verdict: Annotated[str, "of fhash: `best`, `equal` (within 1 %) or `loss`"]
    peer: Annotated[str, "the best one"]
    ratio: Annotated[float | None, "how many times better the better one is; null: without limit"]


@dataclass(frozen=True, kw_only=True)
class MineBench:
    """Fidelity of fhash and its peers on one series."""

    series: Annotated[str, "source and variable"]
    units: Annotated[str, "of the values"]
    measured: Annotated[str, "the part that was measured, in words"]
    shape: Annotated[tuple[int, ...], "of that part, (t, z, y, x)"]
    dtype: Annotated[str, "number type"]
    raw_bytes: Annotated[int, "of that part"]
    asked: Annotated[float, "PSNR that fhash was encoded for, dB"]
    isovalue: Annotated[float, "of the isosurface, in data units"]
    rows: Annotated[tuple[MineRow, ...], "by comparison and codec, fhash first"]
    refused: Annotated[dict[str, str], "reasons by peer or layout that was not measured"]
    machine: Annotated[dict[str, Any], "this machine"]
    notes: Annotated[tuple[str, ...], "how the figures were taken"] = NOTES

    def of(self, goal: str) -> dict[str, MineRow]:
        """Rows of a comparison by codec."""
        return {row.codec: row for row in self.rows if row.goal == goal}

    def verdicts(self) -> list[Verdict]:
        """fhash beside the best peer in every measure but the one that is equal."""
        found: list[Verdict] = []
        for goal in GOALS:
            own, *peers = self.of(goal).values()
            for measure in MEASURES if peers else ():
                here = badness(measure, getattr(own, measure))
                there = {row.codec: badness(measure, getattr(row, measure)) for row in peers}
                if measure == goal or min([here, *there.values()]) == math.inf:
                    continue
                peer = min(there, key=there.__getitem__)
                best, worse = sorted((here, there[peer]))
                verdict = "equal" if worse <= EQUAL * best else "best" if here == best else "loss"
                ratio = worse / best if 0 < best <= worse < math.inf else None
                found.append(
                    Verdict(goal=goal, measure=measure, verdict=verdict, peer=peer, ratio=ratio)
                )
        return found

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**asdict(self), "verdicts": self.verdicts()}


def badness(measure: str, value: float | None) -> float:
    """A figure as an amount of which less is better, and 0 is best; infinite if not defined.

    A PSNR becomes an error, and a ratio of spectra its distance from 1 as a factor. Errors at seams
    count where they exceed the others.
    """
    if measure == "psnr":
        return 0.0 if value is None else 10 ** (-value / 20)
    if measure == "seams" and value:
        return max(value, 1.0)
    if measure == "spectrum_ratio" and value:
        return max(value, 1 / value)
    return math.inf if value is None or measure == "spectrum_ratio" else value


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What the page shows of source and codecs, which come by name at equal bytes.

    Attributes:
        place: the slice in words.
        planes: of the middle step, 2-D.
        spectra: power by wave number, from 1.
    """

    place: str
    planes: dict[str, Values]
    spectra: dict[str, Double]


class _Sized(Trial):
    """A trial that can also be searched for its bytes, in dB."""

    def quality(self, goal: str) -> float:
        return 20 * math.log10(self.bytes) if goal == "bytes" else super().quality(goal)


class _Peer:
    """A variant of a peer on some values, and its trials."""

    def __init__(self, variant: AnyVariant, values: Values, folder: Path) -> None:
        """values: (t, z, y, x), NaN where missing. folder: of temporary files."""
        self.variant, self._values, self._folder = variant, values, folder
        self._missing, self._width = ~np.isfinite(values), range_of(values)
        self._filled: npt.NDArray[Any] = filled(values) if self._missing.any() else values
        self._scales = isinstance(variant, Variant) and variant.step > 0
        self._search = Search(self._trial, step=0.0 if self._scales else variant.step)

    def find(self, goal: str, asked: float) -> _Sized | None:
        """The trial with the fewest bytes that reaches a PSNR in dB, or so many bytes."""
        aim = 20 * math.log10(asked) if goal == "bytes" else asked
        first = aim - UNIFORM if self.variant.mode == "tolerance" else aim
        found = self._search.find(goal, aim, first=first, slack=SLACK[goal], most=TRIALS)
        assert found is None or isinstance(found, _Sized)
        return found

    def decoded(self, level: float) -> tuple[Values, int]:
        """Decoded values at a level, NaN where missing, and bytes."""
        scale, coded = self._coded(level)
        values, count = there_and_back(*coded)
        return np.where(self._missing, np.nan, values / scale), count

    def seconds(self, level: float) -> tuple[float, float]:
        """Seconds of one core that encoding and decoding take."""
        with folder_of(self._folder) as folder:
            files = PeerFiles(*self._coded(level)[1][:-1], folder)
            return spent(files.encode).core, spent(files.decode).core

    def _coded(self, level: float) -> tuple[float, tuple[Values, AnyVariant, float, float, Path]]:
        """A factor, and what codes the values times that factor at a level.

        It makes a tolerance that is rounded to a power of two exact.
        """
        bound = self._width * 10 ** (-level / 20)
        scale = 2 ** math.ceil(math.log2(bound)) / bound * (1 + 1e-6) if self._scales else 1.0
        values = (self._filled * scale).astype(self._filled.dtype)
        return scale, (values, self.variant, self._width * scale, level, self._folder)

    def _trial(self, level: float) -> _Sized:
        decoded, count = self.decoded(level)
        errors = decoded - self._values.astype(np.float64)
        largest = float(np.fmax.reduce(np.abs(errors), axis=None)) / self._width
        psnr = decibels(self._width, rms(errors)) or EXACT
        return _Sized(level=level, bytes=count, psnr=psnr, max_error=largest)


def bench_mine(
    source: Series,
    *,
    psnr: float = 50.0,
    isovalue: float | None = None,
    settings: Mapping[str, Any] | None = None,
    names: Sequence[str] = FILTERS,
    named: Mapping[str, str] | None = None,
    budget: float = BUDGET,
    progress: Progress = silent,
) -> tuple[MineBench, Shown]:
    """Measures fhash and its peers on a series, on one thread.

    Args:
        source: the series; a crop of it is measured where it is too large for the budget.
        psnr: that fhash is encoded for, dB.
        isovalue: of the isosurface, in data units; if None, the middle between the 1st and the 99th
            percentile of the middle step.
        settings: further settings of fhash by name, as for `EncodeConfig.from_dict`.
        names: peers, of FILTERS.
        named: paths of programs by name, as for `peers.programs`.
        budget: seconds to spend, approximately.

    Raises InputError for a constant series and where no peer could be measured, and
    MissingDependencyError where peers are missing and no program is named.
    """
    end = time.perf_counter() + budget
    variants, refused = _variants(names, named or {})
    config = EncodeConfig.from_dict({**(settings or {}), "psnr": psnr})
    with at_most(1), tempfile.TemporaryDirectory(prefix="fhash-bench-") as name:
        folder = Path(name)
        series = _affordable(source, config, budget)
        read = np.stack(list(series.frames()))
        floats = np.asarray(read, decoded_type(read.dtype))
        values = np.where(np.isfinite(floats), floats, floats.dtype.type(np.nan))
        if not np.isfinite(values).any() or range_of(values) == 0:
            raise InputError(f"{source.source}: '{source.name}' is constant; nothing to compare")
        middle = values[len(values) // 2].astype(np.float64)
        if isovalue is None:
            isovalue = float(np.nanpercentile(middle, [1, 99]).mean())
        progress("measuring", 0, 1 + len(variants), OWN)
        decoded, tiles, figures = _own(
            ArraySeries(read, name=series.name, coords=series.coords), config, folder
        )
        quality = fidelity(values, decoded, isovalue, tiles)
        given = ", ".join(f"{key} {value}" for key, value in (settings or {}).items() if value)
        own = {"codec": OWN, "setting": given or "default", **figures, **asdict(quality)}
        rows = [MineRow(goal=goal, **own) for goal in GOALS]
        steps = {"source": middle, OWN: decoded[len(values) // 2]}
        asked = {"psnr": quality.psnr or EXACT, "bytes": figures["bytes"]}
        best: dict[str, tuple[int, _Peer]] = {}
        # A layout of each peer comes first: where time ends, every peer has one.
        variants.sort(key=lambda variant: variant.layout != "frame")
        for number, variant in enumerate(variants, 1):
            progress("measuring", number, 1 + len(variants), variant.name)
            if time.perf_counter() > end and variant.peer in best:
                refused[variant.name] = "no time was left"
                continue
            peer = _Peer(variant, values, folder)
            try:
                found = peer.find("psnr", asked["psnr"])
            except InputError as error:
                refused[variant.name] = str(error)
                continue
            except AttributeError as error:  # an old hdf5plugin lacks the filter
                refused[variant.name] = f"{error}; pip install -U 'fhash[bench]'"
                continue
            if found is None:
                refused[variant.name] = f"does not reach {asked['psnr']:.4g} dB"
            elif variant.peer not in best or found.bytes < best[variant.peer][0]:
                best[variant.peer] = found.bytes, peer
        if not best:
            reasons = "; ".join(refused.values()) or "none is named"
            raise InputError(f"no peer could be measured: {reasons}")
        for goal, (codec, (_, peer)) in product(GOALS, best.items()):
            trial = peer.find(goal, asked[goal])
            if trial is None:
                refused[f"{codec}, {GOALS[goal]}"] = "its largest size is smaller"
                continue
            decoded, count = peer.decoded(trial.level)
            encoding, decoding = peer.seconds(trial.level)
            rows.append(
                MineRow(
                    goal=goal,
                    codec=codec,
                    setting=peer.variant.name,
                    bytes=count,
                    encode_seconds=encoding,
                    decode_seconds=decoding,
                    **asdict(fidelity(values, decoded, isovalue, tiles)),
                )
            )
            steps[codec] = decoded[len(values) // 2]
        progress("measuring", 1 + len(variants), 1 + len(variants), "")
    result = MineBench(
        series=f"{source.source} {source.name}",
        units=source.units,
        measured=described(series),
        shape=values.shape,
        dtype=read.dtype.name,
        raw_bytes=read.nbytes,
        asked=psnr,
        isovalue=isovalue,
        rows=tuple(sorted(rows, key=lambda row: row.goal, reverse=True)),
        refused=refused,
        machine=machine(),
    )
    return result, _shown(steps)


def _variants(
    names: Sequence[str], named: Mapping[str, str]
) -> tuple[list[AnyVariant], dict[str, str]]:
    """Variants of peers and programs that can be searched for a PSNR, and why others are not."""
    found, refused = programs(named)
    several: list[Sequence[AnyVariant]] = list(found.values())
    try:
        several += [all_filters()[name] for name in names]
    except MissingDependencyError as error:
        missing = f"{', '.join(names)}: no hdf5plugin; pip install 'fhash[bench]'"
        if not found:
            raise MissingDependencyError(missing) from error
        refused[", ".join(names)] = missing
    # SPERR's mode of a fixed rate wastes bytes on simple steps.
    return [
        variant
        for each in several
        for variant in each
        if "psnr" in variant.goals and variant.mode != "rate"
    ], refused


def _affordable(series: Series, config: EncodeConfig, budget: float) -> Series:
    """The series, or the largest crop in its middle that the budget allows, as predicted."""
    part = cropped(series, PROBED_VERTICES)
    own = Predictor(part).predict(config).seconds / math.prod(part.shape)
    return cropped(series, max(LEAST_VERTICES, int(budget / (own + PEER_SECONDS))))


def _own(
    series: Series, config: EncodeConfig, folder: Path
) -> tuple[Values, list[tuple[int, int, int]], dict[str, Any]]:
    """Decoded values of fhash, its tiles as for `near_borders`, and bytes and seconds."""
    path = folder / "own.fhz"

    def encode() -> None:
        try:
            fhash_codec.encode(series, path, config, force=True)
        except QualityError as error:  # what it reaches is compared
            Path(error.figures["path"]).replace(path)

    def decode() -> None:
        with open_volume(path) as volume:
            decoded.append(np.asarray(volume[...]))

    decoded: list[Values] = []
    figures = {"encode_seconds": spent(encode).core, "decode_seconds": spent(decode).core}
    with open_volume(path) as volume:
        tiles = [(n, *span) for n, span in zip(volume.chunks[1:], volume.box, strict=True)]
    return decoded[0], tiles, {"bytes": path.stat().st_size, **figures}


def _shown(steps: Mapping[str, Values]) -> Shown:
    """Planes of steps (z, y, x) across their shortest axis, where the source varies most."""
    axis = int(np.argmin(steps["source"].shape))
    planes = {name: np.moveaxis(step, axis, 0) for name, step in steps.items()}
    spread = [
        np.sum(np.nan_to_num(one - np.nanmean(steps["source"])) ** 2) for one in planes["source"]
    ]
    index = int(np.argmax(spread))
    return Shown(
        place=f"The middle step, {'zyx'[axis]} = {index} of what was measured.",
        planes={name: plane[index] for name, plane in planes.items()},
        spectra={name: power_spectrum(s)[: max(s.shape) // 2] for name, s in steps.items()},
    )
