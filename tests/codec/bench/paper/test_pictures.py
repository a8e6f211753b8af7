"""Pictures of key frames: what they show of a feature, and their likeness with others."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.bench.paper.pictures import IDENTICAL, PictureProbe, view_of_feature
from fhash_codec.features.features import dilate, parse_feature
from fhash_formats.errors import InputError

Single = npt.NDArray[np.float32]

LOW, HIGH = 100.0, 300.0
FEATURES = ("interval:160:240", "isosurface:200", "segmentation:200")


def ball(radius: float, side: int = 16) -> Single:
    """Normalised values (z, y, x) that fall from 1 in the middle to 0 beyond twice the radius."""
    axis = np.arange(side) - (side - 1) / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    far = np.sqrt(x * x + y * y + z * z)
    return np.clip(1 - far / (2 * radius), 0, 1).astype(np.float32)


def probe(feature: str, **others: float) -> PictureProbe:
    return PictureProbe(
        [ball(4), ball(6)],
        feature,
        value_range=(LOW, HIGH),
        size=32,
        **others,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("feature", FEATURES)
def test_the_truth_is_identical_and_errors_count(feature: str) -> None:
    pictures = probe(feature)
    truth = [ball(4), ball(6)]
    assert all(picture[..., 3].max() > 0.2 for picture in pictures.pictures)
    assert pictures.measure(truth) == (IDENTICAL, pytest.approx(1))
    rng = np.random.default_rng(0)
    noise = [rng.normal(0, 1, frame.shape).astype(np.float32) for frame in truth]
    near, far = (
        pictures.measure([frame + share * n for frame, n in zip(truth, noise, strict=True)])
        for share in (np.float32(0.01), np.float32(0.1))
    )
    assert far.psnr < near.psnr - 5 < IDENTICAL
    assert far.ssim < near.ssim < 1


@pytest.mark.parametrize("feature", FEATURES)
def test_the_grown_feature_is_all_that_the_picture_needs(feature: str) -> None:
    truth = [ball(4), ball(6)]
    kind = parse_feature(feature)
    masks = [dilate(kind.select(LOW + frame * (HIGH - LOW), 0), 1) for frame in truth]
    wrong = [np.where(mask, frame, 0.55) for mask, frame in zip(masks, truth, strict=True)]
    pictures = probe(feature)
    assert pictures.measure(wrong, masks).psnr > 50
    if not feature.startswith("segmentation"):  # beyond its threshold all is within the mask
        assert pictures.measure(wrong).psnr < 40


def test_another_side_is_another_picture_of_the_same_size() -> None:
    front, side = probe(FEATURES[0]), probe(FEATURES[0], azimuth=30)
    assert front.pictures[0].shape == side.pictures[0].shape == (32, 32, 4)
    assert not np.array_equal(front.pictures[0], side.pictures[0])


def test_the_camera_is_aimed_at_the_feature() -> None:
    small = np.zeros((24, 24, 24), dtype=np.float32)
    small[:8, :8, :8] = ball(2, 8)
    pictures = PictureProbe([small], "interval:0.3:2", size=32)
    alpha = pictures.pictures[0][..., 3]
    rows, columns = np.nonzero(alpha > 0.01)
    assert abs(rows.mean() - 15.5) < 2
    assert abs(columns.mean() - 15.5) < 2
    assert len(rows) > 0.05 * alpha.size


def test_a_feature_without_values_shows_all_of_them() -> None:
    pictures = PictureProbe([ball(4)], "all", size=16)
    assert pictures.pictures[0][..., 3].max() > 0.2


def test_a_malformed_feature_is_refused() -> None:
    with pytest.raises(InputError, match="malformed"):
        view_of_feature((4, 4, 4), "interval:2:1:4")
