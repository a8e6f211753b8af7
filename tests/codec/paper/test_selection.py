"""The coreset and the architecture that the settings select."""

from __future__ import annotations

import numpy as np

from fhash_codec import EncodeConfig
from fhash_codec.paper.selection import select
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries


def test_the_architecture_is_that_of_the_box_and_the_key_frames() -> None:
    field = np.zeros((6, 9, 10, 20), np.float32)
    field[:, 2:7, 3:8, 4:15] = 1.0
    config = EncodeConfig(
        profile="paper",
        features=("interval:0.5:2",),
        dilation=0,
        key_frames="every:2",
        embedding_size=3,
        width=8,
        fold=3,
    )
    selection = select(ArraySeries(field), config, silent)
    assert selection.coreset.box == ((2, 7), (3, 8), (4, 15))
    assert [str(feature) for feature in selection.features] == ["interval:0.5:2"]
    architecture = selection.architecture
    assert architecture.sizes == (len(selection.coreset.key_frames), 5, 5, 11)
    assert len(architecture.levels) == 3  # ceil(log3 11)
    assert (architecture.embedding_size, architecture.width) == (3, 8)


def test_a_mask_is_a_feature() -> None:
    field = np.random.default_rng(0).random((2, 4, 5, 6), dtype=np.float32)
    mask = np.zeros((4, 5, 6), bool)
    mask[1, 2:4, 3] = True
    config = EncodeConfig(profile="paper", dilation=0)
    selection = select(ArraySeries(field), config, silent, mask)
    assert selection.coreset.box == ((1, 2), (2, 4), (3, 4))
    assert len(selection.coreset.values) == 4
