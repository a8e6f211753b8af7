"""Pictures through an encoding: the same with and without occupancy, in fewer evaluations."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fhash_codec.bench.paper.latency import EncodingField, measure_latency
from fhash_codec.bench.paper.pictures import view_of_feature
from fhash_codec.rendering.march import march
from fhash_codec.rendering.march_task import Frame
from fhash_codec.rendering.stream_march import stream
from fhash_codec.rendering.torch_arrays import TorchArrays

SHAPE = (6, 7, 8)
FEATURE = "interval:0.3:0.8"


class Slope:
    """An encoding whose values rise along x, trilinear everywhere, so that a frame says all."""

    def frame(self, key: int) -> np.ndarray:
        _, y, x = np.indices(SHAPE)
        return np.asarray((x + 0.25 * y + 0.1 * key) / 10, dtype=np.float32)

    def sample(self, key: int, places: torch.Tensor) -> torch.Tensor:
        return (places[:, 2] + 0.25 * places[:, 1] + 0.1 * key) / 10


def mask() -> np.ndarray:
    inside = np.zeros(SHAPE, dtype=bool)
    inside[1:5, 1:6, 2:7] = True
    return inside


@pytest.mark.parametrize("feature", [FEATURE, "isosurface:0.5"])
def test_the_picture_is_that_of_the_frame(feature: str) -> None:
    arrays, slope = TorchArrays(torch.device("cpu")), Slope()
    task = view_of_feature(SHAPE, feature, size=16)
    values = np.where(mask(), slope.frame(1), np.float32(np.nan))
    expected = march(Frame(values=values, first=(0, 0, 0)), task).rgba
    assert expected[..., 3].max() > 0.2
    evaluations = []
    for occupancy in (True, False):
        field = EncodingField(slope, 1, mask(), arrays, occupancy=occupancy)  # type: ignore[arg-type]
        drawn = stream(field, task, adaptive=True).rgba
        np.testing.assert_allclose(drawn, expected, atol=2e-3)
        evaluations.append(field.evaluations)
    assert 0 < evaluations[0] < evaluations[1]


def test_slopes_are_those_of_the_encoding() -> None:
    arrays = TorchArrays(torch.device("cpu"))
    field = EncodingField(Slope(), 0, np.ones(SHAPE, dtype=bool), arrays, occupancy=True)  # type: ignore[arg-type]
    slopes = arrays.host(field.slopes(arrays.array([[3.0, 2.0, 1.0]])))
    np.testing.assert_allclose(slopes, [[0.1, 0.025, 0]], atol=1e-6)


def test_occupancy_and_adaptive_marching_are_told_apart() -> None:
    told: list[int] = []
    found = measure_latency(
        Slope(),  # type: ignore[arg-type]
        [mask(), mask()],
        FEATURE,
        size=12,
        views=2,
        progress=lambda *words: told.append(words[1]),
    )
    assert told == list(range(1, 9))
    off, on = found["off"], found["on"]
    assert min(entry[f"{mode}_ms"] for entry in (off, on) for mode in ("stream", "arm")) > 0
    assert on["evaluations"] <= on["samples"] < off["samples"] == off["evaluations"]
    for entry in (off, on):
        assert entry["arm_passes"] < entry["stream_passes"]
    again = measure_latency(Slope(), [mask(), mask()], FEATURE, size=12, views=2)  # type: ignore[arg-type]
    assert again["on"]["samples"] == on["samples"]
