"""The codec in numcodecs and in Zarr format 2."""

from __future__ import annotations

from pathlib import Path

import numcodecs
import numpy as np
import pytest
import zarr

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.transform.numcodecs_codec import NumcodecsTransform


def test_it_is_found_by_its_name_and_configuration() -> None:
    transform = {"t": "none", "z": "none", "y": ["9/7", 1], "x": ["9/7", 1]}
    for config in (
        {"max_error": 0.5},
        {"max_error": 0.5, "effort": 4},
        {"max_error_rel": 0.01},
        {"step": 2.0, "transform": transform},
    ):
        codec = numcodecs.get_codec({"id": "fhash.transform", **config})
        assert isinstance(codec, NumcodecsTransform)
        assert codec.get_config() == {"id": "fhash.transform", **config}
        assert numcodecs.get_codec(codec.get_config()) == codec


@pytest.mark.parametrize(
    "dtype", ["f2", "f4", "f8", ">f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"]
)
@pytest.mark.parametrize("shape", [(), (0, 3), (40,), (6, 8), (2, 3, 4, 5), (2, 1, 3, 4, 5)])
def test_shape_and_type_come_back(dtype: str, shape: tuple[int, ...]) -> None:
    values = (np.arange(np.prod(shape)).reshape(shape) % 120).astype(dtype)
    codec = NumcodecsTransform(max_error=1)
    decoded = codec.decode(codec.encode(values))
    assert decoded.shape == shape
    assert decoded.dtype == np.dtype(dtype).newbyteorder("=")
    assert np.abs(decoded.astype(float) - values.astype(float)).max(initial=0) <= 1
    out = np.empty(shape, decoded.dtype)
    assert codec.decode(codec.encode(values), out) is out
    assert np.array_equal(out, decoded)


def test_zarr_format_2(tmp_path: Path) -> None:
    values = np.sin(np.arange(12 * 20) / 30).reshape(12, 20).astype("f4")
    codec = NumcodecsTransform(max_error=0.001)
    array = zarr.create_array(
        tmp_path / "a.zarr",
        shape=(12, 20),
        chunks=(6, 20),
        dtype="f4",
        zarr_format=2,
        filters=None,
        compressors=codec,
    )
    array[...] = values
    assert np.abs(zarr.open_array(tmp_path / "a.zarr", mode="r")[...] - values).max() <= 0.001


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("fill", [0, None, 5])
def test_padding_in_zarr_format_2_leaves_the_relative_bound(order: str, fill: int | None) -> None:
    values = (1_900_000_000 + np.random.default_rng(0).integers(0, 50, (17, 21))).astype("i4")
    array = zarr.create_array(
        zarr.storage.MemoryStore(),
        shape=values.shape,
        chunks=(5, 8),
        dtype=values.dtype,
        zarr_format=2,
        filters=None,
        fill_value=fill,
        order=order,
        compressors=NumcodecsTransform(max_error_rel=0.1),
    )
    array[...] = values
    assert np.abs(array[...] - values).max() <= 0.1 * np.ptp(values)


def test_damage_and_bytes_are_refused() -> None:
    codec = NumcodecsTransform(max_error=0.01)
    values = np.sin(np.arange(30.0)).reshape(5, 6)
    data = codec.encode(values)
    sound = codec.decode(data)
    for n in range(len(data)):
        for damaged in (data[:n], data[:n] + bytes([data[n] ^ 0x10]) + data[n + 1 :]):
            try:
                decoded = codec.decode(damaged)
            except DamagedFileError:
                continue
            assert n >= 27
            assert np.array_equal(decoded, sound)
    with pytest.raises(InputError, match="not bytes"):
        codec.encode(b"abcd")
    with pytest.raises(InputError, match="one of max_error"):
        NumcodecsTransform()
