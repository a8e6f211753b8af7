"""The coding of a level: components that keep its embeddings, one step for all."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.paper.storage import mix_components
from fhash_codec.paper.tables.codings import choose_codings, squared_weights
from fhash_codec.paper.tables.tiles import components_of, tile_region
from fhash_codec.paper.tables.trained_tables import CoarseTable


@pytest.mark.parametrize(("length", "resolution"), [(1, 1), (5, 3), (5, 5), (9, 2), (20, 7)])
def test_squared_weights_are_those_of_the_interpolation(length, resolution) -> None:
    position = np.arange(length) * (resolution - 1) / max(length - 1, 1)
    # Vertex r of the level weighs 1 - |position - r| where that is positive.
    weights = np.maximum(1 - np.abs(position[:, None] - np.arange(resolution)), 0)
    assert squared_weights(length, resolution) == pytest.approx((weights**2).sum(axis=1).mean())


def test_components_keep_the_embeddings_and_lie_in_their_range(random_model) -> None:
    architecture = random_model.selection.architecture
    slopes = np.random.default_rng(1).standard_normal((architecture.inputs, 200), np.float32)
    samples = random_model.selection.coreset.values.size
    with ThreadPoolExecutor(2) as workers:
        codings = choose_codings(architecture, samples, random_model.trained, slopes, 0.01, workers)
    assert {settings.step for coding in codings for settings in coding.settings} == {0.01}
    for table, coding in zip(random_model.trained, codings, strict=True):
        product = coding.unmixing @ coding.mixing.T
        np.testing.assert_allclose(product, np.eye(len(product)), atol=1e-9)
        region = tile_region((0, 0, 0, 0), coding.tile, table.shape)
        components, needed = components_of(table, coding, region)
        assert needed.shape == coding.tile == components[0].shape
        inside = tuple(slice(0, axis.stop) for axis in region)
        embeddings = table.read((*region, slice(0, 2)))
        # Each of the two float32 products and the sums lose a rounding step or so.
        largest = max(float(np.abs(component).max()) for component in components)
        tolerance = 8 * np.finfo(np.float32).eps * largest * float(np.abs(coding.mixing).max())
        mixed = mix_components(components, coding.mixing)[inside]
        np.testing.assert_allclose(mixed, embeddings, atol=tolerance, rtol=1e-6)
        for component, settings in zip(components, coding.settings, strict=True):
            slack = 1e-6 * (settings.high - settings.low)
            values = component[needed]
            assert (values >= settings.low - slack).all()
            assert (values <= settings.high + slack).all()


def test_the_transform_of_a_component_suits_its_numbers(random_model) -> None:
    """A basis of their own suits a pattern whose strength changes at random."""
    architecture = random_model.selection.architecture
    slopes = np.ones((2, 200), np.float32)
    random = np.random.default_rng(0)
    pattern = random.standard_normal((16, 1, 1, 1)) * random.standard_normal((1, 8, 12, 12))
    chosen = {}
    for name, needed in (
        ("complete", np.ones(pattern.shape, bool)),
        ("part", np.broadcast_to(np.arange(12) < 9, pattern.shape)),
    ):
        both = np.stack([pattern, 0.5 * pattern], axis=-1).astype(np.float32)
        one = replace(architecture, levels=(pattern.shape,), box_size=(8, 12, 12), key_frames=16)
        with ThreadPoolExecutor(2) as workers:
            [coding] = choose_codings(
                one, pattern.size, [CoarseTable(both, needed)], slopes, 0.05, workers
            )
        chosen[name] = coding.settings[1].transform.axes
    assert chosen["complete"][0].kind == "klt"
    # Where vertices are not needed, a basis would describe them too.
    assert all(axis.basis is None for axis in chosen["part"])
