"""Cases of features: at borders, of one vertex, far apart, empty at times, everywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.selftest.case import Case
from fhash_codec.selftest.cases.fields import SHAPE, lattice, series, waves
from fhash_codec.selftest.cases.settings import MORE, QUICK, Settings, of_all

__all__ = ["FEATURE_CASES"]

Values = npt.NDArray[Any]

INSIDE = "interval:10:30"
"""The interval into which `_lifted` lifts the values of the feature."""


def _feature_case(
    name: str,
    about: str,
    make: Callable[[], Values],
    features: tuple[str, ...] = (INSIDE,),
    dilation: int = 0,
    **rest: Any,
) -> Case:
    settings: Settings = rest.pop("settings", QUICK)
    return Case(
        name=name,
        group="features",
        about=about,
        make=lambda: series(make().astype(np.float32)),
        settings=of_all(settings, features=features, dilation=dilation),
        more=of_all(rest.pop("more", MORE), features=features, dilation=dilation),
        **rest,
    )


def _lifted(where: Callable[..., Values]) -> Callable[[], Values]:
    """Waves in 0..1, lifted to 10..11 at the vertices that `where(t, z, y, x)` selects."""
    return lambda: np.where(where(*lattice()), 10.0, 0.0) + waves()


def _borders(t: Values, z: Values, y: Values, x: Values) -> Values:
    ends = [(index == 0) | (index == n - 1) for index, n in zip((z, y, x), SHAPE[1:], strict=True)]
    return np.asarray(np.logical_or.reduce(ends))


def _corners(t: Values, z: Values, y: Values, x: Values) -> Values:
    low, high = (z <= 1) & (y <= 1) & (x <= 1), (z >= 7) & (y >= 8) & (x >= 9)
    return np.asarray(np.where(t % 2 == 0, low, high) | (low & (t == 3)))


def _vertex(t: Values, z: Values, y: Values, x: Values) -> Values:
    return np.asarray((z == 4) & (y == 5) & (x == 2 + t))


def _ends(t: Values, z: Values, y: Values, x: Values) -> Values:
    """Selects two opposite corners, so that the bounding box is the whole domain."""
    return np.asarray(((z == 0) & (y == 0) & (x == 0)) | ((z == 8) & (y == 9) & (x == 10)))


def _with_holes() -> Values:
    """A feature that touches missing values."""
    values = _lifted(lambda t, z, y, x: x > 4)()
    t, _, y, x = lattice()
    values[(y == 5) | ((t == 2) & (x < 6))] = np.nan
    return values


KEYS = EncodeConfig(profile="paper", width=8, epochs=5, key_frames="0,2,3", tables="transform")

FEATURE_CASES: tuple[Case, ...] = (
    _feature_case(
        "at-every-border", "a feature that is the surface of the domain", _lifted(_borders)
    ),
    _feature_case(
        "at-every-border-grown",
        "the surface of the domain, grown beyond the domain",
        _lifted(_borders),
        dilation=64,
    ),
    _feature_case("one-vertex", "a feature of one vertex that moves", _lifted(_vertex)),
    _feature_case(
        "one-vertex-grown", "a feature of one vertex, grown by one", _lifted(_vertex), dilation=1
    ),
    _feature_case("opposite-corners", "a feature in opposite corners in turn", _lifted(_corners)),
    _feature_case("whole-box", "two vertices whose bounding box is the domain", _lifted(_ends)),
    _feature_case("everything", "an interval that holds all values", waves, ("interval:-1:2",)),
    _feature_case(
        "empty-key-frames",
        "a feature that is empty in some key frames",
        _lifted(lambda t, z, y, x: (t == 2) & (x > 3)),
        settings={**QUICK, "paper-keys": KEYS},
    ),
    _feature_case(
        "one-key-frame-filled",
        "a feature that exists only at the last step",
        _lifted(lambda t, z, y, x: (t == 3) & (y == 2)),
    ),
    _feature_case(
        "every-second-vertex",
        "a feature of which no two vertices touch",
        _lifted(lambda t, z, y, x: (t + z + y + x) % 2 == 0),
    ),
    _feature_case("beside-missing", "a feature that meets missing values", _with_holes, dilation=1),
    _feature_case("open-interval", "an interval from -inf to inf", waves, ("interval:-inf:inf",)),
    _feature_case(
        "one-value", "an interval of one value", lambda: np.rint(10 * waves()), ("interval:5:5",)
    ),
    _feature_case(
        "surface-on-vertices",
        "an isosurface through vertices",
        lambda: np.rint(10 * waves()),
        ("isosurface:5",),
    ),
    _feature_case(
        "surface-at-the-end", "an isosurface at the largest value", waves, ("isosurface:1",)
    ),
    _feature_case(
        "two-features", "two features that overlap", waves, ("interval:0.2:0.6", "isosurface:0.6")
    ),
    _feature_case(
        "segmented-step",
        "segmentation of values that form two clusters",
        _lifted(lambda t, z, y, x: x > 5),
        ("segmentation",),
        1,
    ),
    _feature_case(
        "nothing-selected",
        "refused: the feature selects no vertex",
        waves,
        ("interval:5:6",),
        more={},
        refused="selects nothing",
    ),
)
