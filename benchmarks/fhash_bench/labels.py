"""Sizes of labels without loss beside `xz -9e`, on made series and on the user's own."""

from __future__ import annotations

import lzma
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypedDict

import numpy as np
import numpy.typing as npt

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_codec.devices import machine
from fhash_codec.features.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import FhashError, InputError
from fhash_formats.series import ArraySeries, Series
from fhash_formats.transform.tile import encode_chunk

Labels = npt.NDArray[Any]
Shape = tuple[int, int, int, int]

SHAPE: Shape = (8, 20, 56, 60)
"""Shape (t, z, y, x) of most kinds, in vertices."""


def _smooth_field(shape: tuple[int, ...], width: float, seed: int) -> npt.NDArray[np.float64]:
    """Random numbers of mean 0 and deviation 1, smoothed along all axes.

    width: deviation of the Gaussian, in vertices.
    """
    from scipy.ndimage import gaussian_filter

    noise = np.random.default_rng(seed).normal(size=shape)
    field = gaussian_filter(noise, width, mode="wrap")
    return np.asarray(field / field.std())


def _nearest_point(shape: Shape, points: int, speed: float, seed: int) -> npt.NDArray[np.int64]:
    """Number of the nearest of moving points, at every vertex and step.

    speed: deviation of the points' speeds, in vertices a step.
    """
    from scipy.spatial import cKDTree

    chance = np.random.default_rng(seed)
    lengths = np.array(shape[1:])
    starts = chance.uniform(0, 1, (points, 3)) * lengths
    speeds = chance.normal(0, speed, (points, 3))
    vertices = np.moveaxis(np.indices(shape[1:]), 0, -1).reshape(-1, 3)
    frames = [
        cKDTree(starts + step * speeds).query(vertices)[1].reshape(shape[1:])
        for step in range(shape[0])
    ]
    return np.asarray(np.stack(frames).astype(np.int64))


def _components() -> Labels:
    """Connected regions above a threshold, numbered anew at each step."""
    from scipy.ndimage import label

    field = _smooth_field(SHAPE, 2.5, 1)
    return np.asarray(np.stack([label(frame > 0.6)[0] for frame in field]).astype(np.int32))


def _tracked_components() -> Labels:
    """Regions above a threshold, connected in space and time: each keeps its number."""
    from scipy.ndimage import label

    return np.asarray(np.asarray(label(_smooth_field(SHAPE, 2.0, 2) > 1.0)[0]).astype(np.uint16))


def _refinement_levels() -> Labels:
    """Levels of an adaptive mesh: blocks of 4^3 about a front that moves."""
    t, z, y, x = (np.asarray(axis, float) for axis in np.indices(SHAPE))
    bend = 4 * np.sin(y // 4 * 0.6) + 3 * np.cos(z // 4 * 0.9)
    distance = np.abs(x // 4 * 4 + bend - 10 - 4 * t)
    return np.asarray((4 - np.searchsorted([4.0, 9.0, 16.0, 28.0], distance)).astype(np.int8))


def _basins() -> Labels:
    """Watersheds: the minimum to which the steepest descent from each vertex leads."""
    field = _smooth_field(SHAPE, 2.2, 3)
    return np.asarray(np.stack([_descend(frame) for frame in field]).astype(np.uint16))


def _descend(field: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Number of the local minimum below each vertex, in the order of the vertices."""
    padded = np.pad(field, 1, constant_values=np.inf)
    offsets = [(dz, dy, dx) for dz in (0, 1, 2) for dy in (0, 1, 2) for dx in (0, 1, 2)]
    z, y, x = field.shape
    around = np.stack([padded[a : a + z, b : b + y, c : c + x] for a, b, c in offsets])
    places = np.pad(np.arange(field.size).reshape(field.shape), 1)
    targets = np.stack([places[a : a + z, b : b + y, c : c + x] for a, b, c in offsets])
    below = np.take_along_axis(targets, around.argmin(0)[None], 0)[0].ravel()
    while True:
        further = below[below]
        if (further == below).all():
            return np.unique(below, return_inverse=True)[1].reshape(field.shape)
        below = further


def _particles() -> Labels:
    """Numbers of 150 particles at single vertices, 0 elsewhere."""
    chance = np.random.default_rng(4)
    places, speeds = chance.uniform(0, 1, (150, 3)), chance.normal(0, 0.01, (150, 3))
    labels = np.zeros(SHAPE, np.int32)
    for step in range(SHAPE[0]):
        z, y, x = ((places + step * speeds) % 1 * SHAPE[1:]).astype(int).T
        labels[step, z, y, x] = np.arange(150) + 1000
    return labels


def _checkerboard() -> Labels:
    """Cubes of 5 vertices in turns, which move by one vertex a step."""
    t, z, y, x = np.indices(SHAPE)
    return np.asarray(((z // 5 + y // 5 + (x + t) // 5) % 2).astype(np.uint8))


def _stripes() -> Labels:
    """Ascending numbers in slabs of 3 vertices, the same at each step."""
    x = np.indices(SHAPE)[3]
    return np.asarray((x // 3 * 11 + 5).astype(np.int16))


def _many() -> Labels:
    """3,000 grains of a polycrystal that drift."""
    chance = np.random.default_rng(5)
    return np.asarray(
        chance.permutation(3000)[_nearest_point(SHAPE, 3000, 0.15, 5)].astype(np.uint16)
    )


def _large_ids() -> Labels:
    """Global identifiers of 200 moving cells, between 1 and 2 thousand million."""
    ids = np.random.default_rng(6).integers(10**9, 2 * 10**9, 200)
    return np.asarray(ids[_nearest_point(SHAPE, 200, 0.4, 6)].astype(np.int32))


def _thin() -> Labels:
    """One layer of 180 x 300 vertices: cells that move."""
    return _nearest_point((6, 1, 180, 300), 120, 1.5, 7).astype(np.uint8)


def _two_steps() -> Labels:
    """Two steps of cells."""
    return _nearest_point((2, 40, 80, 84), 90, 1.0, 8).astype(np.uint8)


def _tiny_grid() -> Labels:
    """200 steps of a grid of 6 x 7 x 8 vertices."""
    return _nearest_point((200, 6, 7, 8), 12, 0.03, 9).astype(np.int16)


def _filled() -> Labels:
    """Classes of an ocean, with -9999 over land."""
    land = _smooth_field(SHAPE[2:], 5.0, 10) > 0.4
    depth = np.arange(SHAPE[1])[:, None, None] - 14 + 3 * _smooth_field(SHAPE[2:], 4.0, 11)
    classes = np.digitize(_smooth_field(SHAPE, 3.0, 12), [-1.2, -0.4, 0.3, 1.1]) + 1
    return np.asarray(np.where(land | (depth > 0), -9999, classes).astype(np.int16))


def _domains() -> Labels:
    """Magnetic domains: three-state Potts model with noise of one vertex."""
    chance = np.random.default_rng(13)
    states = np.stack([_smooth_field(SHAPE, 1.6, 14 + k) for k in range(3)]).argmax(0)
    flips = chance.random(SHAPE) < 0.03
    return np.asarray(np.where(flips, chance.integers(0, 3, SHAPE), states).astype(np.uint8))


def _ranks() -> Labels:
    """Numbers of 360 processors that share a grid by blocks, the same at each step."""
    _, z, y, x = np.indices(SHAPE)
    return np.asarray((z // 4 * 72 + y // 7 * 9 + x // 7).astype(np.int32))


def _flags() -> Labels:
    """Five independent yes-or-no answers as the bits of a number."""
    bits = [(_smooth_field(SHAPE, 2.5, 20 + k) > 0.3 * k) << k for k in range(5)]
    return np.asarray(np.sum(bits, axis=0).astype(np.uint8))


def _arrival() -> Labels:
    """Step at which a front reached each vertex, -1 before: values grow old and stay."""
    reached = np.floor(SHAPE[0] * (0.5 + 0.28 * _smooth_field(SHAPE[1:], 5.0, 30)))
    t = np.arange(SHAPE[0])[:, None, None, None]
    return np.asarray(np.where(reached <= t, reached, -1).astype(np.int8))


def _noise() -> Labels:
    """Random labels without any structure."""
    return np.asarray(np.random.default_rng(31).integers(0, 6, SHAPE).astype(np.uint8))


def _floats() -> Labels:
    """Material numbers in float32 with NaN outside a ball."""
    materials = _nearest_point(SHAPE, 25, 0.3, 32).astype(np.float32)
    _, z, y, x = np.indices(SHAPE)
    outside = (z - 10) ** 2 * 7 + (y - 28) ** 2 + (x - 30) ** 2 > 28**2
    return np.where(outside, np.float32(np.nan), materials)


KINDS: dict[str, Callable[[], Labels]] = {
    "components": _components,
    "tracked components": _tracked_components,
    "refinement levels": _refinement_levels,
    "basins": _basins,
    "particles": _particles,
    "checkerboard": _checkerboard,
    "stripes": _stripes,
    "many": _many,
    "large ids": _large_ids,
    "thin": _thin,
    "two steps": _two_steps,
    "tiny grid": _tiny_grid,
    "filled": _filled,
    "domains": _domains,
    "ranks": _ranks,
    "flags": _flags,
    "arrival": _arrival,
    "noise": _noise,
    "floats": _floats,
}
"""Kinds by their names; each call makes the same series."""


NOTES = (
    "bytes of fhash are the whole file, at max_error 0; of xz the compressed array alone (xz -9e)",
    "bytes of the codec are those of one Zarr chunk that holds the whole series",
    "the made series are fixed; 'many' and 'ranks' led to coding more than 256 labels, the others"
    " were not looked at when the coder of labels was designed",
)


@dataclass(frozen=True, kw_only=True)
class LabelSize:
    """Figures of one series."""

    kind: Annotated[str, "its name"]
    dtype: Annotated[str, "number type"]
    shape: Annotated[tuple[int, ...], "(t, z, y, x)"]
    distinct: Annotated[int, "number of different values"]
    raw_bytes: Annotated[int, "bytes of the array"]
    xz_bytes: Annotated[int, "of `xz -9e`"]
    fhash_bytes: Annotated[int, "of the container"]
    codec_bytes: Annotated[int, "of the codec for Zarr"]
    seconds: Annotated[float, "time of encoding the container"]

    @property
    def ratio(self) -> float:
        """Bytes of the container over those of xz: below 1, fhash is smaller."""
        return self.fhash_bytes / self.xz_bytes


class LabelReport(TypedDict):
    """Figures of all series, as JSON values."""

    kinds: Annotated[list[dict[str, Any]], list[LabelSize], "each series, the worst ratio first"]
    machine: Annotated[dict[str, Any], "date, command line, processor, load, versions and more"]
    notes: Annotated[list[str], "how it was measured"]


@dataclass(frozen=True, kw_only=True)
class LabelBench:
    """Figures of all series, the worst ratio first."""

    sizes: tuple[LabelSize, ...]
    machine: dict[str, Any]
    notes: tuple[str, ...] = NOTES

    def to_dict(self) -> LabelReport:
        """JSON values."""
        return {
            "kinds": [asdict(size) | {"ratio": size.ratio} for size in self.sizes],
            "machine": self.machine,
            "notes": list(self.notes),
        }


def bench_labels(
    source: Source | None = None,
    *,
    kinds: Sequence[str] = (),
    effort: int | None = None,
    progress: Progress = silent,
) -> LabelBench:
    """Measure one source, or the made series of `kinds` (all of them where none are named).

    Args:
        source: a file, a Series or an array, which is held in memory; None for made series.
        kinds: names of KINDS.
        effort: of encoding; None for the usual one.
        progress: is told the number of series done.

    Raises InputError for an unknown kind and for a source together with kinds, and FhashError where
    a file does not decode to the values that went in.
    """
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        raise InputError(f"kind is '{unknown[0]}'; allowed: {', '.join(KINDS)}")
    if source is not None and kinds:
        raise InputError("kinds are made series; leave them out where DATA is given")
    settings = {} if effort is None else {"effort": effort}
    config = EncodeConfig.from_dict({"max_error": 0.0, "timings": False, **settings})
    total = 1 if source is not None else len(kinds or KINDS)
    sizes = []
    with tempfile.TemporaryDirectory(prefix="fhash-bench-") as folder:
        for number, (kind, series) in enumerate(_series(source, kinds or tuple(KINDS))):
            progress("measuring", number, total, kind)
            sizes.append(_measured(kind, series, config, Path(folder) / "run.fhz"))
    progress("measuring", total, total, "")
    ordered = sorted(sizes, key=lambda size: -size.ratio)
    return LabelBench(sizes=tuple(ordered), machine=machine())


def _series(source: Source | None, kinds: Sequence[str]) -> Iterator[tuple[str, Series]]:
    """Name and series of all that is measured."""
    if source is None:
        for kind in kinds:
            # xz keeps a fill value as well, so it is data here.
            yield kind, ArraySeries(KINDS[kind](), name=kind, keep_extremes=True)
        return
    with open_source(source) as series:
        yield f"{series.source} {series.name}", series


def _measured(kind: str, series: Series, config: EncodeConfig, path: Path) -> LabelSize:
    """Figures of a series. Raises FhashError where the file decodes to other values."""
    values = np.stack(list(series.frames()))
    begun = time.perf_counter()
    fhash_codec.encode(series, path, config, force=True)
    seconds = time.perf_counter() - begun
    with open_volume(path) as volume:
        if not np.array_equal(volume[...], values, equal_nan=values.dtype.kind == "f"):
            raise FhashError(f"{kind}: the file decodes to other values than those that went in")
    return LabelSize(
        kind=kind,
        dtype=values.dtype.name,
        shape=values.shape,
        distinct=int(np.unique(values).size),
        raw_bytes=values.nbytes,
        xz_bytes=len(lzma.compress(values.tobytes(), preset=9 | lzma.PRESET_EXTREME)),
        fhash_bytes=path.stat().st_size,
        codec_bytes=len(encode_chunk(values, max_error=0.0)),
        seconds=seconds,
    )
