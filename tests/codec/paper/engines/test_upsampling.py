"""The separable upsampling of coarse levels: equal to the 16 corners, and its transpose is one."""

from __future__ import annotations

from math import prod

import numpy as np
import pytest
import torch
from readable_paper import interpolate

from fhash_codec.paper.architecture import Architecture
from fhash_codec.paper.engines.upsampling import Upsampling, axis_matrices

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("size", "corners", "length", "count"),
    [(1, 1, 1, 1), (5, 5, 5, 1), (5, 3, 2, 3), (20, 7, 6, 4), (9, 2, 4, 3)],
)
def test_axis_matrices_give_every_vertex_its_position(size, corners, length, count) -> None:
    start, weights = axis_matrices(size, corners, length, count)
    assert (start >= 0).all()
    assert (start + weights.shape[2] <= corners).all()
    np.testing.assert_allclose(weights.sum(axis=2), 1, rtol=1e-15)
    position = (weights * (start[:, None, None] + np.arange(weights.shape[2]))).sum(axis=2)
    vertex = np.minimum(np.arange(count * length), size - 1)
    expected = vertex * (corners - 1) / max(size - 1, 1)
    np.testing.assert_allclose(position.ravel(), expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(("shape", "low"), [((3, 9, 10, 20), 0.3), ((2, 20, 30, 40), 0.9995)])
def test_upsampling_equals_the_sixteen_corners(noise_coreset, shape, low) -> None:
    coreset = noise_coreset(shape, low)
    architecture = Architecture.for_box(coreset.box.shape, shape[0])
    upsampling = Upsampling(architecture, coreset, CPU)
    random = torch.Generator().manual_seed(0)
    numbers = sum(prod(level) for level in architecture.levels[1:]) * 2
    tables = torch.randn(numbers, generator=random)
    bricks = torch.from_numpy(coreset.bricks.astype(np.int64))[:40]
    lattices = upsampling.lattices(bricks)
    levels = len(architecture.levels) - 1
    embeddings = torch.empty(levels, 2, len(bricks), *coreset.brick_shape)
    lattices.interpolate(tables[upsampling.used], embeddings)

    inside = torch.cartesian_prod(*(torch.arange(n) for n in coreset.brick_shape))
    space = bricks[:, None, 1:] * torch.tensor(coreset.brick_shape) + inside
    points = torch.cat([bricks[:, None, :1].expand(-1, len(inside), 1), space], dim=2)
    last = torch.tensor(architecture.sizes) - 1
    points = torch.minimum(points, last).double().reshape(-1, 4)
    start = 0
    for level, out in zip(architecture.levels[1:], embeddings, strict=True):
        table = tables[start : start + prod(level) * 2].view(-1, 2).double()
        start += prod(level) * 2
        expected = interpolate(table, points, architecture.sizes, level)
        ours = out.flatten(2).permute(1, 2, 0).reshape(-1, 2)
        torch.testing.assert_close(ours.double(), expected, rtol=1e-5, atol=1e-5)


def test_the_transpose_is_the_transpose(noise_coreset) -> None:
    coreset = noise_coreset((3, 9, 10, 20))
    architecture = Architecture.for_box(coreset.box.shape, 3)
    upsampling = Upsampling(architecture, coreset, CPU)
    lattices = upsampling.lattices(torch.from_numpy(coreset.bricks.astype(np.int64)))
    random = torch.Generator().manual_seed(0)
    tables = torch.randn(len(upsampling.used), generator=random)
    out = torch.empty(len(architecture.levels) - 1, 2, len(coreset.bricks), *coreset.brick_shape)
    gradient = torch.randn(out.shape, generator=random)
    lattices.interpolate(tables, out)
    transposed = torch.zeros_like(tables)
    lattices.add_transposed(transposed, gradient)
    # <A tables, gradient> = <tables, A' gradient>
    one = float((out.double() * gradient.double()).sum())
    other = float((tables.double() * transposed.double()).sum())
    size = float((out.double() * gradient.double()).abs().sum())
    assert one == pytest.approx(other, abs=1e-6 * size)
