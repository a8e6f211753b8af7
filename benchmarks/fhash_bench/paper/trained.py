"""Encodings by name, the models that they train, and the hash encoding of tiny-cuda-nn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_bench.paper.data import (
    EMBEDDING_SIZE,
    RATE,
    SETS,
    USUAL_COARSEST,
    WIDTH,
    Arrangement,
    Data,
    dense_levels,
    hash_resolutions,
    hash_table,
    scaled,
    tcnn_network,
    tcnn_tables,
)
from fhash_bench.paper.encodings import (
    HIDDEN_LAYERS,
    GatherModel,
    GridLevel,
    HashLevel,
    LatticeModel,
    Level,
    Values,
    adam_step,
    of_key_frame,
)
from fhash_codec.boxes import Sizes
from fhash_codec.features.bricks import Coreset, sample_places
from fhash_codec.paper.network import ceil_log, level_resolutions
from fhash_codec.paper.train import TrainingPlan
from fhash_formats.errors import MissingDependencyError

CHUNK = 1 << 18
"""Points that are evaluated at a time."""
PACKAGE = "tinycudann"
"""Name of the package in Python."""


def missing() -> str | None:
    """Return in one line why tiny-cuda-nn cannot be used here; None where it can."""
    if find_spec(PACKAGE) is None:
        return "tcnn: tiny-cuda-nn is not installed (https://github.com/NVlabs/tiny-cuda-nn)"
    if not torch.cuda.is_available():
        return "tcnn: tiny-cuda-nn needs a CUDA device, and torch finds none here"
    return None


class TcnnModel:
    """tiny-cuda-nn's model of one key frame, trained by Adam on its float32 numbers."""

    def __init__(
        self,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        coarsest: int,
        seed: int,
        device: torch.device,
    ) -> None:
        """Start from tiny-cuda-nn's own random numbers.

        Args:
            coreset: the training samples, of one key frame.
            rates: learning rate of every training step, counted from 1.
            coarsest: corners per axis of the coarsest level.
            seed: seed of the initial numbers.
            device: a CUDA device.

        Raises:
            MissingDependencyError: the package or the device is missing.
        """
        reason = missing()
        if reason is not None:
            raise MissingDependencyError(reason)
        box = coreset.box.shape
        resolutions = hash_resolutions(box, coarsest)
        self.tables = tcnn_tables(box, coarsest, 1)
        self.mlp = tcnn_network(len(resolutions), 1)
        self.coreset, self.rates, self.device, self.step = coreset, rates, device, 0
        self.model: Any = import_module(PACKAGE).NetworkWithInputEncoding(
            3,
            1,
            {
                "otype": "HashGrid",
                "n_levels": len(resolutions),
                "n_features_per_level": EMBEDDING_SIZE,
                "log2_hashmap_size": hash_table(box).bit_length() - 1,
                "base_resolution": coarsest,
                "per_level_scale": 2.0,
            },
            {
                "otype": "FullyFusedMLP",
                "activation": "ReLU",
                "output_activation": "None",
                "n_neurons": WIDTH,
                "n_hidden_layers": HIDDEN_LAYERS,
            },
            seed=seed + 1,
        )
        self.parameters: Tensor = self.model.params
        if self.parameters.numel() != self.tables + self.mlp:
            raise MissingDependencyError(
                f"tcnn: this tiny-cuda-nn has {self.parameters.numel():,} parameters where"
                f" {self.tables + self.mlp:,} are expected; use another version"
            )
        self._moments = [torch.zeros_like(self.parameters) for _ in range(2)]
        self._span = torch.tensor([max(length - 1, 1) for length in box], device=device)
        self._points = self._unit(torch.from_numpy(sample_places(coreset)[:, 1:]))
        self._values = torch.from_numpy(coreset.values).to(device)

    @property
    def embeddings(self) -> int:
        """Embeddings of all levels."""
        return self.tables // EMBEDDING_SIZE

    def train(self, chosen: npt.NDArray[np.int64]) -> None:
        """Do one step of Adam on the mean squared error of some bricks."""
        self.step += 1
        samples = torch.from_numpy(self.coreset.sample_indices(chosen)).to(self.device)
        error = (self._network(self._points[samples]) - self._values[samples]).square().mean()
        (gradient,) = torch.autograd.grad(error, self.parameters)
        with torch.no_grad():
            rate = float(self.rates[self.step])
            mean, square = self._moments
            adam_step(self.parameters, gradient, mean, square, self.step, rate)

    def settle(self) -> None:
        """Do nothing: every number takes part in every step."""

    @torch.no_grad()
    def infer(self, samples: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Values (n,) at samples of the coreset by their numbers."""
        points = self._points[torch.from_numpy(samples).to(self.device)]
        return self._evaluated(points).cpu().numpy()

    @torch.no_grad()
    def sample(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 4) of the box, (key, z, y, x)."""
        return self._evaluated(self._unit(points[:, 1:]))

    def moved(self) -> int:
        """Embeddings that a gradient ever moved; tiny-cuda-nn keeps its network's weights first."""
        square = self._moments[1][self.mlp :].view(-1, EMBEDDING_SIZE)
        return int((square != 0).any(1).sum())

    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """All numbers in one vector, 0 where no gradient moved them."""
        return [torch.where(self._moments[1] != 0, self.parameters.detach(), 0.0).cpu().numpy()]

    def _unit(self, places: Tensor) -> Tensor:
        """Places (n, 3) in vertices of the box as tiny-cuda-nn has them: (x, y, z) in 0 to 1."""
        return (places.to(self.device) / self._span).flip(1).float()

    def _network(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 3)."""
        values: Tensor = self.model(points).float()
        return values.squeeze(1)

    def _evaluated(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 3), some at a time."""
        return torch.cat([self._network(part) for part in torch.split(points, CHUNK)])


Model = GatherModel | LatticeModel | TcnnModel
"""Tables and one network, for one or all key frames."""


@dataclass(frozen=True)
class Part:
    """A model with its samples.

    Attributes:
        keys: numbers of the key frames that the model holds.
        coreset: their samples.
        plan: its batches.
        model: the model.
    """

    keys: tuple[int, ...]
    coreset: Coreset
    plan: TrainingPlan
    model: Model


class TrainedEncoding:
    """All key frames of one series in training: one model, or one for each key frame.

    A place is (z, y, x) in vertices of the domain. A key is the number of a key frame, from 0 on.
    """

    def __init__(
        self,
        name: str,
        parts: Sequence[Part],
        data: Data,
        *,
        in_time: bool,
        collisions: float,
        unit: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        """Join parts.

        Args:
            name: name of the encoding.
            parts: the models.
            data: what they are trained on.
            in_time: whether a model interpolates in time by itself.
            collisions: share of the corners of the tables that share their bucket.
            unit: normalised values that are 0 and 1 for the models.
        """
        self.name, self.parts, self.data = name, tuple(parts), data
        self.in_time, self.collisions = in_time, collisions
        self._low, self._span = unit[0], unit[1] - unit[0]
        self._part = {key: part for part in parts for key in part.keys}
        # Flat places in a frame of the samples of each key frame, and their first and last number.
        self._places: dict[int, npt.NDArray[np.int32]] = {}
        self._numbers: dict[int, tuple[int, int]] = {}
        for part in parts:
            places, box = sample_places(part.coreset), part.coreset.box
            for local, key in enumerate(part.keys):
                # The samples come key frame by key frame.
                first, end = np.searchsorted(places[:, 0], [local, local + 1])
                at = places[first:end, 1:] + np.array(box.first, np.int32)
                flat = np.ravel_multi_index(tuple(at.T), data.frame_shape)
                self._places[key] = flat.astype(np.int32)
                self._numbers[key] = int(first), int(end)

    @property
    def tables(self) -> int:
        """Trained numbers in the tables of all models."""
        return sum(part.model.tables for part in self.parts)

    @property
    def mlp(self) -> int:
        """Trained numbers in the networks of all models."""
        return sum(part.model.mlp for part in self.parts)

    @property
    def samples_an_epoch(self) -> int:
        """Samples that all models together see in an epoch."""
        return sum(len(part.coreset.values) for part in self.parts)

    @property
    def steps_an_epoch(self) -> int:
        """Adam steps of each model in an epoch; the most where they differ."""
        return max(part.plan.batches for part in self.parts)

    def train_epoch(self, epoch: int) -> None:
        """Train every model on all of its samples once; epochs count from 0.

        On a GPU the work may still run when this returns.
        """
        for part in self.parts:
            for chosen in part.plan.order(epoch):
                part.model.train(chosen)

    def settle(self) -> None:
        """Finish work that training put off: evaluation is then faster until the next epoch."""
        for part in self.parts:
            part.model.settle()

    def buckets_used(self) -> float:
        """Share of the embeddings of all tables that a gradient ever moved."""
        total = sum(part.model.embeddings for part in self.parts)
        return sum(part.model.moved() for part in self.parts) / total

    def frame(self, key: int) -> Values:
        """Values (z, y, x) of a key frame, the background where no model was trained."""
        frame = np.full(self.data.frame_shape, self.data.background, np.float32)
        if key in self._part:
            numbers = np.arange(*self._numbers[key])
            values = self._part[key].model.infer(numbers)
            frame.reshape(-1)[self._places[key]] = self._low + self._span * values
        return frame

    def sample(self, key: float, places: Tensor) -> Tensor:
        """Values (n,) at places (n, 3), of integers or floats, of a time in key frames.

        Those outside the box are the background.

        Between key frames F-Hash interpolates its embeddings, and the values of the others are
        interpolated.
        """
        before = min(int(key), len(self.data.key_frames) - 1)
        share = key - before
        if share > 0 and not self.in_time:
            return torch.lerp(self.sample(before, places), self.sample(before + 1, places), share)
        part = self._part.get(before)
        if part is None:
            return torch.full((len(places),), self.data.background, device=places.device)
        box = part.coreset.box
        first = torch.tensor(box.first, dtype=torch.float64, device=places.device)
        last = first + torch.tensor(box.shape, dtype=torch.float64, device=places.device) - 1
        inside = ((places >= first) & (places <= last)).all(1)
        # A tensor like `places` would cut the share of an integer's time to 0.
        time = torch.full((len(places), 1), part.keys.index(before) + share, dtype=torch.float64)
        points = torch.cat([time.to(places.device), places - first], 1)
        values = part.model.sample(points).to(places.device)
        return torch.where(inside, self._low + self._span * values, self.data.background)

    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """The trained numbers of all models; embeddings that no gradient moved are 0."""
        return [array for part in self.parts for array in part.model.arrays()]


def build(
    name: str,
    data: Data,
    arranged: Arrangement,
    *,
    steps: int,
    epochs: int,
    seed: int,
    device: torch.device,
) -> TrainedEncoding:
    """Return an encoding before its training.

    Args:
        name: dense, dense-multi, hash, tcnn or fhash.
        data: what it is trained on.
        arranged: how it is trained.
        steps: Adam steps of each model in an epoch, at most the bricks of its samples.
        epochs: epochs that will be trained at most.
        seed: seed of the initial numbers and of the order of the samples.
        device: where it is trained.

    Raises:
        MissingDependencyError: tcnn, where tiny-cuda-nn or a CUDA device is missing.
    """
    samples: Coreset = getattr(data, arranged.samples)
    unit = data.key_range if arranged.released else (0.0, 1.0)
    if arranged.released:
        values = (samples.values - unit[0]) / (unit[1] - unit[0])
        samples = replace(samples, values=values.astype(np.float32))
    keys = tuple(range(len(data.key_frames)))
    pieces = (
        [(keys, samples)]
        if arranged.joint
        else [((key,), of_key_frame(samples, key)) for key in keys]
    )
    parts: list[Part] = []
    for part_keys, coreset in pieces:
        if not len(coreset.bricks):
            continue
        # Models of single key frames must not start alike.
        part_seed = seed * len(keys) + part_keys[0]
        plan = _plan(coreset, steps, epochs, part_seed, arranged.schedule)
        before = parts[-1].model if parts else None
        model = _model(name, data, arranged, coreset, plan, device, before)
        parts.append(Part(part_keys, coreset, plan, model))
    levels = levels_of(name, data, samples, arranged) if name == "hash" else []
    hashed = [level for level in levels if isinstance(level, HashLevel)]
    corners = [level.corners_per_axis**3 for level in hashed]
    collided = sum(level.collisions() * n for level, n in zip(hashed, corners, strict=True))
    return TrainedEncoding(
        name,
        parts,
        data,
        in_time=name == "fhash",
        unit=unit,
        collisions=collided / sum(corners) if corners else 0.0,
    )


def levels_of(name: str, data: Data, coreset: Coreset, arranged: Arrangement) -> Sequence[Level]:
    """Return the levels of an encoding for the key frames and the box of some samples.

    Dense grids have the resolution of the box; where they cover the whole domain of an analogue of
    the paper's data, that of the paper's grid, scaled as the data are.
    """
    box, count = coreset.box.shape, len(coreset.key_frames)
    sizes = (count, *box)
    if name == "fhash":
        resolutions = level_resolutions(box, count, 2)
        if arranged.released:
            resolutions = resolutions[: max(1, ceil_log(min(box), 2))]
        return [GridLevel(resolution, sizes, False) for resolution in resolutions]
    if name == "hash":
        coarsest = SETS[data.name].coarsest if data.name in SETS else USUAL_COARSEST
        table = hash_table(box)
        return [HashLevel(n, table, sizes) for n in hash_resolutions(box, coarsest)]
    grid = paper_grid(data) if arranged.whole else box
    grids = dense_levels(grid) if name == "dense-multi" else [grid]
    return [GridLevel((count, *level), sizes, True) for level in grids]


def paper_grid(data: Data) -> Sizes:
    """Return the corners (z, y, x) of the paper's dense grid at the scale of some data."""
    known = SETS.get(data.name)
    if known is None:
        return data.frame_shape
    divisor = round(max(known.frame) / max(data.frame_shape))
    return scaled(known.grid, divisor)


def _model(
    name: str,
    data: Data,
    arranged: Arrangement,
    coreset: Coreset,
    plan: TrainingPlan,
    device: torch.device,
    before: Model | None,
) -> Model:
    """Return a model of the arranged engine; arguments as of `build`.

    before: the model of the key frame before, whose corners it may share.
    """
    if arranged.engine == "tcnn":
        coarsest = SETS[data.name].coarsest if data.name in SETS else USUAL_COARSEST
        return TcnnModel(coreset, plan.rates, coarsest=coarsest, seed=plan.seed, device=device)
    levels = levels_of(name, data, coreset, arranged)
    if arranged.engine == "lattice":
        grids = [level for level in levels if isinstance(level, GridLevel)]
        return LatticeModel(grids, coreset, plan.rates, seed=plan.seed, device=device)
    like = before if isinstance(before, GatherModel) else None
    return GatherModel(levels, coreset, plan.rates, seed=plan.seed, device=device, like=like)


def _plan(coreset: Coreset, steps: int, epochs: int, seed: int, schedule: str) -> TrainingPlan:
    """Return the batches of a model: whole bricks, in an order of their own each epoch."""
    batches = min(steps, len(coreset.bricks))
    share = np.arange(epochs * batches + 1) / (epochs * batches)
    falling = 0.5 + 0.5 * np.cos(np.pi * share)
    return TrainingPlan(
        epochs=epochs,
        counts=np.diff(coreset.offsets),
        batches=batches,
        seed=seed,
        rates=RATE * (falling if schedule == "cosine" else np.ones_like(share)),
    )
