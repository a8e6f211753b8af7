"""Quality between key frames."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import fhash_codec
from fhash_codec.bench.paper import between
from fhash_codec.bench.paper.between import measure_between, places_of
from fhash_codec.bench.paper.data import DILATION, Data, gather_data
from fhash_codec.bench.paper.encodings.build import build
from fhash_codec.bench.paper.encodings.gather import GatherModel
from fhash_codec.bench.paper.encodings.trained import TrainedEncoding
from fhash_codec.bench.paper.protocols import arrangement
from fhash_codec.config import EncodeConfig
from fhash_codec.paper.storage import load_network
from fhash_formats.series import ArraySeries


def test_places_of_steps(data: Data) -> None:
    places = places_of(data)
    assert [step.key for step in places] == [0, 0.5, 1, 1.5, 2]
    assert len(places[0].vertices) == data.masks[0].sum()
    assert len(places[1].vertices) == (data.masks[0] | data.masks[1]).sum()
    np.testing.assert_array_equal(places[2].truth, places[2].linear)
    middle = data.frames[0] + data.frames[1]
    np.testing.assert_allclose(places[1].linear, middle[tuple(places[1].vertices.T)] / 2, atol=1e-6)


def trained(data: Data, epochs: int, seed: int = 1) -> TrainedEncoding:
    """F-Hash on equal terms."""
    arranged = arrangement("equal", "fhash", data)
    encoding = build(
        "fhash",
        data,
        arranged,
        steps=arranged.steps[0],
        epochs=epochs,
        seed=seed,
        device=torch.device("cpu"),
    )
    for epoch in range(epochs):
        encoding.train_epoch(epoch)
    encoding.settle()
    return encoding


def test_places_of_steps_have_a_time_of_their_own(data: Data) -> None:
    """Places are integers, as `measure_between` gives them: the share of the time stays."""
    encoding, (low, step, high) = trained(data, 4), places_of(data)[:3]
    places = torch.from_numpy(step.vertices)
    assert not places.is_floating_point()
    between = encoding.sample(step.key, places)
    torch.testing.assert_close(between, encoding.sample(step.key, places.double()))
    for key in (low.key, high.key):
        assert not torch.allclose(between, encoding.sample(key, places), atol=1e-3)


def test_the_figures_are_those_of_the_codec(
    series: ArraySeries, data: Data, tmp_path: Path
) -> None:
    """The numbers of a container, in the bench's model: `fhash info` prints the same quality."""
    config = EncodeConfig(
        profile="paper",
        features=("interval:0.2:2",),
        key_frames="0,2,4",
        dilation=DILATION,
        tables="float32",
        epochs=20,
    )
    fhash_codec.encode(series, tmp_path / "blob.fhz", config)
    encoding = trained(data, 1)
    model = encoding.parts[0].model
    assert isinstance(model, GatherModel)
    with fhash_codec.open(tmp_path / "blob.fhz") as volume:
        codec = volume.info["quality"]["between"]
        network = load_network(volume.container)
        tables = [level.read((slice(None),) * 5) for level in network.tables]
        table = np.concatenate([level.reshape(-1, 2) for level in tables])
        held = table if model.rank is None else table[model.rank >= 0]
        with torch.no_grad():
            for number, read in zip(
                model.numbers, [held, *itertools.chain(*network.layers)], strict=True
            ):
                number.copy_(torch.from_numpy(np.array(read)))
    bench = measure_between(encoding, places_of(data))
    assert bench["psnr_between"] == pytest.approx(codec.pop("psnr"), abs=2e-3)
    assert bench["fringe_share"] == pytest.approx(codec.pop("fringe_fraction"), abs=1e-5)
    for name, figure in codec.items():
        assert bench[name] == pytest.approx(figure, abs=2e-3)


def test_steps_after_the_last_key_frame_are_between(series: ArraySeries) -> None:
    """The last key frame stands for them, as in the codec."""
    places = places_of(gather_data("blob", series, "interval:0.2:2", "0,2,3"))
    assert [step.key for step in places] == [0, 0.5, 1, 2, 2]
    assert [step.between for step in places] == [False, True, False, False, True]


def test_few_places_of_large_steps(data: Data, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(between, "MAX_PLACES", 50)
    taken = [len(step.truth) for step in places_of(data)]
    assert 50 <= sum(taken) <= 55
    monkeypatch.undo()
    every = [len(step.truth) for step in places_of(data)]
    # No step counts for more than it has.
    assert taken == [math.ceil(50 / sum(every) * each) for each in every]
