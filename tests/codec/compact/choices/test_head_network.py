"""The network in training: its gradient, Adam, what the file holds, and the twin of the C++."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec import native
from fhash_codec.compact.choices import head_network_portable as portable
from fhash_codec.compact.choices.head_network import Network, adam_factors
from fhash_codec.compact.choices.head_samples import BLOCK_VOXELS, ERROR_UNIT, Batches
from fhash_formats.transform.head.inputs import INPUTS

needs_library = pytest.mark.skipif(
    native.library() is None, reason="the native library was not built here"
)


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


@needs_library
@pytest.mark.parametrize("looked_at", [1, 9])
@pytest.mark.parametrize("as_in_file", [False, True])
@pytest.mark.parametrize("widths", [(5, 3), (8, 8), (12, 6), (1, 1)])
def test_both_ways_give_the_same_bits(
    looked_at: int,
    as_in_file: bool,
    widths: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = voxels(2, 3, looked_at)
    results = []
    for switch in ("1", "0"):
        monkeypatch.setenv("FHASH_NATIVE", switch)
        trained = network(looked_at, widths)
        trained.learn(data, 1, *factors(6), as_in_file=as_in_file)
        sums = trained.squared_errors(data, as_in_file=as_in_file)
        results.append((trained.parameters, trained.means, trained.squares, np.array(sums)))
    for native_result, portable_result in zip(*results, strict=True):
        np.testing.assert_array_equal(native_result, portable_result)


@needs_library
@pytest.mark.parametrize("as_in_file", [False, True])
def test_the_largest_sums_are_exact(as_in_file: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # Were a sum above 2**53, its bits would depend on the order of its terms.
    data = voxels(1, 64, 9, largest=True)
    results = []
    for switch in ("1", "0"):
        monkeypatch.setenv("FHASH_NATIVE", switch)
        trained = network(9, (14, 24))
        trained.parameters[:] = np.where(trained.parameters < 0, 63.9, 64.0)
        trained.learn(data, 1, *factors(1), as_in_file=as_in_file)
        results.append(np.concatenate([trained.parameters, trained.means]))
    np.testing.assert_array_equal(*results)


@needs_library
def test_scales_of_the_file_are_rounded_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    # Parameters of many magnitudes, also such that float16 holds as subnormal numbers.
    data = voxels(1, 1, 1)
    for exponent in range(-30, 6):
        results = []
        for switch in ("1", "0"):
            monkeypatch.setenv("FHASH_NATIVE", switch)
            scaled = network(1)
            scaled.parameters *= 2.0**exponent * 1.37
            results.append(scaled.squared_errors(data, as_in_file=True))
        assert results[0] == results[1]


@pytest.mark.parametrize("looked_at", [1, 9])
def test_the_gradient_is_that_of_the_mean_squared_error(looked_at: int) -> None:
    data = voxels(1, 4, looked_at)
    trained = network(looked_at, (4, 3))

    def loss(parameters: npt.NDArray[np.float64]) -> float:
        return _loss(data, parameters, (4, 3))

    gradient = portable._gradient(data, 0, (4, 3), trained.parameters, False)
    numeric = np.empty_like(gradient)
    for index in range(len(gradient)):
        step = np.zeros_like(gradient)
        step[index] = 1e-6
        numeric[index] = loss(trained.parameters + step) - loss(trained.parameters - step)
    numeric /= 2e-6
    # Activations and slopes are rounded: to 1/128 and 2**-14.
    assert np.linalg.norm(gradient - numeric) < 0.03 * np.linalg.norm(numeric)


def _loss(data: Batches, parameters: npt.NDArray[np.float64], widths: tuple[int, int]) -> float:
    """The mean squared error of the first batch in sigma, by the definition, without rounding."""
    looked_at = data.inputs.shape[3]
    layers = portable.layer_arrays(parameters, widths, looked_at)
    values = data.inputs[0].transpose(1, 2, 0, 3).reshape(INPUTS, -1) / 512
    for number, (weights, biases) in enumerate(layers):
        if number == 1:
            values = values.reshape(widths[0] * looked_at, -1)
        values = weights @ values + biases[:, None]
        if number < 2:
            values = np.where(values > 0, values, values / 8)
    low, high, target = (each[0] / ERROR_UNIT for each in (data.lowest, data.highest, data.targets))
    return float(np.mean((np.clip(values[0], low, high) - target) ** 2))


def test_a_step_is_adams(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_NATIVE", "0")
    gradients = iter(np.random.default_rng(1).normal(scale=0.01, size=(5, 167)))
    wanted = network(1)
    drawn = list(gradients)
    monkeypatch.setattr(portable, "_gradient", lambda *_: drawn[len(done)])
    done: list[int] = []
    mean, square = np.zeros(167), np.zeros(167)
    parameters = wanted.parameters.copy()
    rates, roots = factors(5)
    for step, gradient in enumerate(drawn, 1):
        wanted.learn(
            voxels(1, 1, 1), step, rates[step - 1 : step], roots[step - 1 : step], as_in_file=False
        )
        done.append(step)
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.999 * square + 0.001 * gradient**2
        root = np.sqrt(square / (1 - 0.999**step))
        parameters -= 0.01 * mean / (1 - 0.9**step) / (root + 1e-8)
    np.testing.assert_allclose(wanted.parameters, parameters, rtol=1e-10, atol=1e-12)


def test_a_long_gradient_is_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FHASH_NATIVE", "0")
    for length, kept in ((0.5, 0.5), (1.0, 1.0), (40.0, 1.0)):
        gradient = np.zeros(167)
        gradient[3] = length
        monkeypatch.setattr(portable, "_gradient", lambda *_, gradient=gradient: gradient)
        trained = network(1)
        trained.learn(voxels(1, 1, 1), 1, *factors(1), as_in_file=False)
        assert trained.means[3] == pytest.approx(0.1 * kept)


def test_the_layers_are_those_of_the_last_measurement() -> None:
    trained = network(9, (8, 8))
    for (weights, biases), layer in zip(
        portable.layer_arrays(trained.parameters, (8, 8), 9), trained.layers(), strict=True
    ):
        assert np.abs(layer.weights).max() <= 31
        assert np.abs(layer.biases).max(initial=0) <= 127
        rounded = layer.weights * layer.weight_scale
        assert np.abs(rounded - weights).max() <= 0.51 * layer.weight_scale
        rounded = layer.biases * layer.bias_scale
        assert np.abs(rounded - biases).max() <= 0.51 * layer.bias_scale + 1e-6


@needs_library
def test_the_native_functions_refuse_sizes_that_they_cannot_take() -> None:
    library = native.library()
    assert library is not None
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
