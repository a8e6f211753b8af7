"""Encoding of several variables: promises of each, errors before the work, what is held."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray
from rarely import rarely

import fhash_codec
from fhash_codec import (
    Dataset,
    EncodeConfig,
    InputError,
    OutputExistsError,
    QualityError,
)
from fhash_codec.compact.tiles import code
from fhash_formats.errors import FhashWarning
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
    bounds = {"u": 0.1, "v": 0.01, "z": 0.0001}
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
        shared = [entry["coordinates"] for entry in dataset.container.header["variables"]]
        assert [one["y"] for one in shared[1:]] == [0, 0]
    sizes = [report["variables"][name]["bytes"] for name in bounds]
    assert sizes == sorted(sizes)


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


def test_presets_mix(tmp_path: Path) -> None:
    path, arrays = tmp_path / "run.fhz", {"a": values(0), "b": values(1)}
    paper = EncodeConfig(preset="published", tables="float16", epochs=2, width=4, timings=False)
    fhash_codec.encode_dataset(arrays, path, {"a": paper, "b": QUICK})
    fhash_codec.encode(arrays["a"], tmp_path / "a.fhz", paper)
    with opened(path) as dataset, fhash_codec.open(tmp_path / "a.fhz") as alone:
        np.testing.assert_array_equal(dataset["a"][...], alone[...])
    assert [each.name for each in tmp_path.iterdir() if "checkpoint" in each.name] == []


@pytest.mark.parametrize("ratio", [5, 12])
@pytest.mark.filterwarnings("ignore:.*no step of the quantiser comes nearer")
def test_a_promised_ratio_holds_for_the_whole_file(tmp_path: Path, ratio: int) -> None:
    rng = np.random.default_rng(0)
    big = {}
    for n, name in enumerate("ab"):
        tiled = np.tile(values(n), (2, 2, 2, 2))
        # Noise that repeats would be exact in fewer bytes than are asked for.
        big[name] = (tiled + rng.normal(0, 0.1, tiled.shape)).astype(np.float32)
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
        lambda config, *_: "too bad" if config.psnr == 41 else None,
    )
    configs = {"a": QUICK, "b": EncodeConfig(effort=1, psnr=41)}
    with pytest.raises(QualityError, match=r"b: too bad; the file is") as caught:
        fhash_codec.encode_dataset(arrays, path, configs, force=True)
    assert path.read_bytes() == b"older"
    written = Path(caught.value.figures["path"])
    assert written == tmp_path / "run.missed.fhz"
    with opened(written) as dataset:
        assert list(dataset) == ["a", "b"]


def test_an_older_file_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    path.write_bytes(b"older")
    with pytest.raises(OutputExistsError):
        fhash_codec.encode_dataset({"a": values(0)}, path)
    with pytest.raises(InputError, match="no variable 'b'"):
        fhash_codec.encode_dataset({"a": values(0)}, path, variables=["b"], force=True)
    assert path.read_bytes() == b"older"


QUICK_ENCODING = EncodeConfig(preset="published", tables="float16", epochs=6, width=16)
FAST = EncodeConfig(effort=1)
BOTH = pytest.mark.parametrize("config", [QUICK_ENCODING, FAST], ids=["paper", "compact"])


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
def test_every_number_type_comes_back(field, tmp_path, dtype, config) -> None:
    source = ((field() + 110) * 0.7).astype(dtype)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    whole = np.dtype(dtype).kind in "iu" and not config.published
    assert back.dtype.kind == (np.dtype(dtype).kind if whole else "f")
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
def test_every_shape_comes_back(tmp_path, shape, config) -> None:
    source = np.random.default_rng(0).random(shape, dtype=np.float32)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    assert back.shape == shape
    assert np.isfinite(back).all()
    assert figures["max_abs_error"] == pytest.approx(np.abs(back - source).max(), rel=1e-5)


def test_missing_values_stay_out_of_range_coreset_and_figures(field, tmp_path) -> None:
    source = field()
    holes = np.random.default_rng(0).random(source.shape) < 0.1
    holes[1] = True
    source[holes] = np.random.default_rng(1).choice([np.nan, np.inf, -np.inf], holes.sum())
    for settings in ({}, {"key_frames": "0,3"}, {"features": ("interval:50:300",)}):
        config = EncodeConfig(preset="published", tables="float16", epochs=30, width=16, **settings)
        figures = fhash_codec.encode(source, tmp_path / "a.fhz", config, force=True)
        assert np.isfinite(figures["rmse"])
        assert figures["psnr"] > 15
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            assert volume.info["value_range"] == [
                float(source[~holes].min()),
                float(source[~holes].max()),
            ]
            values = volume[...]
            assert np.isnan(values[holes]).all()
            filled = np.stack([volume.read(t, outside="background") for t in range(4)])
            np.testing.assert_array_equal(np.isnan(filled), holes)
            if not settings:
                np.testing.assert_array_equal(np.isnan(values), holes)


@BOTH
def test_ctrl_c_before_the_training_leaves_nothing(field, tmp_path, config) -> None:
    def interrupt(stage, done, total, note):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fhash_codec.encode(field(), tmp_path / "run.fhz", config, progress=interrupt)
    assert not list(tmp_path.iterdir())


@BOTH
def test_an_output_that_is_there_is_kept(field, tmp_path, config) -> None:
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


@pytest.mark.filterwarnings("ignore:training ends")
def test_a_missed_promise_replaces_nothing(field, tmp_path) -> None:
    path, config = (
        tmp_path / "run.fhz",
        EncodeConfig(preset="published", epochs=1, width=4, psnr=150),
    )
    path.write_bytes(b"precious")
    for name in ("run.missed.fhz", "run.missed-2.fhz"):
        with pytest.raises(QualityError, match=f"the file is .*/{name}") as missed:
            fhash_codec.encode(field(), path, config, force=True)
        assert missed.value.figures["path"] == str(tmp_path / name)
        assert missed.value.figures["bytes"] == (tmp_path / name).stat().st_size
        assert decoded(tmp_path / name).shape == field().shape
        assert path.read_bytes() == b"precious"
    assert len(list(tmp_path.iterdir())) == 3
    # A promise that is kept replaces the file, and leaves the others alone.
    fhash_codec.encode(field(), path, FAST, force=True)
    assert decoded(path).shape == field().shape
    assert len(list(tmp_path.iterdir())) == 3


@BOTH
def test_the_input_is_never_replaced(field, tmp_path, config) -> None:
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


def test_a_mask_in_memory_is_a_feature(field, tmp_path) -> None:
    source = field()
    mask = source[0] > 50
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, dilation=0), mask=mask)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        np.testing.assert_array_equal(volume.occupancy(3), mask)
    both = EncodeConfig(effort=1, dilation=0, features=("interval:-300:-50",))
    fhash_codec.encode(source, tmp_path / "b.fhz", both, mask=source > 50)
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        np.testing.assert_array_equal(volume.occupancy(2), (source[2] > 50) | (source[2] <= -50))
    with pytest.raises(InputError, match="mask has shape"):
        fhash_codec.encode(source, tmp_path / "c.fhz", QUICK_ENCODING, mask=mask[1:])


# A float64 of that size is a multiple of 256: no decoded value can be nearer.
@pytest.mark.parametrize(
    "config", [QUICK_ENCODING, EncodeConfig(effort=1, psnr=10.0)], ids=["paper", "compact"]
)
def test_64_bit_integers_are_compared_exactly(tmp_path, config) -> None:
    source = 2**60 + np.arange(1344).reshape(4, 6, 7, 8)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    back = decoded(tmp_path / "a.fhz")
    exact = [abs(int(a) - int(b)) for a, b in zip(source.ravel(), back.ravel(), strict=True)]
    assert figures["max_abs_error"] == max(exact)
    assert figures["rmse"] == pytest.approx((sum(e * e for e in exact) / len(exact)) ** 0.5)


@pytest.mark.filterwarnings("ignore:training ends")
def test_a_promise_cannot_hold_where_the_psnr_is_unknown(tmp_path) -> None:
    source = (2 * np.random.default_rng(0).random((2, 4, 5, 6)) - 1) * 1.7e308
    with pytest.raises(QualityError, match="an unknown PSNR"):
        fhash_codec.encode(
            source, tmp_path / "a.fhz", EncodeConfig(preset="published", epochs=1, psnr=300.0)
        )
    figures = fhash_codec.encode(
        np.zeros((2, 4, 5, 6)),
        tmp_path / "b.fhz",
        EncodeConfig(preset="published", epochs=1, psnr=300.0),
    )
    assert figures["rmse"] == 0


def test_effort_1_finds_a_coder_that_does_not_decode_what_it_coded(
    field, tmp_path, monkeypatch
) -> None:
    def wrong(tile, settings, coding):
        coded, outcome = code(tile, settings, coding)
        return replace(coded, decoded=coded.decoded + 1), outcome

    monkeypatch.setattr("fhash_codec.compact.encode.code", wrong)
    with pytest.raises(RuntimeError, match="decodes to other values"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(psnr=45.0, effort=1))
    assert not (tmp_path / "a.fhz").exists()


FAR = {"int64 -2^63": -(2**63), "int64 2^60": 2**60, "ns": 1_700_000_000 * 10**9}
FAR |= {"uint64 2^63": 2**63 - 500, "uint64 2^64": 2**64 - 999}
"""Least of 999 integers where floats have few."""


def far(name: str) -> np.ndarray:
    """Waves of 999 integers from a number on."""
    t, z, y, x = np.ogrid[0:3, 0:8, 0:10, 0:12]
    waves = np.sin(t * 0.3) + np.sin(z * 0.4) + np.sin(y * 0.3) + np.cos(x * 0.2)
    steps = np.rint((waves - waves.min()) / np.ptp(waves) * 998).astype(np.uint64)
    values = steps + np.uint64(FAR[name] % 2**64)
    return values.view(np.uint64 if name.startswith("uint") else np.int64)


@pytest.mark.filterwarnings("ignore:.*its values are exact already")
@pytest.mark.parametrize("name", FAR)
@pytest.mark.parametrize(
    "promise",
    [
        {"max_error": 3.0},
        {"psnr": 40.0},
        *rarely({"ratio": 4.0}, {"max_error_rel": 0.01}, {"psnr": 400.0}),
    ],
    ids=str,
)
def test_integers_far_from_zero_keep_their_range_and_the_promise(tmp_path, name, promise) -> None:
    source = far(name)
    least = source.astype(object).min()
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, **promise))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        back = volume[...]
        assert volume.info["value_range"] == [least, least + 998]
    assert back.dtype == source.dtype
    steps, again = ((values.astype(object) - least).astype(float) for values in (source, back))
    assert again.min() >= 0
    assert again.max() <= 998
    errors = np.abs(again - steps)
    assert figures["max_abs_error"] == errors.max()
    assert figures["data_range"] == 998
    bounds = {"max_error": 3.0, "max_error_rel": 9.98}
    assert errors.max() <= next((bounds[key] for key in promise if key in bounds), 998)
    squares = float(np.mean(errors**2))
    if squares:
        psnr = 20 * np.log10(998) - 10 * np.log10(squares)
        assert figures["psnr"] == pytest.approx(psnr, abs=1e-3)
        assert psnr >= promise.get("psnr", 0)
    else:
        exact = fhash_codec.encode(source, tmp_path / "b.fhz", EncodeConfig(max_error=0.0))
        assert figures["bytes"] <= 1.2 * exact["bytes"]


@pytest.mark.parametrize("name", FAR)
def test_features_of_integers_far_from_zero_are_those_of_their_differences(tmp_path, name) -> None:
    source, least = far(name), FAR[name]
    texts = (f"interval:{least + 300}:{least + 400}", f"isosurface:{least + 700}")
    config = EncodeConfig(effort=1, max_error=2.0, features=texts, dilation=0, timings=False)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    near = (source - source.dtype.type(least)).astype(np.int64)
    near_config = replace(config, features=("interval:300:400", "isosurface:700"))
    near_figures = fhash_codec.encode(near, tmp_path / "b.fhz", near_config)
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        fhash_codec.open(tmp_path / "b.fhz", fill=0) as other,
    ):
        assert volume.dtype == source.dtype  # with a fill value of the encoder's
        kept = np.stack([volume.occupancy(step) for step in range(3)])
        assert (kept == np.stack([other.occupancy(step) for step in range(3)])).all()
        assert list(volume.info["features"]) == list(texts)
        errors = (volume[...].astype(object) - source.astype(object))[kept]
        assert (volume[...][~kept] == volume.fill).all()
    assert max(abs(errors)) == figures["max_abs_error"] <= 2
    assert figures["data_range"] == near_figures["data_range"]


def test_integers_that_missing_values_round_promise_no_bound(tmp_path) -> None:
    values = ArraySeries(far("ns"), missing=[FAR["ns"] + 5])
    with pytest.raises(InputError, match="rounded, by up to 128, and no bound"):
        fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(max_error=0.0))
    with pytest.warns(FhashWarning, match="rounded, by up to 128"):
        fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(psnr=30.0))


def test_a_store_that_changes_after_the_scan_is_named(tmp_path: Path) -> None:
    """Chunks are looked at once more when all is coded: no file mixes two states."""
    store, run = tmp_path / "a.zarr", tmp_path / "a.fhz"
    xarray.DataArray(values(0), dims=("t", "z", "y", "x"), name="u").to_zarr(
        store, consolidated=False
    )
    chunk = next(path for path in sorted((store / "u" / "c").rglob("*")) if path.is_file())

    def progress(stage: str, done: int, total: int, note: str) -> None:
        if stage != "scanning":
            os.utime(chunk, ns=(1, 1))

    with pytest.raises(InputError, match="changed while it was being read"):
        fhash_codec.encode(store, run, QUICK, progress=progress)
    assert not run.exists()
