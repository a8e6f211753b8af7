"""Raw files: layouts from the name and from the user; every refusal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stored_series import (
    VALUES,
    frames,
)

from fhash_formats import RawLayout, open_series
from fhash_formats.errors import InputError
from fhash_formats.readers.common.request import DTYPES

SHAPE = {"x": 6, "y": 5, "z": 3, "t": 4}


@pytest.mark.parametrize("name", [*DTYPES, *DTYPES.values()])
@pytest.mark.parametrize("endian", ["", "_be", "_le"])
def test_raw_layout_from_the_name(tmp_path: Path, name: str, endian: str) -> None:
    dtype = np.dtype(DTYPES.get(name, name)).newbyteorder(">" if endian == "_be" else "<")
    values = (VALUES * 50).astype(dtype)
    path = tmp_path / f"my_density_6x5x3x4_{name}{endian}.raw"
    path.write_bytes(values.tobytes())
    with open_series(path) as series:
        assert series.name == "my_density"
    np.testing.assert_array_equal(frames(path), values)


def test_raw_of_three_dimensions_is_one_step(tmp_path: Path) -> None:
    path = tmp_path / "6x5x3_float32_0007.raw"
    path.write_bytes(VALUES[0].tobytes())
    np.testing.assert_array_equal(frames(path), VALUES[:1])


@pytest.mark.parametrize("suffix", [".raw", ".bin", ".dat", ".whatever"])
def test_raw_layout_from_the_user(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(VALUES.astype(">f8").tobytes())
    np.testing.assert_array_equal(frames(path, raw=RawLayout(SHAPE, "float64", "big")), VALUES)
    path.write_bytes(VALUES[:, 0].tobytes())
    np.testing.assert_array_equal(
        frames(path, raw=RawLayout({"t": 4, "y": 5, "x": 6}, "f4")), VALUES[:, :1]
    )


def test_the_user_overrides_the_name(tmp_path: Path) -> None:
    path = tmp_path / "a_6x5x3x4_uint32_le.raw"
    path.write_bytes(VALUES.astype(">f4").tobytes())
    np.testing.assert_array_equal(frames(path, raw=RawLayout(dtype="f4", endian="big")), VALUES)
    np.testing.assert_array_equal(
        frames(path, raw=RawLayout())[0], VALUES.astype(">f4").view("<u4")[0]
    )


def test_raw_in_another_order(tmp_path: Path) -> None:
    path = tmp_path / "a_6x5x3x4_f4.raw"
    path.write_bytes(np.ascontiguousarray(VALUES.transpose(3, 2, 1, 0)).tobytes())
    np.testing.assert_array_equal(frames(path, axes="x,y,z,t"), VALUES)
    with pytest.raises(InputError, match="does not name the axes of the raw shape, t,z,y,x"):
        open_series(path, axes="z,y,x")


def test_raw_bytes_that_look_like_another_format(tmp_path: Path) -> None:
    values = np.frombuffer(b"\x89HDF\r\n\x1a\n", np.uint8).reshape(2, 2, 2)
    path = tmp_path / "a_2x2x2_uint8.raw"
    path.write_bytes(values.tobytes())
    np.testing.assert_array_equal(frames(path)[0], values)


@pytest.mark.parametrize(
    ("name", "layout", "words"),
    [
        (
            "a.raw",
            None,
            r"shape and type of the raw values is not known; name the file name_XxYxZ.*--shape",
        ),
        ("a.bin", RawLayout(shape=SHAPE), "the type of the raw values"),
        ("a.dat", RawLayout(dtype="f4"), "the shape of the raw values"),
        ("a_6x5x3x4_float33.raw", None, "'float33' is not a number type; allowed: uint8,"),
        (
            "a_6x5x3x4_f8.raw",
            None,
            r"has 1440 bytes; 4x3x5x6 \(t,z,y,x\) of float64 need exactly 2880",
        ),
        ("a_6x5x3_f4.raw", None, "need exactly 360; with t=4 the size would fit"),
        ("a_6x5x3x5_f4.raw", None, "has 1440 bytes.*exactly 1800"),
        ("a_6x5x0x4_f4.raw", None, "z=0; a length is at least 1"),
    ],
)
def test_raw_that_does_not_fit_is_refused(
    tmp_path: Path, name: str, layout: RawLayout | None, words: str
) -> None:
    (tmp_path / name).write_bytes(VALUES.tobytes())
    with pytest.raises(InputError, match=words):
        open_series(tmp_path / name, raw=layout)


def test_a_header_beside_it_is_named(tmp_path: Path) -> None:
    (tmp_path / "part.raw").write_bytes(bytes(24))
    (tmp_path / "part.nhdr").write_text("NRRD0005\n")
    with pytest.raises(InputError, match=r"part\.nhdr may say it: give that file instead"):
        open_series(tmp_path / "part.raw")
