"""Corners of levels: indices by hand, weights beside torch's own grid_sample."""

from __future__ import annotations

import pytest
import torch
from readable_paper import interpolate

from fhash_codec.bench.paper.encodings.corners import GridLevel, HashLevel


def random_points(count: int, sizes: tuple[int, ...]) -> torch.Tensor:
    """Points (n, 4) anywhere between vertices, at whole key frames."""
    random = torch.Generator().manual_seed(1)
    span = torch.tensor(sizes, dtype=torch.float64) - 1
    points = torch.rand(count, 4, generator=random, dtype=torch.float64) * span
    points[:, 0] = points[:, 0].round()
    return points


def test_hash_by_hand() -> None:
    # 5 corners over 9 vertices: vertex (z, y, x) = (2, 5, 8) lies at corner (1, 2.5, 4).
    level = HashLevel(5, 16, (2, 9, 9, 9))
    buckets, weights = level.corners(torch.tensor([[1, 2, 5, 8]], dtype=torch.float64))
    found: dict[int, float] = {}
    for bucket, weight in zip(buckets[0].tolist(), weights[0].tolist(), strict=True):
        if weight > 0:
            found[bucket] = found.get(bucket, 0) + weight
    # x 1, y 2654435761 = ...0001 and z 805459861 = ...0101 in the last four bits.
    # (z, y, x) = (1, 2, 4): 5 ^ 2 ^ 4 = 3; (1, 3, 4): 5 ^ 3 ^ 4 = 2. The table of key frame 1
    # begins at 16.
    assert found == {19: 0.5, 18: 0.5}


def test_hash_in_a_large_table_by_hand() -> None:
    level = HashLevel(256, 1 << 20, (1, 256, 256, 256))
    buckets, weights = level.corners(torch.tensor([[0, 200, 100, 50]], dtype=torch.float64))
    bucket = int(buckets[0, weights[0].argmax()])
    assert bucket == ((200 * 805459861) ^ (100 * 2654435761) ^ 50) % 2**20 == 1041790


def test_collisions_are_counted() -> None:
    assert HashLevel(2, 1 << 20, (1, 9, 9, 9)).collisions() == 0.0
    # 64 corners in 16 buckets: none can be alone in all of them.
    assert HashLevel(4, 16, (1, 9, 9, 9)).collisions() == 1.0


@pytest.mark.parametrize("resolution", [(5, 6, 7), (2, 2, 2), (9, 11, 13)])
def test_dense_grid_equals_grid_sample(resolution: tuple[int, int, int]) -> None:
    sizes = (3, 9, 8, 12)
    level = GridLevel((3, *resolution), sizes, True)
    table = torch.randn(level.size, 2, dtype=torch.float64)
    points = random_points(200, sizes)
    buckets, weights = level.corners(points)
    values = (weights.unsqueeze(-1) * table[buckets]).sum(1)
    span = torch.tensor(sizes[1:], dtype=torch.float64) - 1
    grid = (2 * points[:, 1:] / span - 1).flip(1)
    for key in range(3):
        volume = table.view(3, *resolution, 2)[key].permute(3, 0, 1, 2)
        expected = torch.nn.functional.grid_sample(
            volume[None], grid[None, :, None, None], align_corners=True
        )[0, :, :, 0, 0].T
        chosen = points[:, 0] == key
        torch.testing.assert_close(values[chosen], expected[chosen])


def test_fhash_equals_the_products_tesseract() -> None:
    sizes, resolution = (4, 9, 8, 12), (2, 5, 4, 6)
    level = GridLevel(resolution, sizes, False)
    points = random_points(100, sizes)
    points[:, 0] += 0.25 * (points[:, 0] < 3)
    table = torch.randn(level.size, 2, dtype=torch.float64)
    buckets, weights = level.corners(points)
    assert buckets.shape == (100, 16)
    values = (weights.unsqueeze(-1) * table[buckets]).sum(1)
    torch.testing.assert_close(values, interpolate(table, points, sizes, resolution))


@pytest.mark.parametrize(
    "level",
    [
        GridLevel((3, 4, 1, 6), (3, 9, 1, 12), True),
        GridLevel((2, 4, 1, 6), (3, 9, 1, 12), False),
        HashLevel(8, 64, (3, 9, 1, 12)),
    ],
)
def test_weights_add_up_to_one_and_buckets_are_of_the_level(level: GridLevel | HashLevel) -> None:
    buckets, weights = level.corners(random_points(300, (3, 9, 1, 12)))
    torch.testing.assert_close(weights.sum(1), torch.ones(300, dtype=torch.float64))
    assert weights.min() >= 0
    assert 0 <= buckets.min() <= buckets.max() < level.size
