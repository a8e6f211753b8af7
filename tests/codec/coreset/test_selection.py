"""Sources as series, and what the settings select of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.selection import open_source, select_features
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.series import ArraySeries, Coordinate

VALUES = np.random.default_rng(0).random((3, 4, 5, 6))


def test_files_series_and_arrays_are_sources(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", VALUES)
    series = ArraySeries(VALUES)
    for source in (tmp_path / "a.npy", str(tmp_path / "a.npy"), series, VALUES, VALUES.tolist()):
        with open_source(source) as opened:
            assert opened.shape == VALUES.shape
            np.testing.assert_array_equal(opened.read(2), VALUES[2])
    with open_source(series) as opened:
        assert opened is series


def test_a_mask_replaces_all_and_joins_named_features() -> None:
    mask = VALUES[0] > 0.8
    series = ArraySeries(VALUES)
    alone = select_features(series, EncodeConfig(dilation=0), silent, mask)
    assert [str(feature) for feature in alone.features] == ["mask:array"]
    assert alone.extent.samples == 3 * mask.sum()
    config = EncodeConfig(dilation=0, features=("interval:0:0.1",))
    joined = select_features(series, config, silent, mask)
    assert [str(feature) for feature in joined.features] == ["mask:array", "interval:0:0.1"]
    assert joined.extent.samples == (mask | (VALUES <= 0.1)).sum()
    with pytest.raises(InputError, match="mask has shape"):
        select_features(series, EncodeConfig(), silent, mask[1:])


def test_times_that_are_no_axis_are_warned_of() -> None:
    times = Coordinate(name="time", values=np.array([0.0, 2.0, 2.0]))
    series = ArraySeries(VALUES, coords={"t": times})
    with pytest.warns(FhashWarning, match="step numbers stand for them"):
        selection = select_features(series, EncodeConfig(), silent)
    assert selection.extent.key_frames == (0, 1, 2)
    assert selection.scanned.finite_count == VALUES.size


@pytest.mark.parametrize(
    ("dims", "shape"),
    [
        (("time", "lat", "lon"), (3, 1, 4, 5)),
        (("lev", "lat", "lon"), (1, 3, 4, 5)),
        (("lon", "lat", "time"), (5, 1, 4, 3)),
        (("a", "b", "c"), (1, 3, 4, 5)),
    ],
)
def test_the_axes_of_a_labelled_array_are_those_of_its_names(
    dims: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    values = np.arange(60.0).reshape(3, 4, 5)
    coords = {dim: np.arange(float(n)) + 7 for dim, n in zip(dims, values.shape, strict=True)}
    labelled = xr.DataArray(values, dims=dims, coords=coords)
    with open_source(labelled) as series:
        assert series.shape == shape
        names = [series.coords[axis].name for axis in "tzyx"]
        assert set(dims) <= set(names)
        axis = "tzyx"[names.index(dims[0])]
        assert series.coords[axis].values.tolist() == [7, 8, 9]
        stored = np.stack(list(series.frames()))
    order = [dims.index(name) for name in names if name in dims]
    np.testing.assert_array_equal(stored, values.transpose(order).reshape(shape))


def test_a_labelled_array_of_members_is_refused_with_the_selection() -> None:
    labelled = xr.DataArray(np.zeros((2, 3, 4, 5)), dims=("member", "time", "lat", "lon"))
    with pytest.raises(InputError, match=r"array\.isel\(member=0\)"), open_source(labelled):
        pass
    with open_source(labelled.isel(member=0)) as series:
        assert series.shape == (3, 1, 4, 5)


def test_a_missing_time_is_replaced_by_the_steps() -> None:
    time = Coordinate(name="time", values=np.array([0, 1, np.nan]), attributes={"units": "s"})
    series = ArraySeries(np.zeros((3, 4, 5, 6)), coords={"t": time})
    told = pytest.warns(FhashWarning, match="time at step 2; step numbers stand")
    with told, open_source(series) as opened:
        assert opened.coords["t"].values.tolist() == [0, 1, 2]
