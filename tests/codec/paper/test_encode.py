"""Encoding by the profile paper: the promise that the coding of tables gets."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.boxes import Box
from fhash_codec.paper.encode import select, sparse_tables
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


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

    monkeypatch.setattr("fhash_codec.paper.table_step.write_coded", write_coded)
    config = EncodeConfig(
        profile="paper", epochs=1, width=8, tables="transform", psnr=1.0, key_frames=key_frames
    )
    field = np.random.default_rng(0).random((3, 4, 5, 6), dtype=np.float32)
    with pytest.raises(Reached):
        fhash_codec.encode(field, tmp_path / "a.fhz", config)
    assert given == [promised]


@pytest.mark.parametrize(
    ("tables", "share", "expected"),
    [
        ("float16", 0.49, True),
        ("float16", 0.5, False),
        ("float32", 0.49, True),
        ("uint8", 0.1, True),
        ("uint8", 1.0, False),
        ("sparse", 1.0, True),
        ("dense", 0.1, False),
        ("transform", 0.1, False),
    ],
)
def test_tables_are_sparse_below_half_of_the_box(tables, share, expected) -> None:
    """The share is that of all samples, those of the fringe included."""
    box = Box.of([(1, 6), (0, 10), (2, 12)])
    coreset = Mock(box=box, key_frames=(0, 3), values=np.zeros(round(1000 * share)))
    config = EncodeConfig(profile="paper", tables=tables)
    assert sparse_tables(coreset, config) == expected


def test_the_architecture_is_that_of_the_box_and_the_key_frames() -> None:
    field = np.zeros((6, 9, 10, 20), np.float32)
    field[:, 2:7, 3:8, 4:15] = 1.0
    config = EncodeConfig(
        profile="paper",
        features=("interval:0.5:2",),
        dilation=0,
        key_frames="every:2",
        embedding_size=3,
        width=8,
        fold=3,
    )
    selection = select(ArraySeries(field), config, silent)
    assert selection.coreset.box == ((2, 7), (3, 8), (4, 15))
    assert [str(feature) for feature in selection.features] == ["interval:0.5:2"]
    architecture = selection.architecture
    assert architecture.sizes == (len(selection.coreset.key_frames), 5, 5, 11)
    assert len(architecture.levels) == 3  # ceil(log3 11)
    assert (architecture.embedding_size, architecture.width) == (3, 8)
