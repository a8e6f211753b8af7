"""Levels of a compact file: how many there are, and that each part is that of the whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.compact.parts import MAX_LEVELS, head_mlp, level_count
from fhash_codec.paper.architecture import level_resolutions


@pytest.mark.parametrize("box", [(1, 1, 1), (2, 2, 2), (3, 1, 1), (25, 125, 125), (64, 64, 128)])
def test_there_are_as_many_levels_as_in_the_paper(box: tuple[int, int, int]) -> None:
    assert level_count(box) == len(level_resolutions(box, 1, 2))


def test_there_are_no_more_levels_than_the_coder_has() -> None:
    assert level_count((1, 1, 2048)) == MAX_LEVELS
    assert level_count((1, 1, 1 << 20)) == MAX_LEVELS


def test_no_head_is_an_mlp_without_layers() -> None:
    assert head_mlp(None).layers == ()


def test_parts_of_tables_are_parts_of_the_whole_and_integers_are_not_rounded(
    tmp_path: Path,
) -> None:
    t, _, y, x = np.meshgrid(*(np.arange(n) for n in (3, 5, 13, 17)), indexing="ij")
    values = (40 + 30 * np.sin(x / 3 + t) * np.cos(y / 4)).astype(np.int16)
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(effort=2, tile="2x5x6x8", psnr=45))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.dtype == np.int16
        for table in volume.tables:
            whole = np.asarray(table)
            assert whole.dtype == np.float32
            part = (slice(1, 3), slice(0, 1), slice(1, None), slice(0, 2))
            np.testing.assert_array_equal(table[part], whole[part])
        lattice = volume.tables[0][..., 0]
        assert not np.array_equal(lattice, np.rint(lattice))
        np.testing.assert_array_equal(np.rint(lattice), volume[...])
