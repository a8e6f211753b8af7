"""Occupancy and layers beside coded tables: exact masks, and layers as a reader gets them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec.coreset import occupancy
from fhash_codec.paper.selection import select
from fhash_codec.paper.tables import small_parts
from fhash_codec.paper.tables.small_parts import (
    MIN_WEIGHTS,
    WEIGHT_STEPS,
    quantised_layers,
)
from fhash_codec.paper.tables.step import MAX_LOSS
from fhash_codec.progress import silent
from fhash_formats.container import Container
from fhash_formats.series import ArraySeries


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


@pytest.mark.parametrize(("rows", "is_coded"), [(32, True), (31, False)])
def test_small_matrices_stay_as_they_are(rows, is_coded) -> None:
    _, (first, _) = quantised_layers(layers(rows, MIN_WEIGHTS // 32), lambda _: 0.0, 1.0)
    assert (first is not None) == is_coded


def test_layers_that_no_step_keeps_stay_as_they_are() -> None:
    original = layers(32, 32)
    quantised, settings = quantised_layers(original, lambda _: 1.0, 0.5)
    assert settings == [None, None]
    assert quantised[0][0] is original[0][0]


def test_a_matrix_of_zeros_is_no_error() -> None:
    zeros = [(np.zeros((32, 32), np.float32), np.zeros(32, np.float32))]
    assert quantised_layers(zeros, lambda _: 0.0, 0.0)[1] == [None]


def test_a_file_has_the_layers_that_were_measured(tmp_path, waves, coded_config) -> None:
    config = replace(coded_config, epochs=1, width=64, hidden_layers=2)
    path = tmp_path / "a.fhz"
    figures = fhash_codec.encode(waves((3, 6, 7, 8)), path, config)
    with Container.open(path) as container:
        weight = container.arrays["mlp/weight_2"].read((slice(0, 64), slice(0, 64)))
    # Whole multiples of a step came back, and the loss counts what they cost.
    values = np.unique(weight)[1:-1]  # the range clips its ends
    multiples = values / np.diff(values).min()
    assert values.size < 600
    assert np.abs(multiples - np.rint(multiples)).max() < 0.01
    assert figures["tables_loss_db"] <= MAX_LOSS + 1e-4


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
