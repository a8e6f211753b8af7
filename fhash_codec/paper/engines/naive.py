"""The naive engine: the paper's method written plainly, by 16 corners a sample and autograd.

Every other engine must give the same numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines import Chosen
from fhash_codec.paper.engines.initial import Parameters, check_state, initial_parameters
from fhash_codec.paper.fhash import FHash
from fhash_codec.training.adam import BETA1, BETA2, EPSILON


class NaiveEngine:
    """An `Engine` that trains `FHash` by a dense Adam, in any floating type."""

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
        """Start from the same parameters as every other engine; arguments as in `make_engine`."""
        self.architecture, self.coreset, self.rates = architecture, coreset, rates
        self.device, self.dtype = device, dtype
        start = initial_parameters(architecture, coreset, seed)
        self.buckets = torch.from_numpy(_finest_buckets(architecture, coreset))
        self.in_coreset = np.unpackbits(
            coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)
        ).astype(bool)
        self.model = _model(
            architecture, start, self.buckets, torch.from_numpy(self.in_coreset), dtype
        ).to(device)
        self.adam = torch.optim.Adam(
            self.model.parameters(), betas=(BETA1, BETA2), eps=EPSILON, fused=True
        )
        self.step = 0

    def train(self, chosen: Chosen) -> Tensor:
        """Do one training step on a batch; return the sum of squared errors before it."""
        self.step += 1
        points, target = self._samples(chosen)
        self.adam.zero_grad()
        error: Tensor = (self.model(points) - target).square().sum()
        (error / max(len(target), 1)).backward()  # type: ignore[no-untyped-call]
        self.adam.param_groups[0]["lr"] = float(self.rates[self.step])
        self.adam.step()
        return error.detach().double()

    def settle(self) -> None:
        """Do nothing: every parameter takes part in every step, so no work is ever put off."""

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> Tensor:
        """Return the values (n,) at the samples of some bricks."""
        points, _ = self._samples(chosen)
        return torch.as_tensor(self.model(points))

    def parameters(self) -> Parameters:
        """Return the trained numbers, float32 on the CPU; embeddings outside the coreset are 0."""
        buckets = self.buckets[torch.from_numpy(self.in_coreset)]
        fine = self.model.tables[0].detach().cpu()[buckets].T
        coarse = [table.detach().flatten() for table in list(self.model.tables)[1:]]
        layers = zip(self.model.weights, self.model.biases, strict=True)
        network = [
            torch.column_stack([weight.detach(), bias.detach()]).flatten()
            for weight, bias in layers
        ]
        # The empty tensor lets a model without coarse tables be joined, too.
        coarse_vector, network_vector = (
            torch.cat([*tensors, fine.new_empty(0, device=self.device)]).cpu().float()
            for tensors in (coarse, network)
        )
        return Parameters(
            fine=fine.float().contiguous(), coarse=coarse_vector, network=network_vector
        )

    def state(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return parameters, Adam's moments and the step number as arrays."""
        arrays: dict[str, npt.NDArray[np.generic]] = {"step": np.array(self.step)}
        for name, parameter in self.model.named_parameters():
            arrays[name] = parameter.detach().cpu().numpy()
            for moment in ("exp_avg", "exp_avg_sq"):
                value = self.adam.state[parameter].get(moment, torch.zeros_like(parameter))
                arrays[f"{name}.{moment}"] = value.cpu().numpy()
        return arrays

    @torch.no_grad()
    def restore(self, state: Mapping[str, npt.NDArray[np.generic]]) -> None:
        """Continue from a `state`; raises KeyError or ValueError for one of another model."""
        shapes = {name: parameter.shape for name, parameter in self.model.named_parameters()}
        for ending in ("", ".exp_avg", ".exp_avg_sq"):
            check_state(state, {name + ending: shape for name, shape in shapes.items()})
        self.step = int(state["step"])
        for name, parameter in self.model.named_parameters():
            parameter.copy_(torch.from_numpy(state[name]))
            moments = {
                moment: torch.from_numpy(state[f"{name}.{moment}"].copy()).to(self.device)
                for moment in ("exp_avg", "exp_avg_sq")
            }
            self.adam.state[parameter] = {
                "step": torch.tensor(float(self.step), device=self.device),
                **moments,
            }

    def _samples(self, chosen: Chosen) -> tuple[Tensor, Tensor]:
        """Return points (n, 4) and normalised values (n,) of the coreset vertices of bricks."""
        points = _vertices(self.coreset, chosen)[self.in_coreset[chosen]]
        values = self.coreset.values[self.coreset.places(chosen)]
        return (torch.from_numpy(array).to(self.device, self.dtype) for array in (points, values))  # type: ignore[return-value]


def _vertices(coreset: Coreset, chosen: Chosen) -> npt.NDArray[np.int64]:
    """Return the lattice positions (bricks, vertices, 4) of bricks, (key frame, z, y, x).

    Vertices of a brick beyond the end of the box repeat the last vertex of the box.
    """
    inside = np.stack(
        np.meshgrid(*(np.arange(n) for n in coreset.brick_shape), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    bricks = coreset.bricks[chosen].astype(np.int64)
    space = bricks[:, None, 1:] * np.array(coreset.brick_shape) + inside
    last = np.array(coreset.box.shape) - 1
    key = np.broadcast_to(bricks[:, None, :1], (*space.shape[:2], 1))
    return np.concatenate([key, np.minimum(space, last)], axis=-1)


def _finest_buckets(architecture: Architecture, coreset: Coreset) -> npt.NDArray[np.int64]:
    """Return the bucket (bricks, vertices) of every vertex in the dense finest table."""
    t, z, y, x = np.moveaxis(_vertices(coreset, np.arange(len(coreset.bricks))), -1, 0)
    _, rz, ry, rx = architecture.sizes
    buckets: npt.NDArray[np.int64] = ((t * rz + z) * ry + y) * rx + x
    return buckets


def _model(
    architecture: Architecture,
    start: Parameters,
    buckets: Tensor,
    in_coreset: Tensor,
    dtype: torch.dtype,
) -> FHash:
    """Return a dense model of initial parameters; finest embeddings outside the coreset are 0."""
    finest = torch.zeros(prod(architecture.levels[0]), architecture.embedding_size)
    finest[buckets[in_coreset]] = start.fine.T
    tables, layers = start.dense(architecture)
    copies = [(weight.to(dtype).clone(), bias.to(dtype).clone()) for weight, bias in layers]
    return FHash(architecture, [finest.to(dtype), *(table.to(dtype) for table in tables)], copies)
