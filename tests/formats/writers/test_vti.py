"""VTK's XML grids, read back by their bytes: extents, places, times, descending axes."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from fhash_formats import Region, save_check, save_region
from fhash_formats.errors import InputError, OutputExistsError
from fhash_formats.series import Coordinate

EVEN = {
    "t": [0.1, 0.4, 347921.000277],
    "z": [2.0],
    "y": [-1.0, 0.0, 1.0, 2.0],
    "x": [10.0, 10.5, 11.0],
}
UNEVEN = {**EVEN, "x": [1.0, 2.0, 4.0]}
DATA = np.arange(36, dtype="f4").reshape(3, 1, 4, 3)


def region(positions: dict[str, list[float]] = EVEN, **changes: Any) -> Region:
    coords = {
        axis: Coordinate(name=axis, values=np.array(values, dtype="f8"))
        for axis, values in positions.items()
    }
    made = {
        "name": "wind",
        "dtype": np.dtype("f4"),
        "shape": tuple(len(coords[axis].values) for axis in "tzyx"),
        "coords": coords,
    }
    return Region(**{**made, **changes})


def one(values: dict[str, list[float]] = EVEN, **changes: Any) -> Region:
    return region({**values, "t": [3.5]}, **changes)


def parse(path: Path) -> tuple[ElementTree.Element, list[np.ndarray]]:
    """The XML of a grid, and its appended arrays by offset, each checked against its type."""
    head, mark, rest = path.read_bytes().partition(b'<AppendedData encoding="raw">\n_')
    appended, _, tail = rest.rpartition(b"\n</AppendedData>\n</VTKFile>\n")
    assert tail == b""
    root = ElementTree.fromstring(head + mark + b"</AppendedData></VTKFile>")
    assert (root.get("byte_order"), root.get("header_type"), root.get("version")) == (
        "LittleEndian",
        "UInt64",
        "1.0",
    )
    arrays, end = [], 0
    for array in root.iter("DataArray"):
        if array.get("format") == "appended":
            offset = int(array.get("offset", ""))
            assert offset == end
            end = offset + 8 + int.from_bytes(appended[offset : offset + 8], "little")
            arrays.append(
                np.frombuffer(
                    appended[offset + 8 : end],
                    np.dtype(array.get("type", "").lower()).newbyteorder("<"),
                )
            )
    assert end == len(appended)
    return root, arrays


def test_an_image(tmp_path: Path) -> None:
    paths = save_region(tmp_path / "out.vti", one(units="m/s"), DATA[:1])
    assert paths == [tmp_path / "out.vti"]
    root, (values,) = parse(paths[0])
    (image,) = root.findall("ImageData")
    assert image.attrib == {
        "WholeExtent": "0 2 0 3 0 0",
        "Origin": "10.0 -1.0 2.0",
        "Spacing": "0.5 1.0 1.0",
    }
    assert [piece.get("Extent") for piece in image.findall("Piece")] == ["0 2 0 3 0 0"]
    assert [points.get("Scalars") for points in image.findall("Piece/PointData")] == ["wind"]
    assert [key.text for key in image.findall("Piece/PointData/DataArray/InformationKey")] == [
        "m/s"
    ]
    assert [field.text for field in image.findall("FieldData/DataArray[@Name='TimeValue']")] == [
        "3.5"
    ]
    np.testing.assert_array_equal(values, DATA[0].ravel())  # x fastest


@pytest.mark.parametrize("suffix", [".vti", ".vtr"])
def test_several_steps_are_a_collection_with_their_times(tmp_path: Path, suffix: str) -> None:
    paths = save_region(tmp_path / f"my run{suffix}", region(), DATA)
    assert [path.name for path in paths] == [
        *(f"my run_000{step}{suffix}" for step in range(3)),
        "my run.pvd",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    rows = ElementTree.parse(paths[-1]).getroot().findall("Collection/DataSet")
    assert [row.get("file") for row in rows] == [path.name for path in paths[:-1]]
    assert [float(row.get("timestep", "")) for row in rows] == EVEN["t"]
    for step, path in enumerate(paths[:-1]):
        root, arrays = parse(path)
        np.testing.assert_array_equal(arrays[0], DATA[step].ravel())
        assert [
            float(field.text or "")
            for field in root.iter("DataArray")
            if field.get("Name") == "TimeValue"
        ] == [EVEN["t"][step]]


@pytest.mark.parametrize(("positions", "suffix"), [(EVEN, ".vti"), (UNEVEN, ".vtr")])
def test_a_collection_by_name_takes_the_grid_that_fits(
    tmp_path: Path, positions: dict[str, list[float]], suffix: str
) -> None:
    paths = save_region(tmp_path / "out.pvd", one(positions), DATA[:1])
    assert [path.name for path in paths] == [f"out_0000{suffix}", "out.pvd"]


def test_a_rectilinear_grid_keeps_uneven_positions_exactly(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.vtr", one(UNEVEN), DATA[:1])
    root, (values, x, y, z) = parse(path)
    assert root[0].attrib == {"WholeExtent": "0 2 0 3 0 0"}
    assert [
        axis.get("Name") for axis in root.findall("RectilinearGrid/Piece/Coordinates/DataArray")
    ] == ["x", "y", "z"]
    np.testing.assert_array_equal(values, DATA[0].ravel())
    for found, axis in ((x, "x"), (y, "y"), (z, "z")):
        np.testing.assert_array_equal(found, UNEVEN[axis])


@pytest.mark.parametrize("turned", ["x", "y", "z", "zx", "zyx"])
@pytest.mark.parametrize("suffix", [".vti", ".vtr"])
def test_descending_axes_are_turned_round(tmp_path: Path, suffix: str, turned: str) -> None:
    ascending = {**EVEN, "t": [3.5], "z": [2.0, 2.5]}
    data = np.arange(24, dtype="f4").reshape(1, 2, 4, 3)
    (plain,) = save_region(tmp_path / f"plain{suffix}", region(ascending), data)
    descending = {
        axis: values[::-1] if axis in turned else values for axis, values in ascending.items()
    }
    flipped = data[:, *(slice(None, None, -1 if axis in turned else 1) for axis in "zyx")]
    (path,) = save_region(tmp_path / f"turned{suffix}", region(descending), flipped)
    assert path.read_bytes() == plain.read_bytes()


def test_names_and_units_are_escaped(tmp_path: Path) -> None:
    (path,) = save_region(tmp_path / "out.vti", one(name="a<b & \"c'\x01", units="<m>"), DATA[:1])
    root, _ = parse(path)
    (array,) = root.findall("ImageData/Piece/PointData/DataArray")
    assert array.get("Name") == "a<b & \"c'_"
    assert [key.text for key in array] == ["<m>"]
    paths = save_region(tmp_path / "<&\"'>.pvd", one(), DATA[:1])
    assert [row.get("file") for row in ElementTree.parse(paths[1]).getroot().iter("DataSet")] == [
        paths[0].name
    ]


@pytest.mark.parametrize(
    ("positions", "suffix", "message"),
    [
        (UNEVEN, ".vti", r"coordinate 'x' of x is not evenly spaced, as \.vti needs; use \.vtr"),
        ({**EVEN, "y": [0.0, 2.0, 1.0, 3.0]}, ".vtr", "neither ascends nor descends"),
        ({**EVEN, "y": [0.0, 1.0, 1.0, 3.0]}, ".pvd", "neither ascends nor descends"),
        ({**EVEN, "y": [0.0, 1.0, np.nan, 3.0]}, ".vtr", "neither ascends nor descends"),
        ({**EVEN, "z": [np.nan]}, ".vti", "not evenly spaced"),
        ({**EVEN, "t": [0.0, np.nan, 1.0]}, ".vti", "times are not all finite"),
    ],
)
def test_grids_that_vtk_has_not(
    tmp_path: Path, positions: dict[str, list[float]], suffix: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as caught:
        save_region(tmp_path / f"out{suffix}", region(positions), DATA)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=message):
        save_check(tmp_path / f"out{suffix}", False, region(positions))
    assert list(tmp_path.iterdir()) == []


def test_a_file_name_that_a_collection_cannot_list(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="control characters"):
        save_region(tmp_path / "a\nb.pvd", region(), DATA)


@pytest.mark.parametrize("existing", ["out_0001.vti", "out.pvd"])
def test_any_file_of_a_collection_that_exists_stops_it(tmp_path: Path, existing: str) -> None:
    (tmp_path / existing).write_text("old")
    with pytest.raises(OutputExistsError, match=existing.replace(".", r"\.")):
        save_region(tmp_path / "out.vti", region(), DATA)
    assert [path.name for path in tmp_path.iterdir()] == [existing]
    save_region(tmp_path / "out.vti", region(), DATA, force=True)
    assert len(list(tmp_path.iterdir())) == 4
