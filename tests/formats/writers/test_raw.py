"""NumPy's .npy: the same bytes as NumPy writes, half precision included."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from regions import DATA as DATA_NPY
from regions import labelled_region, region_of

from fhash_formats.errors import InputError, OutputExistsError
from fhash_formats.readers.registry import open_series
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_region


@pytest.mark.parametrize("dtype", ["f2", "f4", "i2"])
def test_the_file_is_the_one_that_numpy_writes(tmp_path: Path, dtype: str) -> None:
    values = np.nan_to_num(DATA_NPY * 10).astype(dtype)
    region = labelled_region(dtype=np.dtype(dtype))
    (path,) = save_region(tmp_path / "out.npy", region, iter(values))
    np.save(tmp_path / "expected.npy", values)
    assert path.read_bytes() == (tmp_path / "expected.npy").read_bytes()


POSITIONS = {
    "t": [347921.000277, 347922.0],
    "z": [0.0, 0.25],
    "y": [3.0, 2.0, 1.0],
    "x": [1.0, 1.1, 1.2, 1.3],
}
DATA = np.arange(48, dtype="f4").reshape(2, 2, 3, 4)


def region(positions: dict[str, list[float]] = POSITIONS, **changes: Any) -> Region:
    made = region_of(positions)
    coords = {axis: replace(each, name=f"{axis} name") for axis, each in made.coords.items()}
    coords["t"] = replace(coords["t"], name="time", attributes={"units": "hours"})
    return replace(made, **{"coords": coords, **changes})


def header(path: Path) -> dict[str, str]:
    lines = path.read_text().splitlines()
    assert lines[0] == "NRRD0005"
    assert lines[-1] == ""
    return dict(line.split(":=" if ":=" in line else ": ", 1) for line in lines[1:-1])


@pytest.mark.parametrize("name", ["run_4x3x2x2_float32.raw", "a_b_4x3x2x2_FLOAT32.RAW"])
def test_a_name_that_says_the_layout_needs_nothing_beside_it(tmp_path: Path, name: str) -> None:
    (path,) = save_region(tmp_path / name, region(), DATA)
    np.testing.assert_array_equal(np.fromfile(path, "<f4").reshape(2, 2, 3, 4), DATA)
    assert list(tmp_path.iterdir()) == [path]


def test_a_name_that_says_big_endian_is_true(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "run_4x3x2x2_float32_be.raw", region(), DATA)
    np.testing.assert_array_equal(np.fromfile(path, ">f4").reshape(2, 2, 3, 4), DATA)
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), DATA)


def test_a_type_that_there_is_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="v2"):
        save_region(tmp_path / "run_4x3x2x2_v2.raw", region(), DATA)


def test_one_step_may_be_left_out_of_the_name(tmp_path: Path) -> None:
    (path,) = save_region(
        tmp_path / "run_4x3x2_float16.raw",
        region({**POSITIONS, "t": [0.0]}, dtype=np.dtype("f2")),
        DATA[:1].astype("f2"),
    )
    np.testing.assert_array_equal(np.fromfile(path, "<f2"), DATA[0].ravel())


@pytest.mark.parametrize(
    "name",
    [
        "run_2x2x3x4_float32.raw",
        "run_4x3x2_float32.raw",
        "run_4x3x2x2_float64.raw",
        "run_4x3x2x2_uint8.raw",
        "4x4x4_float32.raw",
    ],
)
def test_a_name_that_says_another_layout_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(
        InputError,
        match=r"the name says another layout than the values have; use \*_4x3x2x2_float32\.raw",
    ):
        save_region(tmp_path / name, region(), DATA)
    assert list(tmp_path.iterdir()) == []


def test_a_header_beside_any_other_name(tmp_path: Path) -> None:
    paths = save_region(tmp_path / "out.raw", region(units="m/s"), DATA)
    assert paths == [tmp_path / "out.raw", tmp_path / "out.nhdr"]
    np.testing.assert_array_equal(np.fromfile(paths[0], "<f4").reshape(2, 2, 3, 4), DATA)
    assert header(paths[1]) == {
        "content": "wind",
        "type": "float",
        "dimension": "4",
        "sizes": "4 3 2 2",
        "kinds": "space space space time",
        "space dimension": "3",
        "space directions": "(0.10000000000000002,0,0) (0,-1.0,0) (0,0,0.25) none",
        "space origin": "(1.0,3.0,0.0)",
        "endian": "little",
        "encoding": "raw",
        "sample units": "m/s",
        "data file": "out.raw",
        "name_t": "time",
        "units_t": "hours",
        "coordinates_t": "347921.000277 347922.0",
        "name_z": "z name",
        "coordinates_z": "0.0 0.25",
        "name_y": "y name",
        "coordinates_y": "3.0 2.0 1.0",
        "name_x": "x name",
        "coordinates_x": "1.0 1.1 1.2 1.3",
    }


def test_one_step_is_a_plain_volume_and_uneven_axes_have_no_place(tmp_path: Path) -> None:
    paths = save_region(
        tmp_path / "out.raw", region({**POSITIONS, "t": [0.5], "y": [0.0, 1.0, 3.0]}), DATA[:1]
    )
    found = header(paths[1])
    assert (found["dimension"], found["sizes"], found["kinds"]) == (
        "3",
        "4 3 2",
        "space space space",
    )
    assert not [field for field in found if field.startswith("space")]
    assert found["coordinates_y"] == "0.0 1.0 3.0"


def test_text_cannot_break_the_header(tmp_path: Path) -> None:
    paths = save_region(tmp_path / "out.raw", region(name="a\n\nb: c"), DATA)
    assert header(paths[1])["content"] == "a  b: c"
    with pytest.raises(InputError, match="control characters"):
        save_region(tmp_path / "a\nb.raw", region(), DATA)


def test_pynrrd_reads_it(tmp_path: Path) -> None:
    import nrrd

    paths = save_region(tmp_path / "out.raw", region(), DATA)
    data, _ = nrrd.read(str(paths[1]))
    np.testing.assert_array_equal(data.T, DATA)


def test_a_header_that_exists_stops_it(tmp_path: Path) -> None:
    (tmp_path / "out.nhdr").write_text("old")
    with pytest.raises(OutputExistsError, match=r"out\.nhdr exists"):
        save_region(tmp_path / "out.raw", region(), DATA)
    assert [path.name for path in tmp_path.iterdir()] == ["out.nhdr"]
