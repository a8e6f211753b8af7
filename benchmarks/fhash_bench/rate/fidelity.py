"""Fidelity of decoded values beyond PSNR: gradients, spectra, extrema, isosurfaces and seams.

Positions and distances are in vertices. NaN marks vertices that do not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

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
