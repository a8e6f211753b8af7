"""The quality of a model in training: of the coreset alone, as a reader decodes it."""

from __future__ import annotations

from math import log10

import numpy as np
import pytest
import torch

from fhash_codec.coreset import occupancy
from fhash_codec.coreset.bricks import Coreset, build_coreset
from fhash_codec.coreset.features import Everything, Interval
from fhash_codec.coreset.scan import scan
from fhash_codec.paper.training.probe import Diverged, Probe
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries

SHAPE = (3, 9, 10, 21)


class Engine:
    """An engine whose values at the samples of bricks are given."""

    def __init__(self, coreset: Coreset, frames: np.ndarray) -> None:
        low, size = [span[0] for span in coreset.box], coreset.box.shape
        self.shape, self.bricks = coreset.brick_shape, coreset.bricks
        vertices = int(np.prod(self.shape))
        self.samples = np.unpackbits(coreset.mask_bits, axis=1, count=vertices).view(np.bool_)
        padded = [n * m for n, m in zip(coreset.brick_grid, self.shape, strict=True)]
        self.frames = np.zeros((len(frames), *padded))
        box = tuple(slice(a, a + n) for a, n in zip(low, size, strict=True))
        self.frames[:, : size[0], : size[1], : size[2]] = frames[(slice(None), *box)]

    def infer(self, chosen: np.ndarray) -> torch.Tensor:
        values = [
            self.frames[key][
                tuple(slice(i * n, (i + 1) * n) for i, n in zip(place, self.shape, strict=True))
            ].ravel()
            for key, *place in self.bricks[chosen].tolist()
        ]
        return torch.from_numpy(np.array(values)[self.samples[chosen]])


def built(field: np.ndarray, feature: object, fringe: bool) -> Coreset:
    series = ArraySeries(field)
    keys = range(len(field))
    return build_coreset(series, scan(series, silent), keys, [feature], 0, silent, fringe=fringe)


@pytest.fixture(scope="module")
def field() -> np.ndarray:
    values = np.random.default_rng(1).random(SHAPE, dtype=np.float32)
    values[0, 0, 0, :2] = (0.0, 1.0)
    return values


def test_the_fringe_does_not_count(field) -> None:
    coreset = built(field, Interval(0.8, 1.0), fringe=True)
    assert len(coreset.values) > 1.5 * sum(
        occupancy.unpack(bits, coreset.box.shape).sum() for bits in coreset.occupancy
    )
    wrong = np.where(field >= np.float32(0.8), field + np.float32(0.0), 1.0 - field)
    assert Probe(coreset).psnr(Engine(coreset, wrong)) is None
    wrong = np.where(field >= np.float32(0.8), field - np.float32(0.25), field)
    found = Probe(coreset).psnr(Engine(coreset, wrong))
    assert found == pytest.approx(-20 * log10(0.25), abs=1e-5)


def test_values_are_clipped_to_their_range_as_a_reader_does(field) -> None:
    coreset = built(field, Everything(), fringe=False)
    beyond = np.where(field > 0.5, 7.0, field.astype(np.float64))
    error = np.square(1 - field[field > 0.5], dtype=np.float64).sum() / field.size
    assert Probe(coreset).psnr(Engine(coreset, beyond)) == pytest.approx(-10 * log10(error))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_ends_the_training(field, value) -> None:
    coreset = built(field, Everything(), fringe=False)
    broken = field.astype(np.float64)
    broken[1, 4, 4, 4] = value
    with pytest.raises(Diverged, match="no longer finite"):
        Probe(coreset).psnr(Engine(coreset, broken))


def test_a_choice_of_bricks_has_some_of_the_coreset_in_each(field) -> None:
    # Only the last key frame holds the feature: the bricks of the first have neither.
    late = field * np.float32(0.5)
    late[2] = field[2]
    coreset = built(late, Interval(0.9, 1.0), fringe=True)
    assert set(coreset.bricks[:, 0]) == {1, 2}
    for limit in (None, 3, 1):
        probe = Probe(coreset, limit, seed=4)
        assert set(coreset.bricks[probe.bricks, 0]) == {2}
        assert len(probe.bricks) == (limit or np.count_nonzero(coreset.bricks[:, 0] == 2))
    assert Probe(coreset).samples == np.count_nonzero(late >= np.float32(0.9))


def test_the_error_of_a_constant_is_that_of_the_mean_of_all_samples(field) -> None:
    coreset = built(field, Interval(0.8, 1.0), fringe=True)
    values = field[field >= np.float32(0.8)].astype(np.float64)
    mean = coreset.values.mean(dtype=np.float64)
    assert Probe(coreset).error_of_constant() == pytest.approx(np.square(values - mean).mean())
    plain = built(field, Interval(0.8, 1.0), fringe=False)
    assert Probe(plain).error_of_constant() == pytest.approx(values.var())
