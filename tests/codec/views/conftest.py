"""Containers to view: a whole one, one of a feature, one with gaps, a damaged one."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.views import view as chunking
from fhash_formats.series import ArraySeries, Coordinate

sys.path.insert(0, str(Path(__file__).parent))


GOLDEN = Path(__file__).resolve().parents[2] / "golden"
LABELS = GOLDEN / "compact-labels.fhz"
"""Integers whose missing values are -100, in a box that begins at vertex 2 along x."""
COUNTS = GOLDEN / "compact-counts.fhz"
PAPER = GOLDEN / "paper-sparse.fhz"


def coordinates(shape: tuple[int, ...]) -> dict[str, Coordinate]:
    """Dates, heights, latitudes from north to south, and even longitudes."""
    t, z, y, x = shape
    return {
        "t": Coordinate(
            name="time",
            values=np.arange(t) * 6.0,
            attributes={"units": "hours since 2001-02-03", "calendar": "standard"},
        ),
        "z": Coordinate(name="height", values=np.arange(z) * 250.0, attributes={"units": "m"}),
        "y": Coordinate(
            name="lat", values=60.0 - np.arange(y) * 0.5, attributes={"units": "degrees_north"}
        ),
        "x": Coordinate(name="lon", values=np.arange(x) * 0.5, attributes={}),
    }


def blob(shape: tuple[int, ...] = (4, 10, 24, 44)) -> np.ndarray:
    """A blob that moves along x, (t, z, y, x) float32."""
    t, z, y, x = np.meshgrid(*map(np.arange, shape), indexing="ij", sparse=True)
    distance = 9 * (z - 4.5) ** 2 + (y - 11.3) ** 2 + (x - 22.1 - 2 * t) ** 2
    return np.exp(-distance / 160).astype(np.float32)


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container whose box is the domain, in tiles of 2 x 5 x 12 x 11 vertices."""
    path = tmp_path_factory.mktemp("view") / "whole.fhz"
    series = ArraySeries(blob(), name="density", units="kg m-3", coords=coordinates(blob().shape))
    series.attributes = {"standard_name": "air_density", "scale_factor": 2.0, "note": "é"}
    fhash_codec.encode(series, path, EncodeConfig(effort=1, psnr=30.0, tile="2x5x12x11"))
    return path


@pytest.fixture(scope="session")
def feature(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of a feature: its box begins within the domain, and has holes."""
    path = tmp_path_factory.mktemp("view") / "feature.fhz"
    series = ArraySeries(blob(), name="density", units="kg m-3", coords=coordinates(blob().shape))
    config = EncodeConfig(effort=1, psnr=30.0, tile="2x5x7x9", features=("interval:0.6:2",))
    fhash_codec.encode(series, path, config)
    with fhash_codec.open(path) as volume:
        assert all(volume.box.first)
        assert max(volume.box.shape) > 16
    return path


@pytest.fixture(scope="session")
def gappy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of a series with missing values."""
    path = tmp_path_factory.mktemp("view") / "gappy.fhz"
    values = blob((2, 5, 20, 20))
    values[0, 1, 3:7, 5:9] = np.nan
    fhash_codec.encode(values, path, EncodeConfig(effort=1, psnr=30.0))
    return path


@pytest.fixture
def apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small tiles that are not joined, so that small files have several chunks."""
    monkeypatch.setattr(chunking, "FEW_BYTES", 0)


@pytest.fixture
def damaged(whole: Path, tmp_path: Path) -> Path:
    """A copy of `whole` with one bit of its first tile flipped; the metadata are sound."""
    with fhash_codec.open(whole) as volume:
        offset, _ = volume.container.arrays["table_1"].place((0, 0, 0, 0))
    data = bytearray(whole.read_bytes())
    data[offset + 8] ^= 1
    path = tmp_path / "damaged.fhz"
    path.write_bytes(data)
    return path
