"""Arrays of a view: their documents, the bytes of their chunks, and chunks that are left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fhash_codec.zarr_view.arrays import Region, ViewArray, chunk_index, chunk_key

VALUES = np.arange(35, dtype=np.int16).reshape(5, 7)


def view_array(values: np.ndarray = VALUES, **changes: Any) -> ViewArray:
    """An array in chunks of 2 x 4; the first two rows have no value."""
    settings: dict[str, Any] = {
        "shape": values.shape,
        "chunk_shape": (2, 4),
        "dtype": values.dtype,
        "dimension_names": ("y", "x"),
        "attributes": {"units": "m"},
        "fill": -1,
        "read": lambda region: values[region],
        "holds": lambda region: region[0].start >= 2,
    }
    return ViewArray(**{**settings, **changes})


def test_the_document_is_of_zarr_3() -> None:
    document = view_array().document()
    assert document["zarr_format"] == 3
    assert document["node_type"] == "array"
    assert document["shape"] == [5, 7]
    assert document["data_type"] == "int16"
    assert document["chunk_grid"]["configuration"] == {"chunk_shape": [2, 4]}
    assert document["fill_value"] == -1
    assert document["codecs"] == [{"name": "bytes", "configuration": {"endian": "little"}}]
    assert document["dimension_names"] == ["y", "x"]
    assert document["attributes"] == {"units": "m"}


@pytest.mark.parametrize(
    ("dtype", "fill", "written"),
    [
        ("float32", None, "NaN"),
        ("float64", float("nan"), "NaN"),
        ("float32", float("-inf"), "-Infinity"),
        ("float32", 1e20, 1e20),
        ("int32", None, 0),
        ("uint8", 255, 255),
    ],
)
def test_fill_values_in_json(dtype: str, fill: float | None, written: object) -> None:
    assert view_array(VALUES.astype(dtype), fill=fill).document()["fill_value"] == written


def test_single_bytes_have_no_order() -> None:
    assert view_array(VALUES.astype(np.uint8)).document()["codecs"] == [{"name": "bytes"}]


def test_chunks_are_little_endian_and_full_at_the_ends() -> None:
    array = view_array()
    assert array.grid == (3, 2)
    assert array.chunk((1, 0)) == VALUES[2:4, :4].astype("<i2").tobytes()
    last = np.full((2, 4), -1, dtype="<i2")
    last[:1, :3] = VALUES[4:, 4:]
    assert array.chunk((2, 1)) == last.tobytes()
    assert len(array.chunk((2, 1))) == array.chunk_bytes == 16


def test_chunks_without_values_and_outside_the_grid_are_not_there() -> None:
    array = view_array()
    assert list(array.indices()) == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert not any(map(array.has, [(0, 0), (3, 0), (1, 2), (1,), (1, 0, 0), (-1, 0)]))


@pytest.mark.parametrize(("fill", "left_out"), [(2**53, True), (2**53 + 1, False)])
def test_chunks_stay_where_browsers_would_round_the_fill_value(fill: int, left_out: bool) -> None:
    array = view_array(VALUES.astype(np.int64), fill=fill)
    assert array.has((0, 0)) is not left_out


def test_the_read_region_ends_with_the_array() -> None:
    regions: list[Region] = []

    def read(region: Region) -> np.ndarray:
        regions.append(region)
        return VALUES[region]

    view_array(read=read).chunk((2, 1))
    assert regions == [(slice(4, 5), slice(4, 7))]


@pytest.mark.parametrize(
    ("text", "index"),
    [
        ("0", (0,)),
        ("10/0/3", (10, 0, 3)),
        ("", None),
        ("01", None),
        ("-1", None),
        ("1/", None),
        ("1//2", None),
        ("1.5", None),
        ("9" * 19, None),
        ("0/٣", None),
    ],
)
def test_keys_and_indices(text: str, index: tuple[int, ...] | None) -> None:
    assert chunk_index(text) == index
    if index is not None:
        assert chunk_key(index) == f"c/{text}"
