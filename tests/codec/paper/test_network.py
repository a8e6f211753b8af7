"""Networks refuse parts that do not fit; their layers equal the formula in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fhash_codec.paper import network as network_module
from fhash_codec.paper.network import (
    COLUMNS,
    MAX_SHARE,
    MIN_WEIGHTS,
    PRODUCTS,
    ArrayTable,
    DenseLayers,
)
from fhash_codec.paper.points import sample_points
from fhash_codec.paper.regions import decode_region
from fhash_formats.errors import DamagedFileError, InputError


def test_a_network_whose_parts_do_not_fit_is_refused(networks) -> None:
    net = networks.random((4, 5, 6), 2, 2, 2, 1)
    weight, bias = net.layers[0]
    cases = [
        ({"tables": net.tables[:-1]}, "tables for"),
        ({"tables": [net.tables[1], *net.tables[1:]]}, "table of level 1 has shape"),
        ({"tables": [*net.tables[:2], net.tables[0]]}, "table of level 3 has shape"),
        ({"embedding_size": 3}, "table of level 1 has shape"),
        ({"key_frames": 0}, "at least 1"),
        ({"layers": net.layers[:1]}, "one output"),
        ({"layers": ()}, "one output"),
        ({"layers": ((weight[:, 1:], bias), net.layers[1])}, "layer 1 has weight"),
        ({"layers": ((weight, bias[1:]), net.layers[1])}, "layer 1 has weight"),
        ({"layers": (net.layers[0], net.layers[0])}, "layer 2 has weight"),
        ({"layers": ((weight * np.float32(np.nan), bias), net.layers[1])}, "not finite"),
    ]
    for change, message in cases:
        with pytest.raises(InputError, match=message):
            replace(net, **change)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_table_that_is_not_finite_is_refused_not_decoded(networks, bad) -> None:
    """Messages count levels from 1, as the arrays of the file do."""
    net = networks.random((4, 5, 6), 2, 2, 2, 1)
    net.tables[1].values[0, 0, 0, 0, 1] = bad
    with pytest.raises(DamagedFileError, match="level 2 holds"):
        decode_region(net, 0, networks.box(net))
    with pytest.raises(DamagedFileError, match="level 2 holds"):
        sample_points(net, 0, 0, 0, 0)


@pytest.mark.parametrize("gradient", [False, True])
def test_weights_that_overflow_give_no_warning(networks, gradient) -> None:
    """Hostile files may hold such weights."""
    net = networks.random((2, 3, 4), 2, 2, 2, 2)
    huge = np.float32(3e38)
    mixed = tuple((np.where(weight > 0, huge, -huge), bias) for weight, bias in net.layers)
    positive = tuple((np.full_like(weight, huge), bias) for weight, bias in net.layers)
    tables = [ArrayTable(np.abs(table.values) + 1) for table in net.tables]
    points = np.full((4, 3), 0.5)
    for hostile in (replace(net, layers=mixed), replace(net, layers=positive, tables=tables)):
        result = sample_points(hostile, *points, gradient=gradient)
        frame = decode_region(hostile, 0.5, ((0, 2), (0, 3), (0, 4)))
    values = result[0] if gradient else result
    assert not np.isfinite(values).any()
    assert not np.isfinite(frame).any()


@pytest.mark.parametrize("samples", [1, COLUMNS, COLUMNS + 1, 2 * PRODUCTS * COLUMNS + 7])
@pytest.mark.parametrize("hidden_layers", [0, 1, 2])
def test_dense_layers_equal_the_formula_for_any_number_of_samples(
    networks, samples, hidden_layers
) -> None:
    net = networks.random((4, 5, 6), 2, 2, 2, hidden_layers)
    layers = DenseLayers(net, samples)
    assert layers.inputs.shape[1] % COLUMNS == 0
    inputs = np.random.default_rng(1).standard_normal((net.inputs, samples), dtype=np.float32)
    layers.inputs[:-1, :samples] = inputs
    value, size = inputs.astype(np.float64), np.abs(inputs.astype(np.float64))
    for number, (weight, bias) in enumerate(net.layers):
        value = weight @ (np.maximum(value, 0) if number else value) + bias[:, None]
        size = np.abs(weight) @ size + np.abs(bias)[:, None]
    # A sum of m float32 products is within m rounding steps of the sum of their magnitudes.
    steps = sum(weight.shape[1] + 2 for weight, _ in net.layers)
    bound = steps * np.finfo(np.float32).eps * size[0]
    assert (np.abs(layers.run()[:samples] - value[0]) <= bound).all()


@pytest.fixture
def gathered(networks, monkeypatch):
    """A function: requested samples -> the products that they went through, in a usual network.

    It checks that the requested outputs have the bits that they have among all.
    """
    monkeypatch.setattr(network_module, "MIN_WEIGHTS", 0)
    net = networks.random((4, 5, 6), 2, 2, 2, 2)
    samples = 2 * PRODUCTS * COLUMNS - 30
    layers = DenseLayers(net, samples)
    inputs = np.random.default_rng(2).standard_normal((net.inputs, samples), dtype=np.float32)
    layers.inputs[:-1, :samples] = inputs
    everything = layers.run()[:samples].copy()
    products, run = [], layers._run
    monkeypatch.setattr(
        layers, "_run", lambda given: (products.append(given.shape[1]), run(given))[1]
    )

    def gather(requested):
        products.clear()
        outputs = layers.run_some(requested)[: len(requested)]
        np.testing.assert_array_equal(outputs[requested], everything[: len(requested)][requested])
        np.testing.assert_array_equal(layers.inputs[:-1, :samples], inputs)
        return sum(products)

    gather.samples, gather.layers = samples, layers
    return gather


def test_requested_samples_go_through_as_many_products_as_their_fullest_column(gathered) -> None:
    requested = np.zeros(gathered.samples, bool)
    requested[:: COLUMNS - 1] = True  # one in each product, in another column each time
    assert gathered(requested) == 3
    requested[7::COLUMNS] = True  # the same column of each product: nothing is to be gained
    assert gathered(requested) == 2 * PRODUCTS
    assert gathered(np.ones(gathered.samples, bool)) == 2 * PRODUCTS
    assert gathered(np.zeros(gathered.samples, bool)) == 0
    random = np.random.default_rng(0).random(gathered.samples) < 0.2
    assert gathered(random) < PRODUCTS


def test_samples_are_gathered_up_to_a_share_of_the_products(gathered) -> None:
    most = int(MAX_SHARE * 2 * PRODUCTS)
    requested = np.zeros(gathered.samples, bool)
    requested[-most * COLUMNS :] = True
    assert gathered(requested) == most
    requested[-(most + 1) * COLUMNS :] = True
    assert gathered(requested) == 2 * PRODUCTS


@pytest.mark.parametrize("weights", [MIN_WEIGHTS, MIN_WEIGHTS - 1])
def test_samples_of_small_networks_are_not_gathered(gathered, monkeypatch, weights) -> None:
    monkeypatch.setattr(network_module, "MIN_WEIGHTS", MIN_WEIGHTS)
    monkeypatch.setattr(gathered.layers, "_weights", weights)
    requested = np.zeros(gathered.samples, bool)
    requested[-COLUMNS:] = True
    assert gathered(requested) == (1 if weights == MIN_WEIGHTS else 2 * PRODUCTS)
