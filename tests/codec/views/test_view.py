"""Shapes of chunks: bounded bytes, whole parts of tiles, small tiles joined."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fhash_codec
from fhash_codec import EncodeConfig, Volume
from fhash_codec.views.view import FEW_BYTES, MOST_BYTES, ZarrView, opened_view, view_chunks
from fhash_formats.series import ArraySeries, Coordinate

sides = st.tuples(st.integers(1, 99), *[st.integers(1, 700)] * 3)


@given(shape=sides, tile=sides, itemsize=st.sampled_from([1, 2, 4, 8]))
def test_chunks_are_bounded_and_within_the_array(
    shape: tuple[int, ...], tile: tuple[int, ...], itemsize: int
) -> None:
    chunk = view_chunks(shape, tile, itemsize)
    size = itemsize * prod(chunk)
    assert all(1 <= side <= length for side, length in zip(chunk, shape, strict=True))
    assert size <= MOST_BYTES
    few = 2 * size > FEW_BYTES
    assert few or all(
        side == length or itemsize * prod(chunk) // side * min(2 * side, length) > FEW_BYTES
        for side, length in zip(chunk, shape, strict=True)
    )


@given(
    tile=st.tuples(*[st.sampled_from([1, 2, 4, 8, 16, 32, 48])] * 4),
    tiles=st.tuples(*[st.integers(1, 6)] * 4),
)
def test_no_chunk_reaches_into_a_part_of_another_tile(
    tile: tuple[int, ...], tiles: tuple[int, ...]
) -> None:
    shape = tuple(n * m for n, m in zip(tile, tiles, strict=True))
    for side, n, length in zip(view_chunks(shape, tile, 4), tile, shape, strict=True):
        assert n % side == 0 or side % n == 0 or side == length or n == length


ViewOf = Callable[..., ZarrView]


@pytest.fixture
def view_of() -> Iterator[ViewOf]:
    """A function that opens a file with options; all files are closed at the end."""
    with ExitStack() as files:

        def make(path: Path, **options: Any) -> ZarrView:
            opened, view = opened_view(path, **options)
            files.callback(opened.close)
            return view

        yield make


def document(view: ZarrView, path: str) -> Any:
    data = view.get(f"{path}/zarr.json" if path else "zarr.json")
    assert data is not None
    return json.loads(data, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def encoded(path: Path, shape: tuple[int, ...] = (2, 3, 4, 5), **names: Any) -> Path:
    """A container of a small ramp; names: of the variable and of its axes t, z, y, x."""
    series = ArraySeries(np.arange(float(np.prod(shape))).reshape(shape), name=names["name"])
    series.coords = {
        axis: Coordinate(name=names.get(axis, axis), values=np.arange(n) * names.get("step", 1.0))
        for axis, n in zip("tzyx", shape, strict=True)
    }
    fhash_codec.encode(series, path, EncodeConfig(effort=1, max_error=0.0))
    return path


def test_the_root_document_holds_all_metadata(view_of: ViewOf, whole: Path) -> None:
    view = view_of(whole)
    root = document(view, "")
    assert (root["zarr_format"], root["node_type"]) == (3, "group")
    assert root["consolidated_metadata"]["kind"] == "inline"
    inside = root["consolidated_metadata"]["metadata"]
    for path, node in inside.items():
        alone = document(view, path)
        alone.pop("consolidated_metadata", None)
        assert alone == node
    arrays = {path for path, node in inside.items() if node["node_type"] == "array"}
    assert arrays == set(view.arrays)
    assert {"density", "time", "height", "lat", "lon", "lod/0/density", "lod/2/lat"} <= arrays
    assert "lod/3/density" not in arrays
    level = document(view, "lod/1")["consolidated_metadata"]["metadata"]
    assert set(level) == {"density", "time", "height", "lat", "lon"}


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("kind", ["whole", "feature"])
def test_every_key_has_as_many_bytes_as_told(
    view_of: ViewOf, kind: str, request: pytest.FixtureRequest
) -> None:
    view = view_of(request.getfixturevalue(kind))
    keys = list(view.listing())
    assert len(keys) == len(set(keys))
    for key in keys:
        data = view.get(key)
        assert data is not None
        assert view.size(key) == len(data)
        assert view.is_document(key) == key.endswith("zarr.json")


@pytest.mark.parametrize(
    "key",
    [
        "", "/", "zarr.json/", "/zarr.json", "nope", "density", "density/", "density/c",
        "density/c/", "density/c/0", "density/c/0/0/0/99", "density/c/0/0/0/0/0",
        "density/c/00/0/0/0", "density/c/-1/0/0/0", "density/c/0/0/0/0/", "../density/c/0/0/0/0",
        "lod/9/density/zarr.json", "time/c/1", "c/0/0/0/0", ".zattrs", "density/.zarray",
    ],
)  # fmt: skip
def test_other_keys_are_not_there(view_of: ViewOf, whole: Path, key: str) -> None:
    view = view_of(whole)
    assert view.get(key) is None
    assert view.size(key) is None


@pytest.mark.usefixtures("apart")
def test_names_below_a_path(view_of: ViewOf, whole: Path) -> None:
    view = view_of(whole)
    assert set(view.children("")) == {"zarr.json", "density", "time", "height", "lat", "lon", "lod"}
    assert set(view.children("lod")) == {"zarr.json", "0", "1", "2"}
    assert set(view.children("density")) == {"zarr.json", "c"}
    grid = view.arrays["density"].grid
    assert list(view.children("density/c")) == [str(n) for n in range(grid[0])]
    assert list(view.children("density/c/1/0/0")) == [str(n) for n in range(grid[3])]
    assert list(view.children("nope")) == []
    assert set(view.listing("lod/1/lat")) == {"lod/1/lat/zarr.json", "lod/1/lat/c/0"}


@pytest.mark.parametrize(
    ("names", "arrays"),
    [
        ({"name": "lod", "t": "time"}, {"lod_2", "time", "z", "y", "x"}),
        ({"name": "a/b", "x": "lod"}, {"a_b", "t", "z", "y", "lod_2"}),
        ({"name": "x"}, {"x", "t", "z", "y", "x_2"}),
        ({"name": "a", "z": "n", "y": "n", "x": "n"}, {"a", "t", "n", "n_2", "n_3"}),
        ({"name": "zarr.json", "t": "../up"}, {"zarr.json_2", ".._up", "z", "y", "x"}),
        ({"name": "c", "t": "__t"}, {"c", "_t", "z", "y", "x"}),
    ],
)
def test_names_that_would_collide_are_changed(
    tmp_path: Path, names: dict[str, str], arrays: set[str]
) -> None:
    with fhash_codec.open(encoded(tmp_path / "a.fhz", **names)) as volume:
        view = ZarrView({volume.name: volume})
        assert {path for path in view.arrays if not path.startswith("lod/")} == arrays
        (name,) = view.names.values()
        dimensions = view.arrays[name].dimension_names
        assert len(set(dimensions)) == 4
        assert set(dimensions) == arrays - {name}
        got = b"".join(view.get(key) or b"" for key in view.listing(f"{name}/c/"))
        assert got == volume[...].tobytes()


class Several(Mapping[str, Volume]):
    """A stand-in for a file of several variables."""

    def __init__(self, volumes: dict[str, Volume]) -> None:
        self._volumes = volumes
        self.attributes = {"title": "two", "_FillValue": 3, "bad": float("nan")}

    def __getitem__(self, name: str) -> Volume:
        return self._volumes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._volumes)

    def __len__(self) -> int:
        return len(self._volumes)


def test_several_volumes_share_the_coordinates_that_are_equal(tmp_path: Path) -> None:
    first = fhash_codec.open(encoded(tmp_path / "u.fhz", name="u"))
    second = fhash_codec.open(encoded(tmp_path / "v.fhz", name="v", shape=(2, 3, 4, 6)))
    with first, second:
        view = ZarrView(Several({"u": first, "v": second}))
        assert view.arrays["u"].dimension_names == ("t", "z", "y", "x")
        assert view.arrays["v"].dimension_names == ("t", "z", "y", "x_2")
        assert view.arrays["x_2"].shape == (6,)
        root = document(view, "")
        assert root["attributes"] == {"title": "two", "bad": "NaN"}
        scales = document(view, "lod")["attributes"]["ome"]["multiscales"]
        assert [entry["name"] for entry in scales] == ["u", "v"]
        assert view.get("v/c/0/0/0/0") == second[...].tobytes()


def test_the_nodes_of_a_group_stand_together(whole: Path, feature: Path) -> None:
    # zarr-python loses those of consolidated metadata that do not
    with fhash_codec.open(whole) as first, fhash_codec.open(feature) as second:
        view = ZarrView({"u": first, "v": second})
        assert set(view.names.values()) == {"density", "density_2"}
        for group in ("", "lod"):
            inside = document(view, group)["consolidated_metadata"]["metadata"]
            by_depth = sorted(inside, key=lambda path: path.count("/"))
            parents = [path.rpartition("/")[0] for path in by_depth]
            runs = [
                name
                for name, before in zip(parents, [None, *parents], strict=False)
                if name != before
            ]
            assert len(runs) == len(set(runs))
        assert {"lod/2/density", "lod/1/density_2"} <= view.arrays.keys()


def test_attributes_of_the_file_may_be_arrays(view_of: ViewOf) -> None:
    golden = Path(__file__).resolve().parents[2] / "golden"
    attributes = document(view_of(golden / "compact-source.fhz"), "")["attributes"]
    assert attributes["title"] == "golden"
    assert attributes["range"][0] == pytest.approx(0.1)
