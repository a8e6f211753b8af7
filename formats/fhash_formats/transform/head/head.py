"""The trained neighbourhood head: a small network that corrects each decoded voxel from its neighbours, with the same bits everywhere.

A voxel c has 26 neighbours n (head_portable.STEPS; indices clamped to the tile), a clip range [low, high] and an error sigma.
Features: log2(1 + |n - c| / (2 sigma)) with the sign of n - c, the place of c in the range, and log2(1 + (c - low) / (2 sigma)),
the logarithm linear between powers of two. Hidden layers are leaky (slope 1/8). The last output times sigma is added to c and clipped.
Features are kept as integers of 1/512, activations of 1/128, both of at most 4095 units, and weights are integers times a scale per layer.

The second of two hidden layers may take the first one's outputs at a cross of nine voxels: the voxel itself and those before and after
it along t, z, y, x (head_portable.CROSS; indices clamped to the tile). Such a head sees a step farther, and it weighs what it sees there.

The head pays on fronts and plateaus, which a linear transform smears; on noise it gains little.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fhash_formats import native
from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.head.head_portable import apply_cross, apply_network
from fhash_formats.transform.head.inputs import CROSS, FEATURES
from fhash_formats.transform.head.weights import (
    MAX_WEIGHT,
    best_spread,
    decode_weights,
    encode_weights,
)

__all__ = [
    "MAX_BIAS",
    "MAX_CROSS_WIDTH",
    "MAX_HIDDEN",
    "MAX_WEIGHT",
    "MAX_WIDTH",
    "Layer",
    "NeighbourHead",
    "layer_inputs",
]

MAX_HIDDEN = 3
"""Most hidden layers."""
MAX_WIDTH = 64
"""Most outputs of a hidden layer; sums stay exact in float32 up to it."""
MAX_CROSS_WIDTH = 14
"""Most outputs of the first layer before a cross; sums of nine times as many stay exact."""
MAX_BIAS = 127
"""Largest magnitude of a quantised bias (8 bits)."""

_FEATURE_UNIT = 512.0
_ACTIVATION_UNIT = 128.0
_SIGMA_RANGE = (2.0**-100, 2.0**100)  # its inverse is an ordinary float32 as well

_CROSSED = 0x82  # in place of the number of hidden layers: two, the second over the cross

Floats = npt.NDArray[np.float32]


def layer_inputs(hidden: Sequence[int], cross: bool) -> list[int]:
    """How many inputs each layer has, the last one included."""
    return [
        FEATURES,
        *(
            width * len(CROSS) if cross and number == 0 else width
            for number, width in enumerate(hidden)
        ),
    ]


@dataclass(frozen=True, kw_only=True, eq=False)
class Layer:
    """One layer: outputs = weight_scale * weights @ inputs + bias_scale * biases.

    weights: int8 (out, in), at most MAX_WEIGHT either way; biases: int8 (out,), at most MAX_BIAS; both scales positive float16 values.
    """

    weights: npt.NDArray[np.int8]
    biases: npt.NDArray[np.int8]
    weight_scale: float
    bias_scale: float


class _Constants(NamedTuple):
    weights: list[Floats]
    scales: list[np.float32]
    biases: list[Floats]
    low: np.float32
    high: np.float32
    inverse: np.float32
    unit: np.float32


@dataclass(frozen=True, kw_only=True, eq=False)
class NeighbourHead:
    """A trained head. sigma, low, high: float32 values in data units; sigma > 0 is the decoded RMS error, [low, high] the clip range.

    cross: whether the second of two hidden layers sees the first one's outputs at the nine voxels of the cross; its weights are
    (out, 9 * in), the nine of each input together.

    Raises InputError for layers that do not fit together and constants out of range.
    """

    layers: tuple[Layer, ...]
    sigma: float
    low: float
    high: float
    cross: bool = False

    def __post_init__(self) -> None:
        if not 2 <= len(self.layers) <= MAX_HIDDEN + 1:
            raise InputError(
                f"a head has 1 to {MAX_HIDDEN} hidden layers, not {len(self.layers) - 1}"
            )
        if self.cross and len(self.layers) != 3:
            raise InputError(f"a head with a cross has 2 hidden layers, not {len(self.layers) - 1}")
        for number, (layer, inputs) in enumerate(
            zip(self.layers, layer_inputs(self.hidden, self.cross), strict=True)
        ):
            width = len(layer.biases)
            allowed = (
                1
                if number == len(self.layers) - 1
                else MAX_CROSS_WIDTH
                if self.cross and number == 0
                else MAX_WIDTH
            )
            if not 1 <= width <= allowed:
                raise InputError(
                    f"layer {number} of a head has {width} outputs, 1 to {allowed} are allowed"
                )
            if layer.weights.shape != (width, inputs) or layer.biases.shape != (width,):
                raise InputError(
                    f"layer {number} of a head has weights {layer.weights.shape} where {(width, inputs)} is needed"
                )
            for name, values, most in (
                ("weights", layer.weights, MAX_WEIGHT),
                ("biases", layer.biases, MAX_BIAS),
            ):
                if values.dtype != np.int8 or int(np.abs(values.astype(np.int16)).max()) > most:
                    raise InputError(
                        f"the {name} of layer {number} of a head must be int8 of at most {most} either way"
                    )
            for scale in (layer.weight_scale, layer.bias_scale):
                if not (np.isfinite(scale) and scale > 0 and float(np.float16(scale)) == scale):
                    raise InputError(
                        f"layer {number} of a head has scale {scale}: a positive float16 value is needed"
                    )
        if any(
            not np.isfinite(value) or float(np.float32(value)) != value
            for value in (self.sigma, self.low, self.high)
        ):
            raise InputError(
                f"a head's sigma, low and high must be finite float32 values, not {self.sigma}, {self.low}, {self.high}"
            )
        if not _SIGMA_RANGE[0] <= self.sigma <= _SIGMA_RANGE[1] or self.low > self.high:
            raise InputError(
                f"a head needs sigma in {_SIGMA_RANGE} and low <= high, not {self.sigma}, {self.low}, {self.high}"
            )

    @property
    def hidden(self) -> tuple[int, ...]:
        """The widths of the hidden layers."""
        return tuple(len(layer.biases) for layer in self.layers[:-1])

    @cached_property
    def _constants(self) -> _Constants:
        sigma, low, high = np.float32(self.sigma), np.float32(self.low), np.float32(self.high)
        weights, scales, biases = [], [], []
        for number, layer in enumerate(self.layers):
            # Exact products of few bits, but for the one with sigma.
            unit_in = _FEATURE_UNIT if number == 0 else _ACTIVATION_UNIT
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

    def apply(self, decoded: Floats) -> Floats:
        """The decoded tile (t, z, y, x), float32 in data units, with each value corrected and within [low, high]; a new array.

        NaN counts as low. Raises InputError for another dtype or rank.
        """
        if decoded.dtype != np.float32 or decoded.ndim != 4:
            raise InputError(
                f"a head takes a float32 tile (t, z, y, x), not {decoded.dtype} of shape {decoded.shape}"
            )
        if decoded.size == 0:
            return decoded.copy()
        library = native.library()
        constants = self._constants
        if library is None:
            return (apply_cross if self.cross else apply_network)(decoded, *constants)
        source = np.ascontiguousarray(decoded)
        out = np.empty(source.shape, dtype=np.float32)
        weights = np.concatenate([weight.ravel() for weight in constants.weights])
        biases = np.concatenate(constants.biases)
        scales = np.array(constants.scales, dtype=np.float32)
        widths = np.array([FEATURES, *self.hidden, 1], dtype=np.int64)
        sizes = (ctypes.c_int64(size) for size in (*source.shape, len(self.layers)))
        pointers = (
            ctypes.c_void_p(array.ctypes.data) for array in (widths, weights, biases, scales)
        )
        numbers = (ctypes.c_float(float(value)) for value in constants[3:])
        function = library.fhash_head_apply_cross if self.cross else library.fhash_head_apply
        code = function(
            ctypes.c_void_p(source.ctypes.data),
            *sizes,
            *pointers,
            *numbers,
            ctypes.c_void_p(out.ctypes.data),
        )
        if code != 0:
            raise MemoryError(
                f"no memory to apply a head to a tile of shape {source.shape} (code {code})"
            )
        return out

    def to_bytes(self) -> bytes:
        """The head as bytes, all little-endian; `from_bytes` is the inverse.

        u8 number of hidden layers, or 0x82 for two and a cross between them, u8 width of each; float32 sigma, low, high; per layer
        float16 scales of weights and biases, u8 spread; the biases of all layers as int8; then the weights of all layers, row by row, in
        one number (head_weights.py).
        """
        spreads = [best_spread(layer.weights.ravel().tolist()) for layer in self.layers]
        parts = [
            bytes([_CROSSED if self.cross else len(self.hidden), *self.hidden]),
            struct.pack("<3f", self.sigma, self.low, self.high),
        ]
        for layer, spread in zip(self.layers, spreads, strict=True):
            parts.append(struct.pack("<eeB", layer.weight_scale, layer.bias_scale, spread))
        parts += [layer.biases.tobytes() for layer in self.layers]
        state = 1
        for layer, spread in reversed(list(zip(self.layers, spreads, strict=True))):
            state = encode_weights(state, layer.weights.ravel().tolist(), spread)
        parts.append(state.to_bytes((state.bit_length() + 7) // 8, "little"))
        return b"".join(parts)

    @classmethod
    def from_bytes(cls, data: bytes) -> NeighbourHead:
        """The head that `to_bytes` wrote. Raises DamagedFileError for anything else, another spelling of it included."""
        try:
            head = cls._read(data)
        except (struct.error, ValueError, IndexError) as error:
            raise DamagedFileError(f"a damaged neighbourhood head: {error}") from error
        if head.to_bytes() != data:
            raise DamagedFileError(
                "a damaged neighbourhood head: its bytes are not those of the head that they describe"
            )
        return head

    @classmethod
    def _read(cls, data: bytes) -> NeighbourHead:
        cross = data[0] == _CROSSED
        count = 2 if cross else data[0]
        if not 1 <= count <= MAX_HIDDEN:
            raise ValueError(f"{count} hidden layers")
        widths = [*data[1 : 1 + count], 1]
        if (
            len(widths) != count + 1
            or not all(1 <= width <= MAX_WIDTH for width in widths)
            or (cross and widths[0] > MAX_CROSS_WIDTH)
        ):
            raise ValueError(f"layers of widths {widths}")
        inputs = layer_inputs(widths[:-1], cross)
        sigma, low, high = struct.unpack_from("<3f", data, 1 + count)
        at = 13 + count
        scales = [struct.unpack_from("<eeB", data, at + 5 * layer) for layer in range(count + 1)]
        at += 5 * (count + 1)
        biases = []
        for width in widths:
            biases.append(np.frombuffer(data, dtype=np.int8, count=width, offset=at))
            at += width
        size = sum(first * second for first, second in zip(inputs, widths, strict=True))
        if (
            len(data) - at > 3 * size + 1
        ):  # no weight takes more than 22 bits: bounds the work on hostile bytes
            raise ValueError(f"{len(data)} bytes are too many")
        state = int.from_bytes(data[at:], "little")
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
        return cls(layers=tuple(layers), sigma=sigma, low=low, high=high, cross=cross)
