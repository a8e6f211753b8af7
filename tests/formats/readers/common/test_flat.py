""".npy and raw files: byte orders, axis orders, exact sizes; nothing is read but the frame."""

from __future__ import annotations

import itertools
import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fhash_formats import RawLayout, open_series, parse_shape
from fhash_formats.errors import InputError
from fhash_formats.readers.common import flat
from fhash_formats.readers.common.flat import FlatArray
from fhash_formats.readers.common.request import DTYPES

VALUES = np.random.default_rng(0).normal(size=(4, 3, 5, 6)).astype(np.float32)
SHAPE = {"x": 6, "y": 5, "z": 3, "t": 4}


def frames(path: Path, **options: Any) -> np.ndarray:
    with open_series(path, **options) as series:
        stacked = np.stack(list(series.frames()))
        assert stacked.shape == series.shape
        assert stacked.dtype == series.dtype
        assert series.dtype.isnative
        return stacked


@given(
    shape=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    place=st.integers(0, 3),
    part=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    block=st.sampled_from([1, 64, 10**6]),
    run=st.sampled_from([1, 10**6]),
)
@settings(max_examples=60, deadline=None)
def test_a_part_of_a_flat_array_is_that_part(
    tmp_path_factory: pytest.TempPathFactory,
    shape: list[int],
    place: int,
    part: tuple[int, int],
    block: int,
    run: int,
) -> None:
    place = place % len(shape)
    start, stop = sorted(min(edge, shape[place]) for edge in part)
    values = np.arange(np.prod(shape), dtype=">i4").reshape(shape)
    path = tmp_path_factory.mktemp("flat") / "a"
    path.write_bytes(b"head" + values.tobytes())
    ranges = tuple(
        slice(start, stop) if at == place else slice(0, length) for at, length in enumerate(shape)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flat, "BLOCK_BYTES", block)
        patch.setattr(flat, "SHORTEST_RUN", run)
        np.testing.assert_array_equal(
            FlatArray(path, tuple(shape), values.dtype, offset=4).read(ranges), values[ranges]
        )


@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", "f2", "u1", ">i2", "u8"])
@pytest.mark.parametrize("fortran", [False, True])
def test_npy_of_every_type_and_order(tmp_path: Path, dtype: str, fortran: bool) -> None:
    values = (VALUES * 50).astype(dtype)
    np.save(tmp_path / "a.npy", np.asfortranarray(values) if fortran else values)
    np.testing.assert_array_equal(frames(tmp_path / "a.npy"), values)
    np.save(tmp_path / "b.npy", np.asfortranarray(values[0]) if fortran else values[0])
    np.testing.assert_array_equal(frames(tmp_path / "b.npy"), values[:1])


@pytest.mark.parametrize("order", list(itertools.permutations("tzyx"))[::2])
@pytest.mark.parametrize("fortran", [False, True])
def test_npy_with_any_order_of_axes(tmp_path: Path, order: tuple[str, ...], fortran: bool) -> None:
    stored = VALUES.transpose(["tzyx".index(axis) for axis in order])
    np.save(tmp_path / "a.npy", np.array(stored, order="F" if fortran else "C"))
    np.testing.assert_array_equal(frames(tmp_path / "a.npy", axes=",".join(order)), VALUES)


def test_npy_recognised_by_its_magic(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    os.rename(tmp_path / "a.npy", tmp_path / "a.data")
    with open_series(tmp_path / "a.data") as series:
        assert (series.name, series.units, series.attributes) == ("a", "", {})
        assert all(
            np.array_equal(series.coords[axis].values, np.arange(length))
            for axis, length in zip("tzyx", VALUES.shape, strict=True)
        )


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.zeros((2, 2, 2), complex), "complex128"),
        (np.zeros((2, 2, 2), [("a", "i4")]), "compound"),
        (np.full((2, 2, 2), None), "Python objects"),
        (np.zeros((2, 2, 2), bool), "boolean.*mask"),
        (np.full((2, 2, 2), "word"), "text"),
        (np.zeros((2, 2, 2), "M8[s]"), "dates"),
        (np.zeros(()), "0 dimensions"),
        (np.zeros((2, 2)), "2 dimensions"),
        (np.zeros((1, 1, 1, 1, 1)), "5 dimensions"),
        (np.zeros((0, 2, 2)), "length 0"),
        (np.zeros((2, 2, 2), np.longdouble), "float128|longdouble"),
    ],
)
def test_unsuitable_npy_is_described(tmp_path: Path, array: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match=words) as caught:
        open_series(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_npz_is_refused_with_advice(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", v=VALUES)
    with pytest.raises(InputError, match=r"numpy.save"):
        open_series(tmp_path / "a.npz")


@pytest.mark.parametrize("change", [-1, 1, 8])
def test_npy_of_a_wrong_size_is_refused(tmp_path: Path, change: int) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    size = (tmp_path / "a.npy").stat().st_size
    os.truncate(tmp_path / "a.npy", size + change)
    with pytest.raises(InputError, match=r"mmap length is greater|header promises") as caught:
        open_series(tmp_path / "a.npy")
    assert "\n" not in str(caught.value)


def test_npy_with_a_broken_header_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    data = bytearray((tmp_path / "a.npy").read_bytes())
    data[12:20] = b"\xff" * 8
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(InputError, match=r"cannot be read as \.npy"):
        open_series(tmp_path / "a.npy")


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_variable_cannot_be_named(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    (tmp_path / "a_6x5x3x4_f4.raw").write_bytes(VALUES.tobytes())
    with pytest.raises(InputError, match="--var v cannot be used"):
        open_series(tmp_path / ("a.npy" if kind == "npy" else "a_6x5x3x4_f4.raw"), var="v")


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


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"shape": {"x": 1, "y": 2}}, "name three or four of t, z, y, x"),
        ({"shape": {"x": 1, "y": 2, "w": 3}}, "names x, y, w"),
        ({"shape": {}}, "names no axis"),
        ({"shape": {"x": 1, "y": 2, "z": 0}}, "z=0; a length is at least 1"),
        ({"dtype": "c8"}, "'c8' is not a number type"),
        ({"endian": "middle"}, "byte order 'middle'; allowed: little, big"),
    ],
)
def test_impossible_layouts_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        RawLayout(**values)


def test_parse_shape() -> None:
    assert parse_shape("x=64,y=64, z=32,t=10") == {"x": 64, "y": 64, "z": 32, "t": 10}
    assert list(parse_shape("t=1,x=2,y=3")) == ["t", "x", "y"]


@pytest.mark.parametrize(
    "text", ["", "64,64,32", "x=64,x=3", "w=1", "x=-1", "x=1.5", "x=\u00b2", "x", "x=1,,y=2"]
)
def test_parse_shape_refuses(text: str) -> None:
    with pytest.raises(InputError, match=r"write each axis once, such as x=64,y=64,z=32,t=10"):
        parse_shape(text)


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_file_that_changes_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a_6x5x3x4_f4.{kind}"
    for change in (
        lambda: os.truncate(path, 500),
        path.unlink,
        lambda: os.truncate(path, 5000),
        lambda: os.utime(path, ns=(1, 1)),
    ):
        if kind == "npy":
            np.save(path, VALUES)
        else:
            path.write_bytes(VALUES.tobytes())
        with open_series(path) as series:
            np.testing.assert_array_equal(series.read(0), VALUES[0])
            change()
            with pytest.raises(InputError, match=r"changed while it was being read|cannot be read"):
                series.read(1)


def test_a_file_cut_during_a_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(VALUES.tobytes()[:-1])
    with pytest.raises(InputError, match="ends after 1439 bytes, 1440 are needed"):
        FlatArray(path, VALUES.shape, VALUES.dtype).read(
            (slice(3, 4), slice(0, 3), slice(0, 5), slice(0, 6))
        )


@pytest.mark.parametrize("order", ["t,z,y,x", "z,t,y,x"])
def test_one_frame_is_read_at_a_time(
    tmp_path: Path, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_formats.readers.common.file_series.SLAB_BYTES", 1)
    values = np.zeros((40, 40, 64, 64), np.float32)
    np.save(tmp_path / "a.npy", values)
    count = 0
    original = FlatArray._read

    def counted(self: FlatArray, file: Any, into: np.ndarray, start: int) -> None:
        nonlocal count
        count += into.nbytes
        original(self, file, into, start)

    monkeypatch.setattr(FlatArray, "_read", counted)
    with open_series(tmp_path / "a.npy", axes=order) as series:
        series.read(0)
        count = 0
        tracemalloc.start()
        for step in (3, 30):
            series.read(step)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert count == 2 * values[0].nbytes
    assert peak < 3 * values[0].nbytes


def test_a_short_run_among_many_others_is_read_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.random.default_rng(0).integers(0, 9, (2, 5000, 4, 4), np.uint8)  # (z, t, y, x)
    monkeypatch.setattr(flat, "BLOCK_BYTES", 1000)
    np.save(tmp_path / "a.npy", values)
    with open_series(tmp_path / "a.npy", axes="z,t,y,x") as series:
        series._together = 1  # as for frames above the bound of a slab
        series.read(0)
        tracemalloc.start()
        np.testing.assert_array_equal(series.read(4000), values[:, 4000])
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < values[0].nbytes


def test_time_as_the_fastest_axis_reads_many_steps_at_once(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ascontiguousarray(VALUES.transpose(1, 2, 3, 0)))
    with open_series(tmp_path / "a.npy", axes="z,y,x,t") as series:
        np.testing.assert_array_equal(series.read(2), VALUES[2])
        assert series._slab is not None
        assert series._slab[1].shape == VALUES.shape
