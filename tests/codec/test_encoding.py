"""Encoding end to end: every kind of data comes back, quality is what the decoder returns, and nothing is lost on the way."""

from __future__ import annotations

import json
import os
import signal
import warnings
from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec import (
    EncodeConfig,
    FhashWarning,
    InputError,
    InterruptedEncodingError,
    OutputError,
    OutputExistsError,
    QualityError,
)
from fhash_codec.header import brief_history, brief_quality
from fhash_codec.paper.engines.slab import SlabEngine
from fhash_codec.paper.fhash import FHash
from fhash_codec.report import curve
from fhash_formats.container import Container
from fhash_formats.errors import TrainingError
from fhash_formats.series import ArraySeries

QUICK = EncodeConfig(profile="paper", epochs=6, width=16)
FAST = EncodeConfig(effort=1)
BOTH = pytest.mark.parametrize("config", [QUICK, FAST], ids=["paper", "compact"])


def field(shape=(4, 8, 10, 18), dtype=np.float32) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(dtype)


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


@BOTH
@pytest.mark.parametrize(
    "dtype",
    [
        "uint8",
        "int16",
        "uint16",
        "int32",
        "int64",
        "uint64",
        "float16",
        "float32",
        "float64",
        ">f4",
        ">i2",
        ">f8",
    ],
)
def test_every_number_type_comes_back(tmp_path, dtype, config):
    source = ((field() + 110) * 0.7).astype(dtype)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    assert back.dtype.kind == "f"
    assert figures["psnr"] > 20
    error = np.abs(back.astype(np.float64) - source.astype(np.float64))
    assert figures["max_abs_error"] == pytest.approx(error.max(), rel=1e-6)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.info["variable"]["dtype"] == np.dtype(dtype).newbyteorder("=").name


@BOTH
@pytest.mark.parametrize(
    "shape",
    [
        (1, 8, 10, 18),
        (4, 1, 10, 18),
        (4, 8, 1, 18),
        (4, 8, 10, 1),
        (2, 2, 2, 2),
        (1, 1, 1, 7),
        (3, 1, 1, 1),
        (1, 1, 1, 1),
        (7, 3, 5, 11),
    ],
)
def test_every_shape_comes_back(tmp_path, shape, config):
    source = np.random.default_rng(0).random(shape, dtype=np.float32)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    assert back.shape == shape
    assert np.isfinite(back).all()
    assert figures["max_abs_error"] == pytest.approx(np.abs(back - source).max(), rel=1e-5)


@BOTH
@pytest.mark.parametrize("value", [0.0, 7.25, -1e30, 1e8])
def test_a_constant_series_comes_back_exactly(tmp_path, value, config):
    figures = fhash_codec.encode(np.full((3, 4, 5, 6), value), tmp_path / "a.fhz", config)
    assert (decoded(tmp_path / "a.fhz") == value).all()
    assert figures["rmse"] == 0
    assert figures["psnr"] is None


def test_missing_values_stay_out_of_range_coreset_and_figures(tmp_path):
    source = field()
    holes = np.random.default_rng(0).random(source.shape) < 0.1
    holes[1] = True
    source[holes] = np.random.default_rng(1).choice([np.nan, np.inf, -np.inf], holes.sum())
    for settings in ({}, {"key_frames": "0,3"}, {"features": ("interval:50:300",)}):
        config = EncodeConfig(profile="paper", epochs=30, width=16, **settings)
        figures = fhash_codec.encode(source, tmp_path / "a.fhz", config, force=True)
        assert np.isfinite(figures["rmse"])
        assert figures["psnr"] > 15
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert volume.info["value_range"] == [
                float(source[~holes].min()),
                float(source[~holes].max()),
            ]
            whole = volume[...]
            assert np.isnan(whole[holes]).all()
            filled = np.stack([volume.read(t, outside="background") for t in range(4)])
            np.testing.assert_array_equal(np.isnan(filled), holes)
            if not settings:
                np.testing.assert_array_equal(np.isnan(whole), holes)


def test_the_figures_are_those_of_the_file(tmp_path):
    source = field()
    config = EncodeConfig(profile="paper", features=("interval:50:200",), epochs=8, width=16)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz").astype(np.float64)
    inside = np.isfinite(back)
    error = (back - source)[inside]
    span = float(source.max()) - float(source.min())
    assert figures["rmse"] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-6)
    assert figures["psnr"] == pytest.approx(
        20 * np.log10(span / np.sqrt((error**2).mean())), abs=1e-4
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        everywhere = np.where(inside, back, volume.background) - source
        assert volume.background == pytest.approx(source[~inside].mean(), rel=1e-5)
        assert figures["psnr"] * (1 - 1e-5) <= volume.info["quality"]["psnr"] <= figures["psnr"]
    assert figures["psnr_domain"] == pytest.approx(
        20 * np.log10(span / np.sqrt((everywhere**2).mean())), abs=1e-4
    )
    assert figures["bytes"] == (tmp_path / "a.fhz").stat().st_size
    assert figures["ratio"] == source.nbytes / figures["bytes"]
    assert figures["coreset_fraction"] == pytest.approx(inside.mean())
    assert [point["epoch"] for point in figures["curve"]] == list(range(1, 9))
    json.dumps(figures, allow_nan=False)
    again = fhash_codec.diff(source, tmp_path / "a.fhz")
    for name in ("psnr", "rmse", "max_abs_error", "psnr_domain", "ssim", "bytes", "key_frames"):
        assert again[name] == figures[name], name


def test_figures_count_the_steps_between_key_frames(tmp_path):
    source = field((5, 6, 8, 10))
    figures = fhash_codec.encode(
        source,
        tmp_path / "a.fhz",
        EncodeConfig(profile="paper", key_frames="every:2", epochs=30, width=16),
    )
    steps = {point["step"]: point["psnr"] for point in figures["quality"]["per_step"]}
    assert sorted(steps) == [0, 1, 2, 3, 4]
    assert figures["key_frames"] == [0, 2, 4]
    assert min(steps[0], steps[2], steps[4]) > max(steps[1], steps[3])


@pytest.mark.parametrize(("tables", "loss"), [("float32", 0), ("float16", 1e-3), ("uint8", 0.05)])
def test_tables_are_stored_as_asked_and_cost_what_they_cost(tmp_path, tables, loss):
    source = field()
    exact = fhash_codec.encode(
        source,
        tmp_path / "exact.fhz",
        EncodeConfig(profile="paper", epochs=6, width=16, tables="float32"),
    )
    figures = fhash_codec.encode(
        source, tmp_path / "a.fhz", EncodeConfig(profile="paper", epochs=6, width=16, tables=tables)
    )
    span = float(np.ptp(source))
    assert (
        np.abs(decoded(tmp_path / "a.fhz") - decoded(tmp_path / "exact.fhz")).max() <= loss * span
    )
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.arrays["tables/level_1"].dtype == np.dtype(tables)
    assert (figures["bytes"] < 0.75 * exact["bytes"]) == (tables != "float32")


def test_the_file_decodes_to_what_the_torch_model_gives(tmp_path):
    import torch

    source = field()
    fhash_codec.encode(
        source,
        tmp_path / "a.fhz",
        EncodeConfig(profile="paper", epochs=6, width=16, tables="float32", key_frames="0,1,3"),
    )
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        network = volume._model.network
        from fhash_codec.paper.architecture import Architecture

        architecture = Architecture.for_box((8, 10, 18), 3, width=16)
        assert network.levels == architecture.levels
        tables = [
            torch.from_numpy(table.array.read().reshape(-1, 2)).double() for table in network.tables
        ]
        layers = [
            (torch.from_numpy(w).double(), torch.from_numpy(b).double()) for w, b in network.layers
        ]
        model = FHash(architecture, tables, layers)
        points = np.stack(
            np.meshgrid([0.0, 0.5, 1.0, 1.75, 2.0], range(8), range(10), range(18), indexing="ij"),
            axis=-1,
        )
        with torch.no_grad():
            unit = model(torch.from_numpy(points.reshape(-1, 4))).numpy().reshape(points.shape[:-1])
        low, high = volume.info["value_range"]
        expected = low + np.clip(unit, 0, 1) * (high - low)
        # Steps 0, 0.5, 1, 2.5 and 3: key indices 0, 0.5, 1, 1.75 and 2 with key frames 0, 1 and 3.
        for number, step in enumerate((0, 0.5, 1, 2.5, 3)):
            assert np.abs(volume.read(step) - expected[number]).max() <= 1e-5 * (high - low)


def test_the_same_input_gives_the_same_bytes_without_timings(tmp_path):
    config = EncodeConfig(profile="paper", epochs=3, width=16, timings=False)
    for name in ("a.fhz", "b.fhz"):
        fhash_codec.encode(field(), tmp_path / name, config)
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()
    fhash_codec.encode(
        field(),
        tmp_path / "c.fhz",
        EncodeConfig(profile="paper", epochs=3, width=16, timings=False, seed=1),
    )
    assert (tmp_path / "a.fhz").read_bytes() != (tmp_path / "c.fhz").read_bytes()


@pytest.mark.parametrize("moment", [1, 30, 48])
def test_ctrl_c_saves_and_the_same_call_goes_on_to_the_same_bytes(tmp_path, moment):
    config = EncodeConfig(profile="paper", epochs=3, width=16, timings=False)
    fhash_codec.encode(field(), tmp_path / "whole.fhz", config)
    path = tmp_path / "run.fhz"

    def interrupt(stage, done, total, note):
        assert stage != "training" or total == 48
        if stage == "training" and done == moment:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(InterruptedEncodingError, match="the same command goes on"):
        fhash_codec.encode(field(), path, config, progress=interrupt)
    assert not path.exists()
    assert len(list(tmp_path.glob("run.fhz.*.checkpoint"))) == 1
    fhash_codec.encode(field(), path, config)
    assert path.read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.fhz", "whole.fhz"]


WILD = EncodeConfig(
    profile="paper", epochs=3, hidden_layers=2, learning_rate=1.0, tables="float32", timings=False
)


def test_a_training_that_diverges_begins_again_at_a_lower_rate_and_says_so(tmp_path):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", FhashWarning)
        report = fhash_codec.encode(field(), tmp_path / "wild.fhz", WILD)
    assert report["restarts"] == len(told) >= 1
    assert "diverged in epoch 1" in str(told[0].message)
    assert "begins again at a learning rate of 0.25" in str(told[0].message)
    rate = 0.25 ** report["restarts"]
    with fhash_codec.open(tmp_path / "wild.fhz") as wild:
        assert wild.info["training"]["restarts"] == report["restarts"]
        assert wild.info["training"]["learning_rate"] == rate
        assert wild.info["config"]["learning_rate"] == 1.0
        values = wild[...]
    calm = fhash_codec.encode(field(), tmp_path / "calm.fhz", replace(WILD, learning_rate=rate))
    assert calm["restarts"] == 0
    assert report["curve"] == calm["curve"]
    with fhash_codec.open(tmp_path / "calm.fhz") as volume:
        assert "learning_rate" not in volume.info["training"]
        np.testing.assert_array_equal(volume[...], values)


def test_going_on_after_a_restart_gives_the_same_bytes(tmp_path):
    begun = 0

    def interrupt(stage, done, total, note):
        nonlocal begun
        begun += stage == "training" and done == 1
        if stage == "training" and begun > 1 and done == 20:
            os.kill(os.getpid(), signal.SIGINT)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        fhash_codec.encode(field(), tmp_path / "whole.fhz", WILD)
        with pytest.raises(InterruptedEncodingError):
            fhash_codec.encode(field(), tmp_path / "run.fhz", WILD, progress=interrupt)
    restarts = fhash_codec.encode(field(), tmp_path / "run.fhz", WILD)["restarts"]
    assert restarts >= 1
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()


@pytest.mark.filterwarnings("ignore::fhash_codec.FhashWarning")
def test_a_training_that_diverges_at_every_rate_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("fhash_codec.paper.training.train.DIVERGED", 0.0)
    with pytest.raises(TrainingError, match="diverged"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", replace(WILD, learning_rate=0.01))
    assert not list(tmp_path.iterdir())


def test_numbers_that_are_not_finite_are_never_written(tmp_path, monkeypatch):
    class Spoilt(SlabEngine):
        def parameters(self):
            found = super().parameters()
            found.coarse[-1] = float("nan")
            return found

    monkeypatch.setattr("fhash_codec.paper.engines.slab.SlabEngine", Spoilt)
    with pytest.raises(TrainingError, match="not finite"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", replace(WILD, learning_rate=0.01))
    assert not list(tmp_path.iterdir())


@BOTH
def test_ctrl_c_before_the_training_leaves_nothing(tmp_path, config):
    def interrupt(stage, done, total, note):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fhash_codec.encode(field(), tmp_path / "run.fhz", config, progress=interrupt)
    assert not list(tmp_path.iterdir())


@BOTH
def test_an_output_that_is_there_is_kept(tmp_path, config):
    path = tmp_path / "a.fhz"
    path.write_bytes(b"precious")
    with pytest.raises(OutputExistsError, match="--force"):
        fhash_codec.encode(field(), path, config)
    # A failure on the way leaves it alone even with force.
    with pytest.raises(InputError, match="selects nothing"):
        fhash_codec.encode(field(), path, EncodeConfig(features=("interval:1e6:2e6",)), force=True)
    assert path.read_bytes() == b"precious"
    fhash_codec.encode(field(), path, config, force=True)
    assert decoded(path).shape == field().shape


@BOTH
def test_a_missing_folder_is_named_before_any_work(tmp_path, config):
    with pytest.raises(OutputError, match="folder"):
        fhash_codec.encode(field(), tmp_path / "none" / "a.fhz", config)


def test_a_promise_that_is_missed_is_an_error_but_the_file_is_there(tmp_path):
    with pytest.raises(QualityError, match="150 dB were asked for; the file is written"):
        fhash_codec.encode(
            field(),
            tmp_path / "a.fhz",
            EncodeConfig(profile="paper", epochs=1, width=16, psnr=150.0),
        )
    assert decoded(tmp_path / "a.fhz").shape == field().shape
    figures = fhash_codec.encode(
        field(), tmp_path / "b.fhz", EncodeConfig(profile="paper", epochs=1, width=16, psnr=5.0)
    )
    assert figures["psnr"] > 5


def test_quality_improves_with_training(tmp_path):
    psnr = [
        fhash_codec.encode(field(), tmp_path / f"{n}.fhz", EncodeConfig(profile="paper", epochs=n))[
            "psnr"
        ]
        for n in (1, 5, 25)
    ]
    assert psnr[0] < psnr[1] < psnr[2]
    assert psnr[2] > 40


def test_diff_refuses_another_shape(encoded):
    with pytest.raises(InputError, match=r"shape \(4, 8, 10, 18\)"):
        fhash_codec.diff(ArraySeries(field()), encoded[1])


def test_a_deep_network_that_diverges_at_every_other_rate_is_trained_in_the_end(tmp_path):
    config = EncodeConfig(
        profile="paper",
        epochs=20,
        learning_rate=1.0,
        schedule="constant",
        hidden_layers=8,
        width=64,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        figures = fhash_codec.encode(field(), tmp_path / "a.fhz", config)
    assert figures["restarts"] > 1
    assert np.isfinite(figures["rmse"])


@BOTH
def test_the_input_is_never_replaced(tmp_path, config):
    np.save(tmp_path / "a.npy", field())
    kept = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "link.fhz").symlink_to("a.npy")
    for output in ("a.npy", "link.fhz"):
        with pytest.raises(
            InputError, match=r"a container is not a \.npy file|is the input itself"
        ):
            fhash_codec.encode(tmp_path / "a.npy", tmp_path / output, config, force=True)
    mask = tmp_path / "mask.fhz"
    np.save(tmp_path / "mask.npy", field() > 50)
    mask.symlink_to("mask.npy")
    with pytest.raises(InputError, match="is the input itself"):
        fhash_codec.encode(
            tmp_path / "a.npy",
            mask,
            EncodeConfig(features=(f"mask:{tmp_path / 'mask.npy'}",)),
            force=True,
        )
    assert (tmp_path / "a.npy").read_bytes() == kept


def test_a_mask_in_memory_is_a_feature(tmp_path):
    source = field()
    marked = source[0] > 50
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, dilation=0), mask=marked)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        np.testing.assert_array_equal(volume.occupancy(3), marked)
    both = EncodeConfig(effort=1, dilation=0, features=("interval:-300:-50",))
    fhash_codec.encode(source, tmp_path / "b.fhz", both, mask=source > 50)
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        np.testing.assert_array_equal(volume.occupancy(2), (source[2] > 50) | (source[2] <= -50))
    with pytest.raises(InputError, match="mask has shape"):
        fhash_codec.encode(source, tmp_path / "c.fhz", QUICK, mask=marked[1:])


@BOTH
def test_labelled_arrays_keep_their_labels(tmp_path, config):
    import xarray

    times = np.array(
        ["2000-01-01", "2000-01-02", "2000-01-04", "2000-01-05"], dtype="datetime64[s]"
    )
    labelled = xarray.DataArray(
        field(),
        dims=("time", "lev", "lat", "lon"),
        coords={"time": times, "lev": 2.0 * np.arange(8)},
        name="theta",
        attrs={"units": "K"},
    )
    fhash_codec.encode(labelled, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert (volume.name, volume.units, volume.coords["z"].name) == ("theta", "K", "lev")
        assert volume.coords["t"].attributes["units"] == "seconds since 1970-01-01"
        assert volume.step_of_time(946684800.0 + 2 * 86400) == 1.5
        np.testing.assert_array_equal(volume.coords["z"].values, 2.0 * np.arange(8))


# A float64 of that size is a multiple of 256: no decoded value can be nearer.
@pytest.mark.parametrize(
    "config", [QUICK, EncodeConfig(effort=1, psnr=10.0)], ids=["paper", "compact"]
)
def test_64_bit_integers_are_compared_exactly(tmp_path, config):
    source = 2**60 + np.arange(1344).reshape(4, 6, 7, 8)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    exact = [abs(int(a) - int(b)) for a, b in zip(source.ravel(), back.ravel(), strict=True)]
    assert figures["max_abs_error"] == max(exact)
    assert figures["rmse"] == pytest.approx((sum(e * e for e in exact) / len(exact)) ** 0.5)


def test_a_promise_cannot_hold_where_the_psnr_is_unknown(tmp_path):
    source = (2 * np.random.default_rng(0).random((2, 4, 5, 6)) - 1) * 1.7e308
    with pytest.raises(QualityError, match="an unknown PSNR"):
        fhash_codec.encode(
            source, tmp_path / "a.fhz", EncodeConfig(profile="paper", epochs=1, psnr=300.0)
        )
    figures = fhash_codec.encode(
        np.zeros((2, 4, 5, 6)),
        tmp_path / "b.fhz",
        EncodeConfig(profile="paper", epochs=1, psnr=300.0),
    )
    assert figures["rmse"] == 0


def test_a_failure_after_the_training_leaves_its_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr("fhash_codec.paper.training.fit.KEEP_SECONDS", 0.0)
    config = EncodeConfig(profile="paper", epochs=2, width=16, timings=False)
    fhash_codec.encode(field(), tmp_path / "whole.fhz", config)
    trained = []

    def interrupt(stage, done, total, note):
        trained.append(stage)
        if stage == "measuring":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fhash_codec.encode(field(), tmp_path / "run.fhz", config, progress=interrupt)
    trained.clear()
    fhash_codec.encode(
        field(), tmp_path / "run.fhz", config, progress=lambda stage, *rest: trained.append(stage)
    )
    assert "training" not in trained
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.fhz", "whole.fhz"]


def test_a_checkpoint_that_cannot_be_written_does_not_stop_the_training(tmp_path, monkeypatch):
    def full(*args):
        raise OutputError("no space left")

    monkeypatch.setattr("fhash_codec.paper.training.fit.KEEP_SECONDS", 0.0)
    monkeypatch.setattr("fhash_codec.paper.training.checkpoint.save_checkpoint", full)
    with pytest.warns(fhash_codec.FhashWarning, match="no checkpoint: no space left"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", QUICK)
    assert decoded(tmp_path / "a.fhz").shape == field().shape


def test_long_names_and_detours_in_paths_work(tmp_path):
    for path in (tmp_path / f"{'a' * 245}.fhz", tmp_path / "none" / ".." / "b.fhz"):
        fhash_codec.encode(
            field(), path, EncodeConfig(profile="paper", epochs=1, width=16, timings=False)
        )
    assert len(list(tmp_path.iterdir())) == 2


def test_settings_may_be_given_as_python_values():
    assert EncodeConfig(features="all").features == ("all",)
    assert EncodeConfig(profile="paper", key_frames=[0, 3]).key_frames == "0,3"
    with pytest.raises(InputError, match="mask="):
        EncodeConfig(features=(np.ones(3, bool),))


def test_figures_in_a_file_are_brief_and_never_better_than_they_are():
    steps = [
        {"step": 0, "psnr": 45.129876, "rmse": 0.00123456789, "max_abs_error": 0.25},
        dict.fromkeys(("psnr", "rmse", "max_abs_error")),
    ]
    quality = {
        "psnr": 44.9999999,
        "rmse": 1.23456701,
        "max_abs_error": 0.1234561,
        "ssim": None,
        "ssim_window": {"window": 11},
    }
    assert brief_quality({**quality, "per_step": steps}) == {
        "psnr": 44.9999,
        "rmse": 1.23457,
        "max_abs_error": 0.123457,
        "ssim": None,
        "ssim_window": {"window": 11},
        "per_step": {
            "psnr": [45.129, None],
            "rmse": [0.0012346, None],
            "max_abs_error": [0.25, None],
        },
    }


def test_history_in_a_file_is_brief():
    points = [{"seconds": n * 0.12345, "epoch": n, "psnr": 40.123} for n in range(1, 101)]
    brief = brief_history(points, timings=True)
    assert len(brief) == 24
    assert brief[-1] == {"seconds": 12.345, "epoch": 100, "psnr": 40.12}
    assert brief_history(points[:2], timings=False) == [
        {"epoch": 1, "psnr": 40.12},
        {"epoch": 2, "psnr": 40.12},
    ]
    assert brief_history([], timings=True) == []
    expected = [
        {"seconds": None, "epoch": 1, "psnr": 2.5},
        {"seconds": None, "epoch": 2, "psnr": 3},
    ]
    assert (
        curve({"epoch": [1, 2], "psnr": [2.5, 3]})
        == curve([{"epoch": 1, "psnr": 2.5}, {"epoch": 2, "psnr": 3}])
        == expected
    )
