"""The comparison picture: exact colours at control points, and every vertex in its place."""

from __future__ import annotations

import numpy as np
import pytest

from fhash_codec.gallery import (
    GALLERY_SERIES,
    OUTSIDE,
    PICTURES,
    VIRIDIS,
    Pair,
    colours,
    compare,
)
from fhash_codec.rendering.grid import Grid


def test_colours_hit_their_control_points_and_clip_beyond_the_ends() -> None:
    count = len(VIRIDIS)
    expected = [tuple(bytes.fromhex(point)) for point in VIRIDIS]
    got = colours(np.linspace(2.0, 5.0, count), 2.0, 5.0, VIRIDIS)
    assert [tuple(map(int, colour)) for colour in got] == expected
    assert tuple(colours(-99.0, 2.0, 5.0, VIRIDIS)) == expected[0]
    assert tuple(colours(99.0, 2.0, 5.0, VIRIDIS)) == expected[-1]


@pytest.mark.parametrize("shape", [(48, 48), (7, 31), (1, 1), (300, 400)])
def test_picture_shows_original_decoded_and_error_of_each_pair(shape: tuple[int, int]) -> None:
    original = np.linspace(0.0, 1.0, shape[0] * shape[1]).reshape(shape)
    decoded = np.full(shape, np.nan)
    decoded[-1, 0] = original[-1, 0]
    image = compare(
        [Pair(label=f"t = {n}", original=original, decoded=decoded) for n in range(3)],
        title="a",
        subtitle="b",
        quantity="c",
    )
    pixels = np.asarray(image)
    lowest, highest = (np.array(list(bytes.fromhex(VIRIDIS[end]))) for end in (0, -1))
    columns = [x for x in range(image.width) if (pixels[:, x] == OUTSIDE).all(axis=-1).any()]
    assert image.mode == "RGB"
    assert 600 < image.width < 2000
    assert columns or shape == (1, 1)
    assert (pixels == highest).all(axis=-1).any()
    assert (pixels == lowest).all(axis=-1).any()


def test_picture_of_nothing_decoded_and_of_a_constant_has_no_invalid_number() -> None:
    flat = np.full((6, 5), 3.0)
    compare(
        [Pair(label="", original=flat, decoded=np.full((6, 5), np.nan))],
        title="",
        subtitle="",
        quantity="",
    )
    compare(
        [Pair(label="", original=flat, decoded=flat)],
        title="",
        subtitle="",
        quantity="",
        footer="x",
    )


@pytest.mark.parametrize("name", sorted(set(GALLERY_SERIES) - {"blast"}))
def test_a_series_has_values_and_is_the_same_again(name: str) -> None:
    first, second = GALLERY_SERIES[name].make(), GALLERY_SERIES[name].make()
    assert first.shape == (first.shape[0], *first.read(0).shape)
    np.testing.assert_array_equal(first.read(1), second.read(1))
    assert 0.3 < np.isfinite(first.read(0)).mean() <= 1
    assert first.coords["t"].attributes["units"] == "s"


def test_there_is_a_plane_a_depth_and_uneven_axes() -> None:
    grids = {name: Grid.of(GALLERY_SERIES[name].make().coords) for name in ("sea", "ocean", "jet")}
    assert grids["sea"].flat
    assert grids["sea"].warp is None
    for name in ("ocean", "jet"):
        assert grids[name].warp is not None
        assert grids[name].scale[2] < 0


def test_every_picture_is_of_a_series() -> None:
    assert {picture.series for picture in PICTURES} == set(GALLERY_SERIES)
    assert len({picture.name for picture in PICTURES}) == len(PICTURES)
