"""Protocols: samples, steps and engines of each encoding."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.protocols import ENCODINGS, arrangement, published_batch
from fhash_codec.bench.paper.sets import SETS, scaled
from fhash_formats.errors import InputError
from fhash_formats.series import ArraySeries


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
