"""Fidelity of fhash and its peers on one series, at equal PSNR and at equal bytes.

Fidelity is that of gradients, spectra, extrema, isosurfaces and seams. Positions and distances are
in vertices. NaN marks vertices that do not count.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

import fhash_codec
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
from fhash_formats.support.values import Double, Mask, Values

ENERGY = 0.99
"""Share of a spectrum's energy in the bins that `spectrum_error` compares."""
LEAST_POWER = 1e-6
"""Share of the power below which a band is not compared: rounding of float32 reaches it."""
SAMPLING = 1.0
"""Vertices between neighbouring crossings of an isosurface, at most."""


@dataclass(frozen=True, kw_only=True)
class Fidelity:
    """Errors of decoded values."""

    psnr: Annotated[float | None, "dB; null where exact"]
    max_error: Annotated[float, "share of the range"]
    gradient_error: Annotated[float | None, "RMSE of the gradient over its RMS"]
    spectrum_ratio: Annotated[float | None, "power, decoded over source, in the worst octave"]
    spectrum_octave: Annotated[int | None, "first wave number of that octave"]
    largest_error: Annotated[float, "of the largest value, worst step, share of the range"]
    smallest_error: Annotated[float, "of the smallest value, worst step, share of the range"]
    place_error: Annotated[float, "of the position of the maximum, mean over steps, vertices"]
    surface_mean: Annotated[float | None, "mean distance of isosurfaces, vertices"]
    surface_95: Annotated[float | None, "95th percentile of that distance"]
    seams: Annotated[float | None, "RMSE at borders of tiles over that elsewhere; null: one tile"]


def fidelity(
    values: Values, decoded: Values, isovalue: float, tiles: Sequence[Sequence[int]] = ()
) -> Fidelity:
    """All measures of decoded values beside their source.

    Spectrum and isosurface are those of the middle step; the others are of all steps.

    values, decoded: (t, z, y, x), NaN at the same vertices. tiles: see `near_borders`.
    """
    frames, found, middle = values.astype(np.float64), decoded.astype(np.float64), len(values) // 2
    errors, width, steep = found - frames, range_of(values), rms(map(gradient, frames))
    ratio, octave = worst_octave(frames[middle], found[middle])
    largest, smallest, place = extrema_errors(frames, found)
    distances = isosurface_distances(frames[middle], found[middle], isovalue)
    return Fidelity(
        psnr=decibels(width, rms(errors)),
        max_error=float(np.fmax.reduce(np.abs(errors), axis=None)) / width,
        gradient_error=rms(map(gradient, errors)) / steep if steep else None,
        spectrum_ratio=ratio,
        spectrum_octave=octave,
        largest_error=largest / width,
        smallest_error=smallest / width,
        place_error=place,
        surface_mean=float(distances.mean()) if distances.size else None,
        surface_95=float(np.percentile(distances, 95)) if distances.size else None,
        seams=seams(errors, tiles),
    )


def range_of(values: Values) -> float:
    """Largest less smallest finite value, in data units."""
    return float(np.ptp(values[np.isfinite(values)].astype(np.float64)))


def rms(parts: Iterable[Double]) -> float:
    """Root of the mean square of arrays, NaN left out; 0 where there are none."""
    finite = (part[np.isfinite(part)] for part in parts)
    sums = np.array([(float(np.sum(part**2)), part.size) for part in finite]).sum(axis=0)
    return math.sqrt(sums[0] / max(sums[1], 1))


def decibels(width: float, error: float) -> float | None:
    """PSNR in dB of an RMS error, relative to a width; None without error."""
    return 20 * math.log10(width / error) if error else None


def gradient(frame: Double) -> Double:
    """Central differences of a frame (z, y, x) along each axis of 3 vertices or more, in a row."""
    turned = [np.moveaxis(frame, axis, 0) for axis in range(3)]
    return np.concatenate([((each[2:] - each[:-2]) / 2).ravel() for each in turned])


def power_spectrum(frame: Double) -> Double:
    """Power of a frame (z, y, x) in shells of the wave numbers 1, 2, 3 and so on.

    Wave numbers count waves along the longest axis. The mean is removed, missing vertices take it,
    and a Hann window keeps the jump between opposite faces out of the spectrum (Harris, "On the use
    of windows", Proc. IEEE 66, 1978).
    """
    rates = [np.fft.fftfreq(n, 1 / max(frame.shape)) for n in frame.shape]
    squares = sum(each**2 for each in np.meshgrid(*rates, indexing="ij", sparse=True))
    shells = np.rint(np.sqrt(squares)).astype(np.int64).ravel()
    # Without its two zeros, the window also suits an axis of 1 or 2 vertices.
    windows = np.meshgrid(*(np.hanning(n + 2)[1:-1] for n in frame.shape), indexing="ij")
    rest = np.nan_to_num(frame - np.nanmean(frame)) * math.prod(windows)
    power: Double = np.abs(np.fft.fftn(rest)).ravel() ** 2
    return np.bincount(shells, power)[1:].astype(np.float64)


def spectrum_error(frame: Double, decoded: Double) -> float:
    """Largest relative error of a shell's power, of the strongest shells that hold ENERGY."""
    before, after = power_spectrum(frame), power_spectrum(decoded)
    order = np.argsort(-before)
    most = order[: np.searchsorted(np.cumsum(before[order]), ENERGY * before.sum()) + 1]
    return float(np.max(np.abs(after - before)[most] / before[most]))


def worst_octave(frame: Double, decoded: Double) -> tuple[float | None, int | None]:
    """Power of decoded over source, and first wave number, of the octave farthest from ratio 1.

    Octaves begin at the wave numbers 1, 2, 4, 8 and so on. The last one ends at half the vertices
    of the longest axis, and has half an octave at least. Those with less than LEAST_POWER of all
    power are left out; None where all are.
    """
    count = max(frame.shape) // 2
    before, after = (power_spectrum(each)[:count] for each in (frame, decoded))
    first = 2 ** np.arange((2 * count // 3).bit_length())
    if not first.size or not before.any():
        return None, None
    power, found = (np.add.reduceat(each, first - 1) for each in (before, after))
    strong = power > LEAST_POWER * power.sum()
    ratios = found[strong] / power[strong]
    worst = np.argmax(np.abs(np.log(np.maximum(ratios, 1e-300))))
    return float(ratios[worst]), int(first[strong][worst])


def extrema_errors(frames: Double, decoded: Double) -> tuple[float, float, float]:
    """Errors of the largest and the smallest value, and of the position of the maximum.

    The values' errors are those of the worst step. The position's is the mean over the steps of the
    distance between the maxima, in vertices; of equal maxima the closest count.
    """
    from scipy.spatial import KDTree

    largest, smallest, places = [], [], []
    for before, after in zip(frames, decoded, strict=True):
        if np.isnan(before).all():
            continue
        top, found = np.nanmax(before), np.nanmax(after)
        largest.append(abs(found - top))
        smallest.append(abs(np.nanmin(after) - np.nanmin(before)))
        away, _ = KDTree(np.argwhere(before == top)).query(np.argwhere(after == found))
        places.append(np.min(away))
    return float(max(largest)), float(max(smallest)), float(np.mean(places))


def crossings(frame: Double, isovalue: float) -> tuple[Double, Double]:
    """Points (n, 3) where a frame (z, y, x) crosses a value along its edges, and normals (n, 3).

    The points are the vertices of marching cubes (Lorensen and Cline, SIGGRAPH 1987). Normals have
    length 1, or 0 where the gradient is not defined.
    """
    slopes = np.stack(
        [
            np.gradient(frame, axis=axis) if n > 1 else 0 * frame
            for axis, n in enumerate(frame.shape)
        ],
        axis=-1,
    )
    points, normals = [], []
    for axis in range(3):
        low, high = (np.moveaxis(frame, axis, 0)[cut] for cut in (np.s_[:-1], np.s_[1:]))
        crossed = ((low >= isovalue) != (high >= isovalue)) & np.isfinite(low + high)
        share = ((isovalue - low[crossed]) / (high - low)[crossed])[:, None]
        along = np.eye(3)[axis]
        # moveaxis put this axis first; positions are in the order z, y, x.
        start = np.insert(np.argwhere(crossed)[:, 1:], axis, np.argwhere(crossed)[:, 0], axis=1)
        before, after = slopes[tuple(start.T)], slopes[tuple((start + along.astype(int)).T)]
        points.append(start + share * along)
        normals.append(np.nan_to_num(before + share * (after - before)))
    normal = np.concatenate(normals)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.concatenate(points), np.divide(normal, length, out=0 * normal, where=length > 0)


def isosurface_distances(frame: Double, decoded: Double, isovalue: float) -> Double:
    """Distances (n,) of each crossing to the other isosurface, in vertices, in both directions.

    The distance is that to the tangent plane at the nearest crossing, as in the metric D2 for point
    clouds (Tian et al., ICIP 2017). Beyond SAMPLING, the offset along the plane counts, too. Empty
    where a frame does not cross the value.
    """
    from scipy.spatial import KDTree

    both = crossings(frame, isovalue), crossings(decoded, isovalue)
    if not all(len(points) for points, _ in both):
        return np.empty(0)
    found = []
    for (here, _), (there, normals) in (both, both[::-1]):
        away, nearest = KDTree(there).query(here)
        off = np.abs(np.sum((here - there[nearest]) * normals[nearest], axis=1))
        along = np.sqrt(np.maximum(away**2 - off**2, 0))
        plane = np.hypot(off, np.maximum(along - SAMPLING, 0))
        found.append(np.where(normals[nearest].any(axis=1), plane, away))
    return np.concatenate(found)


def near_borders(shape: Sequence[int], tiles: Sequence[Sequence[int]]) -> Mask:
    """Mask (z, y, x) of the two planes at each border between tiles.

    tiles: length of a tile, first vertex and end of the tiled box, along z, y and x.
    """
    near = np.zeros(shape, np.bool_)
    for axis, (tile, first, end) in enumerate(tiles):
        for border in range(first + tile, end, tile):
            np.moveaxis(near, axis, 0)[border - 1 : border + 1] = True
    return near


def seams(errors: Double, tiles: Sequence[Sequence[int]]) -> float | None:
    """RMS of errors (t, z, y, x) at borders of tiles over that elsewhere; None without either."""
    near = near_borders(errors.shape[1:], tiles)
    at_borders, elsewhere = (rms(each[part] for each in errors) for part in (near, ~near))
    return at_borders / elsewhere if at_borders and elsewhere else None


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


@dataclass(frozen=True, kw_only=True)
class Wish:
    """What is compared.

    Attributes:
        psnr: that fhash is encoded for, dB.
        isovalue: of the isosurface, in data units; if None, the middle between the 1st and the 99th
            percentile of the middle step.
        settings: further settings of fhash by name, as for `EncodeConfig.from_dict`.
        names: peers, of FILTERS.
        named: paths of programs by name, as for `peers.programs`.
        budget: seconds to spend, approximately.
    """

    psnr: float = 50.0
    isovalue: float | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    names: Sequence[str] = FILTERS
    named: Mapping[str, str] = field(default_factory=dict)
    budget: float = BUDGET


def bench_mine(
    source: Series, wish: Wish = Wish(), progress: Progress = silent
) -> tuple[MineBench, Shown]:
    """Measures fhash and its peers on a series, on one thread.

    source: the series; a crop of it is measured where it is too large for the budget.

    Raises InputError for a constant series and where no peer could be measured, and
    MissingDependencyError where peers are missing and no program is named.
    """
    end = time.perf_counter() + wish.budget
    variants, refused = _variants(wish.names, wish.named)
    config = EncodeConfig.from_dict({**wish.settings, "psnr": wish.psnr})
    with at_most(1), tempfile.TemporaryDirectory(prefix="fhash-bench-") as name:
        folder = Path(name)
        series = _affordable(source, config, wish.budget)
        read = np.stack(list(series.frames()))
        floats = np.asarray(read, decoded_type(read.dtype))
        values = np.where(np.isfinite(floats), floats, floats.dtype.type(np.nan))
        if not np.isfinite(values).any() or range_of(values) == 0:
            raise InputError(f"{source.source}: '{source.name}' is constant; nothing to compare")
        middle = values[len(values) // 2].astype(np.float64)
        isovalue = wish.isovalue
        if isovalue is None:
            isovalue = float(np.nanpercentile(middle, [1, 99]).mean())
        progress("measuring", 0, 1 + len(variants), OWN)
        decoded, tiles, figures = _own(
            ArraySeries(read, name=series.name, coords=series.coords), config, folder
        )
        quality = fidelity(values, decoded, isovalue, tiles)
        given = ", ".join(f"{key} {value}" for key, value in wish.settings.items() if value)
        own = {"codec": OWN, "setting": given or "default", **figures, **asdict(quality)}
        rows = [MineRow(goal=goal, **own) for goal in GOALS]
        steps = {"source": middle, OWN: decoded[len(values) // 2]}
        asked = {"psnr": quality.psnr or EXACT, "bytes": figures["bytes"]}
        best = _best(variants, values, folder, asked["psnr"], refused, end, progress)
        for goal, (codec, peer) in product(GOALS, best.items()):
            found = _row(
                goal, codec, peer, asked[goal], lambda d: fidelity(values, d, isovalue, tiles)
            )
            if found is None:
                refused[f"{codec}, {GOALS[goal]}"] = "its largest size is smaller"
                continue
            rows.append(found[0])
            steps[codec] = found[1][len(values) // 2]
        progress("measuring", 1 + len(variants), 1 + len(variants), "")
    result = MineBench(
        series=f"{source.source} {source.name}",
        units=source.units,
        measured=described(series),
        shape=values.shape,
        dtype=read.dtype.name,
        raw_bytes=read.nbytes,
        asked=wish.psnr,
        isovalue=isovalue,
        rows=tuple(sorted(rows, key=lambda row: row.goal, reverse=True)),
        refused=refused,
        machine=machine(),
    )
    return result, _shown(steps)


def _best(
    variants: list[AnyVariant],
    values: Values,
    folder: Path,
    psnr: float,
    refused: dict[str, str],
    end: float,
    progress: Progress,
) -> dict[str, _Peer]:
    """The layout of each peer that takes the fewest bytes for a PSNR; `refused` gets why others do
    not count. Raises InputError where no peer is left."""
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
            found = peer.find("psnr", psnr)
        except InputError as error:
            refused[variant.name] = str(error)
            continue
        except AttributeError as error:  # an old hdf5plugin lacks the filter
            refused[variant.name] = f"{error}; pip install -U 'fhash[bench]'"
            continue
        if found is None:
            refused[variant.name] = f"does not reach {psnr:.4g} dB"
        elif variant.peer not in best or found.bytes < best[variant.peer][0]:
            best[variant.peer] = found.bytes, peer
    if not best:
        reasons = "; ".join(refused.values()) or "none is named"
        raise InputError(f"no peer could be measured: {reasons}")
    return {name: peer for name, (_, peer) in best.items()}


def _row(
    goal: str, codec: str, peer: _Peer, asked: float, measured: Callable[[Values], Fidelity]
) -> tuple[MineRow, Values] | None:
    """The figures of a peer for a goal, and its decoded values; None where it does not reach it."""
    trial = peer.find(goal, asked)
    if trial is None:
        return None
    decoded, count = peer.decoded(trial.level)
    encoding, decoding = peer.seconds(trial.level)
    row = MineRow(
        goal=goal,
        codec=codec,
        setting=peer.variant.name,
        bytes=count,
        encode_seconds=encoding,
        decode_seconds=decoding,
        **asdict(measured(decoded)),
    )
    return row, decoded


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
