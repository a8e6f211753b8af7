"""The paper's model and its training, written plainly: the reference that engines are tested by.

* The tesseract encoding of a level: bucket index and interpolation (section 3.2).
* `FHash`, the tables and the network (sections 3.2.4 and 4.2), in torch.
* `NaiveEngine`, its training by autograd and a dense Adam, in float64.

Nothing here shares code with an engine or with the decoder but the initial numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import prod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from fhash_codec.features.bricks import Coreset
from fhash_codec.paper.engines.parameters import (
    BETA1,
    BETA2,
    EPSILON,
    Chosen,
    Parameters,
    initial_parameters,
)
from fhash_codec.paper.network import Architecture, Resolution


def bucket_index(corner: Tensor, resolution: Resolution) -> Tensor:
    """Return the F-Hash bucket int64 (...) of grid corners (..., 4) in (t, z, y, x).

    The index is ((t Rz + z) Ry + y) Rx + x, the linearisation of equation 9 of the paper. It maps
    the corners of a level one to one to 0 .. Rt Rz Ry Rx - 1: no collision, no empty bucket.
    """
    t, z, y, x = corner.unbind(-1)
    _, rz, ry, rx = resolution
    return ((t * rz + z) * ry + y) * rx + x


def locate(points: Tensor, sizes: Sequence[int], resolution: Resolution) -> tuple[Tensor, Tensor]:
    """Find the tesseract around each point (paper, section 3.2.4, steps 1 and 2).

    The first and the last vertex of an axis are the first and the last corner at every level.
    Positions outside the lattice are clamped to it. A position on a corner lies in the tesseract
    that begins there.

    Args:
        points: positions (n, 4), (t, z, y, x) in vertices of the lattice of samples.
        sizes: vertices (t, z, y, x) of that lattice.
        resolution: vertices (t, z, y, x) of the level.

    Returns:
        The corner before each point, int64 (n, 4), and the weight in [0, 1] of the corner after it
        along each axis, (n, 4).
    """
    corners = torch.tensor(resolution, device=points.device)
    span = torch.tensor(
        [max(size - 1, 1) for size in sizes], dtype=points.dtype, device=points.device
    )
    # Multiply before dividing: a vertex that falls on a corner then gives a whole number exactly.
    position = torch.minimum(points.clamp_min(0), span) * (corners - 1) / span
    before = torch.minimum(position.floor().long(), (corners - 2).clamp_min(0))
    return before, position - before


def interpolate(
    table: Tensor, points: Tensor, sizes: Sequence[int], resolution: Resolution
) -> Tensor:
    """Return the embeddings (n, E) at points, by quadrilinear interpolation between 16 corners.

    This is the sum of equations 10 to 12 of the paper, written as one product of four weights per
    corner (section 3.2.4, steps 3 and 4).

    Args:
        table: embeddings (buckets, E) of the level.
        points: positions (n, 4), as in `locate`.
        sizes: vertices (t, z, y, x) of the lattice of samples.
        resolution: vertices (t, z, y, x) of the level.
    """
    before, after_weight = locate(points, sizes, resolution)
    embeddings = torch.zeros(len(points), table.shape[1], dtype=table.dtype, device=table.device)
    for buckets, weights in _corners(before, after_weight, resolution):
        embeddings = embeddings + weights.prod(-1, keepdim=True) * table[buckets]
    return embeddings


def _corners(
    before: Tensor, after_weight: Tensor, resolution: Resolution
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield for each of the 16 corners its bucket (n,) and its weight along each axis (n, 4).

    The corners come with the offset along x changing fastest, along t slowest.
    """
    last = torch.tensor(resolution, device=before.device) - 1
    for offsets in product((0, 1), repeat=4):
        offset = torch.tensor(offsets, device=before.device)
        # An axis of one corner has no corner after it. Its weight is 0, so any bucket will do.
        buckets = bucket_index(torch.minimum(before + offset, last), resolution)
        yield buckets, torch.where(offset.bool(), after_weight, 1 - after_weight)


class FHash(nn.Module):
    """Multi-resolution tesseract encoding, followed by an MLP (paper, sections 3.2.4 and 4.2)."""

    def __init__(
        self,
        architecture: Architecture,
        tables: Sequence[Tensor],
        layers: Sequence[tuple[Tensor, Tensor]],
    ) -> None:
        """Make a model of given numbers, which training then changes in place.

        Args:
            architecture: the sizes of tables and layers.
            tables: embeddings (buckets, E) of each level, finest first.
            layers: weight (outputs, inputs) and bias (outputs,) of each layer.
        """
        super().__init__()
        self.architecture = architecture
        self.tables = nn.ParameterList(nn.Parameter(table) for table in tables)
        self.weights = nn.ParameterList(nn.Parameter(weight) for weight, _ in layers)
        self.biases = nn.ParameterList(nn.Parameter(bias) for _, bias in layers)

    def forward(self, points: Tensor) -> Tensor:
        """Return values (n,), normalised to the range of the series, at points (n, 4).

        A point is (t, z, y, x) in vertices of the lattice of samples: t counts key frames; z, y and
        x count vertices of the feature bounding box. Fractions lie between vertices.
        """
        sizes, levels = self.architecture.sizes, self.architecture.levels
        hidden = torch.cat(
            [
                interpolate(table, points, sizes, level)
                for table, level in zip(self.tables, levels, strict=True)
            ],
            dim=1,
        )
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = nn.functional.linear(hidden if number == 0 else hidden.relu(), weight, bias)
        return hidden.squeeze(1)


class NaiveEngine:
    """The training of `FHash` by a dense Adam in float64, with the methods of an `Engine`."""

    def __init__(
        self,
        architecture: Architecture,
        coreset: Coreset,
        rates: npt.NDArray[np.float64],
        *,
        seed: int,
    ) -> None:
        """Start from the same parameters as every engine; arguments as in `make_engine`."""
        self.coreset, self.rates, self.step = coreset, rates, 0
        start = initial_parameters(architecture, coreset, seed).as_stored(architecture, coreset)
        lattice = coreset.lattice or coreset
        self.in_coreset = np.unpackbits(
            coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)
        ).astype(bool)
        on_lattice = np.unpackbits(
            lattice.mask_bits, axis=1, count=prod(lattice.brick_shape)
        ).astype(bool)
        vertices = _vertices(lattice, np.arange(len(lattice.bricks)))[on_lattice]
        self.buckets = bucket_index(torch.from_numpy(vertices), architecture.levels[0])
        # Finest embeddings outside the coreset are 0.
        finest = torch.zeros(prod(architecture.levels[0]), architecture.embedding_size)
        finest[self.buckets] = torch.from_numpy(start.fine.T)
        tables, layers = start.dense(architecture)
        self.model = FHash(
            architecture,
            [finest, *map(torch.tensor, tables)],
            [(torch.tensor(weight), torch.tensor(bias)) for weight, bias in layers],
        ).double()
        self.adam = torch.optim.Adam(
            self.model.parameters(), betas=(BETA1, BETA2), eps=EPSILON, fused=True
        )

    def train(self, chosen: Chosen) -> Tensor:
        """Do one training step on a batch; return the sum of squared errors before it."""
        self.step += 1
        points, target = self._samples(chosen)
        self.adam.zero_grad()
        error: Tensor = (self.model(points) - target).square().sum()
        (error / max(len(target), 1)).backward()
        self.adam.param_groups[0]["lr"] = float(self.rates[self.step])
        self.adam.step()
        return error.detach()

    @torch.no_grad()
    def infer(self, chosen: Chosen) -> npt.NDArray[np.float64]:
        """Return the values (n,) at the samples of some bricks."""
        return np.asarray(self.model(self._samples(chosen)[0]).numpy())

    def parameters(self) -> Parameters:
        """Return the trained numbers in float32; embeddings outside the coreset are left out."""
        finest, *coarse = (table.detach() for table in self.model.tables)
        layers = [
            torch.column_stack([weight.detach(), bias.detach()])
            for weight, bias in zip(self.model.weights, self.model.biases, strict=True)
        ]
        coarse_vector, network = (
            torch.cat([torch.zeros(0), *(numbers.flatten().float() for numbers in group)])
            for group in (coarse, layers)
        )
        return Parameters(
            fine=finest[self.buckets].T.float().contiguous().numpy(),
            coarse=coarse_vector.numpy(),
            network=network.numpy(),
        )

    def _samples(self, chosen: Chosen) -> tuple[Tensor, Tensor]:
        """Return points (n, 4) and normalised values (n,) of the coreset vertices of bricks."""
        points = _vertices(self.coreset, chosen)[self.in_coreset[chosen]].astype(np.float64)
        points[:, 0] = self.coreset.key_places[points[:, 0].astype(np.int64)]
        values = self.coreset.values[self.coreset.sample_indices(chosen)]
        return torch.from_numpy(points).double(), torch.from_numpy(values).double()


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
