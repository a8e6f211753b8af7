"""Published networks, their coresets and trainings, and the formulas that they are held to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.boxes import Box
from fhash_codec.features.bricks import Coreset, build_coreset, with_steps_between
from fhash_codec.features.features import Everything, FeatureChoice, Interval
from fhash_codec.features.key_frames import KeyTimes
from fhash_codec.features.scan import scan
from fhash_codec.paper.encode import Selection, select
from fhash_codec.paper.engines import make_engine
from fhash_codec.paper.network import Architecture, ArrayTable, Network, level_resolutions
from fhash_codec.paper.storage import Bricks
from fhash_codec.paper.tables import TrainedTable, trained_tables
from fhash_codec.paper.train import plan_training
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries
from fhash_formats.support.values import Single

Points = list[npt.NDArray[np.float64]]
"""Key indices, z, y and x of points, each (n,)."""

# Box (z, y, x), key frames, fold, embedding size, hidden layers.
SHAPES = [
    ((1, 1, 1), 1, 2, 1, 1),
    ((1, 1, 2), 2, 2, 2, 0),
    ((2, 2, 2), 3, 2, 4, 2),
    ((1, 7, 1), 1, 2, 3, 1),
    ((1, 40, 67), 5, 2, 2, 1),
    ((13, 17, 37), 4, 3, 2, 1),
    ((11, 33, 35), 12, 2, 1, 0),
    ((9, 23, 70), 2, 2, 3, 2),
    ((64, 32, 8), 1, 4, 2, 1),
]


class RecordingTable(ArrayTable):
    """A table that remembers the regions read, and accepts plain slices alone."""

    def __init__(self, values: npt.NDArray[Any]) -> None:
        super().__init__(values)
        self.regions: list[tuple[tuple[int, int], ...]] = []

    def read(self, region: tuple[slice, ...]) -> npt.NDArray[Any]:
        assert len(region) == 5
        for axis, size in zip(region, self.shape, strict=True):
            assert axis.step is None
            assert 0 <= axis.start < axis.stop <= size
        self.regions.append(tuple((axis.start, axis.stop) for axis in region))
        return super().read(region)


class Networks:
    """Networks to test with, and what they should give."""

    @staticmethod
    def random(
        box: tuple[int, int, int],
        key_frames: int,
        fold: int,
        embedding_size: int,
        hidden_layers: int,
        *,
        width: int = 16,
        dtype: npt.DTypeLike = np.float32,
    ) -> Network:
        """A network of normally distributed numbers."""
        rng = np.random.default_rng(0)
        levels = level_resolutions(box, key_frames, fold)
        widths = [len(levels) * embedding_size, *[width] * hidden_layers, 1]
        layers = [
            (
                (rng.standard_normal((n, m)) / np.sqrt(m)).astype(np.float32),
                rng.standard_normal(n).astype(np.float32),
            )
            for m, n in pairwise(widths)
        ]
        tables = [
            ArrayTable(rng.standard_normal((*level, embedding_size)).astype(dtype))
            for level in levels
        ]
        return Network(
            levels=levels,
            embedding_size=embedding_size,
            tables=tables,
            layers=tuple(layers),
            box_size=box,
            key_frames=key_frames,
        )

    @staticmethod
    def recording(network: Network) -> Network:
        """The same network with tables that remember what is read."""
        return replace(network, tables=[RecordingTable(table.values) for table in network.tables])  # type: ignore[attr-defined]

    @staticmethod
    def reference(network: Network, points: Sequence[Any]) -> npt.NDArray[np.float64]:
        """Values (n,) at points in float64: 16 corners per level, no shortcuts."""
        sizes = (network.key_frames, *network.box_size)
        inputs = []
        for level, table in zip(network.levels, network.tables, strict=True):
            position = [
                p * (r - 1) / max(s - 1, 1) for p, r, s in zip(points, level, sizes, strict=True)
            ]
            before = [
                np.minimum(np.floor(p), max(r - 2, 0)).astype(int)
                for p, r in zip(position, level, strict=True)
            ]
            embeddings = np.zeros((network.embedding_size, len(points[0])))
            for corner in product((0, 1), repeat=4):
                index = tuple(
                    np.minimum(b + c, r - 1) for b, c, r in zip(before, corner, level, strict=True)
                )
                weight = prod(
                    np.abs(p - b - 1 + c) for p, b, c in zip(position, before, corner, strict=True)
                )
                embeddings += weight * table.values[index].astype(np.float64).T  # type: ignore[attr-defined]
            inputs.append(embeddings)
        hidden = np.concatenate(inputs)
        for number, (weight, bias) in enumerate(network.layers):
            hidden = np.maximum(hidden, 0) if number else hidden
            hidden = weight.astype(np.float64) @ hidden + bias[:, None]
        return hidden[0]

    @staticmethod
    def points(network: Network, count: int, seed: int = 1) -> Points:
        """Random points of the box."""
        rng = np.random.default_rng(seed)
        return [rng.random(count) * (size - 1) for size in (network.key_frames, *network.box_size)]

    @staticmethod
    def key_indices(network: Network) -> list[float]:
        """Key indices at both ends and between."""
        last = network.key_frames - 1
        return sorted({0.0, float(last), last / 2, last * 0.37})

    @staticmethod
    def box(network: Network) -> Box:
        """The region of the whole box."""
        z, y, x = ((0, size) for size in network.box_size)
        return z, y, x


@pytest.fixture(scope="session")
def networks() -> type[Networks]:
    return Networks


@pytest.fixture(params=SHAPES, ids=str)
def network(request: pytest.FixtureRequest) -> Network:
    """A random network of each shape."""
    make: Callable[..., Network] = Networks.random
    return make(*request.param)


def _noise_coreset(
    shape: tuple[int, int, int, int],
    low: float = 0.3,
    fringe: bool = False,
    keys: Sequence[int] = (),
) -> Coreset:
    series = ArraySeries(np.random.default_rng(3).random(shape, dtype=np.float32))
    scanned = scan(series, silent)
    choice = FeatureChoice(keys or range(shape[0]), [Interval(low, 1.0)])
    coreset = build_coreset(series, scanned, choice, silent, fringe=fringe)
    if not keys:
        return coreset
    times = KeyTimes(times=np.arange(shape[0], dtype=np.float64) ** 1.5, key_frames=tuple(keys))
    return with_steps_between(coreset, series, scanned.value_range, times, silent)


def _in_coreset(coreset: Coreset) -> npt.NDArray[np.bool_]:
    return np.unpackbits(coreset.mask_bits, axis=1, count=prod(coreset.brick_shape)).astype(bool)


@pytest.fixture(scope="session")
def noise_coreset() -> Callable[..., Coreset]:
    """A function of (shape, low, fringe, keys): noise; values from `low` to 1 are the feature.

    With `keys`, these steps are key frames, and those between them are samples, too.
    """
    return _noise_coreset


@pytest.fixture(scope="session")
def in_coreset() -> Callable[[Coreset], npt.NDArray[np.bool_]]:
    """A function of a coreset: which vertices (bricks, vertices) of its bricks are samples."""
    return _in_coreset


CODED = EncodeConfig(
    preset="published", epochs=6, width=16, fold=2, embedding_size=2, tables="transform"
)


def _waves(shape: tuple[int, ...] = (5, 9, 12, 20)) -> npt.NDArray[np.float32]:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (100 * (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z)).astype(np.float32)


@pytest.fixture(scope="session")
def waves() -> Callable[..., npt.NDArray[np.float32]]:
    """A function of a shape: a smooth moving field."""
    return _waves


@pytest.fixture(scope="session")
def coded_config() -> EncodeConfig:
    """Settings of a short training whose tables are coded."""
    return CODED


@pytest.fixture(scope="session", params=["all", "feature", "one", "three"])
def pair(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[dict[str, Any], Path]]:
    """The figures and paths of one training: `exact`, its tables as float32, and `coded`."""
    settings: dict[str, dict[str, Any]] = {
        "all": {},
        "feature": {"features": ("interval:50:200",), "dilation": 0},
        "one": {"embedding_size": 1, "hidden_layers": 0, "fold": 3},
        "three": {"embedding_size": 3, "key_frames": "0,2,4", "features": ("interval:20:300",)},
    }
    folder = tmp_path_factory.mktemp("coded")
    config = replace(CODED, **settings[request.param])
    files = {}
    for name, tables in {"exact": "float32", "coded": "transform"}.items():
        path = folder / f"{name}.fhz"
        files[name] = (fhash_codec.encode(_waves(), path, replace(config, tables=tables)), path)
    return files


@dataclass(frozen=True, kw_only=True)
class RandomModel:
    """A coreset in which many vertices do not count, and random numbers in place of a training."""

    field: npt.NDArray[np.float32]
    selection: Selection
    bricks: Bricks
    fine: Single
    tables: list[Single]
    layers: tuple[tuple[Single, Single], ...]
    trained: list[TrainedTable]

    def network(self, fill: float | None = None) -> Network:
        """The network, with `fill` in place of embeddings that are not needed."""
        architecture = self.selection.architecture
        tables = []
        for table in self.trained:
            region = tuple(slice(0, n) for n in table.shape)
            values = table.read(region)
            if fill is not None:
                values = np.where(table.needed(region)[..., None], values, np.float32(fill))
            tables.append(ArrayTable(values))
        return Network(
            levels=architecture.levels,
            embedding_size=architecture.embedding_size,
            tables=tables,
            layers=self.layers,
            box_size=architecture.box_size,
            key_frames=architecture.key_frames,
        )


@pytest.fixture(scope="session")
def random_model() -> RandomModel:
    config = replace(CODED, features=("interval:100:200",), dilation=0)
    field = _waves()
    selection = select(ArraySeries(field), config, silent)
    architecture, coreset = selection.architecture, selection.coreset
    random = np.random.default_rng(0)
    size = architecture.embedding_size
    fine = random.random((size, len(coreset.values)), dtype=np.float32)
    tables = [random.random((prod(level), size), np.float32) for level in architecture.levels[1:]]
    layers = tuple(
        (
            random.standard_normal(shape).astype(np.float32),
            random.random(shape[0], dtype=np.float32),
        )
        for shape in architecture.layer_shapes
    )
    bricks = Bricks(coreset)
    return RandomModel(
        field=field,
        selection=selection,
        bricks=bricks,
        fine=fine,
        tables=tables,
        layers=layers,
        trained=trained_tables(architecture, coreset, bricks, fine, tables),
    )


def _coreset(bend: float) -> Coreset:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (3, 12, 20, 36)), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    series = ArraySeries(values + bend * values**2)
    return build_coreset(
        series, scan(series, silent), FeatureChoice(range(3), [Everything()]), silent
    )


@pytest.fixture(scope="session")
def coreset() -> Coreset:
    return _coreset(0.0)


@pytest.fixture(scope="session")
def other_coreset() -> Coreset:
    """The same vertices with other values."""
    return _coreset(0.5)


@pytest.fixture(scope="session")
def setup() -> Callable[..., Any]:
    """A function of a coreset and settings: the plan and an engine."""

    def make(coreset: Coreset, epochs: int = 4, **settings: Any) -> Any:
        usual = {"learning_rate": 0.01, "schedule": "cosine", "batch": 0, "seed": 5}
        plan = plan_training(coreset, epochs=epochs, **usual | settings)
        architecture = Architecture.for_box(coreset.box.shape, 3, width=16)
        return plan, make_engine(architecture, coreset, plan.rates, seed=5, device="cpu")

    return make
