"""Trainings on a pretended CUDA device, from the command's settings to the file."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pretended_cuda import pretended_cuda

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.fit import train_model
from fhash_codec.paper.network import Architecture
from fhash_formats.errors import FhashWarning

CONFIG = EncodeConfig(
    profile="paper", epochs=2, width=8, batch=20_000, device="cuda", engine="slab"
)


@pytest.fixture
def architecture(coreset: Coreset) -> Architecture:
    return Architecture.for_box(coreset.box.shape, 3, width=8)


@pytest.mark.parametrize("tables", ["float16", "transform"])
def test_a_series_is_encoded_on_the_device(tmp_path: Path, tables: str) -> None:
    values = np.add.outer(np.sin(np.linspace(0, 3, 3)), np.random.default_rng(0).random((6, 7, 9)))
    config = replace(CONFIG, epochs=3, batch=0, tables=tables)
    with pretended_cuda() as pretended, warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)  # of the quality of three epochs
        figures = fhash_codec.encode(values.astype(np.float32), tmp_path / "a.fhz", config)
    assert pretended.counts["launches"] > 100
    assert figures["device"] == "cuda"
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert np.isfinite(volume[:]).any()


def test_a_training_that_diverges_begins_again_on_the_device(
    coreset: Coreset,
    architecture: Architecture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits = iter([0.0, *[1e9] * 100])
    check = fhash_codec.paper.train._Loop.check_errors
    monkeypatch.setattr(
        "fhash_codec.paper.train._Loop.check_errors",
        lambda self: (
            monkeypatch.setattr("fhash_codec.paper.train.DIVERGED", next(limits)),
            check(self),
        ),
    )
    config = replace(CONFIG, epochs=1)
    with pretended_cuda(), pytest.warns(FhashWarning, match="begins again"):
        trained = train_model(coreset, architecture, config, tmp_path / "a.fhz")
    assert (trained.device, trained.restarts) == ("cuda", 1)
