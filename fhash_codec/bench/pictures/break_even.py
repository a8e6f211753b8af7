"""Adaptive ray marching beside the cache by picture size, for `fhash bench render`."""

from __future__ import annotations

import time
from dataclasses import replace
from statistics import median

from fhash_codec.bench.pictures.results import BreakEven
from fhash_codec.progress import Progress
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import Scene
from fhash_codec.volume import Volume

__all__ = ["break_even"]

SIZES = (4, 8, 16, 32, 64, 128)
"""Pixels along both sides of the pictures."""
LOST = 4.0
"""Times of the cache at which larger pictures are not marched through the model any more."""
MAX_TURNS = 3
"""Largest number of runs of each median: a run may take seconds."""


def break_even(
    volume: Volume, scene: Scene, turns: int, size: int, progress: Progress
) -> tuple[BreakEven, ...]:
    """Measure first and later pictures of one step by the cache and by adaptive ray marching.

    Args:
        volume: an open container.
        scene: what is shown.
        turns: runs of each median.
        size: largest pixels along both sides.
        progress: called after each size.
    """
    kept = Renderer(volume)
    first = Renderer(volume, memory=0)
    results: list[BreakEven] = []
    sizes = [side for side in SIZES if side <= size]
    for number, side in enumerate(sizes, start=1):
        march = replace(scene.march, lod=0)
        cached, marched, auto = (
            replace(scene, size=(side, side), march=replace(march, mode=mode))
            for mode in ("cache", "arm", "auto")
        )
        for renderer in (first, kept):  # a histogram of the series is no part of a picture
            renderer.plan(cached)
        kept.render(cached)
        times: dict[str, list[float]] = {"first": [], "kept": [], "arm": []}
        for _ in range(min(turns, MAX_TURNS)):
            times["first"].append(_seconds(first, cached)[0])
            times["kept"].append(_seconds(kept, cached)[0])
            seconds, image = _seconds(first, marched)
            times["arm"].append(seconds)
        results.append(
            BreakEven(
                size=side,
                first_ms=1e3 * median(times["first"]),
                kept_ms=1e3 * median(times["kept"]),
                arm_ms=1e3 * median(times["arm"]),
                evaluations=int(image.counters["evaluations"]),
                auto=first.plan(auto).mode,
            )
        )
        progress("break-even", number, len(sizes), f"{side} pixels")
        if results[-1].ratio > LOST:
            break
    return tuple(results)


def _seconds(renderer: Renderer, scene: Scene) -> tuple[float, Image]:
    """Time of a picture, and the picture."""
    begun = time.perf_counter()
    image = renderer.render(scene)
    return time.perf_counter() - begun, image
