"""Opacities by name: PyVista's, of features, and away from the background."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.colour.opacity import (
    BACKGROUND,
    INTERVAL,
    PRESETS,
    SURFACE,
    opacity_preset,
    raised,
    shown_range,
)

RANGE = (0.0, 10.0)


def at(name: str, values: Any, **arguments: Any) -> list[float]:
    points = opacity_preset(
        name,
        **{"shown": RANGE, "value_range": RANGE, "features": (), "histogram": None, **arguments},
    )
    assert np.all(np.diff(points[:, 0]) > 0)
    assert np.all((points[:, 1] >= 0) & (points[:, 1] <= 1))
    return np.interp(values, *points.T).tolist()


def test_the_presets_of_pyvista() -> None:
    assert at("linear", [0, 2.5, 10]) == [0, 0.25, 1]
    assert at("linear_r", [0, 2.5, 10]) == [1, 0.75, 0]
    np.testing.assert_allclose(at("geom", [0, 9, 10]), [0, (1e-6 / 255) ** 0.1, 1], atol=0.01)
    np.testing.assert_allclose(at("geom_r", [10, 1, 0]), at("geom", [0, 9, 10]))
    np.testing.assert_allclose(
        at("sigmoid", [1, 4, 5, 6, 10]),
        [0, 1 / (1 + np.e**2), 0.5, 1 / (1 + np.e**-2), 1],
        atol=0.01,
    )
    assert at("foreground", [0, 0.04, 1, 10]) == pytest.approx([0, 1, 1, 1])
    assert at("opaque", [-5, 0, 10, 50]) == [1, 1, 1, 1]


@pytest.mark.parametrize("name", PRESETS[2:])
def test_presets_reach_over_the_values_shown(name: str) -> None:
    moved = at(name, np.linspace(100, 200, 101), shown=(100.0, 200.0))
    np.testing.assert_allclose(moved, at(name, np.linspace(0, 10, 101)), atol=1e-12)


@pytest.mark.parametrize("name", ["auto", "feature"])
def test_an_interval_is_shown_within_its_ends(name: str) -> None:
    assert at(name, [2, 3, 4, 5, 6, 7, 8], features=("interval:3:7",)) == pytest.approx(
        [0, 0, INTERVAL, INTERVAL, INTERVAL, 0, 0]
    )


def test_an_end_that_the_data_do_not_reach_is_no_end() -> None:
    assert at("auto", [5, 9, 10], features=("interval:5:100",)) == pytest.approx(
        [0, INTERVAL, INTERVAL]
    )
    assert at("auto", [0, 4, 5], features=("interval:-inf:5",)) == pytest.approx(
        [INTERVAL, INTERVAL, 0]
    )
    assert at("auto", [5, 10], features=("segmentation:5",)) == pytest.approx([0, INTERVAL])


def test_surfaces_and_intervals_of_one_value_are_tents() -> None:
    for feature in ("isosurface:3", "interval:3:3"):
        assert at("auto", [2, 3, 4], features=(feature,)) == pytest.approx([0, SURFACE, 0])


def test_several_features_show_the_largest_opacity() -> None:
    features = ("interval:1:5", "isosurface:4.9", "segmentation:8")
    values = np.linspace(0, 10, 4001)
    alone = [at("auto", values, features=(feature,)) for feature in features]
    np.testing.assert_allclose(
        at("auto", values, features=features), np.max(alone, axis=0), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("feature", ["all", "mask:m.npy"])
def test_without_a_feature_the_background_is_clear(feature: str) -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(4, 0.1, 9000), rng.uniform(0, 10, 1000)])
    counts, edges = np.histogram(values, 256, RANGE)
    opacities = at("auto", [0, 3.9, 4, 4.1, 7, 10], features=(feature,), histogram=(edges, counts))
    assert opacities[2] == 0
    assert opacities[0] > opacities[1]
    assert BACKGROUND >= opacities[5] >= opacities[4] > opacities[3]
    assert opacities[5] == pytest.approx(BACKGROUND, rel=0.1)
    assert at("auto", [0, 10], features=(feature,)) == [0, BACKGROUND]


def test_one_value_alone_in_a_histogram() -> None:
    counts = np.zeros(256, dtype=np.int64)
    edges = np.linspace(0, 10, 257)
    assert at("auto", [0, 10], histogram=(edges, counts)) == [0, BACKGROUND]
    counts[7] = 100
    assert at("auto", [edges[7]], histogram=(edges, counts)) == [0]
    assert at("auto", [3.0], histogram=(edges, counts), value_range=(3.0, 3.0)) == [BACKGROUND]


def test_a_side_that_the_data_have_not_has_no_points() -> None:
    counts = np.full(256, 10)
    counts[0] = 9000
    points = opacity_preset(
        "auto",
        shown=RANGE,
        value_range=RANGE,
        features=(),
        histogram=(np.linspace(0, 10, 257), counts),
    )
    assert points[:, 0].min() > 0
    assert points[:, 1].tolist() == [0, BACKGROUND]


def test_colours_reach_over_the_feature() -> None:
    assert shown_range((), RANGE) == RANGE
    assert shown_range(("interval:3:7",), RANGE) == (3, 7)
    assert shown_range(("interval:3:7", "segmentation:5"), RANGE) == (3, 10)
    assert shown_range(("interval:3:7", "isosurface:9"), RANGE) == RANGE
    low, high = shown_range((), (5.0, 5.0))
    assert low == 5 < high


@pytest.mark.parametrize("scale", [1.0, 2.0**-1000, 2.0**1019])
def test_the_background_is_clear_however_small_or_large_the_values_are(scale: float) -> None:
    counts = np.zeros(16, dtype=np.int64)
    counts[[0, 8, 15]] = 2, 100, 1
    reach = 15 * scale
    edges = np.linspace(-1.0, 1.0, 17) * reach
    with np.errstate(all="raise", under="ignore"):
        opacities = at(
            "auto",
            [-reach, 0.06 * reach, reach],
            value_range=(-reach, reach),
            histogram=(edges, counts),
        )
    assert opacities == pytest.approx([BACKGROUND, 0, BACKGROUND], rel=0.1, abs=0.01)


@pytest.mark.parametrize("features", [(), ("interval:3:7",)])
def test_a_plane_is_opaque(features: tuple[str, ...]) -> None:
    assert at("auto", [-1, 0, 5, 11], features=features, thinnest=(1, 1.0)) == [1, 1, 1, 1]


def test_up_to_eight_vertices_every_value_is_seen_as_through_eight_spacings() -> None:
    full = 1 - (1 - BACKGROUND) ** 8
    histogram = (np.linspace(0, 10, 11), np.array([90, 1, 1, 1, 1, 1, 1, 1, 1, 1]))
    for vertices, length in ((2, 1.0), (8, 7.0), (8, 9.0)):
        (opacity,) = set(at("auto", [0, 3, 10], thinnest=(vertices, length), histogram=histogram))
        through = 1 - (1 - opacity) ** length
        assert through == pytest.approx(max(full, 1 - (1 - BACKGROUND) ** length))
    thick = at("auto", [0, 3, 10], thinnest=(9, 8.0), histogram=histogram)
    assert thick == at("auto", [0, 3, 10], histogram=histogram)
    assert thick[0] == 0


def test_features_of_thin_volumes_are_raised_too_and_named_presets_are_not() -> None:
    thin = at("auto", [2, 5], features=("interval:3:7",), thinnest=(3, 2.0))
    assert thin == pytest.approx([0, 1 - (1 - INTERVAL) ** 4])
    for name in ("linear", "feature"):
        given = {"features": ("interval:3:7",)}
        assert at(name, [2, 5], thinnest=(1, 1.0), **given) == at(name, [2, 5], **given)
    points = np.array([[0.0, 0.5], [1.0, 1.0]])
    np.testing.assert_array_equal(raised(points, (9, 2.0)), points)
    np.testing.assert_allclose(raised(points, (8, 4.0)), [[0, 0.75], [1, 1]])
