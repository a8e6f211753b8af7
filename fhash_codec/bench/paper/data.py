"""The data of a cell: key frames in memory, the coreset of a feature, and every vertex."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import prod

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.paper.sets import SCALES, paper_set, scaled
from fhash_codec.boxes import Sizes, bounding_box
from fhash_codec.config import EncodeConfig
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, Feature, FeatureChoice, Mask
from fhash_codec.features.scan import Scan
from fhash_codec.features.selection import resolve_selection
from fhash_codec.progress import Progress, silent
from fhash_codec.simulation.simulate import simulate
from fhash_formats.errors import InputError
from fhash_formats.series import Series

KINDS = ("interval", "isosurface", "segmentation")
"""Kinds of features in the paper."""
FEATURES: dict[str, dict[str, str]] = {
    "flame": {"interval": "interval:0.35:0.65", "isosurface": "isosurface:0.5"},
    "bubble": {"interval": "interval:0.3:0.7", "isosurface": "isosurface:0.5"},
    "shell": {"interval": "interval:0.3:0.6", "isosurface": "isosurface:0.4"},
}
"""Features of the scenes by kind; a segmentation is at Otsu's threshold. The paper's are not
printed."""
DILATION = 1
"""Vertices by which a feature grows (paper, Coreset Selection)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Samples that every encoding of a cell is trained on, and frames to compare it with.

    Attributes:
        name: flame, bubble, shell, or the name of the user's data.
        series: all steps.
        scanned: range and missing values of the series.
        features: the features, resolved.
        kind: interval, isosurface, segmentation, or the feature as the user wrote it.
        coreset: the samples of the feature at the key frames and their fringe, in the product's
            bricks.
        frames: normalised frames (z, y, x) of the key frames, float32; NaN where values are
            missing.
        background: normalised background outside the coreset.
    """

    name: str
    series: Series
    scanned: Scan
    features: tuple[Feature, ...]
    kind: str
    coreset: Coreset
    frames: tuple[npt.NDArray[np.float32], ...]
    background: float

    @property
    def frame_shape(self) -> Sizes:
        """Vertices (z, y, x) of a frame."""
        _, z, y, x = self.series.shape
        return z, y, x

    @property
    def key_frames(self) -> tuple[int, ...]:
        """Steps of the key frames."""
        return self.coreset.key_frames

    @property
    def raw_bytes(self) -> int:
        """Bytes of the values of all steps in the source's number type."""
        return prod(self.series.shape) * self.series.dtype.itemsize

    @property
    def key_range(self) -> tuple[float, float]:
        """Least and largest normalised value of the key frames."""
        low = min(float(np.nanmin(frame)) for frame in self.frames)
        high = max(float(np.nanmax(frame)) for frame in self.frames)
        return (low, high) if low < high else (0.0, 1.0)

    @cached_property
    def everything(self) -> Coreset:
        """Every finite vertex of the key frames, in a box that is the domain."""
        return self._single((Everything(),), 0)

    @cached_property
    def unfringed(self) -> Coreset:
        """The samples of `coreset` without its fringe."""
        return self._single(self.features, DILATION)

    @cached_property
    def boxes(self) -> Coreset:
        """Every finite vertex of the bounding box of the coreset at each key frame."""
        number = {step: key for key, step in enumerate(self.key_frames)}

        def inside(step: int) -> npt.NDArray[np.bool_]:
            mask = self.masks[number[step]]
            filled = np.zeros_like(mask)
            box = bounding_box(mask)
            if box is not None:
                filled[box.slices()] = True
            return filled

        return self._single((Mask("boxes", read=inside),), 0)

    def _single(self, features: tuple[Feature, ...], dilation: int) -> Coreset:
        """Samples in bricks of one vertex, so that batches are of shuffled vertices."""
        return build_coreset(
            self.series,
            self.scanned,
            FeatureChoice(self.key_frames, features, dilation),
            silent,
            brick=(1, 1, 1),
        )

    @cached_property
    def masks(self) -> tuple[npt.NDArray[np.bool_], ...]:
        """The coreset of each key frame as a mask (z, y, x) of the domain."""
        masks = []
        for bits in self.coreset.occupancy:
            mask = np.zeros(self.frame_shape, np.bool_)
            mask[self.coreset.box.slices()] = occupancy.unpack(bits, self.coreset.box.shape)
            masks.append(mask)
        return tuple(masks)


def simulated(name: str, scale: str, seed: int = 0) -> Series:
    """Return the series of a scene at a part of the paper's lengths, its steps included.

    Args:
        name: flame, bubble or shell.
        scale: full, half, quarter or eighth.
        seed: seed of the scene.

    Raises:
        InputError: there is no such scene or scale.
    """
    known = paper_set(name)
    if scale not in SCALES:
        raise InputError(f"scale is '{scale}'; allowed: {', '.join(SCALES)}")
    divisor = SCALES[scale]
    return simulate(name, (-(-known.steps // divisor), *scaled(known.frame, divisor)), seed)


def feature_text(name: str, kind: str) -> str:
    """Return the feature of a kind as the codec takes it: a scene's own, else `kind` itself."""
    return FEATURES.get(name, {}).get(kind, kind)


def gather_data(
    name: str, series: Series, kind: str, key_frames: str, progress: Progress = silent
) -> Data:
    """Read the key frames of a series and gather the samples of a feature.

    Args:
        name: name of the data set.
        series: the series; its frames are read a few times, and the key frames are kept.
        kind: kind of the feature, or a feature as `fhash encode --feature` takes it.
        key_frames: which steps, as `fhash encode --key-frames` takes it.
        progress: called with each step of the work.

    Raises:
        InputError: the settings do not fit the series, or they select nothing.
    """
    config = EncodeConfig(
        profile="paper", features=(feature_text(name, kind),), key_frames=key_frames
    )
    scanned, keys, features = resolve_selection(series, config, progress, None)
    choice = FeatureChoice(keys, features, DILATION)
    coreset = build_coreset(series, scanned, choice, progress, fringe=True)
    frames = tuple(scanned.value_range.to_unit(series.read(step)) for step in keys)
    return Data(
        name=name,
        series=series,
        scanned=scanned,
        features=features,
        kind=kind,
        coreset=coreset,
        frames=frames,
        background=float(scanned.value_range.to_unit(coreset.background)),
    )
