"""The network in training: its gradient, Adam, and what the file holds."""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec import native
from fhash_codec.compact.choices.head_network import Network, adam_factors
from fhash_codec.compact.choices.head_samples import BLOCK_VOXELS, ERROR_UNIT, Batches
from fhash_formats.transform.head.inputs import INPUTS


def voxels(
    batches: int, blocks: int, looked_at: int, *, largest: bool = False, seed: int = 0
) -> Batches:
    """Batches of random voxels; or with every number at its limit, so that sums are largest."""
    random = np.random.default_rng(seed)
    shape = (batches, blocks, INPUTS, looked_at, BLOCK_VOXELS)
    inputs = random.integers(-1500, 1501, shape)
    size = (batches, blocks * BLOCK_VOXELS)
    targets = np.rint(random.normal(size=size) * ERROR_UNIT)
    if largest:
        inputs = np.full(shape, 4095)
        targets = np.full(size, 1 << 30) * np.where(random.random(size) < 0.9, 1, -1)
    limit = np.full(size, 1 << 30, np.int32)
    low = np.full(size, -ERROR_UNIT, np.int32) if not largest else -limit
    return Batches(
        inputs=inputs.astype(np.int16), targets=targets.astype(np.int32), lowest=low, highest=limit
    )


def network(looked_at: int, widths: tuple[int, int] = (5, 3), seed: int = 0) -> Network:
    return Network(widths, looked_at, np.random.default_rng(seed))


def factors(count: int, rate: float = 0.01) -> tuple[npt.NDArray[np.float64], ...]:
    return adam_factors(np.full(count, rate))


def layer_arrays(
    parameters: npt.NDArray[np.float64], widths: tuple[int, int], looked_at: int
) -> list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]:
    """Views of the weights (out, in) and biases (out,) of each layer."""
    arrays, at = [], 0
    columns = (INPUTS, widths[0] * looked_at, widths[1])
    for inputs, outputs in zip(columns, (*widths, 1), strict=True):
        end = at + outputs * inputs
        weights = parameters[at:end].reshape(outputs, inputs)
        arrays.append((weights, parameters[end : end + outputs]))
        at = end + outputs
    return arrays


@pytest.mark.parametrize("looked_at", [1, 9])
def test_the_gradient_is_that_of_the_mean_squared_error(looked_at: int) -> None:
    data = voxels(1, 4, looked_at)
    trained = network(looked_at, (4, 3))

    def loss(parameters: npt.NDArray[np.float64]) -> float:
        return _loss(data, parameters, (4, 3))

    start = trained.parameters.copy()
    trained.learn(data, 1, *factors(1, rate=0.0), as_in_file=False)
    assert (trained.parameters == start).all()
    gradient = 10 * trained.means
    numeric = np.empty_like(gradient)
    for index in range(len(gradient)):
        step = np.zeros_like(gradient)
        step[index] = 1e-6
        numeric[index] = loss(trained.parameters + step) - loss(trained.parameters - step)
    numeric /= 2e-6
    numeric /= max(np.linalg.norm(numeric), 1.0)  # longer gradients are shortened
    # Activations and slopes are rounded: to 1/128 and 2**-14.
    assert np.linalg.norm(gradient - numeric) < 0.03 * np.linalg.norm(numeric)


def _loss(data: Batches, parameters: npt.NDArray[np.float64], widths: tuple[int, int]) -> float:
    """The mean squared error of the first batch in sigma, by the definition, without rounding."""
    looked_at = data.inputs.shape[3]
    layers = layer_arrays(parameters, widths, looked_at)
    values = data.inputs[0].transpose(1, 2, 0, 3).reshape(INPUTS, -1) / 512
    for number, (weights, biases) in enumerate(layers):
        if number == 1:
            values = values.reshape(widths[0] * looked_at, -1)
        values = weights @ values + biases[:, None]
        if number < 2:
            values = np.where(values > 0, values, values / 8)
    low, high, target = (each[0] / ERROR_UNIT for each in (data.lowest, data.highest, data.targets))
    return float(np.mean((np.clip(values[0], low, high) - target) ** 2))


def test_a_step_is_adams() -> None:
    trained, data = network(1), voxels(5, 1, 1)
    mean, square = np.zeros((2, len(trained.parameters)))
    rates, roots = factors(5)
    for step in range(1, 6):
        before = trained.parameters.copy()
        once = rates[step - 1 : step], roots[step - 1 : step]
        trained.learn(data, step, *once, as_in_file=False)
        gradient = (trained.means - 0.9 * mean) / 0.1
        assert np.linalg.norm(gradient) <= 1 + 1e-9
        mean, square = trained.means.copy(), 0.999 * square + 0.001 * gradient**2
        np.testing.assert_allclose(trained.squares, square, rtol=1e-9, atol=1e-15)
        root = np.sqrt(trained.squares / (1 - 0.999**step))
        expected = before - 0.01 * mean / (1 - 0.9**step) / (root + 1e-8)
        np.testing.assert_allclose(trained.parameters, expected, rtol=1e-9, atol=1e-12)


def test_a_long_gradient_is_shortened() -> None:
    trained = network(1)
    trained.learn(voxels(1, 1, 1, largest=True), 1, *factors(1), as_in_file=False)
    assert np.linalg.norm(trained.means) == pytest.approx(0.1)


@pytest.mark.parametrize("as_in_file", [False, True])
def test_the_bits_of_training_are_fixed(as_in_file: bool) -> None:
    """So that the same series gives the same bytes on every machine."""
    data = voxels(2, 3, 9)
    trained = network(9)
    trained.learn(data, 1, *factors(6), as_in_file=as_in_file)
    sums = trained.squared_errors(data, as_in_file=as_in_file)
    digest = hashlib.sha256(trained.parameters.tobytes() + repr(sums).encode()).hexdigest()
    assert digest[:16] == DIGESTS[as_in_file]


DIGESTS = {False: "75241812da0c4ada", True: "6ff35e4c66d28414"}


def test_the_layers_are_those_of_the_last_measurement() -> None:
    trained = network(9, (8, 8))
    for (weights, biases), layer in zip(
        layer_arrays(trained.parameters, (8, 8), 9), trained.layers(), strict=True
    ):
        assert np.abs(layer.weights).max() <= 31
        assert np.abs(layer.biases).max(initial=0) <= 127
        rounded = layer.weights * layer.weight_scale
        assert np.abs(rounded - weights).max() <= 0.51 * layer.weight_scale
        rounded = layer.biases * layer.bias_scale
        assert np.abs(rounded - biases).max() <= 0.51 * layer.bias_scale + 1e-6


def test_the_native_functions_refuse_sizes_that_they_cannot_take() -> None:
    library = native.library()
    # A block of another length, more blocks and voxels than sums stay exact for, wide layers.
    for sizes in (
        (0, 1, 64, 1, 4, 4),
        (1, 65, 64, 1, 4, 4),
        (1, 1, 32, 1, 4, 4),
        (1, 1, 64, 10, 4, 4),
        (1, 1, 64, 1, 65, 4),
        (1, 1, 64, 1, 4, 0),
    ):
        array = np.array(sizes, dtype=np.int64)
        assert library.fhash_head_errors(*(None,) * 4, array.ctypes.data, None, 0, None) == -1
