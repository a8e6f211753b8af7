"""Streaming by torch: the picture and the work of numpy, and nothing leaves the device before."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec import Volume
from fhash_codec.rendering.stream.fields import Field
from fhash_codec.rendering.stream.stream import stream
from fhash_codec.rendering.task.arrays import NUMPY, Arrays
from fhash_codec.rendering.task.devices import arrays_on
from fhash_codec.rendering.task.task import Marched, Task
from fhash_formats.errors import InputError

Planned = Callable[[Volume, dict[str, Any], Arrays], tuple[Field, Task]]


def assert_same_work(here: Marched, there: Marched, scene: dict[str, Any]) -> None:
    """Equal counters, but for the turns of the search for surfaces, which rounding decides."""
    searched = here.counters["evaluations"] - there.counters["evaluations"]
    assert abs(searched) <= (
        0.05 * here.counters["evaluations"] if "isosurfaces" in scene.get("effects", {}) else 0
    )
    alike = {
        **there.counters,
        **{count: there.counters[count] + searched for count in ("samples", "evaluations")},
    }
    assert alike == here.counters


@pytest.mark.parametrize("adaptive", [False, True])
def test_torch_makes_the_picture_of_numpy(
    planned: Planned, volume: Volume, tensors: Arrays, scene: dict[str, Any], adaptive: bool
) -> None:
    here, there = (
        stream(*planned(volume, scene, arrays), adaptive=adaptive, budget=3000)
        for arrays in (NUMPY, tensors)
    )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-5)
    assert_same_work(here, there, scene)
    for mine, other in ((here.depth, there.depth), (here.normal, there.normal)):
        assert (mine is None) == (other is None)
        if mine is not None and other is not None:
            np.testing.assert_allclose(other, mine, atol=1e-5)


def test_nothing_leaves_the_device_before_the_picture(
    planned: Planned, volume: Volume, tensors: Arrays
) -> None:
    import torch
    from torch.overrides import TorchFunctionMode

    taken = []

    class Watched(type(tensors)):  # type: ignore[misc]
        def host(self, array: Any) -> np.ndarray:
            taken.append(array.numel())
            with torch._C.DisableTorchFunction():
                return super().host(array)

    class Watch(TorchFunctionMode):
        def __torch_function__(
            self, function: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            name = function.__name__
            assert name not in ("cpu", "numpy", "__array__", "cuda"), name
            assert name != "tolist" or args[0].numel() <= 2  # the counts of a pass
            assert function.__name__ == "from_numpy" or not any(
                isinstance(each, (np.ndarray, np.generic)) for each in args
            ), function
            return function(*args, **(kwargs or {}))

    effects = {
        "shadows": True,
        "shading": {"gradient": "central"},
        "isosurfaces": [{"value": 5, "opacity": 0.5}],
    }
    scene = {"effects": {**effects, "buffers": ["depth", "normal"], "jitter": True}}
    field, task = planned(volume, scene, Watched(torch.device("cpu")))
    with Watch():
        marched = stream(field, task, adaptive=True, budget=3000)
    assert marched.rgba.any()
    rays = 40 * 34
    assert sorted(taken) == [rays, 3 * rays, 4 * rays]


def test_torch_marches_through_a_network_as_numpy_does(
    planned: Planned, files: dict[str, Path], tensors: Arrays, network_scene: dict[str, Any]
) -> None:
    with fhash_codec.open(files["paper"]) as network:
        here, there = (
            stream(*planned(network, network_scene, arrays), adaptive=True)
            for arrays in (NUMPY, tensors)
        )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    assert there.counters["evaluations"] > 0
    assert_same_work(here, there, network_scene)
    if here.normal is not None:
        assert here.normal.any()
        np.testing.assert_allclose(there.depth, here.depth, atol=1e-3)
        np.testing.assert_allclose(there.normal, here.normal, atol=1e-3)


@pytest.mark.parametrize("kind", ["compact", "paper"])
def test_cuda_makes_the_picture_of_numpy(
    files: dict[str, Path], planned: Planned, central_scene: dict[str, Any], kind: str
) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    with fhash_codec.open(files[kind]) as opened:
        here, there = (
            stream(*planned(opened, central_scene, arrays_on(device)), adaptive=True)
            for device in ("cpu", "cuda")
        )
    assert here.rgba[..., 3].max() > 0.05
    np.testing.assert_allclose(there.rgba, here.rgba, atol=1e-4)
    np.testing.assert_allclose(there.normal, here.normal, atol=1e-3)
    assert there.counters["rays"] == here.counters["rays"]


def test_a_device_without_enough_memory_says_so(
    planned: Planned, volume: Volume, tensors: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch

    def full(places: object, wanted: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    field, task = planned(volume, {}, tensors)
    monkeypatch.setattr(field, "values", full)
    with pytest.raises(InputError, match="memory of the device"):
        stream(field, task, adaptive=True)
