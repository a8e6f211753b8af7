"""Data sets, features and protocols of the paper's evaluation, and key frames of them in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from fhash_bench.paper.printed import SETS as TITLES
from fhash_bench.paper.printed import TABLE_2
from fhash_codec.boxes import Sizes, bounding_box
from fhash_codec.config import EncodeConfig
from fhash_codec.features import occupancy
from fhash_codec.features.bricks import Coreset, build_coreset
from fhash_codec.features.features import Everything, Feature, FeatureChoice, Mask
from fhash_codec.features.scan import Scan
from fhash_codec.features.selection import resolve_selection
from fhash_codec.paper.network import level_resolutions, parameter_count
from fhash_codec.progress import Progress, silent
from fhash_codec.simulation.simulate import simulate
from fhash_formats.errors import InputError, suggestion
from fhash_formats.series import Series

Number = TypeVar("Number", int, float)

EMBEDDING_SIZE = 2
"""Numbers of an embedding (paper, section 4.2)."""
BATCH = 1 << 21
"""Samples of a batch (paper, section 4.2)."""
USUAL_COARSEST = 4
"""Corners per axis of the coarsest hashed level, for data that are not the paper's."""
TCNN_WEIGHTS = 16
"""Multiple to which tiny-cuda-nn pads the inputs and outputs of its fused network."""
WIDTH = 64
"""Neurons of a hidden layer (paper, section 4.2)."""


@dataclass(frozen=True, kw_only=True)
class PaperSet:
    """A data set of the paper, its analogue here, and what the paper prints of its encodings.

    Attributes:
        title: the paper's name.
        frame: vertices (z, y, x) (paper, Table 2).
        steps: time steps.
        key_frames: key frames.
        grid: corners (z, y, x) of the single-resolution dense grid. The paper does not print them;
            its counts of parameters come out with these alone.
        coarsest: corners per axis of the coarsest hashed level, in the same way.
        segmentation_box: vertices (z, y, x) of its feature bounding box (paper, Table 2).
    """

    title: str
    frame: Sizes
    steps: int
    key_frames: int
    grid: Sizes
    coarsest: int
    segmentation_box: Sizes


def _resembled(scene: str, grid: Sizes, coarsest: int) -> PaperSet:
    """Return the data set that a scene resembles, with what the paper does not print of it."""
    printed = TABLE_2[scene]
    (x, y, z), box = printed.shape, printed.box
    return PaperSet(
        title=TITLES[scene],
        frame=(z, y, x),
        steps=printed.steps,
        key_frames=printed.key_frames,
        grid=grid,
        coarsest=coarsest,
        segmentation_box=(box[2], box[1], box[0]),
    )


SETS: dict[str, PaperSet] = {
    "flame": _resembled("flame", (64, 192, 192), 8),
    "bubble": _resembled("bubble", (256, 128, 128), 4),
    "shell": _resembled("shell", (192, 192, 192), 4),
}
"""The paper's data sets, by the scene of the simulator that resembles them."""

SCALES = {"full": 1, "half": 2, "quarter": 4, "eighth": 8}
"""Divisors of the paper's lengths, by name."""


def paper_set(name: str) -> PaperSet:
    """Return the data set that a scene resembles; raises InputError for another name."""
    if name not in SETS:
        raise InputError(f"data set is '{name}'; {suggestion(name, SETS)}")
    return SETS[name]


def scaled(lengths: Sizes, divisor: int) -> Sizes:
    """Return lengths divided and rounded up: 200 x 172 x 54 at 4 is 50 x 43 x 14."""
    z, y, x = (-(-length // divisor) for length in lengths)
    return z, y, x


def hash_resolutions(frame: Sizes, coarsest: int) -> list[int]:
    """Return the corners per axis of the hashed levels, finest first.

    Each has half as many as the one before, down to `coarsest`; the finest is the first power of
    two times `coarsest` that covers the longest axis. The paper's sets get 6, 7 and 7 levels from
    256 down to 8, 4 and 4.
    """
    finest = coarsest
    while finest < max(frame):
        finest *= 2
    resolutions = [finest]
    while resolutions[-1] > coarsest:
        resolutions.append(resolutions[-1] // 2)
    return resolutions


def hash_table(frame: Sizes) -> int:
    """Return the buckets of a hash table: the largest power of two below the frame's vertices.

    The paper's sets get its 2^20, 2^21 and 2^23.
    """
    return 1 << max((prod(frame) - 1).bit_length() - 1, 4)


def dense_levels(grid: Sizes) -> list[Sizes]:
    """Return the corners (z, y, x) of the levels of a multi-resolution dense grid, finest first.

    Each level halves the one before, rounding up, as long as an axis has more than two corners.
    """
    levels = [grid]
    while max(levels[-1]) > 2:
        z, y, x = (-(-length // 2) for length in levels[-1])
        levels.append((z, y, x))
    return levels


def hash_parameters(frame: Sizes, coarsest: int, key_frames: int) -> int:
    """Return the numbers in the tables of the hash encoding: every level has a whole table."""
    levels = len(hash_resolutions(frame, coarsest))
    return levels * hash_table(frame) * EMBEDDING_SIZE * key_frames


def tcnn_tables(frame: Sizes, coarsest: int, key_frames: int) -> int:
    """Return the numbers in tiny-cuda-nn's tables: none is larger than its level's grid.

    A table has a multiple of 8 buckets.
    """
    table = hash_table(frame)
    buckets = (min(-(-(n**3) // 8) * 8, table) for n in hash_resolutions(frame, coarsest))
    return sum(buckets) * EMBEDDING_SIZE * key_frames


def tcnn_network(levels: int, key_frames: int) -> int:
    """Return the weights of tiny-cuda-nn's networks: two hidden layers, padded, without biases."""
    inputs = -(-levels * EMBEDDING_SIZE // TCNN_WEIGHTS) * TCNN_WEIGHTS
    return (inputs * WIDTH + WIDTH * WIDTH + WIDTH * TCNN_WEIGHTS) * key_frames


def dense_parameters(grid: Sizes, key_frames: int) -> int:
    """Return the numbers of a single-resolution dense grid for each key frame."""
    return prod(grid) * EMBEDDING_SIZE * key_frames


def dense_multi_parameters(grid: Sizes, key_frames: int) -> int:
    """Return the numbers of a multi-resolution dense grid for each key frame."""
    return sum(dense_parameters(level, key_frames) for level in dense_levels(grid))


def fhash_parameters(box: Sizes, key_frames: int, fold: int = 2) -> int:
    """Return the numbers in the tables of F-Hash."""
    return parameter_count(level_resolutions(box, key_frames, fold), EMBEDDING_SIZE)


def paper_parameters(name: str) -> dict[str, int]:
    """Return the parameters of each encoding at the paper's configuration of a data set.

    They are those of the tables; `tcnn` counts its networks too, as the paper's figures do.
    `fhash` is that of the segmentation.
    """
    known = paper_set(name)
    frame, keys = known.frame, known.key_frames
    levels = len(hash_resolutions(frame, known.coarsest))
    return {
        "hash": hash_parameters(frame, known.coarsest, keys),
        "tcnn": tcnn_tables(frame, known.coarsest, keys) + tcnn_network(levels, keys),
        "dense": dense_parameters(known.grid, keys),
        "dense-multi": dense_multi_parameters(known.grid, keys),
        "fhash": fhash_parameters(known.segmentation_box, keys),
    }


KINDS = ("interval", "isosurface", "segmentation")
"""Kinds of features in the paper."""
FEATURES: dict[str, dict[str, str]] = {
    "flame": {"interval": "interval:0.35:0.65", "isosurface": "isosurface:0.5"},
    "bubble": {"interval": "interval:0.3:0.7", "isosurface": "isosurface:0.5"},
    "shell": {"interval": "interval:0.3:0.6", "isosurface": "isosurface:0.4"},
}
"""Features of the scenes by kind; a segmentation is at Otsu's threshold. The paper's are not
printed."""
DILATION = 1
"""Vertices by which a feature grows (paper, Coreset Selection)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Data:
    """Samples that every encoding of a cell is trained on, and frames to compare it with.

    Attributes:
        name: flame, bubble, shell, or the name of the user's data.
        series: all steps.
        scanned: range and missing values of the series.
        features: the features, resolved.
        kind: interval, isosurface, segmentation, or the feature as the user wrote it.
        coreset: the samples of the feature at the key frames and their fringe, in the product's
            bricks.
        frames: normalised frames (z, y, x) of the key frames, float32; NaN where values are
            missing.
        background: normalised background outside the coreset.
    """

    name: str
    series: Series
    scanned: Scan
    features: tuple[Feature, ...]
    kind: str
    coreset: Coreset
    frames: tuple[npt.NDArray[np.float32], ...]
    background: float

    @property
    def frame_shape(self) -> Sizes:
        """Vertices (z, y, x) of a frame."""
        _, z, y, x = self.series.shape
        return z, y, x

    @property
    def key_frames(self) -> tuple[int, ...]:
        """Steps of the key frames."""
        return self.coreset.key_frames

    @property
    def raw_bytes(self) -> int:
        """Bytes of the values of all steps in the source's number type."""
        return prod(self.series.shape) * self.series.dtype.itemsize

    @property
    def key_range(self) -> tuple[float, float]:
        """Least and largest normalised value of the key frames."""
        low = min(float(np.nanmin(frame)) for frame in self.frames)
        high = max(float(np.nanmax(frame)) for frame in self.frames)
        return (low, high) if low < high else (0.0, 1.0)

    @cached_property
    def everything(self) -> Coreset:
        """Every finite vertex of the key frames, in a box that is the domain."""
        return self._single((Everything(),), 0)

    @cached_property
    def unfringed(self) -> Coreset:
        """The samples of `coreset` without its fringe."""
        return self._single(self.features, DILATION)

    @cached_property
    def boxes(self) -> Coreset:
        """Every finite vertex of the bounding box of the coreset at each key frame."""
        number = {step: key for key, step in enumerate(self.key_frames)}

        def inside(step: int) -> npt.NDArray[np.bool_]:
            mask = self.masks[number[step]]
            filled = np.zeros_like(mask)
            box = bounding_box(mask)
            if box is not None:
                filled[box.slices()] = True
            return filled

        return self._single((Mask("boxes", read=inside),), 0)

    def _single(self, features: tuple[Feature, ...], dilation: int) -> Coreset:
        """Samples in bricks of one vertex, so that batches are of shuffled vertices."""
        return build_coreset(
            self.series,
            self.scanned,
            FeatureChoice(self.key_frames, features, dilation),
            silent,
            brick=(1, 1, 1),
        )

    @cached_property
    def masks(self) -> tuple[npt.NDArray[np.bool_], ...]:
        """The coreset of each key frame as a mask (z, y, x) of the domain."""
        masks = []
        for bits in self.coreset.occupancy:
            mask = np.zeros(self.frame_shape, np.bool_)
            mask[self.coreset.box.slices()] = occupancy.unpack(bits, self.coreset.box.shape)
            masks.append(mask)
        return tuple(masks)


def simulated(name: str, scale: str, seed: int = 0) -> Series:
    """Return the series of a scene at a part of the paper's lengths, its steps included.

    Args:
        name: flame, bubble or shell.
        scale: full, half, quarter or eighth.
        seed: seed of the scene.

    Raises:
        InputError: there is no such scene or scale.
    """
    known = paper_set(name)
    if scale not in SCALES:
        raise InputError(f"scale is '{scale}'; allowed: {', '.join(SCALES)}")
    divisor = SCALES[scale]
    return simulate(name, (-(-known.steps // divisor), *scaled(known.frame, divisor)), seed)


def feature_text(name: str, kind: str) -> str:
    """Return the feature of a kind as the codec takes it: a scene's own, else `kind` itself."""
    return FEATURES.get(name, {}).get(kind, kind)


def gather_data(
    name: str, series: Series, kind: str, key_frames: str, progress: Progress = silent
) -> Data:
    """Read the key frames of a series and gather the samples of a feature.

    Args:
        name: name of the data set.
        series: the series; its frames are read a few times, and the key frames are kept.
        kind: kind of the feature, or a feature as `fhash encode --feature` takes it.
        key_frames: which steps, as `fhash encode --key-frames` takes it.
        progress: called with each step of the work.

    Raises:
        InputError: the settings do not fit the series, or they select nothing.
    """
    config = EncodeConfig(
        preset="published",
        tables="float16",
        features=(feature_text(name, kind),),
        key_frames=key_frames,
    )
    scanned, keys, features = resolve_selection(series, config, progress, None)
    choice = FeatureChoice(keys, features, DILATION)
    coreset = build_coreset(series, scanned, choice, progress, fringe=True)
    frames = tuple(scanned.value_range.to_unit(series.read(step)) for step in keys)
    return Data(
        name=name,
        series=series,
        scanned=scanned,
        features=features,
        kind=kind,
        coreset=coreset,
        frames=frames,
        background=float(scanned.value_range.to_unit(coreset.background)),
    )


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
