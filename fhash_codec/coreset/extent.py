"""The extent of the coreset: one bit per vertex of the domain."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Sizes, bounding_box, fuse
from fhash_codec.coreset.features import Everything, Feature, dilate
from fhash_codec.coreset.scan import Scan
from fhash_codec.measure.value_range import Mean
from fhash_codec.progress import Progress
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Series


@dataclass(frozen=True, kw_only=True, eq=False)
class Extent:
    """Where the coreset lies, one bit per vertex of the domain.

    Attributes:
        box: the feature bounding box, fused over the key frames.
        key_frames: steps at which the features were found.
        packed: np.packbits of the mask (z, y, x) of the domain at each key frame.
        domain: its shape (z, y, x).
        samples: vertices of the coreset over all key frames.
        background: mean of the finite values outside the coreset over the key frames, in data units; of all values if none is outside.
    """

    box: Box
    key_frames: tuple[int, ...]
    packed: list[npt.NDArray[np.uint8]]
    domain: Sizes
    samples: int
    background: float

    @property
    def fraction(self) -> float:
        """samples / (key frames * vertices of the domain)."""
        return self.samples / (len(self.key_frames) * prod(self.domain))

    def mask(self, key: int) -> npt.NDArray[np.bool_]:
        """Which vertices (z, y, x) of the box are in the coreset at a key frame."""
        whole = (
            np.unpackbits(self.packed[key], count=prod(self.domain))
            .view(np.bool_)
            .reshape(self.domain)
        )
        return whole[self.box.slices()]


def find_extent(
    series: Series,
    scan: Scan,
    key_frames: Sequence[int],
    features: Sequence[Feature],
    dilation: int,
    progress: Progress,
) -> Extent:
    """Where the coreset lies: finite vertices of the merged features, dilated, at every key frame; raises and warns as `build_coreset`."""
    packed: list[npt.NDArray[np.uint8]] = []
    bounds, outside, samples = [], Mean(), 0
    z, y, x = series.shape[1:]
    if not scan.missing and any(isinstance(feature, Everything) for feature in features):
        # Nothing to look at: one mask of ones for all.
        whole = np.packbits(np.ones((z, y, x), dtype=bool))
        for done in range(len(key_frames)):
            progress("selecting", done + 1, len(key_frames), "")
        return Extent(
            box=Box.of_shape((z, y, x)),
            key_frames=tuple(key_frames),
            packed=[whole] * len(key_frames),
            domain=(z, y, x),
            samples=len(key_frames) * z * y * x,
            background=scan.mean,
        )
    idle = set(features)
    for done, step in enumerate(key_frames):
        frame = series.read(step)
        selected = [feature.select(frame, step) for feature in features]
        idle -= {feature for feature, found in zip(features, selected, strict=True) if found.any()}
        mask, finite = _dilated(np.logical_or.reduce(selected), step, scan, dilation)
        packed.append(np.packbits(mask))
        bounds.append(bounding_box(mask))
        samples += int(np.count_nonzero(mask))
        _add_outside(outside, frame, mask, finite)
        progress("selecting", done + 1, len(key_frames), "")
    box = fuse(bounds)
    if box is None:
        low, high = scan.value_range.low, scan.value_range.high
        names = ", ".join(str(feature) for feature in features)
        raise InputError(
            f"feature {names} selects nothing; values range from {low:.9g} to {high:.9g}"
        )

    for feature in sorted(map(str, idle)):
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
    )


def _dilated(
    mask: npt.NDArray[np.bool_], step: int, scan: Scan, dilation: int
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_] | None]:
    """The finite vertices of a feature once it has grown, and which vertices are finite at all (None: all)."""
    mask = dilate(mask, dilation)
    z, y, x = mask.shape
    finite = scan.finite(step, (z, y, x))
    if finite is not None:
        mask &= finite
    return mask, finite


def _add_outside(
    mean: Mean,
    frame: npt.NDArray[Any],
    mask: npt.NDArray[np.bool_],
    finite: npt.NDArray[np.bool_] | None,
) -> None:
    """Take the finite values outside the coreset into a mean, plane by plane so that their float64 copy stays small."""
    for z, plane in enumerate(frame):
        outside = ~mask[z] if finite is None else finite[z] & ~mask[z]
        mean.add(plane[outside])
