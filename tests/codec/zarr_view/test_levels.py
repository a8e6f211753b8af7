"""Levels over the whole domain: the bits of `volume[...]`, and of `read_lod` in its box."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec.zarr_view import chunking
from fhash_codec.zarr_view.levels import Level, level_count
from fhash_codec.zarr_view.view import ZarrView

TILE = (2, 5, 12, 11)
"""Vertices of the first tile of the container `whole`."""
GOLDEN = Path(__file__).resolve().parents[2] / "golden"


def region_of(level: Level) -> tuple[slice, ...]:
    return tuple(slice(0, n) for n in level.shape)


@pytest.mark.parametrize(
    "name", ["compact-labels", "compact-counts", "paper-sparse", "compact-linear"]
)
def test_level_0_has_the_bits_of_the_volume(name: str) -> None:
    with fhash_codec.open(GOLDEN / f"{name}.fhz") as volume:
        level = Level(volume, 0)
        assert level.shape == volume.shape
        assert level.read(region_of(level)).tobytes() == volume[...].tobytes()


@pytest.mark.parametrize("kind", ["whole", "feature"])
@pytest.mark.parametrize("lod", [1, 2, 3])
def test_coarse_levels_are_those_of_the_box_and_empty_elsewhere(
    kind: str, lod: int, request: pytest.FixtureRequest
) -> None:
    with fhash_codec.open(request.getfixturevalue(kind)) as volume:
        level = Level(volume, lod)
        every = [range(n)[level.vertices(axis)] for axis, n in enumerate(volume.shape[1:])]
        assert level.shape == (volume.shape[0], *map(len, every))
        got = level.read(region_of(level))
        assert got.dtype == volume.dtype
        expected = np.full(level.shape, np.nan, dtype=np.float32)
        inside = [
            [place for place, vertex in enumerate(along) if vertex in vertices]
            for along, vertices in zip(every, volume.lod_vertices(lod), strict=True)
        ]
        for step in range(volume.shape[0]):
            expected[(step, *np.ix_(*inside))] = volume.read_lod(step, lod)
        assert np.isfinite(expected).any()
        assert got.tobytes() == expected.tobytes()
        assert level.holds(region_of(level))


def test_regions_of_a_level_are_parts_of_it(feature: Path) -> None:
    with fhash_codec.open(feature) as volume:
        level = Level(volume, 1)
        whole = level.read(region_of(level))
        outside = 0
        for lows in product(*(range(0, n, 3) for n in level.shape)):
            region = tuple(
                slice(low, min(low + 3, n)) for low, n in zip(lows, level.shape, strict=True)
            )
            assert level.read(region).tobytes() == whole[region].tobytes()
            if not level.holds(region):
                outside += 1
                assert np.isnan(whole[region]).all()
        assert outside


def test_integers_stay_integers_and_keep_their_fill_value() -> None:
    with fhash_codec.open(GOLDEN / "compact-labels.fhz") as volume:
        level = Level(volume, 1)
        coarse = level.read(region_of(level))
        assert coarse.dtype == np.int8
        # labels are taken at vertices, not averaged
        assert coarse[:, :, :, 1:-1].tobytes() == volume[:, ::2, ::2, 2:-2:2].tobytes()
        assert (coarse[:, :, :, 0] == volume.fill).all()


@pytest.mark.parametrize("kind", ["whole", "feature"])
def test_missing_values_and_a_fill_value_of_ones_own(
    kind: str, request: pytest.FixtureRequest
) -> None:
    with fhash_codec.open(request.getfixturevalue(kind), fill=-7) as volume:
        for lod in (0, 1):
            level = Level(volume, lod)
            values = level.read(region_of(level))
            assert not np.isnan(values).any()
            assert (values == -7).any() == (kind == "feature")


def test_missing_values_are_missing(gappy: Path) -> None:
    with fhash_codec.open(gappy) as volume:
        level = Level(volume, 1)
        assert np.isnan(Level(volume, 0).read(region_of(Level(volume, 0)))[0, 1, 3:7, 5:9]).all()
        assert np.isnan(level.read(region_of(level))[1]).sum() == 0


@pytest.mark.parametrize(
    ("name", "count"),
    [("compact-labels", 2), ("compact-linear", 2), ("paper-sparse", 1)],
)
def test_levels_end_where_all_is_small(name: str, count: int) -> None:
    with fhash_codec.open(GOLDEN / f"{name}.fhz") as volume:
        assert level_count(volume) == count
        if count > 1:
            assert max(volume.read_lod(0, count - 1).shape) <= 16
            assert max(volume.read_lod(0, count - 2).shape) > 16


def test_a_tile_whose_chunks_are_asked_for_at_once_is_decoded_once(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunking, "MOST_BYTES", 100)
    monkeypatch.setattr(chunking, "FEW_BYTES", 0)

    def bytes_read(threads: int) -> int:
        with fhash_codec.open(whole) as volume, ThreadPoolExecutor(threads) as pool:
            array = ZarrView({"density": volume}).arrays["density"]
            assert array.chunk_bytes <= 100
            sides = array.chunk_shape
            indices = [
                index
                for index in array.indices()
                if all((i + 1) * n <= m for i, n, m in zip(index, sides, TILE, strict=True))
            ]
            assert len(indices) > 8
            list(pool.map(array.chunk, indices))
            return volume.container.bytes_read

    assert bytes_read(8) == bytes_read(1)


def test_levels_of_integers_far_from_zero_stay_in_their_range(tmp_path: Path) -> None:
    steps = np.arange(2 * 12 * 40 * 40, dtype=np.uint64).reshape(2, 12, 40, 40) // 97
    values = np.uint64(2**64 - 1) - steps
    config = fhash_codec.EncodeConfig(max_error=3.0, effort=1)
    fhash_codec.encode(values, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        for lod in range(level_count(volume)):
            level = Level(volume, lod)
            found = level.read(region_of(level))
            assert found.dtype == values.dtype
            assert found.min() >= values.min()
            near = values[:, :: level.stride, :: level.stride, :: level.stride]
            pair = [(each - values.min()).astype(float) for each in (found, near)]
            assert np.abs(pair[0] - pair[1]).max() < 60
