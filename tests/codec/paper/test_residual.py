"""Residual of a network: bounds that hold at every step, and all ways to read the sum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError, Renderer, Scene
from fhash_codec.plain import export_plain
from fhash_codec.rendering.scenes import Marching
from fhash_formats.container import Container
from fhash_formats.container.reader import check_arrays
from fhash_formats.errors import DamagedFileError

ABSOLUTE = 0.004
FEATURE = "interval:0.3:2"


def swirl(dtype: type = np.float32, amplitude: float = 1.0) -> np.ndarray:
    """A wave that turns, with a little noise that no network learns."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 10, 12, 14)), indexing="ij")
    noise = np.random.default_rng(0).normal(0, 0.01, x.shape)
    values = np.sin(3 * x + 2 * y * t) * np.cos(2 * z) + noise
    return (amplitude * values).astype(dtype)


def settings(**fields: object) -> EncodeConfig:
    return EncodeConfig(**({"profile": "network", "epochs": 3, "max_error": ABSOLUTE} | fields))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of a feature with key frames every other step."""
    path = tmp_path_factory.mktemp("residual") / "run.fhz"
    fhash_codec.encode(swirl(), path, settings(features=FEATURE, key_frames="every:2"))
    return path


@pytest.mark.parametrize(
    ("values", "fields"),
    [
        (swirl(), {}),
        (swirl(), {"max_error": None, "max_error_rel": 1e-3, "tables": "float16"}),
        (swirl(np.float64, 1e6) + 3e6, {"max_error": 200.0, "key_frames": "1,3"}),
        (swirl(np.int16, 20000), {"max_error": 25.0, "samples": "keys", "key_frames": "every:4"}),
    ],
)
def test_bounds_hold_at_every_value(
    tmp_path: Path, values: np.ndarray, fields: dict[str, object]
) -> None:
    values = values.copy()
    if values.dtype.kind == "f":
        values[2, 3, 4:8] = np.nan
    fhash_codec.encode(values, tmp_path / "run.fhz", settings(**fields))
    bound = fields.get("max_error", ABSOLUTE)
    if bound is None:
        bound = 1e-3 * float(np.nanmax(values) - np.nanmin(values))
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        for step, frame in enumerate(values):
            error = np.abs(volume.read(step).astype(np.float64) - frame)
            np.testing.assert_array_equal(np.isnan(error), np.isnan(frame))
            assert np.nanmax(error) <= bound


def test_values_of_no_range_need_no_residual(tmp_path: Path) -> None:
    values = np.full((2, 4, 5, 6), 3.0, np.float32)
    fhash_codec.encode(values, tmp_path / "a.fhz", settings(max_error=None, max_error_rel=0.01))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert "residual" not in volume.container.arrays
        np.testing.assert_array_equal(volume[...], values)


def test_sum_is_the_same_however_it_is_read(run: Path) -> None:
    values = swirl()
    with fhash_codec.open(run) as volume:
        assert volume.describe()["residual"]["bytes"] > 0
        for step in (0, 1, 4):
            frame = volume.read(step)
            counted = np.argwhere(volume.occupancy(step))
            assert len(counted) > 300
            assert np.abs(frame - values[step])[tuple(counted.T)].max() <= ABSOLUTE
            z, y, x = counted[::7].T
            np.testing.assert_allclose(
                volume.sample(t=step, z=z, y=y, x=x), frame[z, y, x], atol=1e-6
            )
            region = ((2, 7), (3, 9), (4, 11))
            part = frame[tuple(slice(*span) for span in region)]
            np.testing.assert_array_equal(volume.read(step, region), part)
        t, z, y, x = 1.4, 4.3, 5.6, 10.2
        _, slopes = volume.sample(t=t, z=z, y=y, x=x, gradient=True)
        for axis, slope in zip("tzyx", slopes, strict=True):
            ends = [
                volume.sample(**{**dict(t=t, z=z, y=y, x=x), axis: at + move})
                for at in [dict(t=t, z=z, y=y, x=x)[axis]]
                for move in (-0.01, 0.01)
            ]
            assert (ends[1] - ends[0]) / 0.02 == pytest.approx(slope, rel=0.05, abs=2e-3)


def test_plain_export_has_the_same_values_and_layers(run: Path, tmp_path: Path) -> None:
    export_plain(run, tmp_path / "plain.fhz")
    with fhash_codec.open(run) as volume, fhash_codec.open(tmp_path / "plain.fhz") as plain:
        np.testing.assert_array_equal(plain[...], volume[...])
        assert volume.container.arrays["mlp/parameters"].shape == (volume.mlp.parameters,)
        assert "mlp/weight_1" not in volume.container.arrays
        for (weight, bias), number in zip(volume.mlp.layers, (1, 2, 3), strict=True):
            stored = plain.container.arrays
            np.testing.assert_array_equal(stored[f"mlp/weight_{number}"].read(), weight)
            np.testing.assert_array_equal(stored[f"mlp/bias_{number}"].read(), bias)


def test_layers_of_another_size_are_damage(run: Path) -> None:
    with Container.open(run) as container:
        arrays = {name: array._metadata for name, array in container.arrays.items()}
        header = {**container.header, "model": {**container.header["model"], "width": 17}}
        with pytest.raises(DamagedFileError, match="mlp/parameters"):
            check_arrays(header, arrays)


def test_pictures_are_of_the_sum(run: Path) -> None:
    with fhash_codec.open(run) as volume:
        renderer = Renderer(volume)
        assert renderer.plan(Scene(size=(32, 32))).mode == "cache"
        with pytest.raises(InputError, match="residual beside its network"):
            renderer.plan(Scene(size=(32, 32), march=Marching(mode="arm")))


def test_bounds_below_the_rounding_are_refused_before_the_training(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rounded"):
        fhash_codec.encode(swirl(), tmp_path / "run.fhz", settings(max_error=1e-8, epochs=10**5))
    assert not any(tmp_path.iterdir())
