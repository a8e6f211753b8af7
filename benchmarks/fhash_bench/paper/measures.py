"""Measurements of a cell: training on the clock, quality between key frames, pictures, latency."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from fhash_bench.engines import wait
from fhash_bench.paper.cells import Point
from fhash_bench.paper.data import Data
from fhash_codec.cost.uses import black, picture_psnr, picture_ssim
from fhash_codec.devices import choose_device
from fhash_codec.features.features import Interval, Isosurface, Segmentation, parse_feature
from fhash_codec.features.key_frames import time_axis
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.bricks import Bricks
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Array, Arrays, Frame, Lighting, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera, TransferFunctionSpec
from fhash_codec.rendering.stream_fields import CoresetField
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.torch_arrays import TorchArrays
from fhash_codec.rendering.transfer_function import TransferFunction
from fhash_formats.support.values import Mask, Single

if TYPE_CHECKING:
    from fhash_bench.paper.trained import TrainedEncoding

EVERY_EPOCH = 20
"""Epochs from the first that are all measured."""
POINTS = 20
"""Points of a curve after these, about."""
DECIBELS = (20.0, 30.0, 40.0)
"""PSNR in dB to which the paper's Table 3 gives times."""

Frames = Sequence[npt.NDArray[np.float32]]
PictureMeasure = Callable[[Frames], tuple[float, float]]
"""Mean PSNR in dB and SSIM of pictures of the key frames' normalised frames (z, y, x)."""


@dataclass(frozen=True, kw_only=True)
class Trained:
    """The course of a training.

    Attributes:
        curve: points, the first before training.
        seconds: of all epochs, as `Point` has them, without the measurements.
    """

    curve: tuple[Point, ...]
    seconds: float


def measured_epochs(epochs: int) -> list[int]:
    """Return the epochs after which a training is measured, 0 and the last one included.

    All up to EVERY_EPOCH are, and 30, of which the paper's Table 4 is.
    """
    every = max(1, (epochs - EVERY_EPOCH) // POINTS)
    return [
        epoch
        for epoch in range(epochs + 1)
        if epoch <= EVERY_EPOCH or epoch in (30, epochs) or (epoch - EVERY_EPOCH) % every == 0
    ]


def train(
    encoding: TrainedEncoding,
    data: Data,
    epochs: int,
    *,
    device: torch.device,
    picture: PictureMeasure | None = None,
    progress: Progress = silent,
) -> Trained:
    """Train an encoding and measure it on the way.

    Args:
        encoding: the encoding, changed in place. The caller has warmed up its kind.
        data: what it is trained on and compared with.
        epochs: passes over its samples.
        device: where it computes.
        picture: measures pictures of the key frames.
        progress: called after each epoch.
    """
    # Others on the machine do not slow a processor's own seconds.
    clock = time.perf_counter if device.type == "cuda" else time.process_time
    points, seconds = [_point(encoding, data, 0, 0.0, picture)], 0.0
    measured = set(measured_epochs(epochs))
    for epoch in range(epochs):
        begun = clock()
        encoding.train_epoch(epoch)
        wait(device)
        seconds += clock() - begun
        if epoch + 1 in measured:
            points.append(_point(encoding, data, epoch + 1, seconds, picture))
        latest = points[-1].coreset_psnr
        note = "" if latest is None else f"{latest:.1f} dB"
        progress("training", epoch + 1, epochs, note)
    return Trained(curve=tuple(points), seconds=seconds)


def rank(curve: Sequence[Point]) -> tuple[int, float, float]:
    """Return a key that is larger for the better of two courses of an encoding.

    More of DECIBELS reached on the coreset come first, then fewer seconds to the last of these,
    then the highest PSNR.
    """
    seconds = [first_seconds(curve, decibels) for decibels in DECIBELS]
    reached = [value for value in seconds if value is not None]
    highest = max((point.coreset_psnr or -math.inf for point in curve), default=-math.inf)
    return len(reached), -reached[-1] if reached else -math.inf, highest


def first_seconds(curve: Sequence[Point], decibels: float) -> float | None:
    """Return the seconds of training to a PSNR of the coreset; None where it is not reached."""
    return next(
        (p.seconds for p in curve if p.coreset_psnr is not None and p.coreset_psnr >= decibels),
        None,
    )


def _point(
    encoding: TrainedEncoding,
    data: Data,
    epoch: int,
    seconds: float,
    picture: PictureMeasure | None,
) -> Point:
    """Return the figures of an encoding after some epochs."""
    encoding.settle()
    frames = [encoding.frame(key) for key in range(len(data.key_frames))]
    step = epoch * encoding.steps_an_epoch
    if not all(np.isfinite(frame).all() for frame in frames):
        return Point(step=step, epoch=epoch, seconds=seconds)
    picture_psnr, picture_ssim = (None, None) if picture is None else picture(frames)
    return Point(
        step=step,
        epoch=epoch,
        seconds=seconds,
        coreset_psnr=masked_psnr(data.frames, frames, data.masks),
        picture_psnr=picture_psnr,
        picture_ssim=picture_ssim,
    )


def masked_psnr(
    truth: Frames, frames: Frames, masks: Sequence[npt.NDArray[np.bool_]]
) -> float | None:
    """Return the PSNR in dB of normalised frames (z, y, x) over masked vertices.

    The peak is 1. It is None without an error, and without a vertex.
    """
    squares = count = 0.0
    for original, decoded, mask in zip(truth, frames, masks, strict=True):
        difference = original[mask].astype(np.float64) - decoded[mask]
        squares, count = squares + float(difference @ difference), count + len(difference)
    return 10 * math.log10(count / squares) if squares > 0 else None


MAX_PLACES = 1 << 18
"""Places of all steps together, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Random vertices of a step in the coreset of a neighbouring key frame.

    Attributes:
        key: time of the step in key frames.
        between: whether the step is no key frame.
        vertices: int64 (n, 3), z, y, x of the domain.
        truth: normalised values (n,).
        linear: the source's key frames, interpolated to the step, (n,).
        fringe: bool (n,), whether a vertex is in the coreset of one of the two key frames alone.
        selected: vertices of the step's own features.
        missed: of these, how many are in the coreset of neither key frame.
    """

    key: float
    between: bool
    vertices: npt.NDArray[np.int64]
    truth: npt.NDArray[np.float32]
    linear: npt.NDArray[np.float32]
    fringe: npt.NDArray[np.bool_]
    selected: int
    missed: int


def places_of(data: Data) -> list[Places]:
    """Return places of every step; it reads the whole series once."""
    found = []
    times = time_axis(data.series.coords["t"].values)
    key_times = times[list(data.key_frames)]
    order = np.argsort(key_times)
    keys = np.interp(times, key_times[order], order.astype(np.float64))
    around = [(int(np.floor(key)), int(np.ceil(key))) for key in keys]
    # All steps give the same share of their vertices, so that no step counts for more than it has.
    vertices = sum(int((data.masks[low] | data.masks[high]).sum()) for low, high in around)
    taken = min(1.0, MAX_PLACES / max(vertices, 1))
    random = np.random.default_rng(0)
    for step, (key, (before, after)) in enumerate(zip(keys, around, strict=True)):
        masks = data.masks[before], data.masks[after]
        mask, fringe = np.bitwise_or(*masks), np.bitwise_xor(*masks)
        flat = np.flatnonzero(mask)
        if taken < 1:
            flat = np.sort(random.choice(flat, math.ceil(taken * len(flat)), replace=False))
        frame = data.series.read(step)
        feature = np.logical_or.reduce([each.select(frame, step) for each in data.features])
        truth = data.scanned.value_range.to_unit(frame.reshape(-1)[flat])
        low, high = (data.frames[number].reshape(-1)[flat] for number in (before, after))
        linear = low + np.float32(key - before) * (high - low)
        finite = np.isfinite(truth) & np.isfinite(linear)
        found.append(
            Places(
                key=float(key),
                between=step not in data.key_frames,
                vertices=np.stack(np.unravel_index(flat[finite], mask.shape), axis=1),
                truth=truth[finite],
                linear=linear[finite],
                fringe=fringe.reshape(-1)[flat[finite]],
                selected=int(np.count_nonzero(feature)),
                missed=int(np.count_nonzero(feature & ~mask)),
            )
        )
    return found


def measure_between(encoding: TrainedEncoding, places: list[Places]) -> dict[str, float | None]:
    """Return the figures of all steps, as a `Cell` has them: PSNR in dB, and shares."""
    errors: dict[str, list[npt.NDArray[np.float64]]] = {
        f"psnr{name}": []
        for name in ("", "_key_frames", "_between", "_linear", "_inner", "_inner_linear",
                     "_fringe", "_fringe_linear")
    }  # fmt: skip
    for step in places:
        decoded = encoding.sample(step.key, torch.from_numpy(step.vertices)).cpu().numpy()
        # As a reader does.
        error = np.clip(decoded.astype(np.float64), 0.0, 1.0) - step.truth
        errors["psnr"].append(error)
        if not step.between:
            errors["psnr_key_frames"].append(error)
            continue
        linear = step.linear.astype(np.float64) - step.truth
        errors["psnr_between"].append(error)
        errors["psnr_linear"].append(linear)
        for name, where in (("inner", ~step.fringe), ("fringe", step.fringe)):
            errors[f"psnr_{name}"].append(error[where])
            errors[f"psnr_{name}_linear"].append(linear[where])
    between = [step for step in places if step.between]
    return {
        **{name: _psnr(parts) for name, parts in errors.items()},
        "fringe_share": _share(
            sum(int(step.fringe.sum()) for step in between), sum(map(_compared, between))
        ),
        "missed_share": _share(
            sum(step.missed for step in between), sum(step.selected for step in between)
        ),
    }


def _compared(step: Places) -> int:
    """Return the number of places of a step."""
    return len(step.truth)


def _share(part: int, whole: int) -> float | None:
    """Return a part as a share; None of nothing."""
    return part / whole if whole else None


def _psnr(errors: list[npt.NDArray[np.float64]]) -> float | None:
    """Return the PSNR in dB of normalised errors; None where they are 0 or not finite."""
    every = np.concatenate([np.zeros(0), *errors])
    mean = float(np.square(every).mean()) if len(every) else 0.0
    return -10 * math.log10(mean) if 0 < mean < math.inf else None


Range = tuple[float, float]

PICTURE_SIZE = 192
"""Pixels along both sides of a picture, by default."""
STEP = 0.5
"""Length of a ray's step in vertex spacings."""
THRESHOLD = 1 / 1024
"""Share of the light behind a sample below which a ray ends."""
FILLED = 0.97
"""Share of the picture, from its middle to its border, that the feature reaches to."""
IDENTICAL = 100.0
"""PSNR in dB that stands for pictures without any difference, so that a mean exists; above it none
is told apart."""
LIGHTING = Lighting(ambient=0.2, diffuse=0.8, specular=0.2, specular_power=16.0, lamp=None)
"""Light of a surface: the defaults of `fhash render`, with the lamp at the camera."""


class Likeness(NamedTuple):
    """Likeness of decoded pictures with true ones, the mean over key frames.

    Attributes:
        psnr: dB of colours over black, 0 to 1 in float32, over all pixels of a picture.
        ssim: structural similarity of bytes over black.
    """

    psnr: float
    ssim: float


class PictureProbe:
    """Pictures of the key frames of a series, with which decoded ones are compared.

    Attributes:
        task: the task that all pictures are drawn by.
        pictures: float32 (H, W, 4) of the truth at each key frame, multiplied by the opacity.
    """

    def __init__(
        self,
        truth: Sequence[Single],
        feature: str,
        *,
        value_range: Range = (0.0, 1.0),
        size: int = PICTURE_SIZE,
        azimuth: float = 0.0,
    ) -> None:
        """Draw the true pictures.

        Args:
            truth: frames (z, y, x) at the key frames, normalised: 0 and 1 are the ends of
                `value_range`.
            feature: what is shown, as `--feature` takes it, in data units; a segmentation with
                its threshold. Another kind of feature is drawn as all values, more opaque the
                larger they are.
            value_range: least and largest value of the series in data units.
            size: pixels along both sides.
            azimuth: degrees by which the camera is turned from the default view.
        """
        self.task = view_of_feature(
            truth[0].shape,
            feature,
            value_range=value_range,
            size=size,
            camera=_aimed(truth, feature, value_range, azimuth, size),
        )
        self.pictures = [self.draw(frame) for frame in truth]
        self._black = [black(picture) for picture in self.pictures]

    def draw(self, frame: Single) -> Single:
        """Draw a frame (z, y, x) of normalised values; NaN shows nothing."""
        values = np.ascontiguousarray(frame, dtype=np.float32)
        drawn = Frame(values=values, first=(0, 0, 0))
        return march(drawn, self.task, bricks=Bricks.of(drawn)).rgba

    def measure(self, frames: Sequence[Single], masks: Sequence[Mask] | None = None) -> Likeness:
        """Compare decoded frames with the truth.

        Args:
            frames: decoded frames (z, y, x), normalised, one for each key frame.
            masks: vertices (z, y, x) that the encoding was trained on, for each key frame; the
                others show nothing, as in the product. None for all vertices.
        """
        psnr, ssim = [], []
        for number, frame in enumerate(frames):
            shown = frame if masks is None else np.where(masks[number], frame, np.float32(np.nan))
            drawn = self.draw(shown)
            decibels = picture_psnr(
                np.clip(drawn[..., :3], 0, 1), np.clip(self.pictures[number][..., :3], 0, 1), 1.0
            )
            psnr.append(IDENTICAL if decibels is None else min(decibels, IDENTICAL))
            ssim.append(picture_ssim(black(drawn), self._black[number]))
        return Likeness(float(np.mean(psnr)), float(np.mean(ssim)))


def view_of_feature(
    shape: tuple[int, ...],
    feature: str,
    *,
    value_range: Range = (0.0, 1.0),
    size: int = PICTURE_SIZE,
    camera: Camera | None = None,
) -> Task:
    """The task of a picture of normalised values of a shape (z, y, x); arguments as for the probe.

    Vertices are 1 apart along every axis. The camera is the default one if None. Raises InputError
    for a feature that is malformed or shows nothing of the range.
    """
    low, high = value_range
    unit = 1 / (high - low)
    kind = parse_feature(feature)
    function = TransferFunction.of(
        TransferFunctionSpec(), value_range=value_range, spacing=1.0, features=(feature,)
    )
    table: Table | None = None
    surfaces: tuple[Surface, ...] = ()
    if isinstance(kind, Isosurface):
        surfaces = (
            Surface(
                value=(kind.value - low) * unit, colour=function.colour(kind.value), opacity=1.0
            ),
        )
    else:
        first, last, colours, extinctions = function.table()
        table = Table(
            low=(first - low) * unit,
            high=(last - low) * unit,
            colours=colours,
            extinctions=extinctions,
        )
    return Task(
        rays=Rays.of(camera or Camera(), _grid(shape), (size, size)),
        step=STEP,
        threshold=THRESHOLD,
        table=table,
        lighting=LIGHTING if surfaces else None,
        surfaces=surfaces,
    )


def _aimed(
    truth: Sequence[Single], feature: str, value_range: Range, azimuth: float, size: int
) -> Camera:
    """The default camera aimed at a feature in any of the frames, which fills the picture.

    A feature that other values than those of a vertex tell is not looked for: the whole domain
    fills the picture.
    """
    kind, camera = parse_feature(feature), Camera(azimuth=azimuth)
    if not isinstance(kind, Interval | Isosurface | Segmentation):
        return camera
    low, high = value_range
    seen = np.zeros(truth[0].shape, dtype=bool)
    for frame in truth:
        seen |= kind.select(low + frame * (high - low), 0)
    if not seen.any():
        return camera
    places = np.argwhere(seen)[:, ::-1].astype(np.float64)
    x, y, z = ((places.min(axis=0) + places.max(axis=0)) / 2).tolist()
    camera = replace(camera, focal_point=(x, y, z))
    pixels, _ = Rays.of(camera, _grid(truth[0].shape), (size, size)).project(places)
    reach = float(np.abs(2 * pixels / size - 1).max())
    return replace(camera, zoom=FILLED / max(reach, 1e-3))


def _grid(shape: tuple[int, ...]) -> Grid:
    """A grid of vertices (z, y, x) that are 1 apart."""
    z, y, x = shape
    return Grid(counts=(x, y, z), origin=np.zeros(3), spacing=np.ones(3))


LATENCY_SIZE = 64
"""Pixels along both sides of a picture, by default."""
VIEWS = 3
"""Random views, by default: the figures are medians over them."""
MODES = {"stream": False, "arm": True}
"""Ways to march, and whether each is adaptive."""
NEAR = 0.125
"""Distance in vertices over which a slope is the difference of two values."""


class EncodingField(CoresetField):
    """Values of an encoding at a key frame, evaluated at every place; a `Field` of `stream`.

    Attributes:
        evaluations: places at which the encoding was evaluated so far.
    """

    def __init__(
        self, encoding: TrainedEncoding, key: int, mask: Mask, arrays: Arrays, *, occupancy: bool
    ) -> None:
        """Prepare a field.

        Args:
            encoding: settled.
            key: number of a key frame.
            mask: vertices (z, y, x) of the domain in the coreset at the key frame.
            arrays: tensors on the device of the encoding.
            occupancy: whether places outside the coreset are known before evaluation; else the
                encoding is evaluated there in vain.
        """
        super().__init__(mask, np.zeros(3), np.array(mask.shape[::-1]) == 1, (0.0, 1.0), arrays)
        self.evaluations = 0
        self._encoding, self._key, self._occupancy = encoding, key, occupancy

    def values(self, places: Array, wanted: Array | None = None) -> Array:
        result = self.arrays.full(len(places), np.nan)
        if wanted is not None:
            # An encoding is evaluated at no more samples than it is asked for.
            (asked,) = self.arrays.nonzero(wanted)
            result[asked] = self.values(places[asked])
            return result
        _, inside = self.inside(places)
        if self._occupancy:
            result[inside] = self._evaluated(places[inside])
        else:
            result[inside] = self._evaluated(places)[inside]
        return result

    def slopes(self, places: Array) -> Array:
        """Differences over NEAR to both sides, also where these leave the coreset."""
        arrays, (low, high) = self.arrays, self.vertices.T
        slopes = arrays.empty((len(places), 3))
        for axis in range(3):
            before, after = arrays.copy(places), arrays.copy(places)
            before[:, axis] = arrays.xp.clip(places[:, axis] - NEAR, low[axis], high[axis])
            after[:, axis] = arrays.xp.clip(places[:, axis] + NEAR, low[axis], high[axis])
            rise = self._evaluated(after) - self._evaluated(before)
            slopes[:, axis] = rise / arrays.xp.clip(after[:, axis] - before[:, axis], NEAR, None)
        return slopes

    def _evaluated(self, places: Array) -> Array:
        """The encoding's values (n,), float64, at places (n, 3), x, y, z."""
        self.evaluations += len(places)
        if not len(places):
            return self.arrays.empty((0,))
        at = self.arrays.to_float32(self.arrays.xp.flip(places, (1,)))
        return self.arrays.to_float64(self._encoding.sample(self._key, at).detach())


def measure_latency(
    encoding: TrainedEncoding,
    masks: Sequence[Mask],
    feature: str,
    *,
    value_range: Range = (0.0, 1.0),
    size: int = LATENCY_SIZE,
    views: int = VIEWS,
    device: str = "cpu",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure pictures of key frames from random views through an encoding.

    Args:
        encoding: settled.
        masks: vertices (z, y, x) of the domain in the coreset, for each key frame.
        feature, value_range: as for `PictureProbe`.
        size: pixels along both sides.
        views: random views; they go through the key frames in turn.
        device: of the encoding, cpu or cuda.
        progress: is told about each picture.

    Returns:
        {"size", "views", "off": {...}, "on": {...}} for the occupancy off and on, each with
        "stream_ms" and "arm_ms" (medians over views) and the means over views "stream_passes",
        "arm_passes", "samples" (streaming), "arm_samples" and "evaluations" (streaming).
    """
    arrays = TorchArrays(choose_device(device))
    rng = np.random.default_rng(0)
    cameras = [
        Camera(azimuth=float(rng.uniform(0, 360)), elevation=float(rng.uniform(-60, 60)))
        for _ in range(views)
    ]
    found: dict[str, Any] = {"size": size, "views": views}
    runs, done = [(on, mode) for on in (False, True) for mode in MODES], 0
    for number, camera in enumerate(cameras):
        key = number % len(masks)
        task = view_of_feature(
            masks[key].shape, feature, value_range=value_range, size=size, camera=camera
        )
        for on, mode in runs:
            field = EncodingField(encoding, key, masks[key], arrays, occupancy=on)
            if not number:  # the first call of a model allocates and compiles
                field.values(arrays.array(np.zeros((size * size, 3))))
                field.evaluations = 0
            begun = time.perf_counter()
            marched = stream(field, replace(task, skipping=on), adaptive=MODES[mode])
            spent = 1e3 * (time.perf_counter() - begun)
            entry = found.setdefault("on" if on else "off", {}).setdefault(mode, [])
            entry.append((spent, marched.counters, field.evaluations))
            done += 1
            progress("rendering", done, views * len(runs), mode)
    return {**found, **{switch: _summary(found[switch]) for switch in ("off", "on")}}


def _summary(runs: dict[str, list[tuple[float, Any, int]]]) -> dict[str, float]:
    """Medians of milliseconds and means of counts over the views, of one kind of occupancy."""

    def mean(mode: str, name: str) -> float:
        return float(np.mean([counters[name] for _, counters, _ in runs[mode]]))

    return {
        "stream_ms": median(spent for spent, _, _ in runs["stream"]),
        "arm_ms": median(spent for spent, _, _ in runs["arm"]),
        "stream_passes": mean("stream", "passes"),
        "arm_passes": mean("arm", "passes"),
        "samples": mean("stream", "samples"),
        "arm_samples": mean("arm", "samples"),
        "evaluations": float(np.mean([count for _, _, count in runs["stream"]])),
    }
