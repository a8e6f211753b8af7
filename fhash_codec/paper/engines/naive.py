"""The naive engine: the paper's method written plainly, 16 corners a sample, autograd, dense Adam; what every engine must equal."""

from __future__ import annotations

from collections.abc import Mapping
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.initial import Parameters, initial_parameters
from fhash_codec.paper.fhash import FHash
from fhash_codec.training.adam import BETA1, BETA2, EPSILON


class NaiveEngine:
    """Trains and evaluates an F-Hash model on a coreset through `FHash`, in any floating type."""

    name = "naive"

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
        device: torch.device,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Fresh parameters from `seed`, the same as every other engine's; `rates` as in `engines.Engine`."""
        self.architecture, self.coreset, self.rates, self.device, self.dtype = (
            architecture,
            coreset,
            rates,
            device,
            dtype,
        )
        start = initial_parameters(architecture, coreset, seed)
        self.buckets = torch.from_numpy(_finest_buckets(architecture, coreset))
        self.mask = np.unpackbits(
            coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)
        ).astype(bool)
        self.model = _model(
            architecture, start, self.buckets, torch.from_numpy(self.mask), dtype
        ).to(device)
        self.adam = torch.optim.Adam(
            self.model.parameters(), betas=(BETA1, BETA2), eps=EPSILON, fused=True
        )
        self.step = 0

    def train(self, chosen: npt.NDArray[np.int64]) -> Tensor:
        """One Adam step on the bricks `chosen`; the sum of squared errors before it."""
        self.step += 1
        points, target = self._samples(chosen)
        self.adam.zero_grad()
        error: Tensor = (self.model(points) - target).square().sum()
        (error / max(len(target), 1)).backward()  # type: ignore[no-untyped-call]
        self.adam.param_groups[0]["lr"] = float(self.rates[self.step])
        self.adam.step()
        return error.detach().double()

    def settle(self) -> None:
        """Nothing is ever behind: every parameter takes every step."""

    @torch.no_grad()
    def infer(self, chosen: npt.NDArray[np.int64]) -> Tensor:
        """Values (bricks, vertices) of the bricks `chosen` at all their vertices."""
        points = torch.from_numpy(_vertices(self.coreset, chosen)).to(self.device, self.dtype)
        return torch.as_tensor(self.model(points.view(-1, 4))).view(len(chosen), -1)

    @torch.no_grad()
    def squared_error(self, chosen: npt.NDArray[np.int64]) -> float:
        """Sum of squared errors over the coreset vertices of the bricks `chosen`."""
        points, target = self._samples(chosen)
        return float((self.model(points) - target).square().sum(dtype=torch.float64))

    def parameters(self) -> Parameters:
        """The trained numbers, on the CPU, float32; embeddings outside the coreset are 0."""
        finest = self.model.tables[0].detach().cpu()[self.buckets].transpose(1, 2)
        finest = finest * torch.from_numpy(self.mask).unsqueeze(1)
        coarse = [table.detach().flatten() for table in list(self.model.tables)[1:]]
        layers = zip(self.model.weights, self.model.biases, strict=True)
        network = [
            torch.column_stack([weight.detach(), bias.detach()]).flatten()
            for weight, bias in layers
        ]
        joined = [
            torch.cat([*parts, finest.new_empty(0, device=self.device)]).cpu().float()
            for parts in (coarse, network)
        ]
        return Parameters(fine=finest.float().contiguous(), coarse=joined[0], network=joined[1])

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Everything that the next step depends on, as arrays."""
        arrays: dict[str, npt.NDArray[np.generic]] = {"step": np.array(self.step)}
        for name, parameter in self.model.named_parameters():
            arrays[name] = parameter.detach().cpu().numpy()
            for moment in ("exp_avg", "exp_avg_sq"):
                kept = self.adam.state[parameter].get(moment, torch.zeros_like(parameter))
                arrays[f"{name}.{moment}"] = kept.cpu().numpy()
        return arrays

    @torch.no_grad()
    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Go on from `state`."""
        self.step = int(state["step"])
        for name, parameter in self.model.named_parameters():
            parameter.copy_(torch.from_numpy(state[name]))
            moments = {
                m: torch.from_numpy(state[f"{name}.{m}"].copy()).to(self.device)
                for m in ("exp_avg", "exp_avg_sq")
            }
            self.adam.state[parameter] = {
                "step": torch.tensor(float(self.step), device=self.device),
                **moments,
            }

    def _samples(self, chosen: npt.NDArray[np.int64]) -> tuple[Tensor, Tensor]:
        """Points (n, 4) and normalised values (n,) of the coreset vertices of bricks."""
        points = _vertices(self.coreset, chosen)[self.mask[chosen]]
        offsets = self.coreset.offsets
        values = np.concatenate([self.coreset.values[offsets[i] : offsets[i + 1]] for i in chosen])
        return (torch.from_numpy(array).to(self.device, self.dtype) for array in (points, values))  # type: ignore[return-value]


def _vertices(coreset: Coreset, chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Lattice positions (bricks, vertices, 4) in (key frame, z, y, x); past the end of the box the last vertex again."""
    inside = np.stack(
        np.meshgrid(*(np.arange(n) for n in coreset.brick_shape), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    bricks = coreset.bricks[chosen].astype(np.int64)
    space = bricks[:, None, 1:] * np.array(coreset.brick_shape) + inside
    last = np.array(coreset.box.shape) - 1
    key = np.broadcast_to(bricks[:, None, :1], (*space.shape[:2], 1))
    return np.concatenate([key, np.minimum(space, last)], axis=-1)


def _finest_buckets(architecture: Architecture, coreset: Coreset) -> npt.NDArray[np.int64]:
    """Bucket (bricks, vertices) in the dense finest table of every vertex of every brick."""
    t, z, y, x = np.moveaxis(_vertices(coreset, np.arange(len(coreset.bricks))), -1, 0)
    _, rz, ry, rx = architecture.sizes
    buckets: npt.NDArray[np.int64] = ((t * rz + z) * ry + y) * rx + x
    return buckets


def _model(
    architecture: Architecture, start: Parameters, buckets: Tensor, mask: Tensor, dtype: torch.dtype
) -> FHash:
    """A dense model that holds the engines' common start; finest embeddings outside the coreset are zero."""
    finest = torch.zeros(prod(architecture.levels[0]), architecture.embedding_size)
    finest[buckets[mask]] = start.fine.transpose(1, 2)[mask]
    tables, layers = start.dense(architecture)
    own = [(weight.to(dtype).clone(), bias.to(dtype).clone()) for weight, bias in layers]
    return FHash(architecture, [finest.to(dtype), *(table.to(dtype) for table in tables)], own)
