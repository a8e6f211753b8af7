"""Decoded frames in the number type of an output, and the fill value of a whole decode."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_cli.conversion import check_fill, convert
from fhash_cli.intervals import NumberType
from fhash_codec import EncodeConfig
from fhash_formats import open_series
from fhash_formats.errors import InputError


def test_a_fill_value_stands_for_nan_in_any_type() -> None:
    frame = np.array([1.4, np.nan, 2.6], "f4")
    assert convert(frame, np.dtype("i2"), fill=-9).tolist() == [1, -9, 3]
    assert convert(frame, np.dtype("f8"), fill=0.5)[1] == 0.5
    assert np.isnan(convert(frame, np.dtype("f2"))[1])
    assert np.isnan(frame[1])
    with pytest.raises(InputError, match="--fill V"):
        convert(frame, np.dtype("i2"))
    with pytest.raises(InputError, match="at some vertices"):
        convert(frame, np.dtype("i2"), background=True)


def test_fill_values_must_fit_the_type() -> None:
    check_fill(np.dtype("i1"), None)
    check_fill(np.dtype("i1"), -128)
    with pytest.raises(InputError, match="fill value 300 does not fit int8"):
        check_fill(np.dtype("i1"), 300)


def test_whole_numbers_stay_exact() -> None:
    assert NumberType().convert(str(2**63 - 1), None, None) == 2**63 - 1
    assert NumberType().convert("-1.5", None, None) == -1.5


@pytest.fixture(scope="module")
def counts(tmp_path_factory) -> tuple[np.ndarray, str]:
    """Counts of a moving front, and a file of those above 3."""
    values = np.arange(10) + np.arange(2)[:, None, None, None] + np.arange(4)[:, None]
    values = np.broadcast_to(values, (2, 3, 4, 10)).astype("i2")
    path = tmp_path_factory.mktemp("counts") / "a.fhz"
    config = EncodeConfig(max_error=0.0, features=("interval:4:99",), dilation=0, effort=1)
    fhash_codec.encode(values, path, config)
    return values, str(path)


@pytest.mark.parametrize("suffix", ["npy", "h5", "nc", "zarr"])
def test_every_format_keeps_the_type_and_says_what_the_fill_value_is(
    fhash, counts, tmp_path, suffix
) -> None:
    values, path = counts
    out = tmp_path / f"a.{suffix}"
    done = fhash("decode", path, "--fill", "-7", "-o", str(out))
    assert done.exit_code == 0, done.output
    expected = np.where(values > 3, values, -7)
    if suffix == "npy":
        decoded = np.load(out)
    elif suffix == "zarr":
        import zarr

        array = zarr.open_group(out, mode="r")["values"]
        decoded, fill = array[...], array.attrs["_FillValue"]
        assert fill == -7
    else:
        import h5py

        with h5py.File(out) as file:
            decoded = file["values"][...]
            assert np.ravel(file["values"].attrs["_FillValue"]).tolist() == [-7]
            assert file["values"].attrs["_FillValue"].dtype == np.int16
    assert decoded.dtype == np.int16
    np.testing.assert_array_equal(decoded, expected)
    if suffix == "nc":
        with open_series(out) as series:
            np.testing.assert_array_equal(series.read(1), np.where(values > 3, values, np.nan)[1])


def test_without_a_fill_value_floats_come_and_one_line_says_why(fhash, counts, tmp_path) -> None:
    values, path = counts
    out = str(tmp_path / "a.npy")
    done = fhash("decode", path, "-o", out)
    assert done.exit_code == 0
    assert "come as float32: some vertices have no value; --fill V keeps int16" in done.output
    np.testing.assert_array_equal(np.load(out), np.where(values > 3, values, np.nan))


def test_a_fill_value_that_does_not_fit_is_refused_and_nothing_written(
    fhash, counts, tmp_path
) -> None:
    out = tmp_path / "a.npy"
    command = ["decode", counts[1], "--dtype", "int8", "--fill", "300", "-o", str(out)]
    done = fhash(*command)
    assert done.exit_code == 2
    assert "does not fit int8" in done.output
    assert not out.exists()


def test_times_between_steps_are_floats(fhash, counts, tmp_path) -> None:
    out = tmp_path / "a.npy"
    done = fhash("decode", counts[1], "--time", "0.5", "-o", str(out))
    assert done.exit_code == 0
    assert "between steps they are interpolated" in done.output
    assert np.load(out).dtype == np.float32


def test_few_integers_are_pointed_to_the_lossless_way(fhash, tmp_path) -> None:
    labels = np.random.default_rng(0).integers(0, 65, (2, 4, 9, 10)).astype("u1")
    np.save(tmp_path / "few.npy", labels % 65)
    np.save(tmp_path / "more.npy", labels * 2)
    words = ["--effort", "1", "--psnr", "20", "-o"]
    few = fhash("encode", tmp_path / "few.npy", *words, tmp_path / "few.fhz")
    more = fhash("encode", tmp_path / "more.npy", *words, tmp_path / "more.fhz")
    assert "--max-error 0 keeps each exactly" in few.stderr
    assert "--max-error 0" not in more.stderr
    words = ["--effort", "1", "--max-error", "0.4", "-o"]
    exact = fhash("encode", tmp_path / "few.npy", *words, tmp_path / "exact.fhz")
    assert "--max-error 0" not in exact.stderr
    assert "none, lossless" in exact.stdout


def test_integers_of_64_bits_are_converted_as_such() -> None:
    integers = np.array([2**60 + 1, 2**60 + 3])
    frame = np.array([2.0**60, np.nan])
    kinds = [np.dtype("i8"), np.dtype("u8")]
    for kind in kinds:
        found = convert(frame, kind, fill=7, integers=integers)
        assert found.tolist() == [2**60 + 1, 7]
    assert convert(frame[:1], np.dtype("i4"), integers=integers[:1]).tolist() == [2**31 - 1]
    assert convert(frame[:1], np.dtype("u8"), integers=-integers[:1]).tolist() == [0]
