"""Head: a small network that corrects decoded values from their neighbours."""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from math import log2
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.native import pointer
from fhash_formats.support.threads import in_threads, row_parts, usable_threads
from fhash_formats.support.values import Single

OFFSETS: tuple[tuple[int, int, int, int], ...] = (
    *((offset, 0, 0, 0) for offset in (-1, 1)),
    *((0, offset, 0, 0) for offset in (-1, 1)),
    *((0, 0, offset, 0) for offset in (-1, 1)),
    *((0, 0, 0, offset) for offset in (-1, 1)),
    *((offset, 0, 0, 0) for offset in (-2, 2)),
    *((0, 0, offset, 0) for offset in (-2, 2)),
    *((0, 0, 0, offset) for offset in (-2, 2)),
    *((0, 0, first, second) for first in (-1, 1) for second in (-1, 1)),
    *((first, 0, 0, second) for first in (-1, 1) for second in (-1, 1)),
    *((first, 0, second, 0) for first in (-1, 1) for second in (-1, 1)),
)
"""Offsets along (t, z, y, x) from a voxel to its 26 neighbours, in the order of the inputs.

In a tile of one step those along t are along z. With the diagonals of t in place of those of z an
MLP of the same size gains 0.07 to 0.5 dB more."""


def offsets_in(steps: int) -> npt.NDArray[np.int64]:
    """The offsets (26, 4) to the neighbours in a tile of some steps."""
    offsets = np.array(OFFSETS, np.int64)
    if steps == 1:
        offsets[:, 1] += offsets[:, 0]
        offsets[:, 0] = 0
    return offsets


_MARK = 16
"""Addend of the number of hidden layers since heads look along t: in no file of before."""


INPUTS = len(OFFSETS) + 2
"""Number of inputs: one per neighbour, and two functions of the voxel's own value."""


MAX_WEIGHT = 31
"""Largest magnitude of a quantised weight (6 bits)."""
_SPREADS = range(1, 256)
"""Spreads that a layer may have."""
_ROUNDING = 1e-9
"""Relative error that a sum of bits has at most, in whatever order and by whatever logarithm."""


@lru_cache(maxsize=256)
def _model(spread: int) -> tuple[list[int], list[int]]:
    """The frequencies of the weights -MAX_WEIGHT to MAX_WEIGHT, and their running sums.

    The sums begin with 0 and end with the total.
    """
    square = spread * spread
    frequencies = [
        1 + (square * square << 16) // (square + weight * weight) ** 2
        for weight in range(-MAX_WEIGHT, MAX_WEIGHT + 1)
    ]
    return frequencies, [0, *accumulate(frequencies)]


@lru_cache(maxsize=1)
def _bits() -> npt.NDArray[np.float64]:
    """The bits of each weight -MAX_WEIGHT to MAX_WEIGHT by each of the spreads, nearly."""
    squares = np.array(_SPREADS, np.int64)[:, None] ** 2
    weights = np.arange(-MAX_WEIGHT, MAX_WEIGHT + 1)
    frequencies = 1 + (squares * squares << 16) // (squares + weights * weights) ** 2
    bits: npt.NDArray[np.float64] = np.log2(frequencies.sum(axis=1, keepdims=True) / frequencies)
    return bits


def best_spread(weights: Sequence[int]) -> int:
    """The spread in 1 to 255 whose frequencies code the weights in the fewest bits."""
    counts = sorted(Counter(weights).items())

    def bits(spread: int) -> float:
        frequencies, starts = _model(spread)
        return sum(
            count * log2(starts[-1] / frequencies[weight + MAX_WEIGHT]) for weight, count in counts
        )

    # Nearly equal sums are formed again in the order that is the same on every machine.
    places = [weight + MAX_WEIGHT for weight, _ in counts]
    sums = (_bits()[:, places] * [count for _, count in counts]).sum(axis=1)
    near = np.flatnonzero(sums <= sums.min() * (1 + _ROUNDING) + _ROUNDING)
    return min((_SPREADS[place] for place in near.tolist()), key=bits)


def encode_weights(state: int, weights: Sequence[int], spread: int) -> int:
    """The state with the weights pushed onto it; `decode_weights` pops them in order.

    state: the integer that holds everything coded so far.
    """
    frequencies, starts = _model(spread)
    for weight in reversed(weights):
        index = weight + MAX_WEIGHT
        quotient, rest = divmod(state, frequencies[index])
        state = quotient * starts[-1] + starts[index] + rest
    return state


def decode_weights(state: int, count: int, spread: int) -> tuple[int, list[int]]:
    """The state after its first `count` weights are popped, and the weights.

    Raises ValueError for spread 0.
    """
    if spread < 1:
        raise ValueError("a spread of 0")
    frequencies, starts = _model(spread)
    weights = []
    for _ in range(count):
        quotient, rest = divmod(state, starts[-1])
        index = bisect_right(starts, rest) - 1
        state = quotient * frequencies[index] + rest - starts[index]
        weights.append(index - MAX_WEIGHT)
    return state, weights


MAX_HIDDEN = 3
"""Most hidden layers."""
MAX_WIDTH = 64
"""Most outputs of a hidden layer; up to that, sums stay exact in float32."""
MAX_BIAS = 127
"""Largest magnitude of a quantised bias (8 bits)."""

SIGMA_RANGE = (2.0**-100, 2.0**100)
"""Least and greatest sigma; the inverse is an ordinary float32 as well."""

_INPUT_UNIT = 512.0
"""Integer steps of an input in 1."""
_ACTIVATION_UNIT = 128.0
"""Integer steps of an activation in 1."""
_WIDEST_LANES = 0
"""Lanes with which the native library computes (head.cpp): the widest that this machine has."""
_MAX_WEIGHT_BYTES = 3
"""Bytes that a weight takes at most (22 bits), which bounds the work on hostile bytes."""


Scaled = tuple[npt.NDArray[np.int8], float]
"""Whole numbers and the scale that they are multiples of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """One layer: outputs = weight_scale * weights @ inputs + bias_scale * biases.

    Attributes:
        weights: int8 (out, in), at most MAX_WEIGHT either way.
        biases: int8 (out,), at most MAX_BIAS either way.
        weight_scale: a positive float16 value.
        bias_scale: a positive float16 value.
    """

    weights: npt.NDArray[np.int8]
    biases: npt.NDArray[np.int8]
    weight_scale: float
    bias_scale: float

    @property
    def parameters(self) -> tuple[Single, Single]:
        """Weights (out, in) and biases (out,), float32.

        They are exact: whole numbers of 6 and 8 bits times scales of 11 bits.
        """
        return (
            self.weights.astype(np.float32) * np.float32(self.weight_scale),
            self.biases.astype(np.float32) * np.float32(self.bias_scale),
        )

    @classmethod
    def of(cls, weights: Scaled, biases: Scaled) -> Self:
        """The layer of its numbers, each with their scale."""
        return cls(
            weights=weights[0], biases=biases[0], weight_scale=weights[1], bias_scale=biases[1]
        )


class _Constants(NamedTuple):
    """The network in float32 for inputs and activations in integer steps.

    The output of a layer is scale * (weights @ inputs) + biases. `inverse` is 1 / (2 sigma), `unit`
    1024 over the length of the clip range.
    """

    weights: list[Single]
    scales: list[np.float32]
    biases: list[Single]
    low: np.float32
    high: np.float32
    inverse: np.float32
    unit: np.float32


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourHead:
    """A trained head. Raises InputError for layers that do not fit together or bad constants.

    Attributes:
        layers: the layers of the network, one output in the last.
        sigma: RMS error of the decoded values, > 0, a float32 value in data units.
        low: lower end of the clip range, a float32 value in data units.
        high: upper end of the clip range, likewise.
    """

    layers: tuple[Layer, ...]
    sigma: float
    low: float
    high: float

    def __post_init__(self) -> None:
        if not 2 <= len(self.layers) <= MAX_HIDDEN + 1:
            raise InputError(
                f"a head has 1 to {MAX_HIDDEN} hidden layers, not {len(self.layers) - 1}"
            )
        inputs = (INPUTS, *self.hidden)
        for number, layer in enumerate(self.layers):
            most_outputs = 1 if number == len(self.hidden) else MAX_WIDTH
            _check_layer(number, layer, inputs[number], most_outputs)
        constants = (self.sigma, self.low, self.high)
        if any(not np.isfinite(value) or float(np.float32(value)) != value for value in constants):
            raise InputError(
                "a head's sigma, low and high must be finite float32 values, "
                f"not {self.sigma}, {self.low}, {self.high}"
            )
        if not SIGMA_RANGE[0] <= self.sigma <= SIGMA_RANGE[1] or self.low > self.high:
            raise InputError(
                f"a head needs sigma in {SIGMA_RANGE} and low <= high, "
                f"not {self.sigma}, {self.low}, {self.high}"
            )

    @property
    def hidden(self) -> tuple[int, ...]:
        """The widths of the hidden layers."""
        return tuple(len(layer.biases) for layer in self.layers[:-1])

    @property
    def size(self) -> int:
        """Number of weights and biases."""
        return sum(layer.weights.size + layer.biases.size for layer in self.layers)

    @cached_property
    def _constants(self) -> _Constants:
        sigma, low, high = np.float32(self.sigma), np.float32(self.low), np.float32(self.high)
        weights, scales, biases = [], [], []
        for number, layer in enumerate(self.layers):
            # All products are exact, of few bits, except the one with sigma.
            unit_in = _INPUT_UNIT if number == 0 else _ACTIVATION_UNIT
            scale, bias = (
                np.float32(layer.weight_scale / unit_in),
                np.float32(layer.bias_scale) * layer.biases.astype(np.float32),
            )
            unit_out = sigma if number == len(self.layers) - 1 else np.float32(_ACTIVATION_UNIT)
            with np.errstate(over="ignore"):
                weights.append(np.ascontiguousarray(layer.weights, dtype=np.float32))
                scales.append(scale * unit_out)
                biases.append(bias * unit_out)
        with np.errstate(over="ignore", divide="ignore"):
            span = high - low
            unit = np.float32(1024) / span if span > 0 else np.float32(0)
        if not np.isfinite(unit):
            unit = np.float32(0)
        return _Constants(weights, scales, biases, low, high, np.float32(0.5) / sigma, unit)

    def apply(self, decoded: Single, *, in_place: bool = False) -> Single:
        """The decoded values, each corrected and clipped to [low, high]; a new array.

        Args:
            decoded: the tile (t, z, y, x), float32 in data units; NaN counts as low.
            in_place: whether `decoded` may be overwritten, and be the result.

        Raises InputError for another dtype or rank.
        """
        if decoded.dtype != np.float32 or decoded.ndim != 4:
            raise InputError(
                f"a head takes a float32 tile (t, z, y, x), "
                f"not {decoded.dtype} of shape {decoded.shape}"
            )
        if decoded.size == 0:
            return decoded.copy()
        source = np.ascontiguousarray(decoded)
        rows = source.shape[1] * source.shape[2]
        parts = row_parts(rows, source.size // rows, usable_threads())
        # Threads read the rows of others around theirs, so that they need another array.
        out = source if in_place and len(parts) == 1 else np.empty_like(source)
        arguments = self._native_arguments

        def correct(part: tuple[int, int]) -> None:
            code = native.library().fhash_head_apply(
                pointer(source),
                source.shape,
                *part,
                len(self.layers),
                *map(pointer, arguments),
                _WIDEST_LANES,
                pointer(out),
            )
            if code != 0:
                raise MemoryError(
                    f"no memory to apply a head to a tile of shape {source.shape} (code {code})"
                )

        for _ in in_threads(correct, parts):
            pass
        return out

    @cached_property
    def _native_arguments(self) -> tuple[npt.NDArray[Any], ...]:
        """Widths, weights, biases, scales, and the constants of the clip range."""
        constants = self._constants
        return (
            np.array([INPUTS, *self.hidden, 1], dtype=np.int64),
            np.concatenate([weight.ravel() for weight in constants.weights]),
            np.concatenate(constants.biases),
            np.array(constants.scales, dtype=np.float32),
            np.array(constants[3:], dtype=np.float32),
        )

    def to_bytes(self) -> bytes:
        """The packed head; `from_bytes` is the inverse. All numbers are little-endian.

        First u8 16 + the number of hidden layers, and u8 the width of each; float32 sigma, low,
        high; per layer float16 the scales of weights and biases, and u8 the spread; then the
        biases of all layers as int8; then the weights of all layers, row by row, in one integer.
        """
        spreads = [best_spread(layer.weights.ravel().tolist()) for layer in self.layers]
        fields = [
            bytes([_MARK + len(self.hidden), *self.hidden]),
            struct.pack("<3f", self.sigma, self.low, self.high),
        ]
        for layer, spread in zip(self.layers, spreads, strict=True):
            fields.append(struct.pack("<eeB", layer.weight_scale, layer.bias_scale, spread))
        fields += [layer.biases.tobytes() for layer in self.layers]
        state = 1
        for layer, spread in reversed(list(zip(self.layers, spreads, strict=True))):
            state = encode_weights(state, layer.weights.ravel().tolist(), spread)
        fields.append(state.to_bytes((state.bit_length() + 7) // 8, "little"))
        return b"".join(fields)

    @classmethod
    def from_bytes(cls, data: bytes) -> NeighbourHead:
        """The head that `to_bytes` packed.

        Raises DamagedFileError for bytes that are no head.
        """
        try:
            return cls._read(data)
        except (struct.error, ValueError, IndexError) as error:
            raise DamagedFileError(f"a damaged neighbourhood head: {error}") from error

    @classmethod
    def _read(cls, data: bytes) -> NeighbourHead:
        """The head in some bytes. Raises ValueError, IndexError or struct.error for others."""
        if data[0] < _MARK:
            raise ValueError("it looks at other neighbours: of a version before the release")
        count = data[0] - _MARK
        if not 1 <= count <= MAX_HIDDEN:
            raise ValueError(f"{count} hidden layers")
        widths = [*data[1 : 1 + count], 1]
        if len(widths) != count + 1 or not all(1 <= width <= MAX_WIDTH for width in widths):
            raise ValueError(f"layers of widths {widths}")
        inputs = [INPUTS, *widths[:-1]]
        sigma, low, high = struct.unpack_from("<3f", data, 1 + count)
        position = 13 + count
        scales = [
            struct.unpack_from("<eeB", data, position + 5 * layer) for layer in range(count + 1)
        ]
        position += 5 * (count + 1)
        biases = []
        for width in widths:
            biases.append(np.frombuffer(data, dtype=np.int8, count=width, offset=position))
            position += width
        weight_count = sum(rows * columns for rows, columns in zip(inputs, widths, strict=True))
        if len(data) - position > _MAX_WEIGHT_BYTES * weight_count + 1:
            raise ValueError(f"{len(data)} bytes are too many")
        if not data[position:] or not data[-1]:
            raise ValueError("its weights are cut, or have zeros after their end")
        state = int.from_bytes(data[position:], "little")
        layers = []
        for (weight_scale, bias_scale, spread), columns, bias in zip(
            scales, inputs, biases, strict=True
        ):
            state, weights = decode_weights(state, len(bias) * columns, spread)
            matrix = np.array(weights, dtype=np.int8).reshape(len(bias), columns)
            layers.append(
                Layer(weights=matrix, biases=bias, weight_scale=weight_scale, bias_scale=bias_scale)
            )
        if state != 1:
            raise ValueError("its weights do not end where their code ends")
        return cls(layers=tuple(layers), sigma=sigma, low=low, high=high)


def _check_layer(number: int, layer: Layer, inputs: int, most_outputs: int) -> None:
    """Raises InputError for a layer with other shapes, or with numbers out of range."""
    width = len(layer.biases)
    if not 1 <= width <= most_outputs:
        raise InputError(
            f"layer {number} of a head has {width} outputs, 1 to {most_outputs} are allowed"
        )
    if layer.weights.shape != (width, inputs) or layer.biases.shape != (width,):
        raise InputError(
            f"layer {number} of a head has weights {layer.weights.shape} "
            f"where {(width, inputs)} is needed"
        )
    for name, values, largest in (
        ("weights", layer.weights, MAX_WEIGHT),
        ("biases", layer.biases, MAX_BIAS),
    ):
        if values.dtype != np.int8 or int(np.abs(values.astype(np.int16)).max()) > largest:
            raise InputError(
                f"the {name} of layer {number} of a head must be int8 of at most {largest} "
                "either way"
            )
    for scale in (layer.weight_scale, layer.bias_scale):
        if not (np.isfinite(scale) and scale > 0 and float(np.float16(scale)) == scale):
            raise InputError(
                f"layer {number} of a head has scale {scale}: a positive float16 value is needed"
            )
