"""Coded chunks of Zarr stores: where they lie, and which stores have none that could be tiles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import zarr
from zarr.codecs import Crc32cCodec, GzipCodec, TransposeCodec

from fhash_formats.errors import DamagedFileError, InputError
from fhash_formats.readers.common.file_series import Request
from fhash_formats.readers.zarr_coded import coded_names, open_coded
from fhash_formats.transform.chunk import decode_chunk
from fhash_formats.transform.zarr_codec import TransformCodec

CODEC = TransformCodec(max_error=0.01)
DIMENSIONS = ("time", "level", "lat", "lon")
SHAPE = (5, 6, 9, 10)


def field(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> npt.NDArray[Any]:
    grid = np.meshgrid(*(np.linspace(0, 3, n) for n in shape), indexing="ij")
    return (20 * np.sin(sum((i + 1) * x for i, x in enumerate(grid)))).astype(dtype)


def write(
    folder: Path,
    values: npt.NDArray[Any],
    chunks: tuple[int, ...],
    dimensions: tuple[str, ...] = DIMENSIONS,
    **options: Any,
) -> Path:
    """A store of one variable "u"."""
    path = folder / "run.zarr"
    group = zarr.open_group(path, mode="w")
    usual: dict[str, Any] = {"serializer": CODEC, "compressors": None, "fill_value": np.nan}
    if values.dtype.kind != "f":
        usual["fill_value"] = 0
    array = group.create_array(
        "u",
        shape=values.shape,
        chunks=chunks,
        dtype=values.dtype,
        dimension_names=list(dimensions),
        **{**usual, **options},
    )
    array[...] = values
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compressors": [Crc32cCodec()]},
        {"compressors": [GzipCodec(), Crc32cCodec()]},
        {"shards": (4, 6, 8, 8)},
        {"shards": (4, 6, 8, 8), "compressors": [GzipCodec()]},
        {"shards": {"shape": (4, 6, 8, 8), "index_location": "start"}},
        {"filters": [TransposeCodec(order=(0, 2, 1, 3))]},
    ],
    ids=str,
)
def test_streams_decode_to_what_zarr_reads(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), **options)
    with open_coded(path, Request()) as (series, array):
        assert (series.shape, array.tile, array.grid) == (SHAPE, (2, 3, 4, 4), (3, 2, 3, 3))
        assert array.quality == {"max_error": 0.01}
        for index in ((0, 0, 0, 0), (1, 1, 2, 0), (2, 1, 2, 2)):
            stream = array.stream(index)
            assert stream is not None
            if "filters" not in options:
                inside = tuple(slice(0, n) for n in array.values(index).shape)
                decoded = decode_chunk(stream, array.tile, np.float32)[inside]
                assert np.array_equal(decoded, array.values(index))


@pytest.mark.parametrize(
    ("dimensions", "chunks", "axes"),
    [
        (("time", "level", "lat", "lon"), (2, 3, 4, 4), None),
        (("time", "lat", "lon"), (1, 4, 4), None),
        (("time", "lat", "lon"), (2, 4, 4), ["z", "t", "y", "x"]),
        (("lon", "lat", "time"), (4, 4, 2), ["x", "t", "y", "z"]),
        (("time", "lat", "lon", "level"), (2, 4, 4, 3), ["t", "x", "z", "y"]),
        (("member", "time", "level", "lat", "lon"), (1, 2, 3, 4, 4), None),
    ],
)
def test_axes_of_tiles_follow_from_the_dimensions(
    tmp_path: Path, dimensions: tuple[str, ...], chunks: tuple[int, ...], axes: list[str] | None
) -> None:
    lengths = dict(zip(DIMENSIONS, SHAPE, strict=True)) | {"member": 3}
    values = field(tuple(lengths[name] for name in dimensions))
    path = write(tmp_path, values, chunks, dimensions)
    select = (("member", "2"),) if "member" in dimensions else ()
    with open_coded(path, Request(select=select)) as (series, array):
        assert array.configuration.get("axes") == axes
        assert array.shape == series.shape
        part = array.values((0, 0, 0, 0))
        assert np.array_equal(part[0], series.read(0)[tuple(slice(0, n) for n in part.shape[1:])])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"serializer": "auto", "compressors": "auto"}, "coded by bytes, zstd, not by fhash"),
        ({"attributes": {"scale_factor": 0.5}}, "is packed"),
        ({"attributes": {"add_offset": 3.0}}, "is packed"),
    ],
)
def test_other_arrays_are_refused_with_the_command_that_takes_them(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), **options)
    with (
        pytest.raises(InputError, match=f"{message}.*fhash encode .* --var u"),
        open_coded(path, Request()),
    ):
        pass


def test_a_selection_within_a_chunk_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, field((3, 4, 9, 10)), (3, 2, 4, 4), ("member", *DIMENSIONS[::2], "lon"))
    with (
        pytest.raises(InputError, match="chunks of 3 along member"),
        open_coded(path, Request(select=(("member", "0"),))),
    ):
        pass


def test_axes_that_the_codec_took_as_one_are_refused(tmp_path: Path) -> None:
    dimensions = ("time", "a", "level", "lat", "lon")
    path = write(tmp_path, field((4, 1, 3, 5, 6)), (2, 2, 3, 5, 6), dimensions)
    with pytest.raises(InputError, match="chunks of 2 along a"), open_coded(path, Request()):
        pass


def test_format_2_is_refused(tmp_path: Path) -> None:
    array = zarr.create_array(
        tmp_path / "a.zarr", shape=SHAPE, chunks=(2, 3, 4, 4), dtype="f4", zarr_format=2
    )
    array[...] = 1
    with (
        pytest.raises(InputError, match="Zarr format 2"),
        open_coded(tmp_path / "a.zarr", Request()),
    ):
        pass
    assert coded_names(tmp_path / "a.zarr")[1] == {"a": False}


def test_chunks_that_the_store_lacks_are_none(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4))
    (path / "u" / "c" / "0" / "1" / "2" / "0").unlink()
    with open_coded(path, Request()) as (_, array):
        assert array.stream((0, 1, 2, 0)) is None
        assert np.isnan(array.fill)
    values = field(SHAPE)
    values[:2] = np.nan
    path = write(tmp_path, values, (2, 3, 4, 4), shards=(4, 6, 8, 8))
    with open_coded(path, Request()) as (_, array):
        assert array.stream((0, 0, 0, 0)) is None
        assert array.stream((1, 0, 0, 0)) is not None


def test_damage_is_told_by_the_checksum(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), compressors=[Crc32cCodec()])
    file = path / "u" / "c" / "0" / "1" / "2" / "0"
    data = bytearray(file.read_bytes())
    data[20] ^= 1
    file.write_bytes(data)
    with open_coded(path, Request()) as (_, array):
        with pytest.raises(DamagedFileError, match=r"\(0, 1, 2, 0\) of u is damaged"):
            array.stream((0, 1, 2, 0))
        assert array.stream((0, 0, 0, 0)) is not None


def test_a_damaged_index_of_a_shard_is_told(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4), shards=(4, 6, 8, 8))
    file = path / "u" / "c" / "0" / "0" / "0" / "0"
    data = bytearray(file.read_bytes())
    data[-9] ^= 1
    file.write_bytes(data)
    with (
        open_coded(path, Request()) as (_, array),
        pytest.raises(DamagedFileError, match="index of shard"),
    ):
        array.stream((0, 0, 0, 0))


def test_names_say_what_is_coded(tmp_path: Path) -> None:
    path = write(tmp_path, field(SHAPE), (2, 3, 4, 4))
    group = zarr.open_group(path)
    group.create_array("v", data=field(SHAPE))
    assert coded_names(path) == (path, {"u": True, "v": False})
    assert coded_names(path / "u") == (path, {"u": True})
