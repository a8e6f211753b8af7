"""Tables, numbers for people, and errors."""

from __future__ import annotations

import errno

import click
import pytest

from fhash_cli.output import (
    apart,
    compared,
    describe_error,
    duration,
    emit,
    factor,
    listed,
    number,
    quality_rows,
    size,
    table,
)
from fhash_formats.errors import DamagedFileError, InputError, QualityError


def test_table_aligns_its_columns() -> None:
    assert table([("a", "one"), ("long", "two")]) == "a     one\nlong  two"
    assert table([("a", "1", "22"), ("b", "333", "4")]) == "a    1  22\nb  333   4"


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (999.4, "999 B"),
        (999.5, "1.00 kB"),
        (1000, "1.00 kB"),
        (9_994, "9.99 kB"),
        (9_996, "10.0 kB"),
        (98_600, "98.6 kB"),
        (13_965_614, "14.0 MB"),
        (999_499, "999 kB"),
        (999_501, "1.00 MB"),
        (4.7e9, "4.70 GB"),
        (2e15, "2,000 TB"),
    ],
)
def test_size(count: float, text: str) -> None:
    assert size(count) == text


def test_number_has_its_unit_or_is_a_dash() -> None:
    assert [number(45.218, "dB"), number(None, "dB"), number(0.5), number(0.5, "1")] == [
        "45.22 dB",
        "-",
        "0.5",
        "0.5",
    ]


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        (0.5, "0.500x"),
        (1.0, "1.00x"),
        (9.996, "10.0x"),
        (47.25, "47.2x"),
        (999.6, "1,000x"),
        (52_683.0, "52,700x"),
    ],
)
def test_factor_has_three_digits_and_no_exponent(ratio: float, text: str) -> None:
    assert factor(ratio) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (0.434, "0.43 s"),
        (9.94, "9.9 s"),
        (9.96, "10 s"),
        (119.4, "119 s"),
        (119.6, "2 min 0 s"),
        (140.2, "2 min 20 s"),
        (3599.4, "59 min 59 s"),
        (3599.6, "1 h 0 min"),
        (11_130, "3 h 5 min"),
    ],
)
def test_duration_is_in_units_that_people_read(seconds: float, text: str) -> None:
    assert duration(seconds) == text


FIGURES = {"bytes": 100_000, "raw_bytes": 4_720_000, "ratio": 47.2}


def test_compared_says_larger_where_it_is() -> None:
    assert compared(FIGURES) == "100 kB: 47.2x smaller than the array (4.72 MB)"
    assert (
        compared({"bytes": 11_800, "raw_bytes": 480, "ratio": 480 / 11_800})
        == "11.8 kB: 24.6x larger than the array (480 B)"
    )


def test_compared_has_the_source_as_it_lies_on_disk_too() -> None:
    on_disk = {**FIGURES, "source_bytes": 2_000_000, "source_ratio": 20.0}
    array = "100 kB: 47.2x smaller than the array (4.72 MB)"
    assert compared(on_disk) == f"{array}, 20.0x smaller than the source on disk (2.00 MB)"
    assert compared(on_disk, part=True) == (
        f"{array}, 20.0x smaller than the whole source on disk (2.00 MB)"
    )
    assert compared({**FIGURES, "source_bytes": None, "source_ratio": None}) == array


def test_listed_leaves_out_the_middle() -> None:
    assert listed(["1", "2"]) == "1, 2"
    assert listed([str(n) for n in range(20)]) == "0, 1, 2, 3, 4, 5, ..., 19"


def test_json_holds_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    emit({"psnr": float("nan"), "range": [float("inf"), 1.5]}, "", as_json=True)
    assert capsys.readouterr().out == '{"psnr": null, "range": [null, 1.5]}\n'


class OutOfMemoryError(RuntimeError):
    """Named like torch's own."""


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (InputError("two\n  lines"), "two lines", 2),
        (QualityError("missed"), "missed", 3),
        (DamagedFileError("broken"), "broken", 4),
        (MemoryError(), "out of memory; take fewer", 1),
        (OutOfMemoryError("CUDA"), "out of memory; take fewer", 1),
        (
            RuntimeError(
                "[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator:"
                " can't allocate memory: 8 bytes"
            ),
            "out of memory; take",
            1,
        ),
        (
            RuntimeError("Can't decrement id ref count (memory allocation failed for pipeline)"),
            "out of memory; take fewer",
            1,
        ),
        (
            RuntimeError("can't start new thread"),
            "no thread can be started: no memory is left, or no process (ulimit -u)",
            1,
        ),
        (
            RuntimeError("no memory of it"),
            "unexpected RuntimeError: no memory of it; please report",
            1,
        ),
        (
            OSError(errno.ENOSPC, "No space left on device", "x.npy"),
            "No space left on device: x.npy",
            1,
        ),
        (click.UsageError("Bad."), "Bad", 2),
        (KeyError("k"), "unexpected KeyError: 'k'; please report this", 1),
    ],
)
def test_every_error_is_one_line_with_an_exit_code(error: Exception, line: str, code: int) -> None:
    text, got = describe_error(error)
    assert text.startswith(line)
    assert "\n" not in text
    assert got == code


def test_numbers_have_as_many_digits_as_tell_them_apart() -> None:
    assert apart(0.0, 4.0) == ["0", "4"]
    assert apart(347921.0, 347921.002) == ["347921", "347921.002"]
    assert apart(7.0, 7.0) == ["7", "7"]
    assert apart(1.0, 1.0 + 1e-15) == ["1", "1"]


@pytest.mark.parametrize(
    ("bulk", "row"),
    [
        ({"psnr": 40, "range": [0, 1]}, ["40 dB, of the 98 % from 0 to 1"]),
        ({"psnr": None, "range": [0, 1]}, ["exact, of the 98 % from 0 to 1"]),
        ({"range": [0, 1]}, []),
        (None, []),
    ],
)
def test_a_bulk_without_a_psnr_has_no_row(bulk: dict[str, object] | None, row: list[str]) -> None:
    figures = dict.fromkeys(("psnr", "psnr_all", "rmse", "max_abs_error", "ssim"), 1.0)
    rows = quality_rows({**figures, "bulk": bulk})
    assert [text for name, text in rows if name == "PSNR, bulk"] == row
