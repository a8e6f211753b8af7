"""Protocols: which samples an encoding is trained on, by how many steps, and by which engine."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.sets import BATCH, SETS
from fhash_codec.coreset.boxes import Sizes
from fhash_formats.errors import InputError

ENCODINGS = ("dense", "dense-multi", "hash", "tcnn", "fhash")
"""Names of the encodings."""
PROTOCOLS = ("published", "equal", "best")
"""Names of the protocols."""
EQUAL_BATCH = 1 << 16
"""Largest number of samples of a batch of the protocol equal, as in the product."""
EQUAL_STEPS = (20, 256)
"""Smallest and largest number of steps in an epoch of the protocol equal, as in the product."""
RATE = 0.01
"""Learning rate of Adam at the start (paper, section 4.2); no schedule is printed."""
CANDIDATES = (5, 20, 80)
"""Steps in an epoch among which the protocol best chooses, for each encoding."""


@dataclass(frozen=True, kw_only=True)
class Arrangement:
    """Samples, models, steps and engine of a training.

    Attributes:
        joint: whether one model with one network holds all key frames; else each has its own.
        whole: whether every vertex of the domain is a sample; else those of the coreset are, and
            the model covers the feature bounding box.
        steps: Adam steps of each model in an epoch; several are candidates, which are all trained,
            and of which the best counts.
        engine: gather, lattice or tcnn.
        schedule: of the learning rate: constant, or cosine, which falls to zero over all epochs.
    """

    joint: bool
    whole: bool
    steps: tuple[int, ...]
    engine: str
    schedule: str = "constant"


def arrangement(protocol: str, encoding: str, data: Data) -> Arrangement:
    """Return how a protocol trains an encoding on some data.

    - `published`: F-Hash is one model on the coreset; the others have one model for each key
      frame, on all of its vertices. All are trained by the gather engine. A batch is the paper's,
      scaled by the vertices of a frame over those of the paper's frame.
    - `equal`: every encoding is one model with one network, on the coreset and in its box. All get
      the same batches, by the gather engine.
    - `best`: as `equal`, with the fastest engine of each encoding, its best steps, and a rate that
      falls to zero, as the product trains. A constant one lets every encoding jump by many dB
      between epochs, the more the smaller the batches are.

    tiny-cuda-nn joins no key frames: it has a model for each of them in every protocol.

    Raises:
        InputError: the name of the protocol or of the encoding is unknown.
    """
    if protocol not in PROTOCOLS or encoding not in ENCODINGS:
        raise InputError(
            f"protocol '{protocol}' with encoding '{encoding}'; allowed: {', '.join(PROTOCOLS)}"
            f" with {', '.join(ENCODINGS)}"
        )
    joint = encoding != "tcnn"
    engine = "tcnn" if encoding == "tcnn" else "gather"
    samples = len(data.coreset.values)
    if protocol == "published":
        batch = published_batch(data.name, data.frame_shape)
        whole = encoding != "fhash"
        in_batches = prod(data.frame_shape) if whole else samples
        steps = (-(-in_batches // batch),)
        return Arrangement(joint=not whole, whole=whole, steps=steps, engine=engine)
    low, high = EQUAL_STEPS
    if protocol == "equal":
        steps = (min(max(-(-samples // EQUAL_BATCH), low), high),)
        return Arrangement(joint=joint, whole=False, steps=steps, engine=engine)
    fastest = "lattice" if encoding in ("dense", "dense-multi", "fhash") else engine
    return Arrangement(
        joint=joint, whole=False, steps=CANDIDATES, engine=fastest, schedule="cosine"
    )


def published_batch(name: str, frame: Sizes) -> int:
    """Return the paper's batch for a frame (z, y, x), in samples.

    A smaller frame of an analogue has a batch that is smaller by as much, so that the steps in an
    epoch of a frame are the paper's 1, 2 and 5. Other data have the paper's batch itself.
    """
    if name not in SETS:
        return BATCH
    return max(1, round(BATCH * prod(frame) / prod(SETS[name].frame)))
