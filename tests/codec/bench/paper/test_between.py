"""Quality between key frames."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper import between
from fhash_codec.bench.paper.between import measure_between, places_of
from fhash_codec.bench.paper.data import Data


class Exact:
    """An encoding without any error at key frames, whose values are interpolated in time."""

    def __init__(self, data: Data) -> None:
        self.data = data

    def sample(self, key: float, places: torch.Tensor) -> torch.Tensor:
        before, after = int(key), min(int(key) + 1, 2)
        low, high = (self.data.frames[n][tuple(places.numpy().T)] for n in (before, after))
        return torch.from_numpy(low + np.float32(key - before) * (high - low))


def test_places_of_steps(data: Data) -> None:
    places = places_of(data)
    assert [step.key for step in places] == [0, 0.5, 1, 1.5, 2]
    assert len(places[0].vertices) == data.masks[0].sum()
    assert len(places[1].vertices) == (data.masks[0] | data.masks[1]).sum()
    np.testing.assert_array_equal(places[2].truth, places[2].linear)
    middle = data.frames[0] + data.frames[1]
    np.testing.assert_allclose(places[1].linear, middle[tuple(places[1].vertices.T)] / 2, atol=1e-6)


def test_interpolated_values_are_as_good_as_the_interpolated_source(data: Data) -> None:
    found = measure_between(Exact(data), places_of(data))  # type: ignore[arg-type]
    assert found["psnr_between"] == pytest.approx(found["psnr_linear"])
    assert found["psnr"] is not None
    assert found["psnr_between"] is not None
    assert found["psnr"] > found["psnr_between"] > 15


def test_few_places_of_large_steps(data: Data, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(between, "MAX_PLACES", 50)
    assert [len(step.truth) for step in places_of(data)] == [10] * 5
