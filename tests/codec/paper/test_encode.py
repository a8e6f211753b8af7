"""Encoding by the profile paper: the promise that the coding of tables gets."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig


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
