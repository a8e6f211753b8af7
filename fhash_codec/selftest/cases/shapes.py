"""Cases of shapes: axes of one vertex, two, three and primes, extreme aspect ratios, tiles that do
not fit, hard positions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases.fields import SHAPE, Shape, series, waves
from fhash_codec.selftest.cases.settings import MORE, QUICK, Settings, of_all
from fhash_formats.series import ArraySeries

__all__ = ["SHAPE_CASES"]

ONE_KEY_FRAME: Settings = {
    "paper-first": EncodeConfig(profile="paper", width=8, epochs=5, key_frames="0"),
    "paper-middle": EncodeConfig(profile="paper", width=8, epochs=5, key_frames="2"),
}
ONE_KEY_FRAME_CODED: Settings = {
    f"{name}-transform": config
    for name, config in of_all(ONE_KEY_FRAME, tables="transform").items()
}
TILES: Settings = {
    "tiles": EncodeConfig(max_error_rel=1e-3, effort=1, tile="3x4x5x7"),
    "one-tile": EncodeConfig(psnr=50.0, effort=2, tile="whole"),
}
TILES_OF_ONE: Settings = {"bound": EncodeConfig(max_error_rel=1e-2, effort=1, tile="1x1x1x1")}


def _shape_case(
    name: str, about: str, shape: Shape, settings: Settings = QUICK, **rest: Any
) -> Case:
    make = _field(shape)
    return Case(
        name=name,
        group="shapes",
        about=about,
        make=make,
        settings=settings,
        **{"more": MORE, **rest},
    )


def _field(shape: Shape) -> Callable[[], ArraySeries]:
    return lambda: series(waves(shape).astype(np.float32))


def _placed(name: str, about: str, **axes: Any) -> Case:
    """A case of positions in space. Decoding ignores them, rendering does not."""

    def make() -> ArraySeries:
        return series(waves().astype(np.float32), **axes)

    return Case(name=name, group="shapes", about=about, make=make, settings=QUICK)


Z, Y, X = (np.arange(float(n)) for n in SHAPE[1:])

SHAPE_CASES: tuple[Case, ...] = (
    _shape_case("one-voxel", "a series of one value", (1, 1, 1, 1)),
    _shape_case("one-voxel-in-time", "one vertex at many steps", (97, 1, 1, 1)),
    _shape_case("one-frame", "a single step", (1, 9, 10, 11)),
    _shape_case(
        "one-key-frame",
        "one key frame stands for all steps",
        SHAPE,
        ONE_KEY_FRAME,
        more=ONE_KEY_FRAME_CODED,
    ),
    *(
        _shape_case(f"one-along-{axis}", f"axis {axis} has one vertex", shape)
        for axis, shape in {"z": (4, 1, 10, 11), "y": (4, 9, 1, 11), "x": (4, 9, 10, 1)}.items()
    ),
    _shape_case("line", "one line of vertices", (3, 1, 1, 127)),
    _shape_case("twos", "two vertices along every axis", (2, 2, 2, 2)),
    _shape_case("threes", "three vertices along every axis", (3, 3, 3, 3)),
    _shape_case("primes", "lengths that are primes", (5, 7, 11, 13)),
    _shape_case("larger-primes", "lengths just above powers of two", (3, 17, 5, 37), quick=False),
    *(
        _shape_case(
            f"long-{axis}",
            f"axis {axis} is hundreds of times as long as the others",
            shape,
            quick=axis == "x",
        )
        for axis, shape in {
            "t": (512, 1, 2, 1),
            "z": (2, 2048, 1, 1),
            "y": (1, 2, 2048, 1),
            "x": (2, 1, 2, 2048),
        }.items()
    ),
    _shape_case("odd-tiles", "tiles that do not divide the lengths", SHAPE, TILES, more={}),
    _shape_case(
        "tiles-of-one", "every vertex is a tile of its own", (2, 3, 4, 3), TILES_OF_ONE, more={}
    ),
    _placed(
        "descending-positions",
        "positions that descend along every axis",
        z=-Z,
        y=7 - 0.5 * Y,
        x=1e3 - 2 * X,
    ),
    _placed("tiny-positions", "vertices 1e-12 apart", z=1e-12 * Z, y=1e-12 * Y, x=1e-12 * X),
    _placed(
        "far-positions",
        "positions whose spacing float64 can hardly resolve",
        z=1e9 + 1e-6 * Z,
        y=1e9 + 1e-6 * Y,
        x=1e9 + 1e-6 * X,
    ),
    _placed(
        "flat-positions",
        "spacings that differ by a factor of a million",
        z=1e-3 * Z,
        y=Y,
        x=1e3 * X,
    ),
    _placed("huge-positions", "vertices 1e300 apart", z=1e300 * Z, y=1e300 * Y, x=1e300 * X),
    _placed(
        "uneven-positions", "positions that grow like powers of two", z=2.0**Z, y=2.0**Y, x=2.0**X
    ),
    _placed(
        "equal-positions",
        "positions that are all equal, or NaN",
        z=0 * Z,
        y=np.full(SHAPE[2], np.nan),
        x=X,
    ),
)
