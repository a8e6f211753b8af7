"""Rendering a volume: plan the picture, decode a frame, light it, march rays, draw around it."""

from __future__ import annotations

import dataclasses
import math
import os
import time
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.cuda.device import first_device
from fhash_codec.cuda.nvrtc import Unavailable
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.grid import Warp
from fhash_codec.rendering.image import Image, overlay, surrounded, time_text
from fhash_codec.rendering.layout import Layout, quantity_of
from fhash_codec.rendering.light import light_grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_device import DeviceMarcher, UntriedError
from fhash_codec.rendering.march_task import Frame, Marched, Task, complete
from fhash_codec.rendering.network_frame import network_frame
from fhash_codec.rendering.plan import Plan, arrays_of, plan_at, plan_picture
from fhash_codec.rendering.scenes import MAX_SIDE, USUAL_EFFECTS, Scene
from fhash_codec.rendering.stream_fields import Field, NetworkField, WarpedField
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.tiled_frame import FrameField, TiledFrame
from fhash_codec.rendering.transfer_function import Histogram
from fhash_codec.volume import Volume, only_features
from fhash_formats.errors import FhashError, FhashWarning, InputError
from fhash_formats.support.files import file_name, without_secrets

GAP = 1 / 64
"""Gap between two panels, as a share of a panel's width."""
WIDE = 1.6
"""Width over height that the picture aims at when the scene gives no number of columns."""


def evolution(
    volume: Volume, scene: Scene, *, draw: Callable[..., Image], progress: Progress = silent
) -> Image:
    """Draw the steps of `scene.evolution` row by row in one picture.

    Each panel has a time label. Colour bar and legend of the scene are of the whole picture and are
    not drawn here.

    Args:
        volume: names the source of the picture.
        scene: a scene with an evolution; its size is that of one panel.
        draw: renders one panel, as `Renderer(volume).render` does.
        progress: is told about each finished panel.

    Raises InputError for a scene without steps and for a picture that is too large.
    """
    layout = _layout(scene)
    panels = _panels(scene)
    width, height = layout.size
    rgba = np.zeros((height, width, 4), dtype=np.float32)
    counters: Counter[str] = Counter()
    seconds = 0.0
    for number, panel in enumerate(panels):
        image = draw(panel, upcoming=panels[number + 1] if number + 1 < len(panels) else None)
        rgba[layout.pixels(number)] = image.rgba
        counters.update(image.counters)
        seconds += image.seconds
        progress("rendering", number + 1, len(panels), "")
    return Image(
        rgba=rgba,
        counters=dict(counters),
        scene=scene.to_dict(),
        source=without_secrets(volume.path),
        digest=volume.container.digest,
        seconds=seconds,
    )


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Places of the panels, in pixels.

    Attributes:
        columns: panels in a row. rows: rows of panels.
        panel: width and height of one panel.
        gap: distance between two panels.
    """

    columns: int
    rows: int
    panel: tuple[int, int]
    gap: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole picture."""
        width, height = self.panel
        return (
            self.columns * (width + self.gap) - self.gap,
            self.rows * (height + self.gap) - self.gap,
        )

    def pixels(self, number: int) -> tuple[slice, slice]:
        """Rows and columns of pixels of the panel with a number, from 0."""
        width, height = self.panel
        row, column = divmod(number, self.columns)
        top, left = row * (height + self.gap), column * (width + self.gap)
        return slice(top, top + height), slice(left, left + width)


def _layout(scene: Scene) -> _Layout:
    """Arrange the panels of a scene's evolution; raises InputError for too few or too many."""
    if scene.evolution is None or not scene.evolution.steps:
        raise InputError("an evolution needs at least one step")
    count, columns = len(scene.evolution.steps), scene.evolution.columns
    width, height = scene.size
    if columns is None:
        columns = min(count, max(1, round(math.sqrt(WIDE * count * height / width))))
        # The same number of rows may need fewer columns: then the last row is fuller.
        columns = math.ceil(count / math.ceil(count / columns))
    if not 1 <= columns <= count:
        raise InputError(f"columns is {columns}; allowed: 1 to {count}, the number of steps")
    layout = _Layout(
        columns=columns,
        rows=math.ceil(count / columns),
        panel=scene.size,
        gap=max(1, round(GAP * width)),
    )
    if max(layout.size) > MAX_SIDE:
        raise InputError(
            f"{count} pictures make {layout.size[0]} x {layout.size[1]} pixels; "
            f"at most {MAX_SIDE}: take fewer, or smaller ones"
        )
    return layout


def _panels(scene: Scene) -> list[Scene]:
    """The scene of each panel."""
    assert scene.evolution is not None
    plain = dataclasses.replace(
        scene.effects, time_label=True, colour_bar=False, legend=(), buffers=()
    )
    return [
        dataclasses.replace(scene, evolution=None, step=step, effects=plain)
        for step in scene.evolution.steps
    ]


Key = tuple[float, int]
"""Step and level of detail of a decoded frame."""

MEMORY = 2 << 30
"""Bytes of decoded frames that a renderer keeps by default."""
BINS = 512
"""Bins of the histogram of a series."""
COARSE = 2**18
"""Most vertices of a frame that is read for the histogram, where levels of detail allow it."""
FAINT = 0.01
"""Share of pixels with ink below which a picture is taken for empty: a tenth of both its sides."""
LOOKED_AT = 5
"""Steps of a series, evenly spread, that are looked at for the one of most structure."""
GLANCE = 2**15
"""Most vertices of a frame that is read to look at it: 32 along each axis show its shape."""


TRIAL_SIZE = (48, 40)
"""Pixels of the picture by which new kernels are tried."""
Source = Callable[[DeviceMarcher | None], tuple[Frame | TiledFrame, Bricks]]


class Renderer:
    """Renders pictures of one volume and keeps decoded frames for the next pictures.

    Not safe for several threads at once. After a picture with `upcoming`, a background thread reads
    the volume until the next picture begins.
    """

    def __init__(
        self,
        volume: Volume,
        *,
        memory: int = MEMORY,
        threads: int | None = None,
        pictures: int = 1,
    ) -> None:
        """Prepare to render a volume.

        Args:
            volume: an open container.
            memory: bytes of decoded frames to keep.
            threads: most threads for marching; None for all processors.
            pictures: that will be drawn, about: the more, the sooner a device pays for its start.
        """
        self.volume, self.memory, self.threads = volume, memory, threads
        self._pictures = pictures
        self._whole = volume
        self._features: tuple[str, ...] = ()
        self._frames: OrderedDict[Key, TiledFrame] = OrderedDict()
        self._histogram: Histogram | None = None
        self._last_plan: tuple[Scene, Plan] | None = None
        self._marcher: DeviceMarcher | None = None
        self._refused = False
        self._of_network: tuple[float, Frame, Bricks] | None = None
        self._fullest: tuple[Any, int] | None = None
        self._background: ThreadPoolExecutor | None = None
        self._prefetch: tuple[Key, Future[TiledFrame]] | None = None
        self._process = os.getpid()

    def plan(self, scene: Scene) -> Plan:
        """Plan a picture without rendering it; raises InputError or RegionError as `render` does.

        A scene that differs from the last one only in its time takes over the rest of that plan.
        One without a time is planned at the step of most structure (`at_fullest`).
        """
        scene = self.at_fullest(scene)
        self._choose(scene.features)
        timeless = replace(scene, step=None, time=None)
        if self._last_plan is not None and self._last_plan[0] == timeless:
            return plan_at(self._last_plan[1], self.volume, scene)
        plan = plan_picture(self.volume, scene, histogram=self.histogram, pictures=self._pictures)
        self._last_plan = timeless, plan
        return plan

    def at_fullest(self, scene: Scene) -> Scene:
        """The scene at the step of most structure, of some, where it says neither step nor time."""
        several = self.volume.shape[0] > 1 and scene.evolution is None
        if scene.step is not None or scene.time is not None or not several:
            return scene
        plan = self.plan(replace(scene, step=0.0))
        looks = scene.features, scene.transfer_function, scene.effects.isosurfaces
        if self._fullest is None or self._fullest[0] != looks:
            self._finish_prefetch()
            self._fullest = looks, _fullest_step(self.volume, plan)
        return replace(scene, step=float(self._fullest[1]))

    def render(
        self,
        scene: Scene | None = None,
        *,
        plan: Plan | None = None,
        upcoming: Scene | None = None,
        progress: Progress = silent,
    ) -> Image:
        """Render a scene, or a plan that was made for it.

        Args:
            scene: what to show; None for the default scene with USUAL_EFFECTS. One with `evolution`
                gives several steps side by side.
            plan: a plan of `plan`, in place of a scene.
            upcoming: the scene of the next picture; its frame is decoded while this one is marched.
            progress: is told about each stage.

        Raises InputError for a scene that cannot be drawn, RegionError for a step or time outside
        the series.
        """
        if plan is None and scene is not None and scene.evolution is not None:
            panels = evolution(self.volume, scene, progress=progress, draw=self.render)
            first = replace(scene, evolution=None, step=scene.evolution.steps[0])
            return surrounded(
                panels,
                scene.effects,
                colours=self.plan(first).function.colours,
                quantity=quantity_of(self.volume.name, self.volume.units),
            )
        begin = time.perf_counter()
        if plan is None:
            plan = self.plan(Scene(effects=USUAL_EFFECTS) if scene is None else scene)
        self._choose(plan.scene.features)
        decoded = self._frame(plan, progress) if plan.lights or not plan.network else None
        if upcoming is not None and plan.decodes_all:  # else the march reads the volume
            self._start_prefetch(upcoming)
        task, secondary_rays = _lit(plan, decoded, progress)
        progress("marching", 0, 1, "")
        if plan.network:
            marched = self._march_network(plan, task, progress)
        else:
            assert decoded is not None
            marched = self._march_frame(plan, task, decoded, progress)
        progress("marching", 1, 1, "")
        more = {
            "secondary_rays": secondary_rays,
            "decoded_vertices": 0 if decoded is None else decoded.vertices,
        }
        return self._finish(plan, marched, more, begin)

    def _choose(self, features: tuple[str, ...]) -> None:
        """Show some features of the volume alone; all if there are none. Forget other frames."""
        if features != self._features:
            self._finish_prefetch()
            chosen = only_features(self._whole, features) if features else self._whole
            self.volume, self._features = chosen, features
            self._frames.clear()
            self._histogram = self._last_plan = self._of_network = None

    def histogram(self) -> Histogram:
        """Count the values of the series: its first, middle and last step, coarse if possible."""
        if self._histogram is None:
            self._finish_prefetch()
            self._histogram = _histogram_of(self.volume)
        return self._histogram

    def _march_frame(
        self, plan: Plan, task: Task, tiles: TiledFrame, progress: Progress
    ) -> Marched:
        """March the rays of a task through a decoded frame."""
        frame, bricks = tiles.frame, tiles.bricks
        if not plan.streams:
            source = frame if tiles.decoded.all() else tiles
            return self._drawn(plan, task, lambda marcher: (source, bricks), progress)
        arrays = arrays_of(plan.scene)
        marched = stream(
            FrameField(frame, bricks, task.rays.grid, arrays),
            task,
            adaptive=plan.mode == "arm",
            budget=plan.scene.march.samples_per_pass,
            progress=progress,
        )
        # Looking up decoded values is not an evaluation of a network.
        return replace(marched, counters={**marched.counters, "evaluations": 0})

    def _march_network(self, plan: Plan, task: Task, progress: Progress) -> Marched:
        """March the rays of a task through the published network."""
        warp = task.rays.grid.warp
        if not plan.streams:
            return self._drawn(
                plan,
                task,
                lambda marcher: self._network_frame(plan, warp, marcher),
                progress,
            )
        field: Field = NetworkField(self.volume, plan.step, plan.units, arrays_of(plan.scene))
        if warp is not None:
            field = WarpedField(field, warp)
        return stream(
            field,
            task,
            adaptive=plan.mode == "arm",
            budget=plan.scene.march.samples_per_pass,
            progress=progress,
        )

    def _network_frame(
        self, plan: Plan, warp: Warp | None, marcher: DeviceMarcher | None
    ) -> tuple[Frame, Bricks]:
        """The frame of the network at a plan's step; that of a device is kept for the next."""
        if marcher is None:
            return network_frame(self.volume, plan.step, plan.units, warp, None)
        if self._of_network is None or self._of_network[0] != plan.step:
            self._of_network = None  # both may not fit
            found = network_frame(self.volume, plan.step, plan.units, warp, marcher)
            self._of_network = plan.step, *found
        return self._of_network[1:]

    def _drawn(self, plan: Plan, task: Task, source: Source, progress: Progress) -> Marched:
        """March on the plan's device, kernels that never ran here before after a trial.

        source: function of the device, None for the processor, that gives the frame and its bricks.
        """

        def by(marcher: DeviceMarcher | None, task: Task = task) -> Marched:
            frame, bricks = source(marcher)
            threads = self.threads
            return march(
                frame, task, bricks=bricks, threads=threads, progress=progress, device=marcher
            )

        if plan.device == "cpu" or self._refused:
            return by(None)
        try:
            if self._marcher is None:
                self._marcher = DeviceMarcher(first_device())
            try:
                return by(self._marcher)
            except UntriedError:
                rays = replace(task.rays, size=TRIAL_SIZE)
                small = replace(task, rays=rays, antialiasing=1)
                self._marcher.trial(lambda: by(self._marcher, small), by(None, small))
                return by(self._marcher)
        except (Unavailable, MemoryError) as error:
            reason = f"the CUDA device cannot draw this: {error}"
            if plan.scene.march.device == "cuda":
                raise InputError(f"{reason}; use --device cpu") from error
            warnings.warn(f"{reason}; the CPU draws", FhashWarning, stacklevel=2)
            self._refused = True
            return by(None)

    def _finish(self, plan: Plan, marched: Marched, more: dict[str, int], begin: float) -> Image:
        """Make a picture of what was marched, with its overlay.

        more: counters of what came before the march. begin: when rendering began.
        """
        volume = self.volume
        layout = plan.layout
        image = Image(
            rgba=marched.rgba,
            scene=plan.scene.to_dict(),
        )
        image = replace(
            image,
            ink=image.ink_share(),
            rgba=_in_picture(marched.rgba, layout, 0.0),
            depth=None if marched.depth is None else _in_picture(marched.depth, layout, np.inf),
            normal=None if marched.normal is None else _in_picture(marched.normal, layout, 0.0),
            counters=complete(marched.counters, more),
            source=file_name(volume.path),
            digest=volume.container.digest,
        )
        label = time_text(plan.step, plan.time, volume.coords["t"])
        drawn = overlay(
            image,
            plan.scene.effects,
            plan.task.rays,
            layout,
            colours=plan.function.colours,
            label=label,
            body=plan.task.body,
        )
        return replace(drawn, seconds=time.perf_counter() - begin)

    def _frame(self, plan: Plan, progress: Progress) -> TiledFrame:
        """The decoded frame of a plan: a cached one, the prefetched one, or a new one."""
        cached = self._cached(plan)
        if cached is not None:
            if not cached.decoded.all():
                self._finish_prefetch()  # now the volume is read here
                if plan.decodes_all:
                    cached.complete()
            return cached
        key = plan.step, plan.lod
        progress("decoding", 0, 1, "")
        decoded = self._finish_prefetch(key)
        if decoded is None or not decoded.covers(plan.region):
            decoded = _decode(self.volume, plan)
        progress("decoding", 1, 1, "")
        self._cache(key, decoded)
        return decoded

    def _cached(self, plan: Plan) -> TiledFrame | None:
        """The cached frame of a plan, if it covers the plan's region."""
        key = plan.step, plan.lod
        cached = self._frames.get(key)
        if cached is None or not cached.covers(plan.region):
            return None
        self._frames.move_to_end(key)
        return cached

    def _cache(self, key: Key, decoded: TiledFrame) -> None:
        """Keep a frame, and drop the least recently used ones beyond the memory."""
        self._frames.pop(key, None)
        while (
            self._frames
            and sum(cached.nbytes for cached in self._frames.values()) + decoded.nbytes
            > self.memory
        ):
            self._frames.popitem(last=False)
        if decoded.nbytes <= self.memory:
            self._frames[key] = decoded

    def _start_prefetch(self, scene: Scene) -> None:
        """Begin to decode the frame of a scene; an error is raised when the scene is rendered."""
        if scene.features != self._features:
            return
        try:
            plan = self.plan(scene)
        except (FhashError, OSError):
            return
        if not plan.decodes_all or self._cached(plan) is not None:
            return
        self._finish_prefetch()
        if self._background is None:
            self._background = ThreadPoolExecutor(1, thread_name_prefix="fhash-render")
        future = self._background.submit(_decode, self.volume, plan)
        self._prefetch = (plan.step, plan.lod), future

    def _finish_prefetch(self, key: Key | None = None) -> TiledFrame | None:
        """Wait for the prefetched frame; return it if it has this key.

        The wait is needed in any case: only one thread at a time may read a volume.
        """
        if self._process != os.getpid():  # a forked process has none of its parent's threads
            self._process, self._background, self._prefetch = os.getpid(), None, None
        if self._prefetch is None:
            return None
        (prefetched, future), self._prefetch = self._prefetch, None
        if prefetched == key:
            return future.result()
        future.exception()  # wait; the error of a prefetched frame that nobody needs is dropped
        return None


def _in_picture(
    pixels: npt.NDArray[np.float32], layout: Layout, empty: float
) -> npt.NDArray[np.float32]:
    """A picture (H, W) or (H, W, n) with the pixels of its view, and one number around them."""
    left, top, width, height = layout.view
    if (width, height) == layout.size:
        return pixels
    whole = np.full((*layout.size[::-1], *pixels.shape[2:]), empty, dtype=np.float32)
    whole[top : top + height, left : left + width] = pixels
    return whole


def _lit(plan: Plan, decoded: TiledFrame | None, progress: Progress) -> tuple[Task, int]:
    """The task of a plan with its light, and the number of secondary rays that the light took."""
    if not plan.lights:
        return plan.task, 0
    assert decoded is not None
    progress("lighting", 0, 1, "")
    light = light_grid(
        decoded.frame,
        plan.task,
        shadows=plan.shadows,
        lamp=plan.lamp,
        ambient_occlusion=plan.occlusion,
        bricks=decoded.bricks,
    )
    progress("lighting", 1, 1, "")
    return replace(plan.task, light=light), light.secondary_rays


def faint_text(image: Image, plan: Plan, volume: Volume) -> str:
    """Text on a picture that has hardly any ink; empty for others."""
    if image.ink >= FAINT:
        return ""
    low, high = volume.value_range.low, volume.value_range.high
    why = "another step, opacity or zoom may show more" if low < high else f"all values are {low:g}"
    return (
        f"{image.ink:.2%} of the picture's pixels differ from the background at step "
        f"{plan.step:g}: {why}"
    )


def _fullest_step(volume: Volume, plan: Plan) -> int:
    """The step of most structure among LOOKED_AT of them, the earliest of equal ones."""
    last, parts = volume.shape[0] - 1, LOOKED_AT - 1
    most, best = 0.0, 0
    for step in sorted({(2 * last * part + parts) // (2 * parts) for part in range(LOOKED_AT)}):
        found = structure(_coarse(volume, step, GLANCE), plan)
        if found > most * (1 + 1e-6):  # beyond the rounding of sums
            most, best = found, step
    return best


def structure(values: npt.NDArray[Any], plan: Plan) -> float:
    """Sum of the differences of neighbouring vertices (z, y, x) as a picture shows them.

    What a vertex looks like is its opacity and, where it has some, its place in the colours.
    """
    values = values.astype(np.float64)  # as scenes have numbers
    low, high = plan.function.colours.positions[[0, -1]]
    opacity = plan.function.opacity(values)
    with np.errstate(over="ignore", invalid="ignore"):
        colour = np.clip((values - low) / (high - low), 0, 1)
    looks = np.where(opacity > 0, opacity * (1 + colour), 0.0)
    for surface in plan.scene.effects.isosurfaces:
        looks = looks + np.where(values >= surface.value, surface.opacity, 0.0)
    return sum(float(np.abs(np.diff(looks, axis=axis)).sum()) for axis in range(3))


def _coarse(volume: Volume, step: int, vertices: int) -> npt.NDArray[Any]:
    """Values (z, y, x) of a step at about so many vertices of the box, at most where it can be."""
    lod = 0
    while float(np.prod(volume.box.shape)) / 8**lod > vertices:
        lod += 1
    if volume.profile == "compact":
        return volume.read_lod(step, lod)
    if not lod:
        return volume.read(step)
    z, y, x = np.ix_(*(range(low, high, 1 << lod) for low, high in volume.box))
    return np.asarray(volume.sample(t=step, z=z, y=y, x=x))


def _histogram_of(volume: Volume) -> Histogram:
    """Count the finite values of a few steps in BINS bins over the value range."""
    last = volume.shape[0] - 1
    # A power of two, 1 for every ordinary range, keeps edges of denormals apart and widths finite.
    scale = volume.value_range.scale
    edges = np.linspace(volume.value_range.low * scale, volume.value_range.high * scale, BINS + 1)
    counts = np.zeros(BINS, dtype=np.int64)
    steps = sorted({0, last // 2, last}) if volume.profile == "compact" else [last // 2]
    for frame in (_coarse(volume, step, COARSE) for step in steps):
        finite = frame[np.isfinite(frame)]
        if scale != 1:  # beyond float64 where the values are not those of the range
            with np.errstate(over="ignore"):
                finite = finite.astype(np.float64) * scale
        counts += np.histogram(np.clip(finite, edges[0], edges[-1]), edges)[0]
    return edges / scale, counts


def _decode(volume: Volume, plan: Plan) -> TiledFrame:
    return TiledFrame(
        volume,
        plan.step,
        plan.lod,
        plan.region,
        units=plan.units,
        warp=plan.task.rays.grid.warp,
        whole=plan.decodes_all,
    )
