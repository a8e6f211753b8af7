"""Feature tracking: several features in colours of their own in one scene, and where each of them is from step to step."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from fhash_codec.coreset.features import (
    Feature,
    Interval,
    Mask,
    Segmentation,
    parse_feature,
    resolve_features,
)
from fhash_codec.coreset.features import Isosurface as SurfaceFeature
from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.colour.colours import parse_colour
from fhash_codec.rendering.colour.opacity import opacity_preset
from fhash_codec.rendering.scene.scene import Isosurface, Scene, TransferFunctionSpec
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.series import Series

__all__ = ["COLOURS", "Tracked", "follow", "parse_tracked", "tracking_scene"]

Floats = npt.NDArray[np.float64]

COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442", "#555555")
"""Of features that are given none: those that Okabe and Ito chose for people who tell few colours apart."""
EDGE = 1e-6
"""Of the value range: how far a colour reaches over into the next."""


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """A feature to follow, an interval, isosurface or segmentation, and its colour."""

    feature: Feature
    colour: str


def parse_tracked(
    texts: Sequence[str], volume: Volume, progress: Progress = silent
) -> list[Tracked]:
    """Features such as "interval:0.2:1=#ff8800", each with a colour of COLOURS if it names none; those of the file if there are no texts.

    A segmentation without a threshold takes that of the file, else Otsu's, of all the decoded steps.
    Raises InputError for what is not known, and for features that values do not tell: masks, and all of a domain.
    """
    own = [str(text) for text in volume.container.header["features"]]
    parts = [
        text.rpartition("=") if "=" in text and not text.startswith("mask:") else (text, "", "")
        for text in texts or own
    ]
    names, colours = [part[0] for part in parts], [part[2] for part in parts]
    threshold = next((text for text in own if text.startswith("segmentation:")), None)
    names = [
        threshold if name == "segmentation" and threshold is not None else name for name in names
    ]
    for name in names:
        feature = parse_feature(name)
        if isinstance(feature, Mask) or not isinstance(
            feature, Interval | SurfaceFeature | Segmentation
        ):
            raise InputError(
                f"feature '{name[:60]}' cannot be drawn by its values; track interval:LO:HI, isosurface:V or segmentation[:T]"
            )
    if len(names) > len(COLOURS) and not all(colours):
        raise InputError(
            f"{len(names)} features are tracked, and there are {len(COLOURS)} colours; give each its own as FEATURE=#rrggbb"
        )
    # A volume reads like the series that features are found in.
    found = resolve_features(
        names, cast(Series, volume), range(volume.shape[0]), volume.value_range, progress
    )
    for colour in colours:
        if colour:
            parse_colour(colour)
    return [
        Tracked(feature=feature, colour=colours[i] or COLOURS[i]) for i, feature in enumerate(found)
    ]


def tracking_scene(scene: Scene, tracked: Sequence[Tracked], volume: Volume) -> Scene:
    """A scene of several features: intervals and segmentations by colour and opacity of their values, isosurfaces as surfaces.

    A value of several features has the largest of their opacities, and the mean of their colours.
    """
    if not tracked:
        raise InputError("no feature to track; give at least one")
    surfaces = tuple(
        Isosurface(value=each.feature.value, colour=each.colour)
        for each in tracked
        if isinstance(each.feature, SurfaceFeature)
    )
    filled = [each for each in tracked if not isinstance(each.feature, SurfaceFeature)]
    low, high = volume.value_range.low, volume.value_range.high
    given = scene.transfer_function
    if filled:
        texts = [str(each.feature) for each in filled]
        points = opacity_preset(
            "feature", shown=(low, high), value_range=(low, high), features=texts, histogram=None
        )
        spec = TransferFunctionSpec(
            colours=_colours(filled, low, high),
            opacity=tuple((float(value), float(opacity)) for value, opacity in points),
            density=given.density,
            unit_distance=given.unit_distance,
        )
    else:
        spec = dataclasses.replace(given, nothing=True)
    effects = dataclasses.replace(
        scene.effects, isosurfaces=(*scene.effects.isosurfaces, *surfaces)
    )
    return dataclasses.replace(scene, transfer_function=spec, effects=effects)


def _colours(tracked: Sequence[Tracked], low: float, high: float) -> tuple[tuple[float, str], ...]:
    """Colours constant over the values of each feature, mixed where several hold, as points that jump."""
    spans = []
    for each in tracked:
        if isinstance(each.feature, Interval):
            spans.append((max(each.feature.low, low), min(each.feature.high, high)))
        else:
            assert isinstance(each.feature, Segmentation)
            spans.append(
                (low if each.feature.threshold is None else max(each.feature.threshold, low), high)
            )
    edge = EDGE * (high - low) or max(abs(low) * 1e-6, 1e-30)
    shades = np.array([parse_colour(each.colour) for each in tracked])
    bounds = sorted({end for span in spans for end in span})
    points: dict[float, Floats] = {}
    shade = shades[0]
    for first, last in itertools.pairwise(bounds):
        inside = [span[0] < last and span[1] > first for span in spans]
        shade = (
            shades[inside].mean(axis=0) if any(inside) else shade
        )  # between two features nothing is seen
        points[first if not points else min(first + edge, (first + last) / 2)] = shade
        points[last] = shade
    if not points:
        points = dict(zip(bounds, (shades[:1] if len(bounds) == 1 else shades), strict=False))
    return tuple(
        (float(value), "#" + "".join(f"{round(255 * float(part)):02x}" for part in shade))
        for value, shade in points.items()
    )


def follow(
    volume: Volume, tracked: Sequence[Tracked], steps: Sequence[float]
) -> list[dict[str, Any]]:
    """Where each feature is at each step: {feature, colour, steps: [{step, time, vertices, centroid, bounds}]}.

    vertices: how many are of the feature. centroid (x, y, z): their mean in physical coordinates; bounds ((x, x), (y, y), (z, z)): the
    first and last position; both None where the feature is not.
    """
    times = volume.coords["t"].values
    axes = [volume.coords[axis].values for axis in "xyz"]
    found: list[list[dict[str, Any]]] = [[] for _ in tracked]
    for step in steps:
        frame = volume.read(step)
        time = float(np.interp(step, np.arange(len(times)), times))
        for each, places in zip(tracked, found, strict=True):
            at = np.nonzero(each.feature.select(frame, int(step)))[::-1]
            count = len(at[0])
            positions = [axis[part] for axis, part in zip(axes, at, strict=True)]
            places.append(
                {
                    "step": float(step),
                    "time": time,
                    "vertices": count,
                    "centroid": [float(part.mean()) for part in positions] if count else None,
                    "bounds": [[float(part.min()), float(part.max())] for part in positions]
                    if count
                    else None,
                }
            )
    return [
        {"feature": str(each.feature), "colour": each.colour, "steps": places}
        for each, places in zip(tracked, found, strict=True)
    ]
