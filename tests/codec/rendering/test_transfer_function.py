"""Transfer functions and named opacities."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec.rendering.scenes import TransferFunctionSpec
from fhash_codec.rendering.transfer_function import (
    BACKGROUND,
    INTERVAL,
    OPAQUE,
    PRESETS,
    SURFACE,
    TransferFunction,
    extinction_of,
    opacity_preset,
)
from fhash_formats.errors import FhashWarning, InputError

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


VALUES = np.linspace(-2, 12, 1401)


def made(spec: dict[str, Any] | None = None, **arguments: Any) -> TransferFunction:
    return TransferFunction.of(
        TransferFunctionSpec.from_dict(spec or {}),
        **{"value_range": (0.0, 10.0), "spacing": 1.0, **arguments},
    )


@pytest.mark.parametrize(
    ("positions", "spec", "ends"),
    [
        ((0.0, 1.0), {}, (0, 10)),
        ((-1.0, 1.0), {"range": [2, 3]}, (2, 3)),
        ((3.0, 7.0), {}, (3, 7)),
        ((3.0, 7.0), {"range": [0, 1]}, (0, 1)),
    ],
)
def test_presets_of_paraview(
    tmp_path: Path, positions: tuple[float, float], spec: dict[str, Any], ends: tuple[float, float]
) -> None:
    low, high = positions
    path = tmp_path / "p.json"
    path.write_text(
        json.dumps(
            {
                "RGBPoints": [low, 0, 0, 0, high, 1, 1, 1],
                "Points": [low, 0, 0.5, 0, high, 0.5, 0.5, 0],
            }
        )
    )
    function = made({"colours": str(path), **spec})
    assert tuple(function.colours.positions) == ends
    np.testing.assert_allclose(function.points, [[ends[0], 0], [ends[1], 0.5]])
    assert len(made({"colours": str(path), **spec, "opacity": "opaque"}).points) == 1


@pytest.mark.parametrize("density", [0.01, 1.0])
@pytest.mark.parametrize(
    "opacity", [*PRESETS[2:], "auto", [[1, 0], [2, 0.9], [2.5, 0], [6, 0], [7, 1.0]]]
)
def test_a_table_is_the_function_and_the_marker_of_visible_values(
    opacity: Any, density: float
) -> None:
    function = made({"opacity": opacity, "density": density})
    low, high, colours, extinctions = function.table()
    assert (colours.shape, colours.dtype, extinctions.shape, extinctions.dtype) == (
        (4096, 3),
        np.float32,
        (4096,),
        np.float64,
    )
    inside = VALUES[(VALUES >= 0) & (VALUES <= 10)]
    place = (inside - low) / (high - low) * 4095
    tabled = np.interp(place, np.arange(4096), 1 - np.exp(-extinctions))
    # Towards opacity 1 the extinction rises without bound: entries beside a point may differ.
    away = np.min(np.abs(inside[:, None] - function.points[:, 0]), axis=1) > (high - low) / 4095
    np.testing.assert_allclose(
        tabled[away], (1 - np.exp(-function.extinction(inside)))[away], rtol=0, atol=0.02
    )
    shown = function.extinction(inside) > 0
    mixed = np.stack(
        [np.interp(place, np.arange(4096), colours[:, channel]) for channel in range(3)], axis=-1
    )
    np.testing.assert_allclose(mixed[shown], function.colour(inside)[shown], rtol=0, atol=2e-3)
    assert np.all(function.visible(inside, inside)[tabled > 0])


def test_visible_is_a_query_by_range() -> None:
    function = made({"opacity": [[1, 0], [2, 0.5], [3, 0], [6, 0], [7, 0.5], [8, 0]]})
    rng = np.random.default_rng(3)
    ends = np.sort(rng.uniform(-1, 11, (3000, 2)))
    low, high = ends.T.copy()
    high[:1000] = low[:1000]
    entry = (function.span[1] - function.span[0]) / 4095
    truth = np.array(
        [np.any(((a < 3) & (b > 1)) | ((a < 8) & (b > 6))) for a, b in zip(low, high, strict=True)]
    )
    wider = np.array(
        [
            np.any(((a - entry < 3) & (b + entry > 1)) | ((a - entry < 8) & (b + entry > 6)))
            for a, b in zip(low, high, strict=True)
        ]
    )
    np.testing.assert_array_equal(function.visible(low, high), wider)
    assert 100 < truth.sum() < 2900
    assert not np.any(truth & ~wider)


def test_a_peak_that_a_table_misses_is_told() -> None:
    function = made(
        {
            "opacity": [
                [1, 0],
                [2, 0.5],
                [3, 0],
                [6.00031, 0],
                [6.00032, 1],
                [6.00033, 0],
                [8, 0],
                [9, 0.2],
            ]
        }
    )
    with pytest.warns(FhashWarning, match="peak of the opacity is narrower"):
        function.table(64)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"opacity": "liner"}, r"opacity 'liner' is not known; did you mean 'linear'\?"),
        ({"colours": "virids"}, "did you mean 'viridis'"),
        ({"colours": "none.json"}, "no such preset"),
        ({"colours": "v" * 5000}, "is not known"),
        ({"colours": "a\0b.json"}, "not a preset"),
        ({"colours": [[1, "red"], [1, "blue"]]}, "values of 'colours' do not ascend"),
        ({"colours": []}, "values of 'colours' do not ascend"),
        ({"colours": [[1, "rot"]]}, "colour 'rot' is not known"),
        ({"opacity": []}, "no points"),
        ({"opacity": [[2, 0], [1, 1]]}, "values of 'opacity' do not ascend"),
        ({"opacity": [[1, 0], [2, 1.5]]}, "opacity is 1.5 at the value 2; allowed: 0 to 1"),
        ({"opacity": [[1, 0], [2, 0]]}, "shows nothing"),
        ({"opacity": [[20, 0], [30, 1]]}, "shows nothing"),
        ({"density": 0}, "shows nothing"),
        ({"range": [3, 3]}, "range is 3 to 3"),
        ({"opacity": "feature"}, "'feature' needs a file of an interval"),
    ],
)
def test_words_that_make_no_function(spec: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        made(spec)
    assert "\n" not in str(caught.value)


def test_a_constant_series_and_json() -> None:
    function = made({"opacity": "opaque"}, value_range=(3.0, 3.0))
    low, high, *_ = function.table()
    assert low < high
    assert bool(function.visible(3.0, 3.0))
    assert np.all(function.extinction([3.0]) == OPAQUE)
    assert json.loads(json.dumps(function.to_dict()))["opacity"] == [[3.0, 1.0]]
    assert made({}, value_range=(3.0, 3.0), features=("isosurface:3",)).visible(3.0, 3.0)


LARGEST = float(np.finfo(np.float64).max)


@pytest.mark.parametrize("value", [LARGEST, -LARGEST, 5e-324, 0.0])
@pytest.mark.parametrize("opacity", ["auto", "linear", "opaque"])
def test_a_constant_at_the_end_of_float64_has_a_table(value: float, opacity: str) -> None:
    with np.errstate(all="raise", under="ignore"):
        function = made(
            {"opacity": opacity},
            value_range=(value, value),
            features=("isosurface:" + repr(value),),
        )
        low, high, colours, extinctions = function.table()
    assert -LARGEST <= low < high <= LARGEST
    assert np.isfinite(colours).all()
    assert np.isfinite(extinctions).all()
    assert bool(function.visible(value, value))


@pytest.mark.parametrize("reach", [LARGEST, 1e300, 1.0])
def test_a_range_whose_width_overflows_is_drawn_like_any_other(reach: float) -> None:
    features = ("interval:-inf:" + repr(reach / 2),)
    with np.errstate(all="raise", under="ignore"):
        function = made({}, value_range=(-reach, reach), features=features)
        opacities = function.opacity(reach * np.array([-1, -0.5, 0.4, 0.425, 0.5, 1]))
        function.table()
        linear = made({"opacity": "linear"}, value_range=(-reach, reach)).opacity(
            reach * np.array([-1, -0.5, 0, 1])
        )
    np.testing.assert_allclose(opacities / INTERVAL, [1, 1, 2 / 3, 0.5, 0, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(linear, [0, 0.25, 0.5, 1])


def test_light_that_passes_does_not_depend_on_the_steps() -> None:
    for steps in (1, 10, 10_000_000):
        passed = np.exp(-extinction_of(0.7, 2.0) * 2.0 / steps)
        assert float(passed) == pytest.approx(0.3 ** (1 / steps), rel=1e-12)
