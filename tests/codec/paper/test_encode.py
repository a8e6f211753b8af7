"""Encoding by the profile paper: the promise that the coding of tables gets."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, QualityError
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


@pytest.mark.parametrize(("low", "expected"), [(0.4, False), (0.8, True)])
def test_a_file_says_which_tables_it_has(tmp_path, low, expected) -> None:
    field = np.random.default_rng(0).random((3, 8, 9, 10), dtype=np.float32)
    config = EncodeConfig(
        profile="paper",
        epochs=1,
        width=8,
        features=(f"interval:{low}:1",),
        dilation=0,
        fringe="untrained",
    )
    figures = fhash_codec.encode(field, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        model = volume.info["model"]
        assert ("sparse" in model) == expected
        assert model["tables"] == "float16"
        dense = 2 * sum(np.prod(level) for level in model["levels"]) + volume.mlp.parameters
        assert (model["parameters"] < dense) == expected
        assert figures["psnr"] == pytest.approx(volume.info["quality"]["psnr"], abs=1e-3)


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


def test_a_mask_is_a_feature() -> None:
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    mask = np.zeros((4, 5, 6), bool)
    mask[1, 2:4, 3] = True
    config = EncodeConfig(profile="paper", dilation=0)
    selection = select(ArraySeries(field), config, silent, mask)
    assert selection.coreset.box == ((1, 2), (2, 4), (3, 4))
    assert len(selection.coreset.values) == 4
