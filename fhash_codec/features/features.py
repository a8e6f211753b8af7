"""Features (intervals, isosurfaces, segmentations), their masks, and their extent in a series."""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_codec.boxes import Box, Sizes, bounding_box, fuse
from fhash_codec.features.scan import Scan, finite_masks, finite_values
from fhash_codec.measure.value_range import Mean, Ranks, ValueRange, pieces
from fhash_codec.progress import Progress
from fhash_formats.container.header import EVERYTHING
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Series, step_blocks
from fhash_formats.support.values import Longs, exact_number, is_wide_integer

Frame = npt.NDArray[Any]
"""Values (z, y, x) of one step."""

FrameMask = npt.NDArray[np.bool_]
"""Booleans (z, y, x) of one step."""

KINDS = "interval:LO:HI, isosurface:V, segmentation[:T], change:D, onset:V, mask:FILE, all"
"""Forms of a feature, for error messages."""

FramesAround = Callable[[int], Iterator[Frame]]
"""Step -> the frames from the key frame before it to the one after it, in their order."""

BINS = 1024
"""Bins of the histogram for Otsu's threshold."""


class Feature(ABC):
    """A region of interest; `str(feature)` is the text that `parse_feature` reads.

    Thresholds are rounded to the number type of a floating-point frame before the comparison, as
    numpy does: in a float32 frame `interval:0.1:0.3` includes the value 0.3. Integers are compared
    as float64, and exactly with a threshold that is an integer beyond 2^53. NaN and infinite
    vertices are never selected.
    """

    @abstractmethod
    def select(self, frame: Frame, step: int) -> FrameMask:
        """Mask (z, y, x) of the vertices of the feature in a frame of data values."""

    def select_steps(self, frames: Frame, steps: range) -> FrameMask:
        """Masks (t, z, y, x) of `select` for neighbouring steps."""
        pairs = zip(frames, steps, strict=True)
        return np.stack([self.select(frame, step) for frame, step in pairs])


class InSpace(Feature):
    """A feature of the values of a frame alone: `select` takes those of several steps as well."""

    def select_steps(self, frames: Frame, steps: range) -> FrameMask:
        return self.select(frames, steps.start)


@dataclass(frozen=True)
class Everything(InSpace):
    """Every finite vertex."""

    def select(self, frame: Frame, step: int) -> FrameMask:
        return np.isfinite(frame)

    def __str__(self) -> str:
        return EVERYTHING


@dataclass(frozen=True)
class Interval(InSpace):
    """Vertices with low <= value <= high; both ends may be infinite."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise InputError(f"feature '{self}' is empty; write interval:LO:HI with LO <= HI")

    def select(self, frame: Frame, step: int) -> FrameMask:
        selected: FrameMask = np.isfinite(frame)
        selected &= frame >= _as_frame_type(self.low, frame)
        selected &= frame <= _as_frame_type(self.high, frame)
        return selected

    def __str__(self) -> str:
        return f"interval:{_text(self.low)}:{_text(self.high)}"


@dataclass(frozen=True)
class Isosurface(InSpace):
    """Vertices beside an isosurface.

    They are both ends of every grid edge (along z, y or x) whose ends lie strictly on either side
    of the value, and the vertices that have the value itself.
    """

    value: float

    def select(self, frame: Frame, step: int) -> FrameMask:
        value, finite = _as_frame_type(self.value, frame), np.isfinite(frame)
        selected: FrameMask = frame == value
        selected &= finite
        above: FrameMask = (frame > value) & finite
        below: FrameMask = (frame < value) & finite
        for axis in (-3, -2, -1):
            high, low, ends = (np.moveaxis(mask, axis, 0) for mask in (above, below, selected))
            crossed = (high[:-1] & low[1:]) | (low[:-1] & high[1:])
            ends[:-1] |= crossed
            ends[1:] |= crossed
        return selected

    def __str__(self) -> str:
        return f"isosurface:{_text(self.value)}"


@dataclass(frozen=True)
class Segmentation(InSpace):
    """The foreground: vertices strictly above a threshold.

    The threshold None stands for Otsu's threshold, which `resolve_features` fills in.
    """

    threshold: float | None = None

    def select(self, frame: Frame, step: int) -> FrameMask:
        if self.threshold is None:
            raise InputError(
                "feature 'segmentation' has no threshold yet; "
                "resolve_features finds Otsu's from the data"
            )
        selected: FrameMask = np.isfinite(frame)
        selected &= frame > _as_frame_type(self.threshold, frame)
        return selected

    def __str__(self) -> str:
        return "segmentation" if self.threshold is None else f"segmentation:{_text(self.threshold)}"


@dataclass(frozen=True)
class Mask(Feature):
    """Vertices that a file of booleans marks; any detector can write such a file.

    Attributes:
        path: of the file.
        read: step -> mask (z, y, x) of the open file; None until `resolve_features` opens it.
    """

    path: str
    read: Callable[[int], FrameMask] | None = field(default=None, compare=False, repr=False)

    def select(self, frame: Frame, step: int) -> FrameMask:
        if self.read is None:
            raise InputError(f"feature '{self}' is not open yet; resolve_features opens it")
        mask = self.read(step)
        if mask.shape != frame.shape:
            raise InputError(
                f"feature '{self}': the mask of step {step} has shape {mask.shape}; "
                f"the frame has {frame.shape} (z, y, x)"
            )
        return np.isfinite(frame) & mask

    def check(self) -> None:
        """Raise InputError if the file has changed since it was opened."""
        check = getattr(self.read, "check", None)  # a mask in memory has none
        if check is not None:
            check()

    def __str__(self) -> str:
        return f"mask:{self.path}"


@dataclass(frozen=True)
class InTime(Feature):
    """A feature in space and time: what happens at a vertex from one step to the next.

    A key frame has the vertices where it happens anywhere between the key frame before and the one
    after, so that nothing is lost between key frames.

    Attributes:
        threshold: in data units.
        around: the frames that a step is judged by; None until `resolve_features` knows them.
    """

    threshold: float
    around: FramesAround | None = field(default=None, compare=False, repr=False)

    @abstractmethod
    def happens(self, before: Frame, after: Frame) -> FrameMask:
        """Mask (z, y, x) of the vertices where it happens between two neighbouring steps."""

    def select(self, frame: Frame, step: int) -> FrameMask:
        if self.around is None:
            raise InputError(
                f"feature '{self}' looks at other steps; resolve_features says at which"
            )
        selected: FrameMask = np.zeros(frame.shape, dtype=bool)
        for before, after in pairwise(self.around(step)):
            selected |= self.happens(before, after)
        return selected & np.isfinite(frame)


class Change(InTime):
    """Vertices whose value changes by more than a threshold from one step to the next."""

    def happens(self, before: Frame, after: Frame) -> FrameMask:
        """Mask (z, y, x) of larger changes; they are computed in float64, of integers exactly."""
        if is_wide_integer(before.dtype):
            rises = after > before
            change = np.where(rises, after - before, before - after).view(np.uint64)
            return np.asarray(change > _as_frame_type(self.threshold, change))
        with np.errstate(invalid="ignore", over="ignore"):
            change = np.abs(np.subtract(after, before, dtype=np.float64))
        return np.isfinite(before) & np.isfinite(after) & (change > self.threshold)

    def __str__(self) -> str:
        return f"change:{_text(self.threshold)}"


class Onset(InTime):
    """Vertices whose value rises above a threshold from one step to the next."""

    def happens(self, before: Frame, after: Frame) -> FrameMask:
        """Mask (z, y, x) of values at or below the threshold before, and above it after."""
        threshold = _as_frame_type(self.threshold, before)
        rises: FrameMask = (before <= threshold) & (after > threshold)
        return rises & np.isfinite(before) & np.isfinite(after)

    def __str__(self) -> str:
        return f"onset:{_text(self.threshold)}"


FORMS: dict[str, tuple[Callable[..., Feature], str]] = {
    "interval": (Interval, "interval:LO:HI with LO <= HI"),
    "isosurface": (Isosurface, "isosurface:V with a finite number V"),
    "segmentation": (Segmentation, "segmentation or segmentation:T with a finite number T"),
    "change": (Change, "change:D with a finite number D >= 0"),
    "onset": (Onset, "onset:V with a finite number V"),
}
"""Features of numbers by their kind, and how they are written."""


def parse_feature(text: str) -> Feature:
    """The feature that a text such as "interval:0.2:1" names.

    Raises InputError, with the forms that are allowed.
    """
    kind, *rest = text.split(":", 1)
    values = rest[0] if rest else None
    if kind == "all" and values is None:
        return Everything()
    if kind == "segmentation" and values is None:
        return Segmentation()
    if kind in FORMS:
        make, form = FORMS[kind]
        numbers = _numbers(text, values, form, finite=kind != "interval")
        if kind != "change" or numbers[0] >= 0:
            return make(*numbers)
        raise InputError(f"feature '{text}' is malformed; write change:D with D >= 0")
    if kind == "mask" and values:
        return Mask(values)
    raise InputError(f"feature '{text}' is not known; allowed: {KINDS}")


def resolve_features(
    texts: Sequence[str],
    series: Series,
    key_frames: Sequence[int],
    value_range: ValueRange,
    progress: Progress,
) -> tuple[Feature, ...]:
    """Features that are ready to select: parsed, with Otsu's threshold filled in and masks open.

    texts: what `parse_feature` reads.
    value_range: of the whole series; the histogram for Otsu's threshold spans it.

    Otsu's threshold comes from one histogram of the finite values of all key frames. They are read
    only if a feature needs the threshold. Progress stage: "thresholding".
    """
    features = [parse_feature(text) for text in texts]
    if Segmentation() in features:
        origin = value_range.origin(series.source_dtype or series.dtype)
        edges = value_range.moved(-origin).from_unit(np.linspace(0.0, 1.0, BINS + 1))
        histogram = _histogram(series, key_frames, value_range, progress)
        threshold = otsu_threshold(histogram, edges)
        by_otsu = Segmentation(math.floor(threshold) + origin if origin else threshold)
        features = [by_otsu if feature == Segmentation() else feature for feature in features]
    return tuple(_resolved(feature, series, key_frames) for feature in features)


def _resolved(feature: Feature, series: Series, key_frames: Sequence[int]) -> Feature:
    """The feature with the frames or the file that it looks at."""
    if isinstance(feature, InTime):
        return dataclasses.replace(feature, around=_frames_around(series, key_frames))
    if isinstance(feature, Mask):
        from fhash_formats.readers.registry import open_mask

        return dataclasses.replace(feature, read=open_mask(feature.path, series.shape))
    return feature


def _frames_around(series: Series, key_frames: Sequence[int]) -> FramesAround:
    """The frames of a series that belong to a key frame.

    The first key frame stands for all steps before it, and the last one for all after it. A step
    that is no key frame has the steps beside it.
    """
    last = series.shape[0] - 1

    def around(step: int) -> Iterator[Frame]:
        first, end = step - 1, step + 1
        if step in key_frames:
            place = list(key_frames).index(step)
            first = key_frames[place - 1] if place else 0
            end = key_frames[place + 1] if place + 1 < len(key_frames) else last
        return (series.frame(each) for each in range(max(first, 0), min(end, last) + 1))

    return around


def otsu_threshold(counts: npt.ArrayLike, edges: npt.ArrayLike) -> float:
    """Otsu's threshold: the inner edge with the largest variance between its two sides.

    counts: of a histogram (n,). edges: of its bins (n + 1,), equally spaced. If empty bins make
    several edges equally good, the middle edge is taken. Source: Otsu 1979, equation 18.
    """
    weights, bounds = np.asarray(counts, dtype=np.float64), np.asarray(edges, dtype=np.float64)
    moments = weights * np.arange(weights.size)
    below, total = np.cumsum(weights)[:-1], weights.sum()
    above = total - below
    difference = np.cumsum(moments)[:-1] * total - moments.sum() * below
    variance = np.divide(
        difference**2, below * above, out=np.zeros_like(below), where=below * above > 0
    )
    best = np.flatnonzero(variance == variance.max())
    return float(bounds[best[best.size // 2] + 1])


def dilate(mask: FrameMask, vertices: int) -> FrameMask:
    """A mask (..., z, y, x) grown by vertices in the 26-neighbourhood (paper, Feature Dilation).

    The growth does not wrap around the ends of an axis. It takes one axis after another. Along an
    axis the shifts double: a mask that has grown by r may be shifted by r + 1 without a gap.
    """
    for axis in (-3, -2, -1):
        reach = 0
        while reach < vertices:
            shift = min(reach + 1, vertices - reach)
            lines, grown = np.moveaxis(mask, axis, 0), mask.copy()
            out = np.moveaxis(grown, axis, 0)
            out[shift:] |= lines[:-shift]
            out[:-shift] |= lines[shift:]
            mask, reach = grown, reach + shift
    return mask


def _as_frame_type(value: float, frame: Frame) -> Any:
    """A threshold as a scalar of the frame's floating-point type, or of float64 for integers.

    numpy then compares without converting the frame. An integer stays one in a frame of integers.
    """
    if isinstance(value, int) and frame.dtype.kind != "f":
        return value
    with np.errstate(over="ignore"):
        return np.float64(value).astype(frame.dtype if frame.dtype.kind == "f" else np.float64)


def _histogram(
    series: Series, key_frames: Sequence[int], value_range: ValueRange, progress: Progress
) -> npt.NDArray[np.int64]:
    """Counts (BINS,) of the finite values of all key frames, over the range of the series."""
    counts = np.zeros(BINS, dtype=np.int64)
    for done, step in enumerate(key_frames):
        for piece in pieces(series.read(step)):  # also of a Volume
            unit = value_range.to_unit(finite_values(piece))
            counts += np.bincount(
                np.minimum((unit * BINS).astype(np.int64), BINS - 1), minlength=BINS
            )
        progress("thresholding", done + 1, len(key_frames), "")
    return counts


def _numbers(text: str, values: str | None, form: str, *, finite: bool) -> list[float]:
    """The numbers of a feature's text; raises InputError, with the form that is allowed."""
    count = 1 if finite else 2
    parts = [] if values is None else values.split(":")
    try:
        numbers = [_number(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) != count or any(
        math.isnan(number) or (finite and math.isinf(number)) for number in numbers
    ):
        raise InputError(f"feature '{text}' is malformed; write {form}")
    return numbers


def _number(text: str) -> float:
    """The number in a text; integers beyond 2^53 stay integers."""
    whole = re.fullmatch(r"\s*[+-]?[0-9]{1,300}\s*", text)
    return exact_number(float(text) if whole is None else int(text))


def _text(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(value)).removesuffix(".0")


@dataclass(frozen=True, kw_only=True, eq=False)
class Extent:
    """The vertices of the coreset at every key frame.

    Attributes:
        box: the feature bounding box, fused over the key frames.
        key_frames: steps at which the features were found.
        packed: np.packbits of the mask (z, y, x) of the domain at each key frame.
        domain: shape (z, y, x) of the domain.
        samples: vertices of the coreset over all key frames.
        background: mean of the finite values outside the coreset over the key frames, in data
            units; the mean of all values if none is outside.
        apart: the packed masks of each feature, by feature and key frame; empty unless asked for.
        stored: whether the file gets the masks in the tiles of the values.
    """

    box: Box
    key_frames: tuple[int, ...]
    packed: list[npt.NDArray[np.uint8]]
    domain: Sizes
    samples: int
    background: float
    apart: tuple[list[npt.NDArray[np.uint8]], ...] = ()
    stored: bool = True

    @property
    def fraction(self) -> float:
        """samples / (key frames * vertices of the domain)."""
        return self.samples / (len(self.key_frames) * prod(self.domain))

    @property
    def vertices(self) -> Longs:
        """Vertices of a frame, ascending, that are in the coreset of some key frame."""
        bits = np.unpackbits(np.bitwise_or.reduce(self.packed), count=prod(self.domain))
        return np.flatnonzero(bits)

    def mask(self, key: int) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the vertices of the box that are in the coreset.

        key: index of a key frame.
        """
        return self._unpacked(self.packed[key])

    def masks(self, keys: range) -> npt.NDArray[np.bool_]:
        """Masks (keys, z, y, x) of `mask` of neighbouring key frames."""
        rows = np.stack(self.packed[keys.start : keys.stop])
        bits = np.unpackbits(rows, axis=1, count=prod(self.domain)).view(np.bool_)
        return bits.reshape(-1, *self.domain)[:, *self.box.slices()]

    def mask_of(self, feature: int, key: int) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the vertices of the box that are in the coreset for one feature.

        feature: its number among those of `apart`. key: index of a key frame.
        """
        return self._unpacked(self.apart[feature][key])

    def with_fringe(self, key: int) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the vertices of the box in the coreset of a key frame or of its
        neighbours.

        Its *fringe* are those that only a neighbour has. Between two key frames a value depends on
        both, and so does that of a vertex in the coreset of one of them.

        key: index of a key frame.
        """
        return self._unpacked(self._packed_with_fringe(key))

    def samples_with_fringe(self) -> int:
        """Vertices of `with_fringe` over all key frames."""
        keys = range(len(self.packed))
        return sum(int(np.bitwise_count(self._packed_with_fringe(key)).sum()) for key in keys)

    def _packed_with_fringe(self, key: int) -> npt.NDArray[np.uint8]:
        near = self.packed[max(key - 1, 0) : key + 2]
        return np.asarray(np.bitwise_or.reduce(near))

    def _unpacked(self, packed: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
        """The vertices of the box of a packed mask of the domain."""
        bits = np.unpackbits(packed, count=prod(self.domain))
        return bits.view(np.bool_).reshape(self.domain)[self.box.slices()]


class FeatureChoice(NamedTuple):
    """Features at key frames that are to be kept of a series."""

    key_frames: Sequence[int]
    """Steps to look at."""
    features: Sequence[Feature]
    """Features, resolved (`resolve_features`); a vertex of any of them is kept."""
    dilation: int = 0
    """Vertices by which they grow."""


def find_extent(
    series: Series,
    scan: Scan,
    choice: FeatureChoice,
    progress: Progress,
    ranks: Ranks | None = None,
    *,
    apart: bool = False,
) -> Extent:
    """The extent of the finite vertices of the merged features, dilated, at every key frame.

    ranks: gets the values of these vertices.
    apart: whether to keep the masks of each feature as well.

    Other parameters, errors, warnings and the progress stage "selecting" as in `build_coreset`.
    """
    z, y, x = series.shape[1:]
    key_frames, features, dilation = choice
    everything = any(isinstance(feature, Everything) for feature in features)
    if everything and not apart and (not scan.missing or len(key_frames) == series.shape[0]):
        progress("selecting", 1, 1, "")
        return _everywhere(scan, key_frames, (z, y, x))
    packed: list[npt.NDArray[np.uint8]] = []
    boxes, outside, samples = [], Mean(), 0
    packed_apart: tuple[list[npt.NDArray[np.uint8]], ...] = tuple(
        [] for _ in (features if apart else ())
    )
    without_vertices = set(features)
    for steps in _neighbours(key_frames, series):
        frames = series.block(steps)
        masks = [feature.select_steps(frames, steps) for feature in features]
        without_vertices -= {
            feature for feature, mask in zip(features, masks, strict=True) if mask.any()
        }
        finite = finite_masks(scan.missing, steps, (z, y, x))
        mask = _dilated(np.logical_or.reduce(masks), finite, dilation)
        packed += _packed(mask)
        for one, packed_one in zip(masks, packed_apart, strict=False):
            packed_one += _packed(_dilated(one, finite, dilation))
        ever: FrameMask = np.any(mask, axis=0)
        boxes.append(bounding_box(ever))
        samples += int(np.count_nonzero(mask))
        _add_outside(outside, frames, mask, finite)
        if ranks is not None:
            ranks.add(frames[mask])
        progress("selecting", len(packed), len(key_frames), "")
    for each in features:
        if isinstance(each, Mask):
            each.check()
    box = fuse(boxes)
    if box is None:
        low, high = scan.value_range.low, scan.value_range.high
        names = ", ".join(str(feature) for feature in features)
        raise InputError(
            f"feature {names} selects nothing; values range from {low:.9g} to {high:.9g}"
        )
    for feature in sorted(map(str, without_vertices)):
        warnings.warn(
            f"feature {feature} selects nothing; the others do", FhashWarning, stacklevel=2
        )
    return Extent(
        box=box,
        key_frames=tuple(key_frames),
        packed=packed,
        domain=(z, y, x),
        samples=samples,
        background=outside.value() if outside.count else scan.mean,
        apart=packed_apart,
    )


def packed_masks(
    series: Series,
    missing: Mapping[int, npt.NDArray[np.uint8]],
    steps: range,
    features: Sequence[Feature],
    dilation: int,
) -> dict[int, npt.NDArray[np.uint8]]:
    """The packed masks of some steps, as `Extent.packed` has those of all.

    missing: masks of the missing values of these steps, see `Scan`.
    """
    result: dict[int, npt.NDArray[np.uint8]] = {}
    for block, frames in series.blocks(steps):
        mask = np.logical_or.reduce([feature.select_steps(frames, block) for feature in features])
        finite = finite_masks(missing, block, series.shape[1:])
        result |= zip(block, _packed(_dilated(mask, finite, dilation)), strict=True)
    return result


def _neighbours(key_frames: Sequence[int], series: Series) -> Iterator[range]:
    """The key frames in blocks of neighbours where all steps are, else one by one."""
    if len(key_frames) < series.shape[0]:
        return (range(step, step + 1) for step in key_frames)
    return (block for _, block in step_blocks(range(series.shape[0]), series.shape[1:]))


def _packed(masks: FrameMask) -> list[npt.NDArray[np.uint8]]:
    """The bits of each step of masks (t, z, y, x)."""
    return list(np.packbits(masks.reshape(len(masks), -1), axis=1))


def _everywhere(scan: Scan, key_frames: Sequence[int], domain: Sizes) -> Extent:
    """The extent of a coreset of all finite vertices; no frame is read for it.

    key_frames: all steps where values are missing.
    """
    every = np.packbits(np.ones(domain, dtype=bool))
    packed = [every] * len(key_frames)
    some = every if len(scan.missing) < len(key_frames) else np.zeros_like(every)
    for step, missing in scan.missing.items():
        packed[step] = every & ~missing
        some = some | packed[step]
    box = bounding_box(np.unpackbits(some, count=prod(domain)).view(np.bool_).reshape(domain))
    assert box is not None, "a scan has a finite value"
    return Extent(
        box=box,
        key_frames=tuple(key_frames),
        packed=packed,
        domain=domain,
        samples=scan.finite_count if scan.missing else len(packed) * prod(domain),
        background=scan.mean,
    )


def _dilated(
    mask: npt.NDArray[np.bool_], finite: npt.NDArray[np.bool_] | None, dilation: int
) -> npt.NDArray[np.bool_]:
    """Masks (t, z, y, x) of the finite vertices of the dilated masks.

    finite: masks of all finite vertices; None if every vertex is finite.
    """
    mask = dilate(mask, dilation)
    if finite is not None:
        mask &= finite
    return mask


def _add_outside(
    mean: Mean,
    frames: npt.NDArray[Any],
    mask: npt.NDArray[np.bool_],
    finite: npt.NDArray[np.bool_] | None,
) -> None:
    """Add the finite values outside the coreset to a mean."""
    outside = ~mask if finite is None else finite & ~mask
    # Planes of a single frame one by one, so that the float64 copies of a large one stay small.
    for place in np.ndindex(outside.shape[:2]) if len(frames) == 1 else [()]:
        mean.add(frames[place][outside[place]])
