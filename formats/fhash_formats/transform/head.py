"""Head: a small network that corrects decoded values from their neighbours."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
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


INPUTS = len(OFFSETS) + 2
"""Number of inputs: one per neighbour, and two functions of the voxel's own value."""


MAX_WEIGHT = 31
"""Largest magnitude of a quantised weight (6 bits)."""
LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+"
"""Letter of each weight from -MAX_WEIGHT to MAX_WEIGHT in a header."""
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

        First u8 the number of hidden layers, and u8 the width of each; float32 sigma, low, high;
        per layer float16 the scales of weights and biases; then the biases of all layers as int8;
        then the weights of all layers, row by row, as int8.
        """
        return b"".join(
            [
                bytes([len(self.hidden), *self.hidden]),
                struct.pack("<3f", self.sigma, self.low, self.high),
                *(struct.pack("<2e", each.weight_scale, each.bias_scale) for each in self.layers),
                *(each.biases.tobytes() for each in self.layers),
                *(each.weights.tobytes() for each in self.layers),
            ]
        )

    @classmethod
    def from_bytes(cls, data: bytes) -> NeighbourHead:
        """The head that `to_bytes` packed.

        Raises DamagedFileError for bytes that are no head.
        """
        try:
            count = data[0]
            if not 1 <= count <= MAX_HIDDEN:
                raise ValueError(f"{count} hidden layers")
            widths = list(data[1 : 1 + count])
            constants = struct.unpack_from("<3f", data, 1 + count)
            scales = struct.unpack_from(f"<{2 * count + 2}e", data, 13 + count)
            numbers = np.frombuffer(data, np.int8, offset=17 + 5 * count)
            return cls._of(widths, constants, scales, numbers)
        except (struct.error, ValueError, IndexError) as error:
            raise DamagedFileError(f"a damaged neighbourhood head: {error}") from error

    def to_json(self) -> dict[str, Any]:
        """The head as JSON values (FORMAT.md, MLP); `from_json` is the inverse."""
        weights = np.concatenate([each.weights.ravel() for each in self.layers])
        return {
            "widths": list(self.hidden),
            "sigma": float(str(np.float32(self.sigma))),
            "range": [float(str(np.float32(end))) for end in (self.low, self.high)],
            "scales": [
                float(str(np.float16(scale)))
                for each in self.layers
                for scale in (each.weight_scale, each.bias_scale)
            ],
            "biases": [int(bias) for each in self.layers for bias in each.biases],
            "weights": "".join(LETTERS[weight + MAX_WEIGHT] for weight in weights.tolist()),
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> NeighbourHead:
        """The head of JSON values that libfhash has checked."""
        weights = [LETTERS.index(letter) - MAX_WEIGHT for letter in values["weights"]]
        numbers = np.array([*values["biases"], *weights], np.int8)
        constants = np.array([values["sigma"], *values["range"]], np.float32).tolist()
        scales = np.array(values["scales"], np.float16).tolist()
        return cls._of(values["widths"], constants, scales, numbers)

    @classmethod
    def _of(
        cls,
        hidden: Sequence[int],
        constants: Sequence[float],
        scales: Sequence[float],
        numbers: npt.NDArray[np.int8],
    ) -> NeighbourHead:
        """The head of its numbers: all biases, then all weights. Raises ValueError for others."""
        inputs, outputs = (INPUTS, *hidden), (*hidden, 1)
        sizes = [*outputs, *(n * k for n, k in zip(inputs, outputs, strict=True))]
        if min(sizes) < 1 or numbers.size != sum(sizes):
            raise ValueError(f"{numbers.size} weights and biases for widths {list(hidden)}")
        parts = np.split(numbers, np.cumsum(sizes)[:-1])
        layers = tuple(
            Layer(
                weights=parts[len(outputs) + number].reshape(width, inputs[number]),
                biases=parts[number],
                weight_scale=float(scales[2 * number]),
                bias_scale=float(scales[2 * number + 1]),
            )
            for number, width in enumerate(outputs)
        )
        sigma, low, high = constants
        return cls(layers=layers, sigma=sigma, low=low, high=high)


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
