"""Encoding on a cluster: the file of one encoding, byte for byte, or one line and no file."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import ClusterError, EncodeConfig, InputError
from fhash_codec.appending import cluster as rooms
from fhash_codec.appending import series_plan
from fhash_codec.appending.cluster import HeldSteps
from fhash_codec.compact import encode
from fhash_codec.compact import tiles as blocks
from fhash_formats.errors import OutputExistsError
from fhash_formats.series import ArraySeries

SHAPE = (9, 6, 8, 10)


def values() -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    noise = np.random.default_rng(0).random(SHAPE)
    return (np.sin(6 * x + 2 * t) * np.cos(5 * y) + z + 0.05 * noise).astype(np.float32)


def settings(**options) -> EncodeConfig:
    given = {"max_error": 0.02, "effort": 1, "tile": "2x6x8x5", **options}
    return EncodeConfig(**given, timings=False)


class Threads:
    """A client of the threads of this process."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self.pool, self.futures = pool, []

    def submit(self, work, *arguments) -> Future:
        given = [each.result() if isinstance(each, Future) else each for each in arguments]
        self.futures.append(self.pool.submit(work, *given))
        return self.futures[-1]

    def compute(self, array) -> Future:
        return self.pool.submit(array.compute, scheduler="synchronous")

    def nthreads(self) -> dict[str, int]:
        return {"worker": 2}


@pytest.fixture
def threads():
    with ThreadPoolExecutor(2) as pool:
        yield Threads(pool)


@pytest.fixture(scope="module")
def client():
    """A client of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def saved(folder: Path, array: np.ndarray) -> Path:
    np.save(folder / "data.npy", array)
    return folder / "data.npy"


def labelled(array: np.ndarray, chunks: dict[str, int]):
    """A dask-backed array in another order of its axes, with coordinates."""
    xarray, _ = pytest.importorskip("xarray"), pytest.importorskip("dask")
    times = np.datetime64("2020-01-01", "ns") + np.arange(SHAPE[0]) * np.timedelta64(6, "h")
    coords = {
        "time": times,
        "lat": ("lat", np.linspace(-40, 40, SHAPE[2]), {"units": "degrees_north"}),
    }
    made = xarray.DataArray(
        array, dims=("time", "lev", "lat", "lon"), coords=coords, name="u", attrs={"units": "m s-1"}
    )
    made["lev"].attrs["axis"], made["lon"].attrs["axis"] = "Z", "X"
    return made.transpose("lat", "time", "lon", "lev").chunk(chunks)


def require_same(tmp_path: Path, source, client, config: EncodeConfig) -> dict:
    """Encode a source with and without a client; the files must be the same. The figures."""
    whole = fhash_codec.encode(source, tmp_path / "whole.fhz", config)
    figures = fhash_codec.encode(source, tmp_path / "run.fhz", config, client=client)
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    varying = ("path", "seconds", "stages")
    assert {key: value for key, value in figures.items() if key not in varying} == {
        key: value for key, value in whole.items() if key not in varying
    }
    assert not list(tmp_path.glob(".*"))
    return figures


CASES = {
    "bound": {},
    "trials and a feature": {"effort": 2, "features": ("change:0.2",)},
    "a relative bound": {"max_error": None, "max_error_rel": 0.01},
}


@pytest.mark.parametrize("case", CASES)
def test_workers_code_a_file_to_the_same_bytes(tmp_path, client, case) -> None:
    require_same(tmp_path, saved(tmp_path, values()), client, settings(**CASES[case]))


@pytest.mark.parametrize("case", CASES)
def test_workers_compute_the_frames_of_a_lazy_array(tmp_path, client, case) -> None:
    source = labelled(values(), {"time": 4, "lat": 3})
    require_same(tmp_path, source, client, settings(**CASES[case]))


def test_a_persisted_array_stays_on_the_workers(tmp_path, client) -> None:
    source = labelled(values(), {"time": 2}).persist()
    require_same(tmp_path, source.to_dataset(), client, settings())


def test_a_failure_of_a_worker_is_one_line(tmp_path, client) -> None:
    path = saved(tmp_path, values())
    hidden = path.with_name("hidden.npy")

    def hide(stage: str, done: int, total: int, note: str) -> None:
        if stage == "planning" and done == total and path.exists():
            os.replace(path, hidden)

    with pytest.raises(ClusterError, match=r"part 1/5 failed on the cluster: .*data\.npy") as error:
        fhash_codec.encode(path, tmp_path / "a.fhz", settings(), client=client, progress=hide)
    assert "\n" not in str(error.value)
    assert os.listdir(tmp_path) == ["hidden.npy"]


@pytest.mark.parametrize("older", [False, True])
def test_an_interruption_cancels_the_rest_and_leaves_no_file(tmp_path, threads, older) -> None:
    path, output = saved(tmp_path, values()), tmp_path / "a.fhz"
    if older:
        output.write_bytes(b"older")

    def stop(stage: str, done: int, total: int, note: str) -> None:
        if stage == "coding" and note == "parts":
            raise KeyboardInterrupt

    config = settings(tile="1x6x8x5")  # 8 parts
    with pytest.raises(KeyboardInterrupt):
        fhash_codec.encode(path, output, config, client=threads, force=older, progress=stop)
    assert len(threads.futures) == rooms.AHEAD * 2  # and none was begun after that
    assert all(future.done() or future.running() for future in threads.futures)
    assert sorted(os.listdir(tmp_path)) == (["a.fhz"] if older else []) + ["data.npy"]
    assert not older or output.read_bytes() == b"older"


def test_what_other_machines_cannot_read_is_refused(tmp_path, threads) -> None:
    output = tmp_path / "a.fhz"
    for source, options, message in (
        (values(), {}, "leave client out"),
        (ArraySeries(values()), {}, "leave client out"),
        (saved(tmp_path, values()), {"mask": np.ones(SHAPE)}, "feature mask:FILE"),
    ):
        with pytest.raises(InputError, match=message):
            fhash_codec.encode(source, output, settings(), client=threads, **options)
    for promise in ({"psnr": 40}, {"ratio": 10}, {}, {"profile": "paper"}):
        with pytest.raises(InputError, match="give max_error or max_error_rel"):
            fhash_codec.encode(
                tmp_path / "data.npy", output, EncodeConfig(**promise), client=threads
            )
    output.write_bytes(b"older")
    with pytest.raises(OutputExistsError):
        fhash_codec.encode(tmp_path / "data.npy", output, settings(), client=threads)
    assert not threads.futures


def test_held_steps_have_the_labels_of_the_whole() -> None:
    whole = ArraySeries(values(), name="u", units="m")
    held = HeldSteps(whole, whole=True).with_steps(3, values()[3:5])
    assert (held.shape, held.name, held.units) == (SHAPE, "u", "m")
    np.testing.assert_array_equal(held.read(4), values()[4])
    with pytest.raises(InputError, match="step 5 was not sent"):
        held.read(5)


@pytest.mark.parametrize("kind", ["values", "gaps", "integers", "constant"])
def test_a_long_series_is_scanned_on_the_cluster(tmp_path, threads, monkeypatch, kind) -> None:
    dask = pytest.importorskip("dask.array")
    for module in (rooms, series_plan, encode):
        monkeypatch.setattr(module, "fits_memory", lambda series: False)
    monkeypatch.setattr(blocks, "MAX_BYTES_IN_MEMORY", 1)
    array = values()
    if kind == "gaps":
        array[4, 2] = np.nan
    if kind == "integers":
        array = (100 * array).astype(np.int16)
    if kind == "constant":
        array[:] = 3
    monkeypatch.setattr(rooms, "PART_BYTES", 2 * array[0].nbytes)
    counts: list[tuple[int, int]] = []

    def watch(stage: str, done: int, total: int, note: str) -> None:
        if stage == "scanning":
            counts.append((done, total))

    require_same(tmp_path, dask.from_array(array, chunks=(4, 6, 8, 10)), threads, settings())
    source = dask.from_array(array, chunks=(4, 6, 8, 10))
    fhash_codec.encode(source, tmp_path / "again.fhz", settings(), client=threads, progress=watch)
    on_cluster = [(2, 9), (4, 9), (6, 9), (8, 9), (9, 9)]
    alone = [(step, 9) for step in range(1, 10)]
    assert counts == (on_cluster[:3] + alone if kind == "gaps" else on_cluster)


def test_extremes_that_nobody_declared_are_refused_on_the_cluster_too(
    tmp_path, threads, monkeypatch
) -> None:
    dask = pytest.importorskip("dask.array")
    monkeypatch.setattr(rooms, "fits_memory", lambda series: False)
    monkeypatch.setattr(rooms, "PART_BYTES", 1)
    array = values()
    array[[1, 7], 0] = 1e20
    with pytest.raises(InputError, match="give --missing 1e\\+20"):
        fhash_codec.encode(
            dask.from_array(array, chunks=3), tmp_path / "a.fhz", settings(), client=threads
        )
    assert not list(tmp_path.iterdir())
