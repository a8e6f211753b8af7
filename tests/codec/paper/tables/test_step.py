"""Coding trained tables with one step: the loss is as reported, and less than the gain."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import fhash_codec
from fhash_codec import FhashWarning, QualityError
from fhash_codec.paper.tables.step import MAX_LOSS
from fhash_formats.container import Container


@pytest.fixture(scope="module")
def rough_waves(waves) -> np.ndarray:
    """Waves with noise: their tables hold many coefficients, so that their error hardly jumps."""
    noise = np.random.default_rng(0).normal(0, 3, (5, 9, 12, 20))
    return waves() + noise.astype(np.float32)


def decoded(path) -> np.ndarray:
    with fhash_codec.open(path) as volume:
        return volume[...]


def test_the_loss_is_within_its_limit_and_what_is_said(pair) -> None:
    (exact, _), (coded, path) = pair["exact"], pair["coded"]
    loss = exact["psnr"] - coded["psnr"]
    assert exact["tables_loss_db"] is None
    assert coded["tables_loss_db"] <= MAX_LOSS + 1e-4
    if len(coded["key_frames"]) == 5:
        assert coded["tables_loss_db"] == pytest.approx(loss, abs=2e-4)
    else:
        # The search sees key frames alone.
        between, other = (run["quality"]["between"] for run in (coded, exact))
        loss = other["psnr_key_frames"] - between["psnr_key_frames"]
        assert loss <= MAX_LOSS + 1e-3
    with fhash_codec.open(path) as volume:
        assert volume.info["model"]["tables_loss_db"] == coded["tables_loss_db"]
        assert volume.info["model"]["tables"] == "transform"
        assert volume.info["required_features"] == ["transform"]
        assert "occupancy/mask" in volume.container.arrays
        assert coded["bytes"] < 0.75 * exact["bytes"]
        assert volume.verify() == len(volume.info["arrays"])
    with fhash_codec.open(path) as volume, fhash_codec.open(pair["exact"][1]) as other:
        for t in (0, 1.5, 4):
            np.testing.assert_array_equal(volume.occupancy(t), other.occupancy(t))


@pytest.mark.parametrize("below", [1.0, 6.0])
def test_a_promise_is_kept_and_no_more(rough_waves, coded_config, tmp_path, below) -> None:
    source = rough_waves
    config = replace(coded_config, epochs=10)
    free = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    wanted = free["psnr"] - below
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    assert figures["bytes"] < free["bytes"]
    lost = free["psnr"] + free["tables_loss_db"] - figures["psnr"]
    assert figures["tables_loss_db"] == pytest.approx(lost, abs=1e-3)


def test_a_promise_out_of_reach_costs_no_bytes(waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=2)
    free = fhash_codec.encode(waves(), tmp_path / "a.fhz", config)
    with (
        pytest.warns(FhashWarning, match="ends at its limit of 0 more seconds: the model has"),
        pytest.raises(QualityError, match="150 dB were asked for") as missed,
    ):
        fhash_codec.encode(
            waves(), tmp_path / "b.fhz", replace(config, psnr=150.0, train_on_seconds=0)
        )
    assert "Training ended at its limit of --train-on-seconds 0: more may help" in str(missed.value)
    assert missed.value.figures["tables_loss_db"] <= MAX_LOSS + 1e-4
    assert missed.value.figures["bytes"] <= free["bytes"] + 40  # the texts of the settings


def test_by_default_coded_tables_have_few_levels_and_take_fewer_bytes(
    rough_waves, coded_config, tmp_path
) -> None:
    source = rough_waves
    config = replace(coded_config, epochs=30, psnr=38.0)
    published = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    config = replace(config, fold=0, embedding_size=0)
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", config)
    assert 38.0 <= figures["psnr"] < 38.1
    assert figures["bytes"] < 0.75 * published["bytes"]
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        model = volume.info["model"]
        assert (model["fold"], model["embedding_size"]) == (8, 1)
        assert model["levels"] == [[5, 9, 12, 20], [2, 2, 2, 3]]
        assert volume.info["config"]["fold"] == 0


def test_training_goes_on_for_a_promise(rough_waves, coded_config, tmp_path) -> None:
    config = replace(coded_config, epochs=10)
    free = fhash_codec.encode(rough_waves, tmp_path / "a.fhz", config)
    wanted = free["psnr"] + 1.0
    with pytest.warns(FhashWarning, match=r"training goes on for \d+ epochs"):
        figures = fhash_codec.encode(rough_waves, tmp_path / "b.fhz", replace(config, psnr=wanted))
    assert wanted <= figures["psnr"] < wanted + 0.1
    with fhash_codec.open(tmp_path / "b.fhz") as volume:
        assert volume.info["training"]["epochs"] > 10


@pytest.mark.parametrize(
    "shape", [(1, 1, 1, 1), (3, 1, 1, 1), (1, 1, 1, 7), (2, 2, 2, 2), (7, 3, 5, 11)]
)
def test_every_shape_comes_back(coded_config, tmp_path, shape) -> None:
    source = np.random.default_rng(0).random(shape, dtype=np.float32)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", coded_config)
    back = decoded(tmp_path / "a.fhz")
    assert back.shape == shape
    assert np.isfinite(back).all()
    assert figures["max_abs_error"] == pytest.approx(np.abs(back - source).max(), rel=1e-5)


def test_a_constant_series_comes_back_exactly(coded_config, tmp_path) -> None:
    figures = fhash_codec.encode(np.full((3, 4, 5, 6), 7.25), tmp_path / "a.fhz", coded_config)
    assert (decoded(tmp_path / "a.fhz") == 7.25).all()
    assert figures["rmse"] == 0


def test_the_same_input_gives_the_same_bytes(waves, coded_config, tmp_path) -> None:
    for name in ("a.fhz", "b.fhz"):
        fhash_codec.encode(
            waves((3, 6, 7, 8)), tmp_path / name, replace(coded_config, epochs=2, timings=False)
        )
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


def test_other_readers_see_what_is_needed(pair) -> None:
    with Container.open(pair["coded"][1]) as container:
        json.dumps(container.header)
        size = container.header["model"]["embedding_size"]
        names = [name for name in container.arrays if name.startswith("tables/")]
        assert len(names) == size * len(container.header["model"]["levels"])
        assert container.arrays["tables/level_1/component_1"].shape == tuple(
            container.header["model"]["levels"][0]
        )
