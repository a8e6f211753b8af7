"""Pictures of a volume: plan, decode, light, march, draw around."""

from __future__ import annotations

import time
from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.animation.evolution import evolution
from fhash_codec.rendering.colour.opacity import Histogram
from fhash_codec.rendering.march import march
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.picture.overlay import overlay, time_text
from fhash_codec.rendering.picture.plan import Plan
from fhash_codec.rendering.scene.scene import Scene
from fhash_codec.rendering.stream.fields import Field, FrameField, NetworkField
from fhash_codec.rendering.stream.stream import stream
from fhash_codec.rendering.task.bricks import Bricks
from fhash_codec.rendering.task.counters import complete
from fhash_codec.rendering.task.devices import arrays_on
from fhash_codec.rendering.task.light import light_grid
from fhash_codec.rendering.task.task import Frame, Marched
from fhash_codec.rendering.task.units import Units
from fhash_codec.volume import Volume
from fhash_formats.errors import FhashError

__all__ = ["Renderer", "render"]

Key = tuple[float, int]
"""Step and level of detail of a decoded frame."""

MEMORY = 2 << 30
"""Bytes of decoded frames that a renderer keeps."""
BINS = 512
COARSE = 2**18
"""Vertices of a level of detail that is enough for a histogram."""


def render(volume: Volume, scene: Scene | None = None, *, progress: Progress = silent) -> Image:
    """A picture of a volume; the scene's defaults suit the feature of the file.

    Raises InputError for a scene that cannot be drawn, RegionError for a step or time outside the series.
    """
    return Renderer(volume).render(Scene() if scene is None else scene, progress=progress)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Decoded:
    frame: Frame
    region: Box
    bricks: Bricks

    @property
    def nbytes(self) -> int:
        return self.frame.values.nbytes


class Renderer:
    """Makes pictures of one volume, and keeps what it decoded for the next ones, up to `memory` bytes.

    Not for several threads at once. After a picture with an `upcoming` one the volume is read in the background until the next.
    """

    def __init__(self, volume: Volume, *, memory: int = MEMORY, threads: int | None = None) -> None:
        self.volume, self.memory, self.threads = volume, memory, threads
        self._decoded: OrderedDict[Key, _Decoded] = OrderedDict()
        self._histogram: Histogram | None = None
        self._planned: tuple[Scene, Plan] | None = None
        self._reader: ThreadPoolExecutor | None = None
        self._coming: tuple[Key, Future[_Decoded]] | None = None

    def plan(self, scene: Scene) -> Plan:
        """What a picture of a scene would take; raises InputError or RegionError as `render` does."""
        timeless = replace(scene, step=None, time=None)
        if self._planned is not None and self._planned[0] == timeless:
            return self._planned[1].at(self.volume, scene)
        plan = Plan.of(self.volume, scene, histogram=self.histogram)
        self._planned = timeless, plan
        return plan

    def render(
        self,
        scene: Scene | None = None,
        *,
        plan: Plan | None = None,
        upcoming: Scene | None = None,
        progress: Progress = silent,
    ) -> Image:
        """A picture of a scene, or of a plan that was made for it.

        upcoming: the scene of the next picture. What that needs is decoded while this one is marched.
        """
        if plan is None and scene is not None and scene.evolution is not None:
            return evolution(self.volume, scene, progress=progress, draw=self.render)
        begin = time.perf_counter()
        plan = plan if plan is not None else self.plan(Scene() if scene is None else scene)
        task = plan.task
        lit: dict[str, int] = {}
        frame = (
            self._frame(plan, progress)
            if plan.mode == "cache" or plan.lights or self.volume.profile == "compact"
            else None
        )
        if upcoming is not None:
            self._prepare(upcoming)
        if plan.lights:
            assert frame is not None
            progress("lighting", 0, 1, "")
            light = light_grid(
                frame.frame,
                task.rays.grid,
                task.table,
                shadows=plan.shadows,
                lamp=plan.lamp,
                ambient_occlusion=plan.occlusion,
            )
            task, lit = replace(task, light=light), {"secondary_rays": light.secondary_rays}
            progress("lighting", 1, 1, "")
        if plan.mode == "cache":
            assert frame is not None
            progress("marching", 0, 1, "")
            marched = march(frame.frame, task, bricks=frame.bricks, threads=self.threads)
            progress("marching", 1, 1, "")
        else:
            arrays = arrays_on(plan.scene.march.device)
            field: Field = (
                FrameField(frame.frame, task.rays.grid, frame.bricks, arrays)
                if frame is not None and self.volume.profile == "compact"
                else NetworkField(self.volume, plan.step, plan.units, arrays)
            )
            marched = stream(
                field,
                task,
                adaptive=plan.mode == "arm",
                budget=plan.scene.march.samples_per_pass,
                progress=progress,
            )
        return self._finished(plan, marched, lit, begin)

    def histogram(self) -> Histogram:
        """How frequent values are in the series: of its first, middle and last step, coarse where the file has levels of detail."""
        if self._histogram is None:
            self._settle()
            volume = self.volume
            last = volume.shape[0] - 1
            # By a power of two, 1 for every ordinary range, so that edges of denormals are apart and no width overflows.
            scale = volume.value_range.scale
            edges = np.linspace(
                volume.value_range.low * scale, volume.value_range.high * scale, BINS + 1
            )
            counts = np.zeros(BINS, dtype=np.int64)
            if volume.profile == "compact":
                size = float(np.prod(volume.box.shape))
                lod = 0
                while size / 8**lod > COARSE:
                    lod += 1
                frames = [volume.read_lod(step, lod) for step in sorted({0, last // 2, last})]
            else:
                frames = [volume.read(last // 2)]
            for frame in frames:
                known = frame[np.isfinite(frame)]
                counts += np.histogram(
                    np.clip(known if scale == 1 else known * scale, edges[0], edges[-1]), edges
                )[0]
            self._histogram = edges / scale, counts
        return self._histogram

    def _frame(self, plan: Plan, progress: Progress) -> _Decoded:
        """The decoded frame of a plan, from those that are kept if one of them holds its region."""
        kept = self._kept(plan)
        if kept is not None:
            return kept
        key = plan.step, plan.lod
        progress("decoding", 0, 1, "")
        made = self._settle(key)
        if made is None or not _holds(made, plan):
            made = _decode(self.volume, plan)
        progress("decoding", 1, 1, "")
        self._decoded.pop(key, None)
        while (
            self._decoded
            and sum(each.nbytes for each in self._decoded.values()) + made.nbytes > self.memory
        ):
            self._decoded.popitem(last=False)
        if made.nbytes <= self.memory:
            self._decoded[key] = made
        return made

    def _prepare(self, scene: Scene) -> None:
        """Begin to decode what a picture of this scene needs; what is wrong with it is raised when that picture is made."""
        try:
            plan = self.plan(scene)
        except (FhashError, OSError):
            return
        if plan.mode != "cache" or self._kept(plan) is not None:
            return
        self._settle()
        if self._reader is None:
            self._reader = ThreadPoolExecutor(1, thread_name_prefix="fhash-render")
        self._coming = (plan.step, plan.lod), self._reader.submit(_decode, self.volume, plan)

    def _kept(self, plan: Plan) -> _Decoded | None:
        """What is kept of a plan's frame, if that holds its region."""
        kept = self._decoded.get((plan.step, plan.lod))
        if kept is None or not _holds(kept, plan):
            return None
        self._decoded.move_to_end((plan.step, plan.lod))
        return kept

    def _settle(self, key: Key | None = None) -> _Decoded | None:
        """Wait for what is decoded in the background, since a volume is read by one thread at a time; that frame, if it is of this key."""
        if self._coming is None:
            return None
        (of, future), self._coming = self._coming, None
        if of == key:
            return future.result()
        future.exception()  # waits; a failure of a frame that nobody wants is no one's
        return None

    def _finished(self, plan: Plan, marched: Marched, lit: dict[str, int], begin: float) -> Image:
        volume = self.volume
        image = Image(
            rgba=marched.rgba,
            depth=marched.depth,
            normal=marched.normal,
            counters=complete(marched.counters, lit),
            scene=plan.scene.to_dict(),
            source=volume.path.name,
            digest=volume.container.digest,
        )
        units = "" if volume.units in ("", "1") else f" [{volume.units}]"
        label = time_text(plan.step, plan.time, str(volume.coords["t"].attributes.get("units", "")))
        drawn = overlay(
            image,
            plan.scene.effects,
            plan.task.rays,
            colours=plan.function.colours,
            quantity=f"{volume.name}{units}",
            coords=volume.coords,
            label=label,
        )
        return replace(drawn, seconds=time.perf_counter() - begin)


def _holds(kept: _Decoded, plan: Plan) -> bool:
    """Whether a frame reaches as far as a plan looks."""
    return all(a <= c and d <= b for (a, b), (c, d) in zip(kept.region, plan.region, strict=True))


def _decode(volume: Volume, plan: Plan) -> _Decoded:
    frame = decoded_frame(volume, plan.step, plan.lod, plan.region, plan.units)
    return _Decoded(frame=frame, region=plan.region, bricks=Bricks.of(frame))


def decoded_frame(volume: Volume, step: float, lod: int, region: Box, units: Units) -> Frame:
    """The values of a region of the feature bounding box at a step, of every 2^lod-th vertex, as a marcher takes them."""
    inner = volume.box.intersect(region)
    if inner is None:
        # Nothing of the feature is in the picture.
        return Frame(
            values=np.full((1, 1, 1), np.nan, dtype=np.float32),
            first=volume.box.first,
            stride=1 << lod,
        )
    if lod == 0:
        values, first = volume.read(step, inner), inner.first
    else:
        vertices = volume.lod_vertices(lod, inner)
        first = (vertices[0].start, vertices[1].start, vertices[2].start)
        before, after = int(np.floor(step)), int(np.ceil(step))
        values = volume.read_lod(before, lod, inner)
        if after != before:
            share = volume.key_times.key_index(step) - volume.key_times.key_index(before)
            values = values * (1 - share) + volume.read_lod(after, lod, inner) * share
    return Frame(values=_single(values, units), first=first, stride=1 << lod)


def _single(values: npt.NDArray[np.floating], units: Units) -> npt.NDArray[np.float32]:
    plain = values if units == Units() else units.to(values)
    return np.ascontiguousarray(plain, dtype=np.float32)
