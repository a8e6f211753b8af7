"""Feature tracking: several features in one scene, each in its colour, and where they are."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, TypedDict, cast

import numpy as np
import numpy.typing as npt

from fhash_codec.features.features import (
    Feature,
    Interval,
    Mask,
    Segmentation,
    parse_feature,
    resolve_features,
)
from fhash_codec.features.features import Isosurface as SurfaceFeature
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.colours import colour_code, parse_colour
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.scenes import Isosurface, LegendEntry, Scene, TransferFunctionSpec
from fhash_codec.rendering.transfer_function import opacity_preset, raised
from fhash_codec.volume import Volume, feature_names, holds_features_apart
from fhash_formats.errors import InputError
from fhash_formats.series import Series
from fhash_formats.support.values import Double

COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442", "#555555")
"""Default colours of features: Okabe and Ito chose them to be told apart by colour-blind people."""
EDGE = 1e-6
"""Width over which one colour changes into the next, as a share of the value range."""


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """A feature to follow (interval, isosurface or segmentation) and its colour."""

    feature: Feature
    colour: str


def parse_tracked(
    texts: Sequence[str], volume: Volume, progress: Progress = silent
) -> list[Tracked]:
    """Read features with colours, such as "interval:0.2:1=#ff8800".

    Args:
        texts: features, each with "=COLOUR" or a default colour of COLOURS; the features of the
            file if empty. A segmentation without a threshold takes that of the file, else Otsu's
            threshold over all decoded steps.
        volume: an open container.
        progress: is told about the search for a threshold.

    Raises InputError for unknown features and colours, and for features that cannot be told by
    values: masks, and all of a domain.
    """
    own = [str(text) for text in volume.container.header["features"]]
    names, colours = _names_and_colours(texts or own)
    thresholded = next((text for text in own if text.startswith("segmentation:")), "segmentation")
    names = [thresholded if name == "segmentation" else name for name in names]
    for name in names:
        _check_trackable(name)
    if len(names) > len(COLOURS) and not all(colours):
        raise InputError(
            f"{len(names)} features are tracked, and there are {len(COLOURS)} colours; "
            "give each its own as FEATURE=#rrggbb"
        )
    # A volume reads like the series that features are resolved in.
    features = resolve_features(
        names, cast(Series, volume), range(volume.shape[0]), volume.value_range, progress
    )
    for colour in colours:
        if colour:
            parse_colour(colour)
    return [
        Tracked(feature=feature, colour=colours[number] or COLOURS[number])
        for number, feature in enumerate(features)
    ]


def _names_and_colours(texts: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split texts into features and colours; the colour is empty where a text has none."""
    names, colours = [], []
    for text in texts:
        # The file name of a mask may hold "=".
        has_colour = "=" in text and not text.startswith("mask:")
        name, _, colour = text.rpartition("=") if has_colour else (text, "", "")
        names.append(name)
        colours.append(colour)
    return names, colours


def _check_trackable(name: str) -> None:
    """Raise InputError for a feature that cannot be drawn by its values."""
    feature = parse_feature(name)
    if isinstance(feature, Mask) or not isinstance(
        feature, Interval | SurfaceFeature | Segmentation
    ):
        raise InputError(
            f"feature '{name[:60]}' cannot be drawn by its values; "
            "track interval:LO:HI, isosurface:V or segmentation[:T]"
        )


def tracking_scene(scene: Scene, tracked: Sequence[Tracked], volume: Volume) -> Scene:
    """Show several features in a scene, each in its colour.

    Intervals and segmentations are shown by the transfer function, isosurfaces as surfaces, within
    the box of the volume and with a legend. A value of several features has the largest of their
    opacities and the mean of their colours. Raises InputError without a feature.
    """
    if not tracked:
        raise InputError("no feature to track; give at least one")
    surfaces = tuple(
        Isosurface(value=item.feature.value, colour=item.colour)
        for item in tracked
        if isinstance(item.feature, SurfaceFeature)
    )
    filled = [item for item in tracked if not isinstance(item.feature, SurfaceFeature)]
    effects = dataclasses.replace(
        scene.effects,
        isosurfaces=(*scene.effects.isosurfaces, *surfaces),
        box=True,
        legend=(*scene.effects.legend, *_legend(tracked, volume)),
    )
    function = (
        _transfer_function(scene, filled, volume)
        if filled
        else dataclasses.replace(scene.transfer_function, nothing=True)
    )
    return dataclasses.replace(
        scene,
        transfer_function=function,
        effects=effects,
        features=scene.features or _features_apart(tracked, volume),
    )


def _features_apart(tracked: Sequence[Tracked], volume: Volume) -> tuple[str, ...]:
    """The tracked features if the file keeps each of them apart, so that the rest is skipped.

    Empty if some are not of the file: they may be anywhere in its coreset.
    """
    names, wanted = feature_names(volume), [str(item.feature) for item in tracked]
    if not holds_features_apart(volume) or not set(wanted) < set(names):
        return ()
    return tuple(dict.fromkeys(wanted))


def _legend(tracked: Sequence[Tracked], volume: Volume) -> list[LegendEntry]:
    """The entries of tracked features, with units of their values."""
    units = "" if volume.units in ("", "1") else f" {volume.units}"
    return [
        LegendEntry(text=f"{_in_words(item.feature, volume.name)}{units}", colour=item.colour)
        for item in tracked
    ]


def _in_words(feature: Feature, name: str) -> str:
    """The values of a feature, as people write them."""
    if isinstance(feature, SurfaceFeature):
        return f"{name} = {feature.value:.6g}"
    assert isinstance(feature, Interval | Segmentation)
    low, high = (
        (feature.low, feature.high)
        if isinstance(feature, Interval)
        else (feature.threshold if feature.threshold is not None else -math.inf, math.inf)
    )
    if math.isinf(high):
        return f"{name} ≥ {low:.6g}" if math.isfinite(low) else name
    return f"{name} ≤ {high:.6g}" if math.isinf(low) else f"{name}: {low:.6g} to {high:.6g}"


def _transfer_function(
    scene: Scene, filled: Sequence[Tracked], volume: Volume
) -> TransferFunctionSpec:
    """The transfer function of intervals and segmentations, with the density that is given."""
    given = scene.transfer_function
    low, high = volume.value_range.low, volume.value_range.high
    points = opacity_preset(
        "feature",
        shown=(low, high),
        value_range=(low, high),
        features=[str(item.feature) for item in filled],
        histogram=None,
    )
    if given.unit_distance is None:
        points = raised(points, Grid.of_volume(volume, scene.scale).thinnest)
    return TransferFunctionSpec(
        colours=_colours(filled, low, high),
        opacity=tuple((float(value), float(opacity)) for value, opacity in points),
        density=given.density,
        unit_distance=given.unit_distance,
    )


def _colours(tracked: Sequence[Tracked], low: float, high: float) -> tuple[tuple[float, str], ...]:
    """Colour points that are constant over each feature and jump between them.

    Where several features overlap, the colour is their mean.
    """
    spans = [_span(item.feature, low, high) for item in tracked]
    colours = np.array([parse_colour(item.colour) for item in tracked])
    edge = EDGE * (high - low) or max(abs(low) * 1e-6, 1e-30)
    bounds = sorted({end for span in spans for end in span})
    points: dict[float, Double] = {}
    colour = colours[0]
    for first, last in itertools.pairwise(bounds):
        inside = [span[0] < last and span[1] > first for span in spans]
        if any(inside):  # otherwise the values lie between two features and are not seen
            colour = colours[inside].mean(axis=0)
        points[first if not points else min(first + edge, (first + last) / 2)] = colour
        points[last] = colour
    if not points:
        points = dict(zip(bounds, (colours[:1] if len(bounds) == 1 else colours), strict=False))
    return tuple((float(value), colour_code(colour)) for value, colour in points.items())


def _span(feature: Feature, low: float, high: float) -> tuple[float, float]:
    """The values of an interval or a segmentation within a value range."""
    if isinstance(feature, Interval):
        return max(feature.low, low), min(feature.high, high)
    assert isinstance(feature, Segmentation)
    return low if feature.threshold is None else max(feature.threshold, low), high


class PlaceOfFeature(TypedDict):
    """A feature at a step, in physical coordinates."""

    step: Annotated[float, "the step"]
    time: Annotated[float, "its physical time"]
    vertices: Annotated[int, "their number"]
    centroid: Annotated[list[float] | None, "their mean (x, y, z); null without a vertex"]
    bounds: Annotated[list[list[float]] | None, "first and last position along x, y and z"]


class Followed(TypedDict):
    """A feature that was followed."""

    feature: Annotated[str, "as `--feature` takes it"]
    colour: Annotated[str, "its colour, `#rrggbb` or a name"]
    steps: Annotated[list[PlaceOfFeature], "where it is at each step"]


def follow(volume: Volume, tracked: Sequence[Tracked], steps: Sequence[float]) -> list[Followed]:
    """Find where each feature is at each step."""
    times = volume.coords["t"].values
    axes = [volume.coords[axis].values for axis in "xyz"]
    places: list[list[PlaceOfFeature]] = [[] for _ in tracked]
    for step in steps:
        frame = volume.read(step)
        time = float(np.interp(step, np.arange(len(times)), times))
        for item, items_places in zip(tracked, places, strict=True):
            selected = np.asarray(item.feature.select(frame, int(step)))
            items_places.append(_place(float(step), time, selected, axes))
    return [
        {"feature": str(item.feature), "colour": item.colour, "steps": items_places}
        for item, items_places in zip(tracked, places, strict=True)
    ]


def _place(
    step: float, time: float, selected: npt.NDArray[np.bool_], axes: Sequence[Double]
) -> PlaceOfFeature:
    """The place of the selected vertices (z, y, x) at coordinates x, y, z."""
    indices = np.nonzero(selected)[::-1]
    count = len(indices[0])
    positions = [axis[index] for axis, index in zip(axes, indices, strict=True)]
    return {
        "step": step,
        "time": time,
        "vertices": count,
        "centroid": [float(axis.mean()) for axis in positions] if count else None,
        "bounds": [[float(axis.min()), float(axis.max())] for axis in positions] if count else None,
    }
