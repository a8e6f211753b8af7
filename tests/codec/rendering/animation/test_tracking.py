"""Features in their colours, and where they are from step to step."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec import Volume
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.scenes import Isosurface, Scene
from fhash_codec.rendering.tracking import COLOURS, Tracked, follow, parse_tracked, tracking_scene
from fhash_codec.rendering.transfer_function import TransferFunction
from fhash_formats.errors import InputError

SMALL = Scene(size=(20, 14))


def test_features_get_colours_and_thresholds(volume: Volume) -> None:
    tracked = parse_tracked(["interval:0.2:0.4", "isosurface:0.7=#ff0000", "segmentation"], volume)
    assert [str(item.feature).split(":")[0] for item in tracked] == [
        "interval",
        "isosurface",
        "segmentation",
    ]
    assert [item.colour for item in tracked] == [COLOURS[0], "#ff0000", COLOURS[2]]
    assert 0.1 < tracked[2].feature.threshold < 0.9  # type: ignore[attr-defined]
    assert [str(item.feature) for item in parse_tracked([], volume)] == ["interval:-1:9"]


@pytest.mark.parametrize(
    "text", ["all", "mask:m.npy", "interval:0:1=#12", "blob:3", "interval:3:1"]
)
def test_features_that_values_do_not_tell(text: str, volume: Volume) -> None:
    with pytest.raises(InputError):
        parse_tracked([text], volume)


def test_a_value_of_two_features_has_both_colours_and_the_larger_opacity(volume: Volume) -> None:

    scene = tracking_scene(
        SMALL,
        parse_tracked(
            ["interval:0.2:0.6=#ff0000", "interval:0.4:0.8=#0000ff", "isosurface:0.9=#00ff00"],
            volume,
        ),
        volume,
    )
    assert scene.effects.isosurfaces == (Isosurface(value=0.9, colour="#00ff00"),)
    # The volume is thin: three vertices along z.
    full = 1 - (1 - 0.3) ** (8 / Grid.of(volume.coords).thinnest[1])
    function = TransferFunction.of(scene.transfer_function, value_range=(0.0, 1.0), spacing=1.0)
    np.testing.assert_allclose(
        function.colour([0.3, 0.5, 0.7]), [[1, 0, 0], [0.5, 0, 0.5], [0, 0, 1]], atol=0.01
    )
    np.testing.assert_allclose(
        function.opacity([0.1, 0.3, 0.5, 0.7, 0.85]), [0, full, full, full, 0], atol=1e-9
    )
    assert scene.effects.box
    assert [(entry.text, entry.colour) for entry in scene.effects.legend] == [
        (f"{volume.name}: 0.2 to 0.6", "#ff0000"),
        (f"{volume.name}: 0.4 to 0.8", "#0000ff"),
        (f"{volume.name} = 0.9", "#00ff00"),
    ]


def test_features_without_an_end_are_named_by_the_other(volume: Volume) -> None:
    texts = ["interval:0.3:inf", "interval:-inf:0.2", "segmentation:0.4"]
    scene = tracking_scene(SMALL, parse_tracked(texts, volume), volume)
    name = volume.name
    assert [entry.text for entry in scene.effects.legend] == [
        f"{name} ≥ 0.3",
        f"{name} ≤ 0.2",
        f"{name} ≥ 0.4",
    ]


def test_isosurfaces_alone_leave_the_volume_out(volume: Volume) -> None:
    scene = tracking_scene(SMALL, parse_tracked(["isosurface:0.5"], volume), volume)
    assert scene.transfer_function.nothing
    with pytest.raises(InputError, match="no feature"):
        tracking_scene(SMALL, [], volume)


def test_a_feature_is_followed(volume: Volume) -> None:
    (followed,) = follow(volume, parse_tracked(["segmentation:0.5"], volume), [0.0, 3.0])
    first, last = followed["steps"]
    assert (first["time"], last["time"]) == (0, 4)
    np.testing.assert_allclose(first["centroid"], [8, 4, 1.5], atol=0.3)  # x descends from 10
    np.testing.assert_allclose(last["centroid"], [5, 4, 1.5], atol=0.3)
    assert first["vertices"] > 10
    assert first["bounds"][2] == [1.0, 2.0]
    (nowhere,) = follow(
        volume,
        [Tracked(feature=parse_tracked(["interval:5:6"], volume)[0].feature, colour="red")],
        [0.0],
    )
    assert nowhere["steps"][0] == {
        "step": 0.0,
        "time": 0.0,
        "vertices": 0,
        "centroid": None,
        "bounds": None,
    }
