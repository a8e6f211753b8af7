"""Tiles of a volume in the dimensions of an array of Zarr."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from coded_stores import dataset, write

import fhash_codec
from fhash_codec.views.unpack import ChunkTable
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries

pytestmark = pytest.mark.filterwarnings("ignore:.*Zarr format 3 specification")


@pytest.mark.parametrize(
    ("dimensions", "chunk", "axes"),
    [
        (("time", "level", "lat", "lon"), (2, 3, 4, 4), None),
        (("time", "lat", "lon"), (2, 4, 4), None),
        (("lon", "time", "lat"), (4, 2, 4), None),
        (("lat", "lon", "level", "time"), (4, 4, 3, 2), None),
    ],
)
def test_chunks_have_the_dimensions_of_the_source(
    tmp_path: Path, dimensions: tuple[str, ...], chunk: tuple[int, ...], axes: list[str] | None
) -> None:
    lengths = {"time": 2, "level": 3, "lat": 4, "lon": 4}
    run = tmp_path / "run.fhz"
    store = write(tmp_path, dataset(dimensions), dask={name: lengths[name] for name in dimensions})
    fhash_codec.pack(store, run)
    with fhash_codec.open(run) as volume:
        table = ChunkTable(volume)
        assert tuple(table.outline.dimensions) == dimensions
        assert table.chunk == chunk
        assert table.shard is not None
        # What the codec of the store took for z, y, x is so again.
        assert table.codec.axes is axes
        assert table.codec.reading
        assert len(table.stream([0] * len(dimensions))) > 10
        assert table.fill is None


def test_a_made_up_axis_is_left_out_and_the_codec_says_so(tmp_path: Path) -> None:
    data = dataset(("time", "lat", "lon"))
    data.to_netcdf(tmp_path / "run.nc", engine="h5netcdf")
    run = tmp_path / "run.fhz"
    config = fhash_codec.EncodeConfig(max_error=0.1, effort=1, tile="2x1x4x4")
    fhash_codec.encode(tmp_path / "run.nc", run, config)
    with fhash_codec.open(run) as volume:
        table = ChunkTable(volume)
        assert table.chunk == (2, 4, 4)
        assert table.codec.axes == ("t", "y", "x")


def test_a_feature_is_refused(tmp_path: Path) -> None:
    run, values = tmp_path / "run.fhz", dataset().u.values
    mask = np.zeros(values.shape, bool)
    mask[:, 1:4, 2:5, 2:5] = True
    config = fhash_codec.EncodeConfig(max_error=0.1, effort=1, dilation=0)
    fhash_codec.encode(ArraySeries(values), run, config, mask=mask)
    with fhash_codec.open(run) as volume, pytest.raises(InputError, match="a part of its domain"):
        ChunkTable(volume)
