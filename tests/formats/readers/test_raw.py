"""NumPy's .npy: every type and order of axes, exact sizes; every refusal."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stored_series import VALUES, assert_frames, frames

from fhash_formats.errors import InputError
from fhash_formats.readers.common.file_series import DTYPES, RawLayout
from fhash_formats.readers.registry import list_variables, open_series


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


@pytest.mark.parametrize("order", ["C", "F"])
def test_components_of_vectors_are_selected(tmp_path: Path, order: Any) -> None:
    values = np.arange(4 * 5 * 6 * 7 * 3, dtype=np.float32).reshape(4, 5, 6, 7, 3)
    np.save(tmp_path / "a.npy", np.asarray(values, order=order))
    with pytest.raises(InputError, match=r"5 dimensions \(dim0=4, .*--select dim4=0 \(dim4 has 3"):
        open_series(tmp_path / "a.npy")
    for name, index in (("dim4", 2), ("4", 2), ("-1", -1)):
        assert_frames(tmp_path / "a.npy", values[..., 2], select={name: index})
    assert_frames(tmp_path / "a.npy", values[1:2, ..., 0], select={"dim0": 1, "dim4": 0})
    assert_frames(
        tmp_path / "a.npy",
        values[:, 2, ..., 1][:, None],
        select={"dim1": 2, "dim4": 1},
        axes="t,y,x",
    )
    with pytest.raises(InputError, match=r"--select dim4=3 is outside the indices 0\.\.2"):
        open_series(tmp_path / "a.npy", select={"dim4": 3})
    with pytest.raises(InputError, match=r"no dimension 'c'; its dimensions are dim0=4"):
        open_series(tmp_path / "a.npy", select={"c": 3})


@pytest.mark.parametrize(("last", "asked"), [(1, False), (2, True), (9, True), (10, False)])
def test_a_short_last_axis_is_asked_about(tmp_path: Path, last: int, asked: bool) -> None:
    values = np.arange(4 * 11 * 12 * last, dtype=np.float32).reshape(4, 11, 12, last)
    np.save(tmp_path / "a.npy", values)
    if asked:
        with pytest.raises(
            InputError,
            match=rf"a is 4 steps of 11x12x{last} vertices \(--axes t,z,y,x\), or a 4x11x12 field"
            rf" of {last} components \(--select dim3=0\)",
        ):
            open_series(tmp_path / "a.npy")
    else:
        assert_frames(tmp_path / "a.npy", values)
    assert_frames(tmp_path / "a.npy", values, axes="t,z,y,x")
    assert_frames(tmp_path / "a.npy", values[None, ..., last - 1], select={"dim3": last - 1})
    commands = [
        line.split(".fhz")[1] for line in list_variables(tmp_path / "a.npy")[0].commands("a")
    ]
    assert commands == ([" --axes t,z,y,x", " --select dim3=0"] if asked else [""])


def test_a_last_axis_as_long_as_another_is_x(tmp_path: Path) -> None:
    for shape in ((20, 8, 30, 8), (20, 30, 7, 8), (8, 8, 8)):
        np.save(tmp_path / "a.npy", np.zeros(shape, np.float32))
        with open_series(tmp_path / "a.npy") as series:
            assert series.shape[-len(shape) :] == shape


@pytest.mark.parametrize("order", ["C", "F"])
def test_fields_of_structured_arrays_are_variables(tmp_path: Path, order: Any) -> None:
    state = np.zeros((4, 3, 5, 6), [("n", "i2"), ("gas", [("rho", ">f4"), ("v", "f8", (2,))])])
    state["gas"]["rho"] = VALUES
    state["gas"]["v"] = VALUES[..., None] * [1, 2]
    np.save(tmp_path / "state.npy", np.asarray(state, order=order))
    assert_frames(tmp_path / "state.npy", VALUES, var="state.gas.rho")
    assert_frames(tmp_path / "state.npy", (VALUES * 2).astype("f8"), var="v", select={"dim4": 1})
    with pytest.raises(InputError, match=r"holds 2 variables: state\.n .*, state\.gas\.rho"):
        open_series(tmp_path / "state.npy")


@pytest.mark.parametrize(
    ("stored", "missing", "expected"),
    [
        ("f4", 1e20, "f4"),
        ("f8", -9999, "f8"),
        ("i2", -32768, "f4"),
        (">u2", 65535, "f4"),
        ("i4", -9999, "f8"),
        ("i8", 2**62 + 1, "f8"),
    ],
)
def test_missing_values_of_the_user(
    tmp_path: Path, stored: str, missing: float, expected: str
) -> None:
    values = np.arange(60).reshape(3, 4, 5).astype(stored)
    values[1, 2] = missing
    values[0, 0, 0] = 2**62 if stored == "i8" else 0
    np.save(tmp_path / "a.npy", values)
    wanted = np.where(values == np.array(missing, stored), np.nan, values.astype(expected))
    assert_frames(tmp_path / "a.npy", wanted.astype(expected)[None], missing=[missing, 7.5])
    with open_series(tmp_path / "a.npy", missing=[missing]) as series:
        assert series.fill == np.array(missing, stored).item()
        assert series.source_dtype == (
            None if "f" in stored else np.dtype(stored).newbyteorder("=")
        )
        assert np.isnan(series.read(0)[1, 2]).all()


def test_a_missing_value_that_the_type_cannot_hold_changes_nothing(tmp_path: Path) -> None:
    np.save(tmp_path / "b.npy", VALUES.astype("f2"))
    assert_frames(tmp_path / "b.npy", VALUES.astype("f2"), missing=[1e20])
    values = np.arange(60, dtype=np.uint8).reshape(1, 3, 4, 5)
    np.save(tmp_path / "a.npy", values)
    assert_frames(tmp_path / "a.npy", values, missing=[-9999, 1e20, float("nan"), 0.5])


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


def test_a_complex_array_names_its_parts(tmp_path: Path) -> None:
    wave = VALUES * (1 + 2j)
    np.save(tmp_path / "a.npy", wave)
    with pytest.raises(InputError, match=r"--var a\.real and --var a\.imag$"):
        open_series(tmp_path / "a.npy")
    assert_frames(tmp_path / "a.npy", wave.imag, var="a.imag")


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
