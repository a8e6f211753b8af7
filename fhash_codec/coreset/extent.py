"""The extent of the coreset: its box, and one bit per vertex of the domain and key frame."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.boxes import Box, Sizes, bounding_box, fuse
from fhash_codec.coreset.features import Everything, Feature, dilate
from fhash_codec.coreset.scan import Scan, finite_mask
from fhash_codec.measure.ranks import Ranks
from fhash_codec.measure.value_range import Mean
from fhash_codec.progress import Progress
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import Series


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
    """

    box: Box
    key_frames: tuple[int, ...]
    packed: list[npt.NDArray[np.uint8]]
    domain: Sizes
    samples: int
    background: float
    apart: tuple[list[npt.NDArray[np.uint8]], ...] = ()

    @property
    def fraction(self) -> float:
        """samples / (key frames * vertices of the domain)."""
        return self.samples / (len(self.key_frames) * prod(self.domain))

    def mask(self, key: int) -> npt.NDArray[np.bool_]:
        """Mask (z, y, x) of the vertices of the box that are in the coreset.

        key: index of a key frame.
        """
        return self._unpacked(self.packed[key])

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


def find_extent(
    series: Series,
    scan: Scan,
    key_frames: Sequence[int],
    features: Sequence[Feature],
    dilation: int,
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
    everything = any(isinstance(feature, Everything) for feature in features)
    if everything and not scan.missing and not apart:
        return _everywhere(scan, key_frames, (z, y, x), progress)
    packed: list[npt.NDArray[np.uint8]] = []
    boxes, outside, samples = [], Mean(), 0
    packed_apart: tuple[list[npt.NDArray[np.uint8]], ...] = tuple(
        [] for _ in (features if apart else ())
    )
    without_vertices = set(features)
    for done, step in enumerate(key_frames):
        frame = series.read(step)
        masks = [feature.select(frame, step) for feature in features]
        without_vertices -= {
            feature for feature, mask in zip(features, masks, strict=True) if mask.any()
        }
        finite = scan.finite(step, (z, y, x))
        mask = _dilated(np.logical_or.reduce(masks), finite, dilation)
        packed.append(np.packbits(mask))
        for one, packed_one in zip(masks, packed_apart, strict=False):
            packed_one.append(np.packbits(_dilated(one, finite, dilation)))
        boxes.append(bounding_box(mask))
        samples += int(np.count_nonzero(mask))
        _add_outside(outside, frame, mask, finite)
        if ranks is not None:
            ranks.add(frame[mask])
        progress("selecting", done + 1, len(key_frames), "")
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
    result = {}
    for step in steps:
        frame = series.read(step)
        mask = np.logical_or.reduce([feature.select(frame, step) for feature in features])
        finite = finite_mask(missing, step, series.shape[1:])
        result[step] = np.packbits(_dilated(mask, finite, dilation))
    return result


def _everywhere(scan: Scan, key_frames: Sequence[int], domain: Sizes, progress: Progress) -> Extent:
    """The extent of a coreset that holds every vertex; no frame is read for it."""
    all_ones = np.packbits(np.ones(domain, dtype=bool))
    for done in range(len(key_frames)):
        progress("selecting", done + 1, len(key_frames), "")
    return Extent(
        box=Box.of_shape(domain),
        key_frames=tuple(key_frames),
        packed=[all_ones] * len(key_frames),
        domain=domain,
        samples=len(key_frames) * prod(domain),
        background=scan.mean,
    )


def _dilated(
    mask: npt.NDArray[np.bool_], finite: npt.NDArray[np.bool_] | None, dilation: int
) -> npt.NDArray[np.bool_]:
    """Mask (z, y, x) of the finite vertices of the dilated mask.

    finite: mask of all finite vertices; None if every vertex is finite.
    """
    mask = dilate(mask, dilation)
    if finite is not None:
        mask &= finite
    return mask


def _add_outside(
    mean: Mean,
    frame: npt.NDArray[Any],
    mask: npt.NDArray[np.bool_],
    finite: npt.NDArray[np.bool_] | None,
) -> None:
    """Add the finite values outside the coreset to a mean.

    Planes are added one by one, so that their float64 copies stay small.
    """
    for z, plane in enumerate(frame):
        outside = ~mask[z] if finite is None else finite[z] & ~mask[z]
        mean.add(plane[outside])
