"""`Dataset`: volumes by name, closed together, that pickle by their path; and `open`."""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from cf_files import smooth

import fhash_codec
from fhash_codec import Dataset, EncodeConfig, InputError, Volume
from fhash_codec import dataset as shared_volumes
from fhash_codec.dataset import acquire, release, volumes_of
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError as InputError_shared_volumes
from fhash_formats.errors import MissingInputError

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


def test_datasets_and_their_volumes_pickle_by_path(run: tuple[Arrays, Path]) -> None:
    _, path = run
    with fhash_codec.open(path, fill=-1) as dataset:
        again = pickle.loads(pickle.dumps(dataset))
        volume = pickle.loads(pickle.dumps(dataset["a/u"]))
        with again, volume:
            assert list(again) == list(dataset)
            assert (again["v"].fill, volume.fill, volume.variable) == (-1, -1, "a/u")
            np.testing.assert_array_equal(volume[1], dataset["a/u"][1])


QUICK = EncodeConfig(effort=1, psnr=30, without=("ssim",))


@pytest.fixture(scope="module")
def run_shared_volumes(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("shared") / "run.fhz"
    fhash_codec.encode(smooth(2, 4, 5, 6), path, QUICK)
    return path


def test_a_file_is_opened_once(run_shared_volumes: Path) -> None:
    first, second = acquire(str(run_shared_volumes)), acquire(str(run_shared_volumes))
    assert first is second
    assert list(first.volumes) == ["values"]
    assert first.is_of_this_process()
    with volumes_of(str(run_shared_volumes))["values"] as other:
        assert other is not first.volumes["values"]


def test_the_last_user_closes_it(run_shared_volumes: Path) -> None:
    handle = acquire(str(run_shared_volumes))
    volume = handle.volumes["values"]
    release(handle)
    volume.read(0)
    del handle
    with pytest.raises(InputError_shared_volumes, match="closed"):
        volume.container.verify()


def test_another_state_of_the_file_is_another_volume(
    tmp_path: Path, run_shared_volumes: Path
) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes(run_shared_volumes.read_bytes())
    handle = acquire(str(path))
    assert acquire(str(path), None, handle.digest) is handle
    fhash_codec.encode(smooth(3, 4, 5, 6), path, QUICK, force=True)
    assert acquire(str(path)).volumes["values"].shape == (3, 4, 5, 6)
    with pytest.raises(InputError_shared_volumes, match="another file"):
        acquire(str(path), None, handle.digest)


def test_few_files_stay_open(run_shared_volumes: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(shared_volumes, "KEPT", 2)
    for number in range(4):
        path = tmp_path / f"{number}.fhz"
        path.write_bytes(run_shared_volumes.read_bytes())
        acquire(str(path))
    assert len(shared_volumes._kept) == 2
    assert len(shared_volumes._open) <= 3


def test_a_forked_process_opens_the_file_again(run_shared_volumes: Path, monkeypatch) -> None:
    handle = acquire(str(run_shared_volumes))
    parent = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: parent + 1)
    assert not handle.is_of_this_process()
    assert acquire(str(run_shared_volumes)) is not handle


def test_a_missing_file_is_said_to_be_missing(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError):
        acquire(str(tmp_path / "none.fhz"))
