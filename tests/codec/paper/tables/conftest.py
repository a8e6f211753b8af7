"""Series and settings for `--tables transform`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.paper.encode import Selection, select
from fhash_codec.paper.network import ArrayTable, Floats, Network
from fhash_codec.paper.tables import Bricks, TrainedTable, trained_tables
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries

CODED = EncodeConfig(
    profile="paper", epochs=6, width=16, fold=2, embedding_size=2, tables="transform"
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
    fine: Floats
    tables: list[Floats]
    layers: tuple[tuple[Floats, Floats], ...]
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
