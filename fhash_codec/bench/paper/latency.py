"""Latency of pictures straight through an encoding (paper, Table 6): sample streaming and ARM.

The paper gives milliseconds alone, and F-Hash alone has an occupancy there. Milliseconds mix three
things: samples that are asked for, passes in which they come, and the cost of one evaluation. So
each encoding is marched with and without the occupancy of the coreset, and passes, samples and
evaluations are counted.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.bench.paper.encodings.encoding import Encoding
from fhash_codec.bench.paper.pictures import view_of_feature
from fhash_codec.devices import choose_device
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.march_task import Array, Arrays
from fhash_codec.rendering.scenes import Camera
from fhash_codec.rendering.stream_fields import CoresetField
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.torch_arrays import TorchArrays

__all__ = ["EncodingField", "measure_latency"]

Mask = npt.NDArray[np.bool_]
Range = tuple[float, float]

SIZE = 64
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
        self, encoding: Encoding, key: int, mask: Mask, arrays: Arrays, *, occupancy: bool
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
    encoding: Encoding,
    masks: Sequence[Mask],
    feature: str,
    *,
    value_range: Range = (0.0, 1.0),
    size: int = SIZE,
    views: int = VIEWS,
    seed: int = 0,
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
        seed: of the views.
        device: of the encoding, cpu or cuda.
        progress: is told about each picture.

    Returns:
        {"size", "views", "off": {...}, "on": {...}} for the occupancy off and on, each with
        "stream_ms" and "arm_ms" (medians over views) and the means over views "stream_passes",
        "arm_passes", "samples" (streaming), "arm_samples" and "evaluations" (streaming).
    """
    arrays = TorchArrays(choose_device(device))
    rng = np.random.default_rng(seed)
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
