"""Encoding of several variables: promises of each, errors before the work, what is held."""

from __future__ import annotations

import gc
import warnings
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray
import zarr

import fhash_codec
from fhash_codec import Dataset, EncodeConfig, InputError, OutputExistsError, QualityError
from fhash_codec.dataset_encoding import encodable
from fhash_formats import list_variables
from fhash_formats.series import ArraySeries

QUICK = EncodeConfig(effort=1, timings=False)
SHAPE = (4, 5, 8, 10)
UNITS = "hours since 2000-01-01"


def values(number: int) -> npt.NDArray[np.float32]:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    return (np.sin((3 + number) * x + t) + z * y).astype(np.float32)


def data() -> xarray.Dataset:
    """Winds on staggered grids, a height, a label without a grid and one of texts."""
    lengths = dict(zip(("time", "level", "lat", "lon"), SHAPE, strict=True))
    coords: dict[str, Any] = {
        name: (name, np.arange(length) * 1.5, {"units": UNITS} if name == "time" else {})
        for name, length in lengths.items()
    }
    coords["lon_u"] = ("lon_u", np.arange(10) * 1.5 + 0.75)
    grid = tuple(lengths)
    return xarray.Dataset(
        {
            "u": ((*grid[:3], "lon_u"), values(0), {"units": "m s-1"}),
            "v": (grid, values(1), {"units": "m s-1", "long_name": "northward wind"}),
            "z": (grid, values(2)),
            "number": (("time",), np.arange(4.0)),
        },
        coords=coords,
        attrs={"title": "a run"},
    )


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "data.nc"
    data().to_netcdf(path)
    return path


def opened(path: Path) -> Dataset:
    dataset = fhash_codec.open(path)
    assert isinstance(dataset, Dataset)
    return dataset


def test_every_variable_of_a_file_keeps_its_promise(tmp_path: Path, source: Path) -> None:
    bounds = {"u": 0.1, "v": 0.01, "z": 0.001}
    configs = {n: EncodeConfig(effort=1, max_error=bound) for n, bound in bounds.items()}
    path = tmp_path / "run.fhz"
    report = fhash_codec.encode_dataset(source, path, configs)
    assert list(report["variables"]) == list(bounds)
    assert report["bytes"] == path.stat().st_size
    assert report["raw_bytes"] == 3 * values(0).nbytes
    with opened(path) as dataset:
        for number, (name, volume) in enumerate(dataset.items()):
            assert np.abs(volume[...] - values(number)).max() <= bounds[name]
            assert volume.coords["x"].name == ("lon_u" if name == "u" else "lon")
            assert report["variables"][name]["bytes"] == volume.container.size
            assert report["variables"][name]["stages"]
        assert len(dataset.container.arrays) == 5 + 3
    sizes = [report["variables"][name]["bytes"] for name in bounds]
    assert sizes == sorted(sizes)


def test_the_file_is_a_dataset_of_xarray(tmp_path: Path, source: Path) -> None:
    path, config = tmp_path / "run.fhz", EncodeConfig(effort=1, max_error=0.01)
    masked = EncodeConfig(effort=1, features=("interval:0.9:1.1",), dilation=0)
    fhash_codec.encode_dataset(source, path, {"u": config, "v": config, "z": masked})
    for consolidated in (None, True, False):
        store = zarr.storage.ZipStore(path, mode="r")
        with (
            warnings.catch_warnings(),
            xarray.open_zarr(store, consolidated=consolidated) as shown,
            opened(path) as dataset,
            xarray.open_dataset(source) as original,
        ):
            warnings.simplefilter("error")
            for name in ("u", "v"):
                np.testing.assert_array_equal(shown[name], dataset[name][...])
                assert shown[name].dims == original[name].dims
                assert shown[name].attrs == original[name].attrs
                for dimension in shown[name].dims:
                    np.testing.assert_array_equal(shown[dimension], original[dimension])
            z, y, x = (slice(low, high) for low, high in dataset["z"].box)
            np.testing.assert_array_equal(shown["z"], dataset["z"][:, z, y, x])
            whole = [n == m for n, m in zip(shown["z"].shape, SHAPE, strict=True)]
            names = [name in original.dims for name in shown["z"].dims]
            assert names == whole
            assert not all(whole)
        store.close()


def test_arrays_in_memory_and_datasets_of_xarray(tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    report = fhash_codec.encode_dataset(data(), path, QUICK)
    assert list(report["variables"]) == ["u", "v", "z"]
    with opened(path) as dataset:
        assert dataset["v"].units == "m s-1"
        assert dict(dataset.attributes) == {"title": "a run"}
    fhash_codec.encode_dataset({"b": values(0), "a": values(1)}, path, QUICK, force=True)
    with opened(path) as dataset:
        assert [(name, volume.name) for name, volume in dataset.items()] == [("b", "b"), ("a", "a")]


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, source: Path) -> None:
    for name in ("a.fhz", "b.fhz"):
        fhash_codec.encode_dataset(source, tmp_path / name, QUICK, variables=["z", "u"])
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()
    with opened(tmp_path / "a.fhz") as dataset:
        assert list(dataset) == ["z", "u"]


def test_profiles_mix(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    path, arrays = tmp_path / "run.fhz", {"a": values(0), "b": values(1)}
    paper = EncodeConfig(profile="paper", epochs=2, width=4, timings=False)
    fhash_codec.encode_dataset(arrays, path, {"a": paper, "b": QUICK})
    fhash_codec.encode(arrays["a"], tmp_path / "a.fhz", paper)
    with opened(path) as dataset, fhash_codec.open(tmp_path / "a.fhz") as alone:
        np.testing.assert_array_equal(dataset["a"][...], alone[...])
        # Embeddings are no values, and are not shown as such.
        assert "a" not in dataset.container.arrays
        assert "b" in dataset.container.arrays
    assert [each.name for each in tmp_path.iterdir() if "checkpoint" in each.name] == []


@pytest.mark.parametrize("ratio", [5, 12])
@pytest.mark.filterwarnings("ignore:.*no step of the quantiser comes nearer")
def test_a_promised_ratio_holds_for_the_whole_file(tmp_path: Path, ratio: int) -> None:
    rng = np.random.default_rng(0)
    arrays = {name: values(n) + rng.normal(0, 0.1, SHAPE) for n, name in enumerate("ab")}
    big = {name: np.tile(a, (2, 2, 2, 2)).astype(np.float32) for name, a in arrays.items()}
    config = EncodeConfig(effort=1, ratio=ratio)
    report = fhash_codec.encode_dataset(big, tmp_path / "run.fhz", config)
    assert report["ratio"] >= ratio


def test_a_missed_promise_names_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, arrays = tmp_path / "run.fhz", {"a": values(0), "b": values(1)}
    path.write_bytes(b"older")
    monkeypatch.setattr(
        "fhash_codec.encoding.missed_promise",
        lambda config, figures: "too bad" if config.psnr == 41 else None,
    )
    configs = {"a": QUICK, "b": EncodeConfig(effort=1, psnr=41)}
    with pytest.raises(QualityError, match=r"b: too bad; it is kept, the new file is") as caught:
        fhash_codec.encode_dataset(arrays, path, configs, force=True)
    assert path.read_bytes() == b"older"
    written = Path(caught.value.figures["path"])
    assert written == tmp_path / "run.missed.fhz"
    with opened(written) as dataset:
        assert list(dataset) == ["a", "b"]


class Lazy(Mapping[str, ArraySeries]):
    """Series that are made as they are asked for, and a record of those that are alive then."""

    def __init__(self) -> None:
        self.made: list[weakref.ref[Any]] = []
        self.alive: list[int] = []

    def __getitem__(self, name: str) -> ArraySeries:
        gc.collect()
        self.alive.append(sum(ref() is not None for ref in self.made))
        array = values("abcd".index(name))
        self.made.append(weakref.ref(array))
        return ArraySeries(array, name=name)

    def __iter__(self) -> Iterator[str]:
        return iter("abcd")

    def __len__(self) -> int:
        return 4


def test_no_variable_is_held_with_the_next_one(tmp_path: Path) -> None:
    lazy = Lazy()
    fhash_codec.encode_dataset(lazy, tmp_path / "run.fhz", QUICK)
    assert len(lazy.alive) == 2 * len(lazy)
    # The last one that was only looked at may still be there.
    assert max(lazy.alive) == 0


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown variable": ({"variables": ["u", "q"]}, "no variable 'q'"),
    "a variable twice": ({"variables": ["u", "u"]}, "different names"),
    "settings of no variable": ({"config": {"q": QUICK}}, "none of the variables u, v, z"),
    "a variable of one axis": ({"variables": ["u", "number"]}, "number"),
    "a name of a data file": ({"path": "run.nc"}, "a container is not a .nc file"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_requests_are_refused_before_the_work(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    options, message = BAD[case]
    monkeypatch.setattr("fhash_codec.dataset_encoding.encode_variable", None)
    path = tmp_path / options.pop("path", "run.fhz")
    with pytest.raises(InputError, match=message):
        fhash_codec.encode_dataset(source, path, **options)
    assert list(tmp_path.iterdir()) == []


def test_an_older_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes(b"older")
    with pytest.raises(OutputExistsError):
        fhash_codec.encode_dataset({"a": values(0)}, path)
    with pytest.raises(InputError, match="no variable 'b'"):
        fhash_codec.encode_dataset({"a": values(0)}, path, variables=["b"], force=True)
    assert path.read_bytes() == b"older"


def test_variables_that_need_a_choice_are_left_out(source: Path) -> None:
    listed = list_variables(source)
    assert encodable(listed) == (["u", "v", "z"], ["number"])
    assert encodable(listed, selected=1) == ([], ["u", "v", "z", "number"])
