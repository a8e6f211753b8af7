"""Features apart: a volume with some features of its file, decoded and drawn."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError, Scene
from fhash_codec.coreset.features import dilate
from fhash_codec.feature_volume import feature_names, holds_features_apart, only_features
from fhash_codec.rendering.animation.tracking import parse_tracked, tracking_scene

LOW, HIGH = "interval:0:0.2", "interval:0.8:1"
KEY_FRAMES = (0, 2, 3)


def ramp() -> np.ndarray:
    """Values that rise along x from 0 to 1, and fall along y a little with time."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 5, 6, 24)), indexing="ij")
    return np.clip(x - 0.05 * t * y + 0 * z, 0, 1).astype(np.float32)


@pytest.fixture(scope="module", params=["float16", "transform", "plain"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with plain tables, one with coded tables, and that one in plain numbers."""
    path = tmp_path_factory.mktemp("apart") / "two.fhz"
    config = EncodeConfig(
        profile="paper",
        features=(LOW, HIGH),
        key_frames="0,2,3",
        epochs=2,
        width=8,
        tables="float16" if request.param == "float16" else "transform",
    )
    fhash_codec.encode(ramp(), path, config)
    if request.param == "plain":
        fhash_codec.export_plain(path, path.with_name("plain.fhz"))
        return path.with_name("plain.fhz")
    return path


@pytest.mark.parametrize("feature", [LOW, HIGH])
def test_a_feature_alone_has_its_own_coreset_and_the_same_values(run, feature) -> None:
    low, high = (np.float32(end) for end in feature.split(":")[1:])
    source = ramp()
    masks = [dilate((source[step] >= low) & (source[step] <= high), 1) for step in range(4)]
    with fhash_codec.open(run) as volume:
        alone = only_features(volume, [feature])
        assert holds_features_apart(volume)
        assert feature_names(alone) == [feature]
        for step in KEY_FRAMES:
            np.testing.assert_array_equal(alone.occupancy(step), masks[step])
            expected = np.where(masks[step], volume.read(step), np.float32(np.nan))
            np.testing.assert_array_equal(alone.read(step), expected)
        np.testing.assert_array_equal(alone.occupancy(1), masks[0] | masks[2])
        again = pickle.loads(pickle.dumps(alone))
        np.testing.assert_array_equal(again.read(2), alone.read(2))
        again.close()


def test_all_features_together_are_the_volume_itself(run) -> None:
    with fhash_codec.open(run) as volume:
        assert only_features(volume, [HIGH, LOW]) is volume
        for step in range(4):
            apart = [only_features(volume, [name]).occupancy(step) for name in (LOW, HIGH)]
            np.testing.assert_array_equal(apart[0] | apart[1], volume.occupancy(step))


def test_features_that_a_file_lacks_or_has_merged_are_refused(run, tmp_path) -> None:
    with fhash_codec.open(run) as volume, pytest.raises(InputError, match="is none of its feat"):
        only_features(volume, ["interval:0:0.3"])
    path = tmp_path / "merged.fhz"
    fhash_codec.encode(ramp(), path, EncodeConfig(features=(LOW, HIGH), effort=1))
    with fhash_codec.open(path) as volume, pytest.raises(InputError, match="are merged"):
        only_features(volume, [LOW])


@pytest.mark.parametrize("count", [8, 9])
def test_many_features_are_apart_in_coded_files_too(tmp_path, count) -> None:
    """The numbers of the mask have 8 bits; more features have bits."""
    features = tuple(f"interval:{n / 10:g}:{n / 10 + 0.05:g}" for n in range(count))
    config = EncodeConfig(
        profile="paper", features=features, epochs=1, width=4, dilation=0, tables="transform"
    )
    path, plain = tmp_path / "many.fhz", tmp_path / "plain.fhz"
    fhash_codec.encode(ramp(), path, config)
    fhash_codec.export_plain(path, plain)
    for name in (path, plain):
        with fhash_codec.open(name) as volume:
            masked = "occupancy/mask" in volume.container.arrays
            assert masked == (count == 8 and name == path)
            assert masked != ("occupancy/bits" in volume.container.arrays)
            source = ramp()[2]
            for feature in (features[0], features[-1]):
                low, high = (np.float32(end) for end in feature.split(":")[1:])
                np.testing.assert_array_equal(
                    only_features(volume, [feature]).occupancy(2),
                    (source >= low) & (source <= high),
                )


def test_the_card_names_the_features_apart(run) -> None:
    with fhash_codec.open(run) as volume:
        occupancy = volume.describe()["occupancy"]
        assert occupancy["apart"] == [LOW, HIGH]
        stored = volume.container.arrays
        assert occupancy["bytes"] == sum(
            array.nbytes_stored for name, array in stored.items() if "occupancy/" in name
        )


def test_a_picture_of_one_feature_skips_the_other(run) -> None:
    opaque = {"opacity": [[0, 0.5], [1, 0.5]]}
    scene = Scene.from_dict({"size": [24, 24], "transfer_function": opaque})
    with fhash_codec.open(run) as volume:
        renderer = fhash_codec.Renderer(volume)
        both = renderer.render(scene)
        one = renderer.render(Scene.from_dict({**scene.to_dict(), "features": [LOW]}))
        assert 0 < one.counters["samples"] < both.counters["samples"]
        assert one.scene["features"] == [LOW]
        np.testing.assert_array_equal(renderer.render(scene).rgba, both.rgba)


def test_tracking_one_feature_of_several_leaves_out_the_rest(run) -> None:
    with fhash_codec.open(run) as volume:
        shown = {}
        for texts in ([LOW], [LOW, HIGH], ["interval:0:0.1"], ["interval:0:0.1", LOW]):
            tracked = parse_tracked(texts, volume)
            shown[len(shown)] = tracking_scene(Scene(), tracked, volume).features
    assert shown == {0: (LOW,), 1: (), 2: (), 3: ()}
