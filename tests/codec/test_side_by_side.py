"""Variables side by side: what is the same is shared, what differs gets a name of its own."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.side_by_side import SideBySide, shown_names
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries, Coordinate
from fhash_formats.source_metadata import SourceMetadata, SourceVariable

CONFIG = EncodeConfig(max_error=0.01, effort=1, timings=False)
SHAPE = (3, 1, 5, 6)


def values(seed: int, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def opened(sources: dict[str, Any], path: Path) -> xr.Dataset:
    fhash_codec.encode_dataset(sources, path, CONFIG)
    return xr.open_dataset(path, engine="fhash")


def along(**sizes: int) -> xr.Variable:
    return xr.Variable(tuple(sizes), np.zeros(tuple(sizes.values())))


def test_variables_of_one_name_in_their_sources_are_all_there(tmp_path: Path) -> None:
    sources = {f"{group}/u": ArraySeries(values(n), name="u") for n, group in enumerate("gh")}
    with opened(sources, tmp_path / "a.fhz") as dataset:
        for number, name in enumerate(sources):
            np.testing.assert_allclose(dataset[name], values(number), atol=0.01)


def test_a_staggered_grid_has_positions_of_its_own(tmp_path: Path) -> None:
    half = {"x": Coordinate(name="x", values=np.arange(6) + 0.5)}
    sources = {
        "u": ArraySeries(values(0), name="u"),
        "v": ArraySeries(values(1), name="v", coords=half),
        "w": ArraySeries(values(2, (3, 1, 5, 7)), name="w"),
        "p": ArraySeries(values(3), name="p", coords=half),
    }
    with opened(sources, tmp_path / "a.fhz") as dataset:
        dimensions = {name: dataset[name].dims[-1] for name in sources}
        assert dimensions == {"u": "x", "v": "x_2", "w": "x_3", "p": "x_2"}
        assert dataset["v"].dims[:3] == dataset["u"].dims[:3]
        assert dataset["x_2"].values.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5]
        assert dataset.sizes["x_3"] == 7


def with_latitudes(number: int) -> ArraySeries:
    series = ArraySeries(values(number), name=f"u{number}")
    latitudes = np.full((5, 6), 10.0 * number)
    series.metadata = SourceMetadata(
        dimensions={"time": "t", "y": "y", "x": "x"},
        variable_attributes={"coordinates": "lat"},
        variables=(
            SourceVariable(name="lat", dimensions=("y", "x"), values=latitudes, is_coordinate=True),
        ),
    )
    return series


def test_arrays_beside_of_one_name_do_not_take_the_place_of_others(tmp_path: Path) -> None:
    sources = {"u0": with_latitudes(0), "u1": with_latitudes(1)}
    with opened(sources, tmp_path / "a.fhz") as dataset:
        assert set(dataset.coords) == {"lat", "lat_2"}
        assert (dataset["lat"] == 0).all()
        assert (dataset["lat_2"] == 10).all()
    with xr.open_dataset(tmp_path / "a.fhz", engine="fhash", decode_coords=False) as raw:
        assert raw["u0"].attrs["coordinates"] == "lat"
        assert raw["u1"].attrs["coordinates"] == "lat_2"


def test_a_coordinate_has_not_the_name_of_a_variable() -> None:
    joined = SideBySide({"u": "x", "x": "x"})
    assert joined.add("u", along(x=3), {"x": along(x=3)}) == {"x": "x_2"}
    joined.add("x", along(x=3), {"x": along(x=3)})
    assert {name: v.dims for name, v in joined.variables.items()} == {
        "x_2": ("x_2",),
        "u": ("x_2",),
        "x": ("x_2",),
    }


def test_the_values_of_a_variable_are_not_there_again_beside_another() -> None:
    joined = SideBySide({"u": ("t", "x"), "mask": ("t", "x"), "height": ("t", "x")})
    found = joined.add("u", along(t=2, x=3), {"mask": along(x=3, t=2), "height": along()})
    assert found == {"mask": "mask", "height": "height_2"}
    assert set(joined.variables) == {"u", "height_2"}


def test_a_dimension_without_positions_is_shared() -> None:
    joined = SideBySide({"u": "x", "v": "x", "w": "x"})
    joined.add("u", along(x=3), {})
    joined.add("v", along(x=3), {"x": along(x=3)})
    joined.add("w", along(x=3), {"x": along(x=3) + 1})
    assert joined.variables["v"].dims == ("x",)
    assert joined.variables["w"].dims == ("x_2",)


def test_a_variable_alone_keeps_the_names_of_its_source() -> None:
    joined = SideBySide({"x": "x"})
    joined.add("x", along(x=3), {})
    assert joined.variables["x"].dims == ("x",)


def test_names_are_those_of_the_sources_where_these_differ() -> None:
    assert shown_names({"a/u": "u", "b/v": "v"}) == {"a/u": "u", "b/v": "v"}
    assert shown_names({"a": "u", "b": "u", "c": "b"}) == {"a": "a", "b": "b", "c": "c"}


def vector_file(path: Path, kind: str) -> dict[str, np.ndarray]:
    """A vector whose components have the names of the axes; their values."""
    arrays = {name: values(number, (2, 4, 5, 6)) for number, name in enumerate("xyz")}
    with h5py.File(path, "w") as file:
        for step, (name, array) in product((0, 1), arrays.items()):
            place = f"data/{step}/meshes/B/{name}" if kind == "openpmd" else f"velocity/{name}"
            if kind == "openpmd":
                file.require_group(f"data/{step}").attrs["time"] = float(step)
                file.require_group(f"data/{step}/meshes/B").attrs["axisLabels"] = list("xyz")
                file[place] = array[step]
            elif not step:
                file[place] = array
    return arrays


@pytest.mark.parametrize("kind", ["openpmd", "groups", "arrays"])
def test_components_called_as_axes_share_one_grid(tmp_path: Path, kind: str) -> None:
    source, path = tmp_path / "run.h5", tmp_path / "run.fhz"
    arrays = vector_file(source, kind)
    word = {"openpmd": "B", "groups": "velocity", "arrays": "values"}[kind]
    fhash_codec.encode_dataset(arrays if kind == "arrays" else source, path, CONFIG)
    with xr.open_dataset(path, engine="fhash") as found:
        assert set(found.data_vars) == {f"{word}_{name}" for name in "xyz"}
        assert sum(each**2 for each in found.data_vars.values()).dims == ("time", "z", "y", "x")
        assert found.sizes.keys() == {"time", "z", "y", "x"}
    with fhash_codec.open(path) as dataset:
        assert dataset["y"].name == f"{word}_y"
        assert "y" in dataset
        assert "w" not in dataset
        with pytest.raises(KeyError, match="no variable 'w'"):
            dataset["w"]
    with fhash_codec.open(path, variable="z") as volume:
        assert volume.name == f"{word}_z"


def test_a_last_part_of_several_names_is_refused(tmp_path: Path) -> None:
    arrays = {name: values(0, (2, 4, 4, 4)) for name in ("E/x", "B/x", "B/rho")}
    fhash_codec.encode_dataset(arrays, tmp_path / "run.fhz", CONFIG)
    with fhash_codec.open(tmp_path / "run.fhz") as dataset:
        assert [dataset[name].name for name in ("E/x", "B_x", "rho")] == ["E_x", "B_x", "B/rho"]
        with pytest.raises(KeyError, match="2 variables named 'x'"):
            dataset["x"]
    with pytest.raises(InputError, match="2 variables named 'x'"):
        fhash_codec.open(tmp_path / "run.fhz", variable="x")
