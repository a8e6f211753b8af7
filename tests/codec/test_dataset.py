"""`Dataset`: volumes by name, closed together, that pickle by their path; and `open`."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import Dataset, EncodeConfig, InputError, Volume
from fhash_codec.volume import open as open_volume

Arrays = dict[str, npt.NDArray[np.float32]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Arrays, Path]:
    """Two arrays, and the path of the container of both."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 4, 9, 12)), indexing="ij")
    arrays = {
        "v": np.sin(5 * x + t).astype(np.float32),
        "a/u": (np.cos(4 * y) * z).astype(np.float32),
    }
    path = tmp_path_factory.mktemp("dataset") / "run.fhz"
    fhash_codec.encode_dataset(arrays, path, EncodeConfig(effort=1, max_error=0.01))
    return arrays, path


def test_a_dataset_is_a_mapping_of_volumes(run: tuple[Arrays, Path]) -> None:
    arrays, path = run
    with fhash_codec.open(path) as dataset:
        assert isinstance(dataset, Dataset)
        assert isinstance(dataset, Mapping)
        assert (list(dataset), len(dataset), "v" in dataset, "w" in dataset) == (
            ["v", "a/u"],
            2,
            True,
            False,
        )
        assert repr(dataset) == f"<fhash Dataset v, a/u of {path}>"
        for name, volume in dataset.items():
            assert (volume.variable, volume.name, volume.shape) == (name, name, (3, 4, 9, 12))
            assert dataset[name] is volume
            np.testing.assert_allclose(volume[...], arrays[name], atol=0.01)
        assert dataset.verify() == len(dataset.container.arrays)
        with pytest.raises(KeyError, match="no variable 'w'; it holds v, a/u"):
            dataset["w"]
        dataset["v"].close()
        assert dataset["a/u"][0].shape == (4, 9, 12)
    with pytest.raises(InputError, match="closed"):
        dataset["v"].container.arrays["coords/x"].read()


def test_one_variable_is_opened_by_name(run: tuple[Arrays, Path]) -> None:
    arrays, path = run
    for opened in (open_volume(path, variable="a/u"), fhash_codec.open(path, variable="a/u")):
        assert isinstance(opened, Volume)
        with opened as volume:
            np.testing.assert_allclose(volume[...], arrays["a/u"], atol=0.01)
        with pytest.raises(InputError, match="closed"):
            volume.container.arrays["coords/x"].read()
    with pytest.raises(InputError, match=r"several variables, v, a/u; choose one"):
        open_volume(path)
    for opening in (open_volume, fhash_codec.open):
        with pytest.raises(InputError, match="no variable 'w'; it holds v, a/u"):
            opening(path, variable="w")


def test_a_file_of_one_variable_knows_its_name(tmp_path: Path, run: tuple[Arrays, Path]) -> None:
    path = tmp_path / "one.fhz"
    fhash_codec.encode(run[0]["v"], path, EncodeConfig(effort=1))
    with fhash_codec.open(path) as volume, fhash_codec.open(path, variable="values") as same:
        assert isinstance(volume, Volume)
        assert isinstance(same, Volume)
        assert volume.variable is None
        np.testing.assert_array_equal(volume[...], same[...])
    with pytest.raises(InputError, match="no variable 'v'; it holds values"):
        fhash_codec.open(path, variable="v")


def test_datasets_and_their_volumes_pickle_by_path(run: tuple[Arrays, Path]) -> None:
    _, path = run
    with fhash_codec.open(path, fill=-1) as dataset:
        again = pickle.loads(pickle.dumps(dataset))
        volume = pickle.loads(pickle.dumps(dataset["a/u"]))
        with again, volume:
            assert list(again) == list(dataset)
            assert (again["v"].fill, volume.fill, volume.variable) == (-1, -1, "a/u")
            np.testing.assert_array_equal(volume[1], dataset["a/u"][1])


def test_what_is_told_of_a_variable_is_its_own(run: tuple[Arrays, Path]) -> None:
    _, path = run
    with fhash_codec.open(path) as dataset:
        infos = {name: volume.info for name, volume in dataset.items()}
        assert sum(info["bytes"] for info in infos.values()) < path.stat().st_size
        assert infos["v"]["ratio"] == infos["v"]["raw_bytes"] / infos["v"]["bytes"]
        assert "v" in infos["v"]["arrays"]
        assert "a_u" in infos["a/u"]["arrays"]
        assert dataset["a/u"].describe()["tables"][0]["path"] == "a_u"
