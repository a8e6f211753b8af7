"""The published network as a frame that is marched through: where it has values, and its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.paper.model import PaperModel, PointSampler, PointTables
from fhash_codec.rendering.bricks import SIDE, Bricks
from fhash_codec.rendering.grid import Warp
from fhash_codec.rendering.march_device import DeviceMarcher
from fhash_codec.rendering.march_task import Frame, NetworkValues, Units
from fhash_codec.volume import Volume
from fhash_formats.support.values import Double, Single


def network_frame(
    volume: Volume, step: float, units: Units, warp: Warp | None, device: DeviceMarcher | None
) -> tuple[Frame, Bricks]:
    """The frame of a network at a step, with its bricks, as long as the first is.

    A place has a value where all vertices of weight around it are in the coreset. Which one is not
    known before the network is evaluated: any value of the range, with a margin.

    Args:
        volume: of a published network.
        step: of the series; fractional between two steps.
        units: of the values.
        warp: of uneven axes; the frame has their drawn vertices.
        device: evaluates the network; None for the processor.

    Raises:
        Unavailable: the device cannot do this network.
        DamagedFileError: numbers of a table are not finite.
    """
    model = volume._model
    assert isinstance(model, PaperModel), "a plan marches through no other file"
    low, high = (float(end) for end in units.to(list(volume.value_range.ends)))
    in_coreset = volume.occupancy(step, volume.box)
    mask = np.where(in_coreset, np.float32(1), np.float32(np.nan))
    bricks = possible_bricks(mask, low, high)
    key = volume.key_times.key_index(step)
    on_device = None if device is None else device.network(model.network, key)
    sampler = None
    fields: dict[str, Any] = {"network": 1}
    if on_device is None:
        sampler = PointSampler(PointTables.of_box(model.network, key), key)
        fields = sampler.fields()
    network = NetworkValues(
        fields=fields,
        low=low,
        high=high,
        mask=mask,
        whole=bool(in_coreset.all()),
        held=sampler,
        device=on_device,
    )
    frame = Frame(values=mask, first=volume.box.first, network=network)
    return (frame, bricks) if warp is None else _warped(frame, bricks, warp)


def possible_bricks(mask: Single, low: float, high: float) -> Bricks:
    """Bricks with the values that a field may have where a mask is no NaN: a range and a margin."""
    bricks = Bricks.of(Frame(values=mask, first=(0, 0, 0)))
    has_value = bricks.low <= bricks.high
    low, high = (float(np.float32(end)) for end in (2 * low - high, 2 * high - low))
    return replace(
        bricks,
        low=np.where(has_value, np.float32(low), np.float32(np.inf)),
        high=np.where(has_value, np.float32(high), np.float32(-np.inf)),
        value_range=(low, high) if has_value.any() else (0.0, 0.0),
    )


def _warped(frame: Frame, bricks: Bricks, warp: Warp) -> tuple[Frame, Bricks]:
    """A frame on the drawn vertices, between which places run linearly on the series' axes.

    Bricks of it have the extreme values of all bricks that they touch.
    """
    assert frame.network is not None
    first, counts, bounds, places = [], [], [], {}
    low, high = bricks.low, bricks.high
    for axis, own in zip((2, 1, 0), (warp.places[n] for n in (2, 1, 0)), strict=True):
        start, size = frame.first[2 - axis], frame.values.shape[2 - axis]
        # A single vertex is half a vertex wide on both sides.
        ends = np.array([start, start + size - 1], dtype=np.float64)
        if own is None:
            drawn_ends, drawn = ends, range(start, start + size)
        else:
            drawn_ends = np.interp(ends, own, np.arange(len(own)))
            drawn = range(int(np.floor(drawn_ends[0])), int(np.ceil(drawn_ends[1])) + 1)
            places["network_" + "xyz"[axis]] = own[drawn.start : drawn.stop] - start
        wide = warp.counts[axis] == 1
        bounds.append(drawn_ends + (np.array([-0.5, 0.5]) if wide else 0.0))
        first.append(drawn.start)
        counts.append(len(drawn))
        begin, end = _touched(drawn, own, start, low.shape[2 - axis])
        low = span_extremes(low, begin, end, 2 - axis, np.minimum)
        high = span_extremes(high, begin, end, 2 - axis, np.maximum)
    network = replace(
        frame.network, fields={**frame.network.fields, **places}, bounds=np.array(bounds[::-1])
    )
    # The shape alone counts; the mask stays on the series' vertices.
    values = np.broadcast_to(np.float32(0), counts)
    z, y, x = first
    drawn_frame = Frame(values=values, first=(z, y, x), network=network)
    return drawn_frame, replace(bricks, values=values, low=low, high=high)


def _touched(
    drawn: range, own: Double | None, start: int, bricks: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First and last brick of the series that each brick of drawn cells touches along an axis.

    drawn: the frame's vertices. own: place of each drawn vertex in the series; None for itself.
    start: vertex of the series at which its bricks begin, of which there are so many.
    """
    last = max(drawn[-1], drawn.start + 1)
    starts = np.arange(drawn.start, last, SIDE)
    ends = np.stack([starts, np.minimum(starts + SIDE, last)])
    at = ends.astype(np.float64)
    if own is not None:
        at = own[np.clip(ends, 0, len(own) - 1)]
    at = (at - start) / SIDE
    found = np.floor(at[0] - 1e-9), np.floor(at[1] + 1e-9)
    begin, end = (np.clip(each, 0, bricks - 1).astype(np.int64) for each in found)
    return begin, end


def span_extremes(
    values: Single,
    begin: npt.NDArray[np.int64],
    end: npt.NDArray[np.int64],
    axis: int,
    reduce: np.ufunc,
) -> Single:
    """Reduce the spans `begin` to `end`, both included, of an axis."""
    moved = np.moveaxis(values, axis, 0)
    parts = [
        reduce.reduce(moved[low : high + 1], axis=0) for low, high in zip(begin, end, strict=True)
    ]
    return np.ascontiguousarray(np.moveaxis(np.stack(parts), 0, axis))
