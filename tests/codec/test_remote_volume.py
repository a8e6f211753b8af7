"""Volumes of files elsewhere: counted requests and bytes, and the values of the file at hand."""

from __future__ import annotations

import io
import pickle
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fhash_codec
from fhash_codec import EncodeConfig, InputError


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A container of noise, which makes large tiles: 12 of 1 x 16 x 16 x 16."""
    noise = np.random.default_rng(1).normal(size=(2, 16, 32, 48)).astype(np.float32)
    path = tmp_path_factory.mktemp("remote") / "noise.fhz"
    config = EncodeConfig(effort=1, max_error=1e-6, tile="1x16x16x16", without=("ssim",))
    fhash_codec.encode(noise, path, config)
    return path


@pytest.fixture
def url(path: Path, range_server) -> str:
    return range_server.put("noise.fhz", path.read_bytes())


def test_requests_and_bytes(path, url, range_server) -> None:
    """The limits that docs/remote.md promises."""
    with fhash_codec.open(path) as here, fhash_codec.open(url) as volume:
        assert here.container.size > 120_000
        assert here.chunks == (1, 16, 16, 16)
        requests, size = range_server.taken()
        assert requests <= 3
        assert size <= 64_000
        tile = (0, slice(0, 16), slice(16, 32), slice(16, 32))
        assert_array_equal(volume[tile], here[tile])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= 16_000
        assert_array_equal(volume[tile], here[tile])
        assert range_server.taken() == (0, 0)
        assert_array_equal(volume[1], here[1])
        requests, size = range_server.taken()
        assert requests == 1
        assert size <= here.container.size / 2
        assert_array_equal(volume[:], here[:])
        assert range_server.taken()[0] <= 2
        assert volume.verify() == here.verify()
        volume.close()


def test_levels_of_detail_ask_for_all_tiles_at_once(path, url, range_server) -> None:
    with fhash_codec.open(path) as here, fhash_codec.open(url) as volume:
        range_server.taken()
        assert_array_equal(volume.read_lod(0, 2), here.read_lod(0, 2))
        assert range_server.taken()[0] == 1
        assert_array_equal(volume.tables[1][0, :8, :8, :8, 0], here.tables[1][0, :8, :8, :8, 0])


@pytest.mark.parametrize("profile", ["paper", "compact"])
def test_both_profiles_equal_the_file_at_hand(encoded, path, range_server, profile) -> None:
    path = encoded[1] if profile == "paper" else path
    url = range_server.put("run.fhz", path.read_bytes())
    with fhash_codec.open(path) as here, fhash_codec.open(url) as volume:
        assert range_server.taken()[0] <= 3
        assert_array_equal(volume[:], here[:])
        points = {"t": [0.5], "z": [2.2], "y": [7.7], "x": [9.1]}
        assert_array_equal(volume.sample(**points), here.sample(**points))
        assert {**volume.info, "path": ""} == {**here.info, "path": ""}
        assert volume.describe()


def test_a_file_that_changes_is_noticed(path, url, range_server) -> None:
    data = path.read_bytes()
    with fhash_codec.open(url) as volume:
        assert np.isfinite(volume[0, 0, :4, :4]).all()
        range_server.put("noise.fhz", data[::-1])
        with pytest.raises(InputError, match="the file changed since it was opened; open it again"):
            volume[1]


def test_a_volume_of_a_url_pickles_with_its_options(path, range_server) -> None:
    range_server.token = "Bearer 1"
    url = range_server.put("run.fhz", path.read_bytes())
    options = {"headers": {"Authorization": "Bearer 1"}}
    with fhash_codec.open(url, fill=-1.0, storage_options=options) as volume:
        assert volume.path == url
        assert url in repr(volume)
        data = pickle.dumps(volume)
        with pickle.loads(data) as copy:
            assert_array_equal(copy[0, 0], volume[0, 0])
            assert copy.fill == -1.0
    range_server.put("run.fhz", path.read_bytes()[:-1])
    with pytest.raises(fhash_codec.FhashError):
        pickle.loads(data)


def test_a_pickled_volume_is_not_another_file(path, encoded, tmp_path) -> None:
    place = tmp_path / "run.fhz"
    place.write_bytes(path.read_bytes())
    with fhash_codec.open(place) as volume:
        data = pickle.dumps(volume)
    place.write_bytes(encoded[1].read_bytes())
    with pytest.raises(InputError, match="another file is there than was opened before"):
        pickle.loads(data)


def test_open_files(path) -> None:
    with fhash_codec.open(path) as here, open(path, "rb") as file:
        with fhash_codec.open(file) as volume, fhash_codec.open(io.BytesIO(path.read_bytes())) as b:
            assert_array_equal(volume[1], here[1])
            assert_array_equal(b[1], here[1])
            with pytest.raises(InputError, match="open it by its path or URL"):
                pickle.dumps(volume)
        assert not file.closed
