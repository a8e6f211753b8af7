"""Training of the neighbourhood head: its gain, the voxels that matter, and repeatability."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt
import pytest

from fhash_codec.compact.choices.head_samples import Pair
from fhash_codec.compact.choices.head_training import train_head
from fhash_formats.transform.head.head import NeighbourHead

Floats = npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def front() -> tuple[Floats, Floats]:
    """A travelling step between two plateaus, and a smoothed copy: three-voxel means with noise."""
    t, z, y, x = np.meshgrid(
        np.arange(3), np.arange(12), np.arange(14), np.arange(40), indexing="ij"
    )
    original = np.where(x + 0.4 * y - 2 * t + 0.3 * z > 18, 2.0, -1.0).astype(np.float32)
    wide = np.pad(original, ((0, 0), (0, 0), (0, 0), (1, 1)), mode="edge")
    decoded = (wide[..., :-2] + wide[..., 1:-1] + wide[..., 2:]) / 3 + 0.05 * np.sin(x)
    decoded += np.random.default_rng(0).normal(scale=0.6, size=decoded.shape)
    return decoded.astype(np.float32), original


def mse(first: Floats, second: Floats) -> float:
    return float(np.mean((first.astype(np.float64) - second) ** 2))


def test_a_front_is_sharpened_by_what_the_gain_says(front: tuple[Floats, Floats]) -> None:
    decoded, original = front
    trained = train_head(
        [Pair(decoded, original, None)],
        low=-1.0,
        high=2.0,
        updates=300,
        samples=200_000,
    )
    gained = 10 * np.log10(
        mse(np.clip(decoded, -1, 2), original) / mse(trained.head.apply(decoded), original)
    )
    assert trained.gain_db > 6
    assert gained == pytest.approx(trained.gain_db, abs=1.0)
    assert trained.history[-1][1:] == (300, trained.gain_db)
    assert len(trained.head.to_bytes()) <= 530


@pytest.fixture(scope="module")
def far() -> tuple[Floats, Floats]:
    """Noise with an error beyond the neighbourhood: half the value three voxels before."""
    random = np.random.default_rng(0)
    original = random.normal(size=(2, 10, 12, 40)).astype(np.float32)
    decoded = original + 0.5 * np.roll(original, 3, axis=3)
    return decoded.astype(np.float32), original


def test_a_cross_sees_farther(far: tuple[Floats, Floats]) -> None:
    settings = {
        "low": -8.0,
        "high": 8.0,
        "hidden": (8, 8),
        "samples": 100_000,
        "updates": 400,
    }
    near, cross = (
        train_head([Pair(*far, None)], cross=cross, **settings) for cross in (False, True)
    )
    assert cross.gain_db > near.gain_db + 0.3
    gained = 10 * np.log10(mse(*far) / mse(cross.head.apply(far[0]), far[1]))
    assert gained == pytest.approx(cross.gain_db, abs=0.3)
    assert cross.head.cross


def test_noise_gains_nothing_much() -> None:
    random = np.random.default_rng(0)
    original = random.normal(size=(2, 16, 16, 32)).astype(np.float32)
    decoded = (original + 0.1 * random.normal(size=original.shape)).astype(np.float32)
    trained = train_head(
        [Pair(decoded, original, None)],
        low=-6.0,
        high=6.0,
        updates=150,
        samples=100_000,
    )
    assert abs(trained.gain_db) < 0.5


@pytest.mark.parametrize("cross", [False, True])
def test_the_same_seed_gives_the_same_head(front: tuple[Floats, Floats], cross: bool) -> None:
    settings = {
        "low": -1.0,
        "high": 2.0,
        "hidden": (4, 4),
        "cross": cross,
        "samples": 40_000,
        "updates": 40,
    }
    runs = [
        train_head([Pair(*front, None)], seed=seed, **settings).head.to_bytes()
        for seed in (4, 4, 5)
    ]
    assert runs[0] == runs[1] != runs[2]


def test_voxels_that_do_not_count_do_not_matter(front: tuple[Floats, Floats]) -> None:
    decoded, original = front
    counted = np.zeros(original.shape, dtype=bool)
    counted[:, 2:9] = True
    other = np.where(counted, original, np.nan).astype(np.float32)
    heads = [
        train_head(
            [Pair(decoded, values, counted)],
            low=-1.0,
            high=2.0,
            updates=40,
            samples=40_000,
        ).head
        for values in (original, other)
    ]
    assert heads[0].to_bytes() == heads[1].to_bytes()


def test_several_tiles_of_several_shapes_and_a_tile_that_does_not_count(
    front: tuple[Floats, Floats],
) -> None:
    decoded, original = front
    pairs = [
        Pair(decoded, original, None),
        Pair(decoded[:1, :5, :, :7], original[:1, :5, :, :7], None),
        Pair(decoded, original * np.float32(np.nan), np.zeros(original.shape, dtype=bool)),
    ]
    trained = train_head(
        pairs,
        low=-1.0,
        high=2.0,
        hidden=(6, 4),
        cross=True,
        samples=100_000,
        updates=200,
    )
    assert trained.head.hidden == (6, 4)
    assert trained.gain_db > 3


def test_progress_rises_to_one_in_small_parts(front: tuple[Floats, Floats]) -> None:
    parts: list[float] = []
    trained = train_head(
        [Pair(*front, None)],
        low=-1.0,
        high=2.0,
        updates=150,
        samples=40_000,
        progress=parts.append,
    )
    assert trained is not None
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    assert np.diff([0.0, *parts]).max() <= 20 / 150
    assert [update for _, update, _ in trained.history] == list(range(15, 151, 15))


def test_what_the_progress_raises_ends_the_training(front: tuple[Floats, Floats]) -> None:
    def interrupt(share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_head(
            [Pair(*front, None)],
            low=-1.0,
            high=2.0,
            updates=5000,
            samples=4096,
            progress=interrupt,
        )


@pytest.mark.parametrize("updates", [1, 2, 3, 7, 11])
def test_a_very_short_training_gives_a_head(front: tuple[Floats, Floats], updates: int) -> None:
    trained = train_head([Pair(*front, None)], low=-1.0, high=2.0, updates=updates, samples=4096)
    assert trained is not None
    assert trained.history[-1][1:] == (updates, trained.gain_db)
    assert NeighbourHead.from_bytes(trained.head.to_bytes()).hidden == (12, 8)


@pytest.mark.parametrize(
    "pair",
    [
        Pair(*(np.zeros((1, 2, 2, 2), np.float32),) * 2, None),
        Pair(*(np.full((1, 4, 4, 4), value, np.float32) for value in (0.0, 1e-33)), None),
        Pair(*(np.full((1, 4, 4, 4), value, np.float32) for value in (-3e38, 3e38)), None),
        Pair(
            np.zeros((1, 2, 2, 2), np.float32),
            np.ones((1, 2, 2, 2), np.float32),
            np.zeros((1, 2, 2, 2), dtype=bool),
        ),
    ],
    ids=["exact", "error too small", "error too large", "no voxel counts"],
)
def test_where_nothing_can_be_learned_there_is_no_head(pair: Pair) -> None:
    assert train_head([pair], low=-3e38, high=3e38, updates=5, samples=4096) is None


def test_an_error_that_a_head_removes_gives_a_finite_gain() -> None:
    decoded = np.tile(np.float32([0.25, 0.75]), (2, 8, 8, 16))
    trained = train_head(
        [Pair(decoded, np.rint(decoded), None)], low=0.0, high=1.0, updates=80, samples=8192
    )
    assert trained is not None
    assert all(np.isfinite(gain) for _, _, gain in trained.history)


def test_two_trainings_at_once_give_what_each_gives_alone(front: tuple[Floats, Floats]) -> None:
    def trained(seed: int) -> bytes:
        result = train_head(
            [Pair(*front, None)], low=-1.0, high=2.0, updates=40, samples=40_000, seed=seed
        )
        assert result is not None
        return result.head.to_bytes()

    with ThreadPoolExecutor(2) as workers:
        together = list(workers.map(trained, (1, 2)))
    assert together == [trained(1), trained(2)]
