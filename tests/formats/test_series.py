"""Series in memory and selections of steps: the contract that every reader keeps, too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr

from fhash_formats import errors
from fhash_formats.errors import InputError, RegionError, suggestion
from fhash_formats.readers.registry import open_mask, open_series
from fhash_formats.series import (
    BLOCK,
    ArraySeries,
    Coordinate,
    SourceMetadata,
    SourceVariable,
    StepsSeries,
    is_plain_name,
    references,
    renamed,
    step_blocks,
    with_history,
    without_names,
)

VALUES = np.random.default_rng(0).normal(size=(4, 2, 3, 5)).astype(np.float32)


@pytest.mark.parametrize("step", [-1, 4])
def test_no_step_counts_from_the_end(step: int) -> None:
    all_steps = ArraySeries(VALUES)
    for series in (all_steps, StepsSeries(all_steps, [3, 2, 1, 0])):
        with pytest.raises(RegionError, match=rf"array: step {step} is outside 0\.\.3"):
            series.read(step)
    with pytest.raises(RegionError, match=rf"step {step} is outside"):
        StepsSeries(all_steps, [0, step])


def test_some_steps() -> None:
    some = StepsSeries(ArraySeries(VALUES), [2, 0])
    np.testing.assert_array_equal(np.stack(list(some.frames())), VALUES[[2, 0]])
    np.testing.assert_array_equal(some.coords["t"].values, [2, 0])
    with pytest.raises(InputError, match="empty"):
        StepsSeries(ArraySeries(VALUES), [])


@pytest.mark.parametrize(
    ("steps", "frame", "blocks"),
    [
        (range(5), (1, 1, 1), [range(5)]),
        (range(3, 8), (1, 1, BLOCK // 2), [range(3, 5), range(5, 7), range(7, 8)]),
        (range(2, 4), (2, 1, BLOCK), [range(2, 3), range(3, 4)]),
        (range(6, 0, -3), (1, 1, 1), [range(6, 7), range(3, 4)]),
        (range(0, 5, 2), (1, 1, 1), [range(1), range(2, 3), range(4, 5)]),
        (range(0), (1, 1, 1), []),
    ],
)
def test_steps_are_cut_into_neighbours_that_are_read_together(
    steps: range, frame: tuple[int, int, int], blocks: list[range]
) -> None:
    cut = list(step_blocks(steps, frame))
    assert [together for _, together in cut] == blocks
    assert [step for places, _ in cut for step in steps[places]] == list(steps)


@pytest.mark.parametrize("chosen", [None, [0, 1, 2, 3], [3, 1, 0]])
def test_blocks_are_the_frames(chosen: list[int] | None) -> None:
    array = ArraySeries(VALUES)
    series = array if chosen is None else StepsSeries(array, chosen)
    ((steps, frames),) = series.blocks(range(1, 3))
    assert steps == range(1, 3)
    np.testing.assert_array_equal(frames, [series.read(1), series.read(2)])


def test_three_axes_are_one_step() -> None:
    series = ArraySeries(VALUES[0].astype(">f8"))
    assert (series.shape, series.dtype) == ((1, 2, 3, 5), np.dtype(np.float64))
    np.testing.assert_array_equal(series.read(0), VALUES[0])


def test_masked_values_are_nan_and_never_what_is_under_the_mask() -> None:
    masked = np.ma.masked_greater(VALUES, 0)
    np.testing.assert_array_equal(
        np.stack(list(ArraySeries(masked).frames())), np.where(VALUES > 0, np.nan, VALUES)
    )
    integers = (VALUES * 9).astype(np.int16)
    np.testing.assert_array_equal(ArraySeries(np.ma.asarray(integers)).read(1), integers[1])
    with pytest.raises(InputError, match="masked values of type int16, which has no NaN"):
        ArraySeries(np.ma.masked_greater(integers, 0))


@pytest.mark.parametrize(
    ("array", "coords", "message"),
    [
        (VALUES[0, 0], {}, "2 dimensions"),
        (VALUES > 0, {}, "type bool"),
        (VALUES[:0], {}, "an axis is empty"),
        (
            VALUES,
            {"t": Coordinate(name="t", values=np.zeros(3))},
            r"coordinate of t is float64 \(3,\); float64 \(4,\)",
        ),
        (
            VALUES,
            {"x": Coordinate(name="x", values=np.zeros(5, np.float32))},
            "coordinate of x is float32",
        ),
        (VALUES, {"w": Coordinate(name="w", values=np.zeros(5))}, "exactly those of t, z, y and x"),
    ],
)
def test_what_cannot_be_a_series(array: Any, coords: dict[str, Coordinate], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ArraySeries(array, coords=coords)


def test_a_series_knows_its_files(tmp_path: Path) -> None:
    assert ArraySeries(VALUES).files == ()
    for step in range(2):
        np.save(tmp_path / f"f{step}.npy", VALUES[step])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = VALUES
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
        layout[:] = h5py.VirtualSource("a.h5", "v", VALUES.shape)
        file.create_virtual_dataset("v", layout)
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["v"] = h5py.ExternalLink("a.h5", "v")
    zarr.create_array(tmp_path / "a.zarr", data=VALUES)
    names = {
        "f0.npy": ["f0.npy"],
        "f?.npy": ["f0.npy", "f1.npy"],
        "a.h5": ["a.h5"],
        "virtual.h5": ["virtual.h5", "a.h5"],
        "virtual[.]h5": ["virtual.h5", "a.h5"],
        "linked.h5": ["linked.h5", "a.h5"],
        "a.zarr": ["a.zarr"],
    }
    for opened, files in names.items():
        for steps in (None, slice(0, 1)):
            with open_series(tmp_path / opened, steps=steps) as series:
                assert series.files == tuple(tmp_path / name for name in files)
    mask = open_mask(tmp_path / "f0.npy", VALUES.shape)
    mask.close()
    assert mask.files == (tmp_path / "f0.npy",)


METADATA = SourceMetadata(
    dimensions={"lon": "x", "time": "t", "one": ""},
    variable_attributes={"coordinates": "lat month", "units": "K"},
    variables=(
        SourceVariable(name="lat", dimensions=("lon", "nv"), values=np.arange(8).reshape(4, 2)),
        SourceVariable(name="month", dimensions=("time",), values=np.array(["jan", "feb", "mar"])),
        SourceVariable(name="ps", dimensions=("time", "lon"), values=np.arange(12).reshape(3, 4)),
        SourceVariable(name="crs", dimensions=(), values=np.array(1)),
    ),
)


def test_a_part_has_the_values_of_its_places() -> None:
    cut = METADATA.cut({"t": [2, 0], "x": range(1, 3), "z": [5]})
    assert cut.named("lat").values.tolist() == [[2, 3], [4, 5]]
    assert cut.named("month").values.tolist() == ["mar", "jan"]
    assert cut.named("ps").values.tolist() == [[9, 10], [1, 2]]
    assert cut.named("crs").values == 1
    assert cut.variable_attributes == METADATA.variable_attributes


def test_one_place_takes_the_dimension_away() -> None:
    cut = METADATA.named("ps").cut({"time": 1, "other": 7})
    assert cut.dimensions == ("lon",)
    assert cut.values.tolist() == [4, 5, 6, 7]


def test_between_steps_nothing_along_time_is_known() -> None:
    cut = METADATA.cut({"t": None})
    assert [each.name for each in cut.variables] == ["lat", "crs"]
    assert cut.variable_attributes == {"coordinates": "lat", "units": "K"}


def test_dimensions_are_found_by_axis() -> None:
    assert (METADATA.along("x"), METADATA.along("z")) == ("lon", None)
    assert METADATA.named("other") is None


def test_attributes_name_other_variables() -> None:
    found = references(
        {
            "grid_mapping": "crs: lat lon",
            "formula_terms": "a: hyam ps: ps",
            "coordinates": "lat",
            "bounds": "b",
            "units": "K",
            "cell_measures": 3,
        }
    )
    assert list(found) == [
        ("coordinates", "lat"),
        ("grid_mapping", "crs"),
        ("grid_mapping", "lat"),
        ("grid_mapping", "lon"),
        ("bounds", "b"),
        ("formula_terms", "hyam"),
        ("formula_terms", "ps"),
    ]


def test_names_are_taken_out_of_a_list() -> None:
    assert without_names({"coordinates": "a b"}, {"a"}) == {"coordinates": "b"}
    assert without_names({"coordinates": "a b", "c": 1}, {"a", "b"}) == {"c": 1}


@pytest.mark.parametrize("before", [None, "", "  ", 7])
def test_history_begins_with_its_first_line(before: object) -> None:
    assert with_history({"history": before}, "now") == {"history": "now"}


def test_history_gets_one_line_more() -> None:
    assert with_history({"history": "a\n", "b": 1}, "now") == {"history": "a\nnow", "b": 1}


@pytest.mark.parametrize("name", ["a/b", "", "..", " a", "__a", "a\n", "a\\b", "x" * 300, 3])
def test_other_names_are_not_plain(name: object) -> None:
    assert not is_plain_name(name)
    assert is_plain_name("Größe m-2")


def test_attributes_follow_the_new_names_of_arrays() -> None:
    names = {"lat": "lat_2", "crs": "crs_2", "a": "a_2"}
    attributes = {
        "coordinates": "lat lon",
        "grid_mapping": "crs: lat lon",
        "formula_terms": "a: a b: b",
        "long_name": "lat",
    }
    assert renamed(attributes, names) == {
        "coordinates": "lat_2 lon",
        "grid_mapping": "crs_2: lat_2 lon",
        "formula_terms": "a: a_2 b: b",
        "long_name": "lat",
    }


NAMES = ("shadows", "shading", "box")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("shadow", "did you mean 'shadows'?"),
        ("shadng", "did you mean 'shading'?"),
        ("foo", "known: shadows, shading, box"),
        ("", "known: shadows, shading, box"),
        ("x" * 10_000, "known: shadows, shading, box"),
    ],
)
def test_suggestion(name: str, text: str) -> None:
    assert suggestion(name, NAMES) == text


@pytest.mark.parametrize(
    ("error", "base", "exit_code"),
    [
        (errors.InputError, ValueError, 2),
        (errors.MissingInputError, FileNotFoundError, 2),
        (errors.RegionError, IndexError, 2),
        (errors.OutputExistsError, FileExistsError, 2),
        (errors.OutputError, OSError, 1),
        (errors.QualityError, Exception, 3),
        (errors.DamagedFileError, ValueError, 4),
        (errors.UnsupportedFileError, errors.DamagedFileError, 4),
        (errors.TrainingError, ArithmeticError, 1),
        (errors.MissingDependencyError, ImportError, 2),
        (errors.InterruptedEncodingError, Exception, 130),
    ],
)
def test_every_error_has_its_base_and_its_exit_code(
    error: type[errors.FhashError], base: type[Exception], exit_code: int
) -> None:
    assert issubclass(error, errors.FhashError)
    assert issubclass(error, base)
    assert error.exit_code == exit_code
    assert str(error("what is wrong")) == "what is wrong"


def test_a_missed_quality_has_its_figures() -> None:
    assert errors.QualityError("missed", {"psnr": 40.0}).figures == {"psnr": 40.0}
    assert errors.QualityError("missed").figures == {}
