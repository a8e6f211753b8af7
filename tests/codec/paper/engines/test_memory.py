"""Memory of a training on a device: not less than it takes, and not far more."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.memory import LIBRARIES, TIMES, UNEVEN, needed_bytes
from fhash_codec.paper.engines.slab import SlabEngine


class Made(TorchDispatchMode):
    """Counts the bytes of all tensors that are made, also of those that are freed again."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        known = {id(each.untyped_storage()) for each in tensors(args)}
        known |= {each.data_ptr() for each in tensors(args)}
        for each in tensors(result):
            self.bytes += each.nbytes if each.data_ptr() not in known else 0
        return result


def tensors(values: Any) -> list[torch.Tensor]:
    return [each for each in tree_flatten(values)[0] if isinstance(each, torch.Tensor)]


@pytest.mark.parametrize("low", [0.0, 0.7])
@pytest.mark.parametrize("settings", [{"hidden_layers": 1, "width": 64}, {"hidden_layers": 2}])
def test_a_training_needs_what_is_said(
    noise_coreset: Callable[..., Coreset], settings: dict[str, int], low: float
) -> None:
    coreset = noise_coreset((3, 30, 40, 50), low)
    architecture = Architecture.for_box(coreset.box.shape, 3, **{"width": 16, **settings})
    bricks = len(coreset.bricks)
    needed = needed_bytes(architecture, coreset, 8) - LIBRARIES
    engine = SlabEngine(architecture, coreset, np.full(3, 0.01), seed=0, device=torch.device("cpu"))
    every = tensors([*vars(engine).values(), *vars(engine.upsampling).values()])
    # Some are views of the same memory.
    storages = {each.data_ptr(): each for each in (t.untyped_storage() for t in every)}
    held = sum(each.nbytes() for each in storages.values())
    batch = np.arange(min(UNEVEN * -(-bricks // 8), bricks))
    with Made() as made:
        engine.train(batch)
    assert held < needed
    # Much of what a step makes is freed before its end.
    assert 0.5 * (held + made.bytes) < needed < held + 2 * TIMES * made.bytes


def test_more_of_anything_needs_more(noise_coreset: Callable[..., Coreset]) -> None:
    def needed(shape: tuple[int, ...], batches: int = 8, **settings: int) -> int:
        coreset = noise_coreset(shape, 0.0)
        architecture = Architecture.for_box(coreset.box.shape, shape[0], **settings)
        return needed_bytes(architecture, coreset, batches)

    usual = needed((2, 20, 30, 40))
    assert usual > LIBRARIES
    assert needed((4, 20, 30, 40)) > usual
    assert needed((2, 20, 30, 40), width=128) > usual
    assert needed((2, 20, 30, 40), embedding_size=4) > usual
    assert needed((2, 20, 30, 40), batches=2) > usual
