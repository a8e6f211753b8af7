"""The hash encoding of tiny-cuda-nn, with its fused network: needs that package and a CUDA GPU."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.bench.paper.encodings.encoding import EMBEDDING_SIZE, HIDDEN_LAYERS, WIDTH
from fhash_codec.bench.paper.encodings.places import sample_places
from fhash_codec.bench.paper.sets import hash_resolutions, hash_table, tcnn_network, tcnn_tables
from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.parameters import adam_step
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
        samples = torch.from_numpy(self.coreset.places(chosen)).to(self.device)
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
