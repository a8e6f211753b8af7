"""The protocol of an encoding: what is trained serves it."""

from __future__ import annotations

import torch

from fhash_codec.bench.paper import sets
from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings import encoding
from fhash_codec.bench.paper.encodings.build import build
from fhash_codec.bench.paper.protocols import arrangement


def test_a_trained_encoding_serves_the_protocol(data: Data) -> None:
    built: encoding.Encoding = build(
        "hash",
        data,
        arrangement("equal", "hash", data),
        steps=1,
        epochs=1,
        seed=1,
        device=torch.device("cpu"),
    )
    named = [name for name in vars(encoding.Encoding) if not name.startswith("_")]
    assert len(named) >= 11
    assert all(hasattr(built, name) for name in named)


def test_constants_agree() -> None:
    assert encoding.EMBEDDING_SIZE == sets.EMBEDDING_SIZE
    assert encoding.WIDTH == sets.WIDTH
