"""A smooth tile, settings for it, and its streams in every form."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from specs import spec_of

from fhash_formats.native import crc32c
from fhash_formats.transform.encoding import Coding, encode_tile, exact_tile
from fhash_formats.transform.tile_format import TileSettings

Values = npt.NDArray[Any]

SHAPE = (2, 3, 7, 10)
SPEC = spec_of(("haar", "none", "9/7", "9/7"), (1, 0, 2, 2), SHAPE)
SETTINGS = TileSettings(
    transform=SPEC, step=0.1, center=0.5, low=-2.0, high=3.0, quantum=0.08 * (1 - 1e-6)
)


def wave(shape: tuple[int, ...] = SHAPE, dtype: npt.DTypeLike = np.float32) -> Values:
    """A sum of sines within the range of SETTINGS."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")
    return (np.sin(0.3 * t + 0.5 * y) + np.cos(0.4 * x - 0.2 * z) + 0.3).astype(dtype)


def same(values: Values, others: Values) -> bool:
    """Whether two arrays have one type and the same values, NaN included."""
    return values.dtype == others.dtype and np.array_equal(
        values, others, equal_nan=values.dtype.kind == "f"
    )


def streams() -> dict[str, tuple[Values, bytes]]:
    """A tile and its stream, with own settings, for each combination of sections."""
    values = wave((1, 3, 4, 5))
    holes = values.copy()
    holes[0, 1, 2, 1:4] = [np.nan, np.inf, -np.inf]
    integers = (values * 50).astype("i2")
    coarse, fine = replace(SETTINGS, quantum=0.0), replace(SETTINGS, quantum=0.002)
    own, nothing = Coding(own_settings=True), np.zeros(holes.shape, bool)
    return {
        "plain": (values, encode_tile(values, coarse, own).data),
        "residual": (values, encode_tile(values, fine, replace(own, error=0.001)).data),
        "missing": (holes, encode_tile(holes, SETTINGS, replace(own, error=0.04)).data),
        "empty": (holes, encode_tile(holes, coarse, own, in_coreset=nothing).data),
        "exact": (holes, exact_tile(holes).data),
        "integers": (integers, encode_tile(integers, replace(SETTINGS, high=99.0), own).data),
    }


def resealed(data: bytes) -> bytes:
    """A changed stream with the checksum of what it is now."""
    return crc32c(data[4:]).to_bytes(4, "little") + data[4:]


def damaged_copies(data: bytes) -> list[bytes]:
    """A stream cut at every length, with bytes after its end, and with each of its bits flipped."""
    flipped = [
        data[:n] + bytes([data[n] ^ 1 << bit]) + data[n + 1 :]
        for n in range(len(data))
        for bit in range(8)
    ]
    return [*(data[:n] for n in range(len(data))), data + b"\0", data + b"\x01a", *flipped]
