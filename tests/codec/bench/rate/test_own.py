"""The profiles of fhash: their promises, and figures of decoded values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.bench.rate.own import PROFILES, Own, promised
from fhash_formats.series import ArraySeries

Field = Callable[..., np.ndarray]


def test_own_figures_are_those_of_diff(tmp_path: Path, field: Field) -> None:
    values = field()
    config = EncodeConfig(profile="paper", epochs=2, width=4)
    data_range = float(values.max()) - float(values.min())
    own = Own(ArraySeries(values), data_range, tmp_path)
    trial = own.trial(config)
    (path,) = tmp_path.iterdir()
    report = fhash_codec.diff(values, path)
    assert trial.bytes == path.stat().st_size
    assert trial.psnr == pytest.approx(report["psnr"], abs=1e-9)
    assert trial.max_error == pytest.approx(report["max_abs_error"] / data_range)
    assert own.trial(config) is trial
    count, seconds = own.read_region(config, 1, ((0, 6), (4, 20), (4, 20)))
    assert 0 < count <= trial.bytes
    assert seconds > 0


@pytest.mark.parametrize("profile", PROFILES)
def test_profiles_are_promised_what_they_can_keep(profile: str) -> None:
    settings = {"seed": 7, "epochs": 3, "effort": 2}
    quality = promised(settings, profile, "psnr", 41.0).to_dict()
    bound = promised(settings, profile, "bound", 0.02).to_dict()
    assert (quality["epochs"], quality["effort"]) == ((3, 5) if profile == "paper" else (0, 2))
    assert quality["profile"] == bound["profile"] == profile
    assert quality["seed"] == bound["seed"] == 7
    if profile == "paper":
        assert quality == bound
        assert quality["psnr"] is None
    else:
        assert (quality["psnr"], bound["psnr"]) == (41.0, None)
        assert (quality["max_error_rel"], bound["max_error_rel"]) == (None, 0.02)
