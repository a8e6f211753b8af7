"""A container of the blobs, and everything that is measured of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from blobs import axes, field

import fhash_codec
from fhash_bench.pictures import shell, vtk
from fhash_bench.pictures.render import bench_render
from fhash_bench.pictures.results import RenderBench
from fhash_codec import EncodeConfig, Volume
from fhash_codec.rendering.scenes import Scene
from fhash_formats.series import ArraySeries


@pytest.fixture(scope="session")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Volume]:
    """An open container of the blobs."""
    path = tmp_path_factory.mktemp("blobs") / "blobs.fhz"
    series = ArraySeries(field(), name="density", units="", coords=axes())
    fhash_codec.encode(series, path, EncodeConfig(effort=1, max_error=0.002))
    with fhash_codec.open(path) as opened:
        yield opened


@pytest.fixture(scope="session")
def result(volume: Volume) -> RenderBench:
    """Every part measured once, with small pictures where their size is fixed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shell, "SIDE", 40)
        patch.setattr(vtk, "FINE_SIZE", 64)
        patch.setattr(vtk, "EXPLAINED_SIZE", 48)
        return bench_render(volume, Scene(step=1.0), size=24, turns=1)
