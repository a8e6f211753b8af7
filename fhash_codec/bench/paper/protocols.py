"""Protocols: which samples an encoding is trained on, by how many steps, and by which engine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Literal

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.sets import BATCH, SETS
from fhash_codec.boxes import Sizes
from fhash_formats.errors import InputError

ENCODINGS = ("dense", "dense-multi", "hash", "tcnn", "fhash")
"""Names of the encodings."""
PROTOCOLS = ("published", "released", "equal", "best")
"""Names of the protocols."""
EQUAL_BATCH = 1 << 16
"""Largest number of samples of a batch of the protocol equal, as in the product."""
EQUAL_STEPS = (20, 256)
"""Smallest and largest number of steps in an epoch of the protocol equal, as in the product."""
RATE = 0.01
"""Learning rate of Adam at the start (paper, section 4.2); no schedule is printed."""
RELEASED_BATCH = 2_000_000
"""Samples of a batch of the authors' released code."""
RELEASED_EPOCHS = 2
"""Epochs of the protocol released for one of the others: the code has 120, the paper 60."""
CANDIDATES = (5, 20, 80)
"""Steps in an epoch among which the protocol best chooses, for each encoding."""


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """Samples, models, steps and engine of a training.

    Attributes:
        joint: whether one model with one network holds all key frames; else each has its own.
        samples: the attribute of `Data` that holds the samples. The model covers their box.
        steps: Adam steps of each model in an epoch; several are candidates, which are all trained,
            and of which the best counts.
        engine: gather, lattice or tcnn.
        schedule: of the learning rate: constant, or cosine, which falls to zero over all epochs.
        released: whether F-Hash is that of the authors' released code. It has as many levels as the
            shortest axis of the box gives, and values from 0 to 1 over the key frames.
    """

    joint: bool
    samples: Literal["coreset", "unfringed", "boxes", "everything"]
    steps: tuple[int, ...]
    engine: str
    schedule: str = "constant"
    released: bool = False

    @property
    def whole(self) -> bool:
        """Whether every vertex of the domain is a sample."""
        return self.samples == "everything"


def arrangement(protocol: str, encoding: str, data: Data) -> Arrangement:
    """Return how a protocol trains an encoding on some data.

    - `published`: F-Hash is one model on the coreset without a fringe; the others have one model
      for each key frame, on all of its vertices. All are trained by the gather engine. A batch is
      the paper's, scaled by the vertices of a frame over those of the paper's frame, and holds
      shuffled vertices.
    - `released`: F-Hash as in the authors' released code, on every vertex of the feature's bounding
      box at each key frame, for twice the epochs. It has no other encoding; those of `published`
      stand beside it.
    - `equal`: every encoding is one model with one network, on the coreset and its fringe, in their
      box. All get the same batches of bricks, by the gather engine.
    - `best`: as `equal`, with the fastest engine of each encoding, its best steps, and a rate that
      falls to zero, as the product trains. A constant one lets every encoding jump by many dB
      between epochs, the more the smaller the batches are.

    tiny-cuda-nn joins no key frames: it has a model for each of them in every protocol.

    Raises:
        InputError: the name of the protocol or of the encoding is unknown, or the protocol does not
            have the encoding.
    """
    if protocol not in PROTOCOLS or encoding not in encodings_of(protocol, ENCODINGS):
        raise InputError(
            f"protocol '{protocol}' with encoding '{encoding}'; allowed: {', '.join(PROTOCOLS)}"
            f" with {', '.join(ENCODINGS)}, released with fhash alone"
        )
    joint = encoding != "tcnn"
    engine = "tcnn" if encoding == "tcnn" else "gather"
    batch = published_batch(data.name, data.frame_shape)
    if protocol == "released":
        steps = (-(-len(data.boxes.values) * BATCH // (batch * RELEASED_BATCH)),)
        return Arrangement(joint=True, samples="boxes", steps=steps, engine=engine, released=True)
    if protocol == "published" and encoding == "fhash":
        steps = (-(-len(data.unfringed.values) // batch),)
        return Arrangement(joint=True, samples="unfringed", steps=steps, engine=engine)
    if protocol == "published":
        steps = (-(-prod(data.frame_shape) // batch),)
        return Arrangement(joint=False, samples="everything", steps=steps, engine=engine)
    low, high = EQUAL_STEPS
    if protocol == "equal":
        steps = (min(max(-(-len(data.coreset.values) // EQUAL_BATCH), low), high),)
        return Arrangement(joint=joint, samples="coreset", steps=steps, engine=engine)
    fastest = "lattice" if encoding in ("dense", "dense-multi", "fhash") else engine
    return Arrangement(
        joint=joint, samples="coreset", steps=CANDIDATES, engine=fastest, schedule="cosine"
    )


def encodings_of(protocol: str, encodings: Sequence[str]) -> list[str]:
    """Return those of some encodings that a protocol has."""
    return [name for name in encodings if protocol != "released" or name == "fhash"]


def published_batch(name: str, frame: Sizes) -> int:
    """Return the paper's batch for a frame (z, y, x), in samples.

    A smaller frame of an analogue has a batch that is smaller by as much, so that the steps in an
    epoch of a frame are the paper's 1, 2 and 5. Other data have the paper's batch itself.
    """
    if name not in SETS:
        return BATCH
    return max(1, round(BATCH * prod(frame) / prod(SETS[name].frame)))
