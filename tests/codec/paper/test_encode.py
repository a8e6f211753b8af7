"""Encoding by the profile paper: the promise that the coding of tables gets."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, QualityError


class Reached(Exception):
    """Raised instead of coding the tables."""


@pytest.mark.filterwarnings("ignore:training goes on")
@pytest.mark.parametrize(("key_frames", "promised"), [("all", 1.0), ("0,2", None)])
def test_tables_get_the_promise_only_if_every_step_is_a_key_frame(
    tmp_path, monkeypatch, key_frames, promised
) -> None:
    """The search for their quantiser step sees key frames alone."""
    given = []

    def write_coded(*arguments):
        given.append(arguments[-2])
        raise Reached

    monkeypatch.setattr("fhash_codec.paper.tables.step.write_coded", write_coded)
    config = EncodeConfig(
        profile="paper", epochs=1, width=8, tables="transform", psnr=1.0, key_frames=key_frames
    )
    field = np.random.default_rng(0).random((3, 4, 5, 6), dtype=np.float32)
    with pytest.raises(Reached):
        fhash_codec.encode(field, tmp_path / "a.fhz", config)
    assert given == [promised]


@pytest.mark.parametrize(
    ("key_frames", "advice"), [("all", "More --epochs may help"), ("0,2", "key frames are trained")]
)
def test_a_missed_promise_says_what_may_help(tmp_path, key_frames, advice) -> None:
    config = EncodeConfig(profile="paper", epochs=1, width=8, psnr=150.0, key_frames=key_frames)
    field = np.random.default_rng(0).random((3, 4, 5, 6), dtype=np.float32)
    with pytest.raises(QualityError, match=advice):
        fhash_codec.encode(field, tmp_path / "a.fhz", config)


def test_the_history_is_about_the_coreset_alone(tmp_path) -> None:
    """Its last point is the PSNR of the file, which has no fringe to measure."""
    field = np.random.default_rng(0).random((6, 8, 9, 10), dtype=np.float32)
    config = EncodeConfig(
        profile="paper",
        epochs=3,
        width=8,
        tables="float32",
        features=("interval:0.9:1",),
        dilation=0,
    )
    figures = fhash_codec.encode(field, tmp_path / "a.fhz", config)
    assert figures["curve"][-1]["psnr"] == pytest.approx(figures["psnr"], abs=0.02)
