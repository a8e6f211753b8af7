"""An output has the dimensions, arrays and attributes of its source, where that is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import xarray as xr

from fhash_formats import Region, save_region
from fhash_formats.series import Coordinate, index_coordinate
from fhash_formats.source_metadata import SourceMetadata, SourceVariable
from fhash_formats.writers.common.outline import Outline

SHAPE = (2, 1, 3, 4)
METADATA = SourceMetadata(
    dimensions={"lon": "x", "one": "", "time": "t", "y": "y"},
    variable_attributes={
        "coordinates": "gone name",
        "grid_mapping": "crs",
        "ancillary_variables": "gone",
        "scale_factor": 0.5,
        "valid_range": np.array([1, 2], "i2"),
        "level": np.int16(4),
        "tags": ["a", "b"],
    },
    variables=(
        SourceVariable(
            name="lon",
            dimensions=("lon",),
            values=np.arange(4, dtype="f4"),
            attributes={"units": "degrees_east"},
            is_coordinate=True,
        ),
        SourceVariable(
            name="time",
            dimensions=("time",),
            values=np.array([5, 7]),
            attributes={"units": "days since 2000-01-01", "bounds": "time_bnds"},
            is_coordinate=True,
        ),
        SourceVariable(name="time_bnds", dimensions=("time", "bnds"), values=np.eye(2)),
        SourceVariable(
            name="name",
            dimensions=("time",),
            values=np.array(["a", "ä"], dtype=object),
            is_coordinate=True,
        ),
        SourceVariable(
            name="depth",
            dimensions=("y",),
            values=np.array([1, -99, 3], "i2"),
            attributes={"_FillValue": np.int16(-99), "scale_factor": 0.5},
            is_coordinate=True,
        ),
        SourceVariable(
            name="slope",
            dimensions=("y",),
            values=np.array([1, -9, 3], "f4"),
            attributes={"_FillValue": np.float32(-9)},
            is_coordinate=True,
        ),
        SourceVariable(name="crs", dimensions=(), values=np.int32(0), attributes={"a": 1.5}),
    ),
    attributes={"Conventions": "CF-1.11", "history": "one\ntwo", "NAME": "plumbing"},
)


def region(metadata: SourceMetadata | None = METADATA, **coords: Any) -> Region:
    usual = {axis: index_coordinate(axis, n) for axis, n in zip("tzyx", SHAPE, strict=True)}
    return Region(
        name="u",
        units="K",
        dtype=np.dtype("f4"),
        shape=SHAPE,
        coords={**usual, **coords},
        attributes={"long_name": "wind"},
        metadata=metadata,
    )


VALUES = np.arange(24, dtype="f4").reshape(SHAPE)


def test_frames_go_where_the_dimensions_say() -> None:
    outline = Outline.of(region())
    assert outline.shape == (4, 1, 2, 3)
    assert outline.ordered((1, 5, 6, 7)) == (7, 1, 1, 6)
    values = np.zeros(outline.shape)
    for step, frame in enumerate(VALUES):
        place, ordered = outline.place(step, frame)
        values[place] = ordered
    np.testing.assert_array_equal(values[:, 0], VALUES[:, 0].transpose(2, 0, 1))


def test_names_of_what_is_not_there_are_left_out() -> None:
    attributes = dict(Outline.of(region()).attributes)
    assert attributes.pop("tags") == ["a", "b"]
    assert attributes == {
        "coordinates": "name depth slope",
        "grid_mapping": "crs",
        "level": np.int16(4),
        "units": "K",
    }


def test_positions_that_the_source_has_not_are_told_where_they_tell_something() -> None:
    assert "y" not in [each.name for each in Outline.of(region()).variables]
    cut = Coordinate(name="y", values=np.array([3.0, 4, 5]))
    found = {each.name: each for each in Outline.of(region(y=cut)).variables}
    assert found["y"].values.tolist() == [3, 4, 5]


def test_a_region_without_a_source_has_four_axes() -> None:
    outline = Outline.of(region(None))
    assert list(outline.dimensions.values()) == list("tzyx")
    assert outline.shape == SHAPE
    assert outline.attributes == {"long_name": "wind", "units": "K"}
    assert len(outline.variables) == 4


@pytest.mark.parametrize("suffix", ["nc", "zarr"])
def test_files_give_everything_back(tmp_path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    save_region(path, region(), iter(VALUES))
    options = {"engine": "zarr"} if suffix == "zarr" else {"engine": "h5netcdf"}
    with xr.open_dataset(path, decode_coords="all", **options) as found:
        assert found["u"].dims == ("lon", "one", "time", "y")
        np.testing.assert_array_equal(found["u"][:, 0], VALUES[:, 0].transpose(2, 0, 1))
        assert set(found.coords) == {
            "lon",
            "time",
            "time_bnds",
            "name",
            "depth",
            "slope",
            "crs",
        }
        assert found["lon"].dtype == np.float32
        assert found["name"].values.tolist() == ["a", "ä"]
        np.testing.assert_array_equal(found["depth"], [0.5, np.nan, 1.5])
        np.testing.assert_array_equal(found["slope"], [1, np.nan, 3])
        assert found["crs"].attrs == {"a": 1.5}
        assert found["u"].attrs["level"] == 4
        assert list(found["u"].attrs["tags"]) == ["a", "b"]
        assert found.attrs == {"Conventions": "CF-1.11", "history": "one\ntwo"}
        assert str(found["time"].values[1]).startswith("2000-01-08")
