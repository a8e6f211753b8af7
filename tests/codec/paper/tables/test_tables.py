"""Regions of the box out of bricks equal those of dense frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec.features import occupancy
from fhash_codec.features.occupancy import unpack
from fhash_codec.paper import tables as small_parts
from fhash_codec.paper.encode import select
from fhash_codec.paper.model import decode_region
from fhash_codec.paper.storage import finest_frame
from fhash_codec.paper.tables import (
    MIN_WEIGHTS,
    WEIGHT_STEPS,
    Samples,
    quantised_layers,
    tile_shape,
)
from fhash_codec.progress import silent
from fhash_formats.container import Container
from fhash_formats.series import ArraySeries


@pytest.mark.parametrize("key", range(5))
def test_regions_are_those_of_the_frame(random_model, key) -> None:
    bricks, coreset = random_model.bricks, random_model.selection.coreset
    size = random_model.selection.architecture.box_size
    box = tuple((0, n) for n in size)
    mask, values = bricks.mask(key, box), bricks.samples(key, box)
    occupied = unpack(coreset.occupancy[key], size)
    assert not (occupied & ~mask).any()
    assert (mask & ~occupied).any()  # the fringe
    assert 0 < mask.mean() < 1
    to_unit = random_model.selection.scanned.value_range.to_unit
    frame = random_model.field[(key, *(slice(low, high) for low, high in coreset.box))]
    np.testing.assert_array_equal(values[mask], to_unit(frame[mask]))
    for region in (((1, 4), (0, 3), (7, 11)), ((3, 4), (5, 6), (2, 3))):
        inner = tuple(slice(*span) for span in region)
        np.testing.assert_array_equal(bricks.mask(key, region), mask[inner])
        np.testing.assert_array_equal(bricks.samples(key, region), values[inner])
        np.testing.assert_array_equal(
            bricks.embeddings(random_model.fine, key, region),
            finest_frame(coreset, random_model.fine, key)[inner],
        )


@pytest.fixture(scope="module")
def samples(random_model) -> Samples:
    selection = random_model.selection
    tile = (2, *tile_shape(selection.architecture.levels[0])[1:3], 8)
    return Samples(selection.coreset, random_model.bricks, tile)


def test_errors_are_those_of_the_clipped_values_at_all_samples(random_model, samples) -> None:
    network = random_model.network()
    squares, count = samples.squares(network, list(samples.counts))
    box = tuple((0, n) for n in network.box_size)
    coreset = random_model.selection.coreset
    masks = [unpack(coreset.occupancy[key], network.box_size) for key in range(5)]
    # Samples of the fringe do not count: the promise is about the coreset.
    assert coreset.values.size > count == sum(int(mask.sum()) for mask in masks)
    assert sum(samples.counts.values()) == count
    direct = 0.0
    for key, mask in enumerate(masks):
        unit = np.clip(decode_region(network, key, box).astype(np.float64), 0, 1)
        error = unit - random_model.bricks.samples(key, box)
        direct += float((error[mask] ** 2).sum())
    assert squares == pytest.approx(direct)


def layers(rows: int, columns: int):
    random = np.random.default_rng(0)
    return [
        (
            random.standard_normal((rows, columns)).astype(np.float32),
            random.standard_normal(rows).astype(np.float32),
        ),
        (np.ones((1, rows), np.float32), np.zeros(1, np.float32)),
    ]


def worst(changed, original) -> float:
    return max(
        float(np.square(a - b).mean()) for (a, _), (b, _) in zip(changed, original, strict=True)
    )


@pytest.mark.parametrize("allowed", [1e-2, 1e-4, 1e-6])
def test_the_largest_step_that_is_allowed_is_taken(allowed) -> None:
    original = layers(32, MIN_WEIGHTS // 32)
    quantised, settings = quantised_layers(
        original, lambda changed: worst(changed, original), allowed
    )
    first, last = settings
    assert first is not None
    assert last is None  # too small to gain anything
    assert worst(quantised, original) <= allowed
    np.testing.assert_array_equal(quantised[1][0], original[1][0])
    np.testing.assert_array_equal(quantised[0][1], original[0][1])
    # Twice the step would have been too large.
    assert first.step > 0.8 * np.sqrt(12 * allowed) / 2 or first.step >= WEIGHT_STEPS[0] / 2


def test_layers_that_no_step_keeps_stay_as_they_are() -> None:
    original = layers(32, 32)
    quantised, settings = quantised_layers(original, lambda _: 1.0, 0.5)
    assert settings == [None, None]
    assert quantised[0][0] is original[0][0]


@pytest.mark.parametrize("vertices", [1, 5000, 1 << 22])
def test_the_mask_is_the_occupancy(tmp_path, waves, coded_config, monkeypatch, vertices) -> None:
    monkeypatch.setattr(small_parts, "MASK_VERTICES", vertices)
    config = replace(coded_config, epochs=1, features=("interval:50:150",), dilation=0)
    path = tmp_path / "a.fhz"
    fhash_codec.encode(waves(), path, config)
    coreset = select(ArraySeries(waves()), config, silent).coreset
    with Container.open(path) as container:
        assert "occupancy/bits" not in container.arrays
        mask = container.arrays["occupancy/mask"].read(
            tuple(slice(0, n) for n in container.arrays["occupancy/mask"].shape)
        )
    for step, bits in zip(mask, coreset.occupancy, strict=True):
        np.testing.assert_array_equal(step != 0, occupancy.unpack(bits, coreset.box.shape))
    with fhash_codec.open(path) as volume:
        both = volume.occupancy(0.5)
        np.testing.assert_array_equal(both, volume.occupancy(0) | volume.occupancy(1))


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


@pytest.mark.parametrize(
    "index",
    [np.s_[3], np.s_[1:4, 2:7, 3:11, 5:17], np.s_[:, 8, ::-2, 19], np.s_[4, 3:5, 4:6, 7:9]],
    ids=str,
)
def test_a_region_is_that_slice_of_the_whole_bit_for_bit(pair, index) -> None:
    path = pair["coded"][1]
    whole = decoded(path)
    with fhash_codec.open(path) as volume:
        np.testing.assert_array_equal(volume[index], whole[index])


def test_points_and_times_between_are_as_smooth_as_before(waves, pair) -> None:
    random = np.random.default_rng(0)
    points = {
        axis: random.random(300) * (n - 1) for axis, n in zip("tzyx", waves().shape, strict=True)
    }
    with fhash_codec.open(pair["coded"][1]) as volume, fhash_codec.open(pair["exact"][1]) as other:
        values, slopes = volume.sample(**points, gradient=True)
        expected = other.sample(**points)
        finite = np.isfinite(expected)
        assert finite.sum() > 30
        np.testing.assert_array_equal(finite, np.isfinite(values))
        assert np.isfinite(slopes[finite]).all()
        span = float(np.ptp(waves()))
        assert np.sqrt(np.mean((values - expected)[finite] ** 2)) < 0.05 * span


def test_the_coreset_does_not_depend_on_what_is_not_needed(random_model) -> None:
    for table in random_model.trained[:2]:
        region = tuple(slice(0, n) for n in table.shape[:4])
        assert (~table.needed(region)).sum() > 50
    one, other = random_model.network(fill=5.0), random_model.network(fill=-7.0)
    box = tuple((0, n) for n in one.box_size)
    for key in range(5):
        mask = random_model.bricks.mask(key, box)
        np.testing.assert_array_equal(
            decode_region(one, key, box)[mask], decode_region(other, key, box)[mask]
        )
