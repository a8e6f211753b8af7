"""An encoding of all key frames: the models that share them, their samples and their batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.bench.paper.data import Data
from fhash_codec.bench.paper.encodings.encoding import Values
from fhash_codec.bench.paper.encodings.places import sample_places
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.train import TrainingPlan


class Model(Protocol):
    """Tables and one network, for one or all key frames."""

    @property
    def tables(self) -> int:
        """Trained numbers of the tables."""

    @property
    def mlp(self) -> int:
        """Trained numbers of the network."""

    @property
    def embeddings(self) -> int:
        """Embeddings of all levels."""

    def train(self, chosen: npt.NDArray[np.int64]) -> None:
        """Do one step of Adam on the mean squared error of some bricks of the coreset."""

    def settle(self) -> None:
        """Finish work that training put off."""

    def infer(self, samples: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Values (n,) at the samples of successive whole bricks, by their ascending numbers."""

    def sample(self, points: Tensor) -> Tensor:
        """Values (n,) at points (n, 4) of the box, (key, z, y, x); keys count the model's own."""

    def moved(self) -> int:
        """Embeddings that a gradient ever moved."""

    def arrays(self) -> list[npt.NDArray[np.float32]]:
        """The trained numbers; embeddings that no gradient moved are 0."""


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
    """An `Encoding` made of parts that together hold every key frame once."""

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
        """Train every model on all of its samples once; epochs count from 0."""
        for part in self.parts:
            for chosen in part.plan.order(epoch):
                part.model.train(chosen)

    def settle(self) -> None:
        """Finish work that training put off."""
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
        """The trained numbers of all models."""
        return [array for part in self.parts for array in part.model.arrays()]
