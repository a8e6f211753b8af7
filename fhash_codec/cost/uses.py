"""Reads and pictures of `fhash cost`: what frames, regions, levels of detail and effects cost."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box
from fhash_codec.cost.encodings import PLACES, REGION, KeptFile
from fhash_codec.cost.plan import Allowance, Facts
from fhash_codec.cost.results import NETWORK, Picture, Read
from fhash_codec.measure.errors import psnr
from fhash_codec.measure.metrics import ssim
from fhash_codec.progress import Progress
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame, complete, warped
from fhash_codec.rendering.plan import Plan
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import (
    AmbientOcclusion,
    AttenuatedMaximum,
    Effects,
    Isosurface,
    Marching,
    Scene,
    Shading,
    Shadows,
)
from fhash_codec.rendering.tiled_frame import decoded_frame
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.series import Series
from fhash_formats.support.values import Single, Values

LEVELS = (1, 2, 3)
"""Levels of detail."""


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """A kind of read.

    Attributes:
        read: reads at a step and region; the values that were read.
        compare: pairs of (original, read) of the last read, both of one shape.
    """

    what: str
    read: Callable[[Volume, int, Box], Values]
    compare: Callable[[Volume, int, Box, Values], tuple[Values, Values]] | None
    size: tuple[int, int, int] | None


def measure_reads(
    series: Series,
    files: Sequence[KeptFile],
    facts: Facts,
    allowance: Allowance,
    progress: Progress,
) -> Iterator[Read]:
    """Measure every kind of read from every file, until the time of the part is over.

    Each read opens the file anew; the operating system has it in memory. The places are the same
    for every file.
    """
    for number, file in enumerate(files):
        with allowance.work(f"reads of {file.name}"):
            expected = 0.0
            with open_volume(file.path) as volume:
                profile = volume.profile
            for kind in _kinds(series, profile):
                if not allowance.has(f"{kind.what} of {file.name}", expected):
                    break
                begun = time.perf_counter()
                yield _measured(series, file, kind, facts)
                expected = time.perf_counter() - begun
        progress("reading", number + 1, len(files), file.name)
        if allowance.interrupted:
            break


def _kinds(series: Series, profile: str) -> Iterator[_Kind]:
    """The kinds of reads that a series and a profile have."""
    steps, *space = series.shape

    def original(_: Volume, step: int, region: Box, values: Values) -> tuple[Values, Values]:
        return series.read(step)[region.slices()], values

    def over_time(_: Volume, step: int, region: Box, values: Values) -> tuple[Values, Values]:
        frames = [series.read(number)[region.slices()].ravel() for number in range(steps)]
        return np.concatenate(frames), values

    small = tuple(min(REGION, n) for n in space)
    yield _Kind(what="open", read=lambda volume, *_: np.empty(0), compare=None, size=None)
    yield _Kind(
        what="frame",
        read=lambda volume, step, region: volume.read(step),
        compare=original,
        size=(space[0], space[1], space[2]),
    )
    yield _Kind(
        what=f"region of {REGION}^3",
        read=lambda volume, step, region: volume.read(step, region),
        compare=original,
        size=(small[0], small[1], small[2]),
    )
    if steps > 1:
        yield _Kind(what="line in time", read=_line, compare=over_time, size=(1, 1, 1))
    if profile == "compact":
        for lod in LEVELS:
            if max(space) > 1 << lod:
                yield _level(series, lod)


def _line(volume: Volume, step: int, region: Box) -> Values:
    """All steps of one vertex."""
    return np.concatenate([volume.read(t, region).ravel() for t in range(volume.shape[0])])


def _level(series: Series, lod: int) -> _Kind:
    """A whole frame at a level of detail; its error is that of linear interpolation between its
    vertices."""
    _, *space = series.shape

    def compare(volume: Volume, step: int, region: Box, values: Values) -> tuple[Values, Values]:
        fine = interpolated(values, volume.lod_vertices(lod), space)
        return series.read(step), fine

    return _Kind(
        what=f"level of detail {lod}",
        read=lambda volume, step, region: volume.read_lod(step, lod),
        compare=compare,
        size=(space[0], space[1], space[2]),
    )


def interpolated(values: Values, places: Sequence[range], space: Sequence[int]) -> Values:
    """Values (z, y, x) at some vertices, linear between them and constant beyond, at all vertices.

    Args:
        values: (z, y, x), NaN where there is none.
        places: the vertices of the values along each axis.
        space: vertices of the domain along each axis.
    """
    result = np.asarray(values, dtype=np.float64)
    for axis, (at, length) in enumerate(zip(places, space, strict=True)):
        position = np.interp(np.arange(length), np.asarray(at), np.arange(len(at)))
        low = np.floor(position).astype(np.int64)
        high = np.minimum(low + 1, len(at) - 1)
        share = (position - low).reshape([-1 if n == axis else 1 for n in range(3)])
        # A weight of 0 must not spread NaN.
        upper = np.where(share > 0, np.take(result, high, axis), 0.0)
        result = np.take(result, low, axis) * (1 - share) + upper * share
    return result


def _measured(series: Series, file: KeptFile, kind: _Kind, facts: Facts) -> Read:
    """The medians of a kind of read."""
    rng = np.random.default_rng(0)
    steps, *space = series.shape
    size = kind.size or (1, 1, 1)
    taken, touched = [], []
    squares, count, largest = 0.0, 0, 0.0
    values: Values = np.empty(0)
    for place in range(PLACES + 1):
        step = int(rng.integers(0, steps))
        low = [int(rng.integers(0, n - m + 1)) for n, m in zip(space, size, strict=True)]
        region = Box.of_shape(size).shift(low)
        begun = time.perf_counter()
        with open_volume(file.path) as volume:
            values = kind.read(volume, step, region)
            seconds = time.perf_counter() - begun
            if place == 0:
                continue
            taken.append(seconds)
            touched.append(volume.container.bytes_read)
            if kind.compare is None:
                continue
            original, decoded = kind.compare(volume, step, region, values)
        both = np.isfinite(original) & np.isfinite(decoded)
        # Scaled by a power of two near the range, squares of large values do not overflow.
        scaled = (part[both].astype(np.float64) * facts.scale for part in (original, decoded))
        error = np.abs(np.subtract(*scaled))
        squares, count = squares + float(np.sum(error**2)), count + error.size
        largest = max(largest, float(error.max(initial=0.0)))
    rmse = (squares / count) ** 0.5 if count else None
    return Read(
        file=file.name,
        file_psnr=file.psnr,
        what=kind.what,
        values=values.size,
        milliseconds=1e3 * median(taken),
        bytes_read=round(median(touched)),
        psnr=psnr(facts.width * facts.scale, rmse),
        max_abs_error=largest / facts.scale if count else None,
    )


Pixels = npt.NDArray[np.uint8]


def black(rgba: Single) -> Pixels:
    """Bytes (H, W, 3) over black of a picture (H, W, 4) that is multiplied by its opacity."""
    return np.asarray(np.rint(np.clip(rgba[..., :3], 0.0, 1.0) * 255), dtype=np.uint8)


def picture_psnr(
    picture: npt.NDArray[np.generic], other: npt.NDArray[np.generic], peak: float
) -> float | None:
    """PSNR in dB over all pixels and channels, `peak` being white; None where nothing differs."""
    error = float(np.mean((picture.astype(np.float64) - other.astype(np.float64)) ** 2))
    return 10 * math.log10(peak * peak / error) if error else None


def picture_ssim(picture: Pixels, other: Pixels) -> float:
    """Mean structural similarity of bytes (H, W, 3) over the channels; see
    `fhash_codec.measure.metrics`."""
    total = count = 0.0
    for channel in range(3):
        similarity, number = ssim(picture[None, ..., channel], other[None, ..., channel], 255.0)
        total, count = total + similarity, count + number
    return total / count if count else 1.0


STEPS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
"""Ray steps, in vertex spacings."""
THRESHOLDS = (0.3, 0.1, 0.03, 0.01, 1 / 256, 1 / 1024)
"""Shares of light at which a ray ends."""
FINEST = {"step": 1 / 32, "threshold": 0.0, "lod": 0.0}
"""Finest setting of each knob; pictures of other settings are compared with its picture."""


SIZE = 384
"""Pixels along both sides."""
MARCH_SIZE = 128
"""Pixels along both sides where ways to march are compared."""
NETWORK_SIZE = 48
"""Pixels along both sides where rays march through a network."""
TURNS = 3
"""Runs of each median."""
NOTHING = "nothing named"
"""Name of the picture without any effect."""


class PictureCosts:
    """Pictures of one file, and of others beside it."""

    def __init__(
        self,
        volume: Volume,
        allowance: Allowance,
        progress: Progress,
        pictures: list[Picture],
    ) -> None:
        """Prepare pictures of the middle step of a volume; what is measured goes to `pictures`."""
        self._volume, self._allowance, self._progress = volume, allowance, progress
        self._renderer = Renderer(volume)
        self._scene = Scene(
            size=(SIZE, SIZE),
            step=float(volume.shape[0] // 2),
            background="black",
            march=Marching(mode="cache", lod=0),
        )
        self._pictures = pictures
        self._seconds = 0.0

    def measure(self, series: Series, files: Sequence[KeptFile]) -> None:
        """Measure everything, the most telling first, until the time of the part is over."""
        with self._allowance.work("pictures"):
            self._renderer.render(self._scene)
            begun = time.perf_counter()
            self._renderer.render(self._scene)
            self._seconds = time.perf_counter() - begun
        self._group("effect", self._effects(), best=None)
        self._knob("step length", "step", STEPS)
        if self._volume.profile == "compact":
            side = max(self._volume.box.shape)
            self._knob("level of detail", "lod", [n for n in LEVELS if side > 1 << n])
        self._encodings(series, files)
        if self._volume.profile == "paper":
            self._marches(self._renderer, MARCH_SIZE)
        self._knob("threshold", "threshold", THRESHOLDS)
        self._first_pictures()
        for file in files:
            if not self._allowance.interrupted and file.name == NETWORK:
                with open_volume(file.path) as volume:
                    self._marches(Renderer(volume), NETWORK_SIZE)

    def _group(
        self,
        group: str,
        scenes: Mapping[str, Scene],
        *,
        best: str | None,
        renderer: Renderer | None = None,
        turns: int = TURNS,
    ) -> None:
        """Measure scenes in turns; with `best` each is compared with that one."""
        renderer = renderer or self._renderer
        expected = self._seconds * len(scenes)
        if turns > 1 and expected * (turns + 1) > self._allowance.left:
            turns = 1
        if not self._allowance.has(f"pictures by {group}", expected * (turns + 1)):
            return
        begun = time.perf_counter()
        with self._allowance.work(f"pictures by {group}"):
            guarded = self._allowance.guard(self._progress)
            runs = {
                name: partial(renderer.render, scene, progress=guarded)
                for name, scene in scenes.items()
            }
            measured = in_turns(runs, turns)
            self._seconds = (time.perf_counter() - begun) / len(scenes) / (turns + 1)
            for name, (milliseconds, image) in measured.items():
                reference = None if best is None else measured[best][1].rgba
                self._add(group, name, milliseconds, image, reference, best=name == best)
        self._progress("drawing", 1, 1, group)

    def _add(
        self,
        group: str,
        setting: str,
        milliseconds: float,
        image: Image,
        reference: Single | None,
        *,
        best: bool = False,
    ) -> None:
        psnr, ssim = _likeness(image.rgba, reference)
        self._pictures.append(
            Picture(
                group=group,
                setting=setting,
                milliseconds=milliseconds,
                counters=complete(image.counters),
                psnr=psnr,
                ssim=ssim,
                best=best,
            )
        )

    def _effects(self) -> dict[str, Scene]:
        """Each effect alone, after the scene that names none."""
        middle = float(np.mean(self._renderer.plan(self._scene).function.span))
        effects = {
            NOTHING: Effects(),
            "shading": Effects(shading=Shading()),
            "shadows": Effects(shadows=Shadows()),
            "ambient occlusion": Effects(ambient_occlusion=AmbientOcclusion()),
            "isosurface": Effects(isosurfaces=(Isosurface(value=middle),)),
            "maximum intensity": Effects(maximum_intensity=True),
            "minimum intensity": Effects(minimum_intensity=True),
            "average intensity": Effects(average_intensity=True),
            "attenuated maximum": Effects(attenuated_maximum_intensity=AttenuatedMaximum()),
            "depth and normals": Effects(buffers=("depth", "normal")),
            "antialiasing 2": Effects(antialiasing=2),
            "jitter": Effects(jitter=True),
            "box, axes, colour bar": Effects(box=True, axes=True, colour_bar=True),
        }
        return {name: replace(self._scene, effects=chosen) for name, chosen in effects.items()}

    def _knob(self, group: str, knob: str, values: Sequence[float]) -> None:
        """Vary one setting of the march against its finest value."""
        finest = FINEST[knob]
        scenes = {f"{value:.4g}": self._with(knob, value) for value in (*values, finest)}
        self._group(group, scenes, best=f"{finest:.4g}")

    def _with(self, knob: str, value: float) -> Scene:
        changed: dict[str, Any] = {knob: int(value) if knob == "lod" else value}
        return replace(self._scene, march=replace(self._scene.march, **changed))

    def _marches(self, renderer: Renderer, side: int) -> None:
        """Compare the cache with rays through a network: sample by sample, and adaptive (ARM)."""
        scenes = {
            name: replace(
                self._scene,
                size=(side, side),
                march=replace(self._scene.march, mode=mode),
            )
            for name, mode in (
                ("cache", "cache"),
                ("stream, ARM off", "stream"),
                ("ARM on", "arm"),
            )
        }
        self._group(
            f"march, {NETWORK}, {side} px", scenes, best="cache", renderer=renderer, turns=1
        )

    def _first_pictures(self) -> None:
        """Compare first pictures of a step by level of detail: nothing is decoded yet."""
        if self._volume.profile == "compact":
            levels = [0, *(n for n in LEVELS if max(self._volume.box.shape) > 1 << n)]
            scenes = {f"{level}": self._with("lod", level) for level in levels}
            fresh = Renderer(self._volume, memory=0)
            self._group("level of detail, first picture", scenes, best="0", renderer=fresh)

    def _encodings(self, series: Series, files: Sequence[KeptFile]) -> None:
        """Compare the picture of each file with that of the source, all by one plan."""
        group = "encoding"
        if not self._allowance.has(f"pictures by {group}", 2 * self._seconds * (len(files) + 1)):
            return
        plan = self._renderer.plan(self._scene)
        with self._allowance.work(f"pictures by {group}"):
            reference = _marched(self._source_frame(series, plan), plan)
            for file in files:
                with open_volume(file.path) as volume:
                    begun = time.perf_counter()
                    frame = decoded_frame(volume, plan.step, 0, plan.region, plan.units)
                    image = _marched(frame, plan)
                    seconds = time.perf_counter() - begun
                counters = {**image.counters, "decoded_vertices": frame.values.size}
                image = replace(image, counters=counters)
                self._add(group, file.name, 1e3 * seconds, image, reference.rgba)
            self._add(group, "the source", 0.0, reference, None, best=True)

    def _source_frame(self, series: Series, plan: Plan) -> Frame:
        """The frame of the source that a plan decodes from a file, in the units of its march."""
        values = plan.units.single(series.read(int(plan.step))[plan.region.slices()])
        kept = self._volume.occupancy(plan.step, plan.region)
        z, y, x = (low for low, _ in plan.region)
        return Frame(values=np.where(kept, values, np.float32(np.nan)), first=(z, y, x))


def _marched(frame: Frame, plan: Plan) -> Image:
    """A picture of a frame by the task of a plan, without what is drawn around it."""
    result = march(warped(frame, plan.task.rays.grid.warp), plan.task)
    return Image(rgba=result.rgba, counters=complete(result.counters))


def _likeness(rgba: Single, reference: Single | None) -> tuple[float | None, float | None]:
    """PSNR in dB and SSIM of a picture against another; None without one."""
    if reference is None:
        return None, None
    if reference is rgba:
        return None, 1.0
    return picture_psnr(rgba, reference, 1.0), picture_ssim(black(rgba), black(reference))


def in_turns(runs: Mapping[str, Callable[[], Image]], turns: int) -> dict[str, tuple[float, Image]]:
    """Run every variant once without timing, then in turns.

    Returns the median milliseconds and the last picture of each variant.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    images = {name: run() for name, run in runs.items()}
    for _ in range(turns):
        for name, run in runs.items():
            begun = time.perf_counter()
            images[name] = run()
            seconds[name].append(time.perf_counter() - begun)
    return {name: (1e3 * median(seconds[name]), images[name]) for name in runs}
