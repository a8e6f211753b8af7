"""Data of a cell: key frames, masks and samples belong together."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fhash_bench.paper.data import (
    ENCODINGS,
    FEATURES,
    KINDS,
    SETS,
    Data,
    arrangement,
    dense_levels,
    feature_text,
    hash_resolutions,
    hash_table,
    paper_parameters,
    paper_set,
    published_batch,
    scaled,
    simulated,
    tcnn_network,
)
from fhash_bench.paper.encodings import sample_places
from fhash_codec.features.features import parse_feature
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


def test_masks_hold_the_samples(data: Data) -> None:
    every = np.concatenate([f[m] for f, m in zip(data.frames, data.masks, strict=True)])
    np.testing.assert_array_equal(np.sort(every), np.sort(data.unfringed.values))
    assert data.coreset.fringe is not None
    of_key_frames = data.coreset.values[~data.coreset.fringe]
    np.testing.assert_array_equal(np.sort(every), np.sort(of_key_frames))
    assert data.coreset.fringe.any()
    assert 0.1 < data.coreset.fraction < 0.8


def test_boxes_hold_the_bounding_box_of_each_key_frame(data: Data) -> None:
    places = sample_places(data.boxes)
    for key, mask in enumerate(data.masks):
        at = np.argwhere(mask)
        expected = np.prod(at.max(axis=0) - at.min(axis=0) + 1)
        assert (places[:, 0] == key).sum() == expected > mask.sum()
    assert data.boxes.box == data.coreset.box
    assert data.boxes.brick_shape == (1, 1, 1)


def test_everything_is_the_domain(data: Data) -> None:
    assert data.everything.box.shape == data.frame_shape
    assert len(data.everything.values) == sum(frame.size for frame in data.frames)
    assert data.raw_bytes == 5 * 7 * 9 * 12 * 4


@pytest.mark.parametrize("name", FEATURES)
def test_scenes_at_a_quarter_of_the_papers_shape(name: str) -> None:
    shapes = {"flame": (34, 14, 43, 50), "bubble": (61, 64, 32, 32), "shell": (34, 54, 54, 54)}
    assert simulated(name, "quarter").shape == shapes[name]
    for kind in KINDS:
        parse_feature(feature_text(name, kind))


def test_other_features_are_taken_as_they_are() -> None:
    assert feature_text("flame", "interval:0:1") == "interval:0:1"
    assert feature_text("mine.h5", "segmentation") == "segmentation"


def test_an_unknown_scale_is_refused() -> None:
    with pytest.raises(InputError, match="quarter"):
        simulated("flame", "tenth")


@pytest.mark.parametrize(("name", "steps"), [("flame", 1), ("bubble", 2), ("shell", 5)])
@pytest.mark.parametrize("divisor", [1, 2, 4])
def test_published_steps_are_the_papers(name: str, steps: int, divisor: int, data: Data) -> None:
    frame = scaled(SETS[name].frame, divisor)
    if divisor == 1:
        assert published_batch(name, frame) == 2**21
    values = np.broadcast_to(np.zeros((), np.float32), (1, *frame))
    sized = dataclasses.replace(data, name=name, series=ArraySeries(values))
    for encoding in ("dense", "dense-multi", "hash", "tcnn"):
        arranged = arrangement("published", encoding, sized)
        assert arranged.steps == (steps,)
        assert arranged.whole
        assert not arranged.joint


def test_published_fhash_is_joint_on_the_coreset(data: Data) -> None:
    arranged = arrangement("published", "fhash", data)
    assert arranged.joint
    assert not arranged.whole
    assert arranged.steps == (1,)  # 2^21 samples are more than there are


def test_released_is_the_authors_code(data: Data) -> None:
    arranged = arrangement("released", "fhash", data)
    batch = round(published_batch("blob", data.frame_shape) * 2_000_000 / 2**21)
    assert batch == 2_000_000
    assert (arranged.joint, arranged.samples, arranged.steps) == (True, "boxes", (1,))
    assert (arranged.engine, arranged.schedule) == ("gather", "constant")
    assert arrangement("published", "fhash", data).samples == "unfringed"
    with pytest.raises(InputError, match="released with fhash alone"):
        arrangement("released", "hash", data)


def test_equal_differs_by_the_encoding_alone(data: Data) -> None:
    arranged = {name: arrangement("equal", name, data) for name in ENCODINGS if name != "tcnn"}
    assert len(set(arranged.values())) == 1
    assert not arranged["hash"].whole


def test_best_takes_the_fastest_engine(data: Data) -> None:
    engines = {name: arrangement("best", name, data).engine for name in ENCODINGS}
    assert engines == {
        "dense": "lattice",
        "dense-multi": "lattice",
        "hash": "gather",
        "tcnn": "tcnn",
        "fhash": "lattice",
    }
    assert len(arrangement("best", "hash", data).steps) > 1


def test_unknown_names_are_refused(data: Data) -> None:
    with pytest.raises(InputError, match="published, released, equal, best"):
        arrangement("fair", "hash", data)


COUNTS = {
    "flame": {
        "hash": 125_829_120,
        "tcnn": 47_994_880,
        "dense": 47_185_920,
        "fhash": 25_374_176,
    },
    "bubble": {"hash": 264_241_152, "tcnn": 80_945_280, "dense": 75_497_472},
    "shell": {
        "hash": 1_174_405_120,
        "tcnn": 215_768_320,
        "dense": 141_557_760,
        "fhash": 112_857_968,
    },
}


@pytest.mark.parametrize("name", SETS)
def test_parameters_to_the_unit(name: str) -> None:
    counts = paper_parameters(name)
    assert {key: counts[key] for key in COUNTS[name]} == COUNTS[name]
    assert counts["dense-multi"] == pytest.approx(8 / 7 * counts["dense"], rel=2e-6)


def test_hash_configurations_are_the_papers() -> None:
    found = {
        name: (hash_table(s.frame), hash_resolutions(s.frame, s.coarsest))
        for name, s in SETS.items()
    }
    assert {name: table for name, (table, _) in found.items()} == {
        "flame": 2**20,
        "bubble": 2**21,
        "shell": 2**23,
    }
    assert [len(resolutions) for _, resolutions in found.values()] == [6, 7, 7]
    assert {resolutions[0] for _, resolutions in found.values()} == {256}


def test_a_quarter_of_the_papers_lengths() -> None:
    assert [scaled(s.frame, 4) for s in SETS.values()] == [
        (14, 43, 50),
        (64, 32, 32),
        (54, 54, 54),
    ]


def test_dense_levels_halve_down_to_two_corners() -> None:
    assert dense_levels((5, 3, 1)) == [(5, 3, 1), (3, 2, 1), (2, 1, 1)]


def test_tcnn_pads_its_network() -> None:
    assert tcnn_network(6, 1) == 16 * 64 + 64 * 64 + 64 * 16 == 6144
    assert tcnn_network(9, 2) == 2 * (32 * 64 + 64 * 64 + 64 * 16)


def test_an_unknown_set_is_refused() -> None:
    with pytest.raises(InputError, match="bubbel"):
        paper_set("bubbel")
