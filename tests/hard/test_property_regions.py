"""Any part of a volume equals that part of all values: numpy's indices, regions, times, levels of
detail."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from properties import Draw, looking, same

import fhash_codec
from fhash_codec import EncodeConfig, Volume
from fhash_formats.errors import InputError

SHAPE = (5, 7, 9, 11)
SETTINGS = {
    "compact": EncodeConfig(effort=1, tile="2x3x4x5"),
    "compact, a feature": EncodeConfig(
        effort=1, tile="4x4x4x4", features=("interval:0.2:2",), dilation=0
    ),
    "paper": EncodeConfig(profile="paper", epochs=1, width=4),
    "paper, a feature": EncodeConfig(
        profile="paper",
        epochs=1,
        width=4,
        features=("interval:0.2:2",),
        dilation=0,
        key_frames="0,2,4",
    ),
}


def field(shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    """Return waves with holes, float32 (t, z, y, x)."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    values[1:2, 2:3, 3:4, :] = np.nan
    return values


@pytest.fixture(scope="module", params=SETTINGS)
def volume(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Volume, np.ndarray]]:
    """An open volume and all its values."""
    path = tmp_path_factory.mktemp("regions") / "a.fhz"
    fhash_codec.encode(field(), path, SETTINGS[request.param])
    with fhash_codec.open(path) as opened:
        yield opened, opened[...]


def boxes(shape: tuple[int, ...]) -> st.SearchStrategy[tuple[tuple[int, int], ...]]:
    """Draw regions (z, y, x) with at least one vertex."""
    return st.tuples(
        *(
            st.integers(0, n - 1).flatmap(
                lambda low, n=n: st.tuples(st.just(low), st.integers(low + 1, n))
            )
            for n in shape
        )
    )


@looking(60)
@given(index=hnp.basic_indices(SHAPE, allow_newaxis=False, allow_ellipsis=True))
@example(index=(slice(-1, -100, -3), Ellipsis, -1))
@example(index=(slice(10**20, None), slice(None, None, -(10**20))))
def test_any_index_is_numpys(volume: tuple[Volume, np.ndarray], index: object) -> None:
    selected = volume[0][index]  # type: ignore[index]
    assert same(np.asarray(selected), np.asarray(volume[1][index]))  # type: ignore[index]


@looking(50)
@given(
    index=st.lists(
        st.one_of(st.integers(-13, 13), st.slices(12), st.just(Ellipsis)), max_size=6
    ).map(tuple)
)
def test_what_numpy_refuses_is_an_index_error(
    volume: tuple[Volume, np.ndarray], index: tuple[object, ...]
) -> None:
    try:
        expected = volume[1][index]
    except IndexError:
        with pytest.raises(IndexError) as caught:
            volume[0][index]
        assert "\n" not in str(caught.value)
    else:
        assert same(np.asarray(volume[0][index]), np.asarray(expected))


@looking(30)
@given(
    region=boxes(SHAPE[1:]),
    t=st.floats(0, SHAPE[0] - 1),
    outside=st.sampled_from(["nan", "background"]),
)
def test_a_region_is_that_part_of_the_frame_at_any_time(
    volume: tuple[Volume, np.ndarray], region: tuple[tuple[int, int], ...], t: float, outside: str
) -> None:
    place = tuple(slice(*span) for span in region)
    assert same(
        volume[0].read(t, region, outside=outside), volume[0].read(t, outside=outside)[place]
    )
    assert (volume[0].occupancy(t, region) == volume[0].occupancy(t)[place]).all()


@looking(60)
@given(step=st.integers(0, SHAPE[0] - 1), lod=st.integers(0, 10), region=boxes(SHAPE[1:]))
def test_a_region_of_a_level_of_detail_is_that_part_of_it(
    volume: tuple[Volume, np.ndarray], step: int, lod: int, region: tuple[tuple[int, int], ...]
) -> None:
    opened = volume[0]
    try:
        level, all_of_it = opened.read_lod(step, lod), opened.lod_vertices(lod)
    except InputError:
        assert opened.profile == "paper"
        return
    try:
        vertices = opened.lod_vertices(lod, region)
    except IndexError:
        with pytest.raises(IndexError):
            opened.read_lod(step, lod, region)
        assert any(
            not set(every) & set(range(*span))
            for every, span in zip(all_of_it, region, strict=True)
        )
        return
    place = tuple(
        slice(every.index(kept[0]), every.index(kept[-1]) + 1)
        for every, kept in zip(all_of_it, vertices, strict=True)
    )
    assert same(opened.read_lod(step, lod, region), level[place])


@looking(30)
@given(data=st.data())
def test_points_on_vertices_have_the_values_there(
    volume: tuple[Volume, np.ndarray], data: Draw
) -> None:
    opened, all_values = volume
    count = data.draw(st.integers(1, 8))
    t, z, y, x = (
        np.array(data.draw(st.lists(st.integers(0, n - 1), min_size=count, max_size=count)))
        for n in SHAPE
    )
    sampled, expected = opened.sample(t=t, z=z, y=y, x=x), all_values[t, z, y, x]
    assert (np.isnan(sampled) == np.isnan(expected)).all()
    np.testing.assert_allclose(sampled, expected, rtol=2e-5, atol=2e-6)


@contextmanager
def encoded(values: np.ndarray, config: EncodeConfig) -> Iterator[Volume]:
    with tempfile.TemporaryDirectory(prefix="fhash-") as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fhash_codec.encode(values, Path(place) / "a.fhz", config)
        with fhash_codec.open(Path(place) / "a.fhz") as opened:
            yield opened


@looking(15, 500)
@given(
    shape=hnp.array_shapes(min_dims=4, max_dims=4, min_side=1, max_side=9),
    dtype=st.sampled_from(["int8", "uint16", "int64", "uint64", "float16", "float32", "float64"]),
    bound=st.sampled_from([0.0, 1e-3, 0.3]),
    seed=st.integers(0, 99),
    data=st.data(),
)
def test_any_series_of_any_tiles_keeps_its_bound_and_its_regions(
    shape: tuple[int, ...], dtype: str, bound: float, seed: int, data: Draw
) -> None:
    random = np.random.default_rng(seed)
    kind = np.dtype(dtype)
    if kind.kind == "f":
        values = random.standard_normal(shape).astype(kind)
        values.flat[:: data.draw(st.integers(2, 50))] = np.nan
        assume(np.isfinite(values).any())
    else:
        limits = np.iinfo(kind)
        least, most = (
            max(limits.min, -(2**53)),
            min(limits.max, 2**53),
        )  # volumes decode integers to float64
        values = random.integers(least, most, shape, dtype=kind, endpoint=True)
    tile = "x".join(str(data.draw(st.integers(1, 12))) for _ in range(4))
    config = (
        EncodeConfig(effort=1, tile=tile, max_error_rel=bound)
        if bound
        else EncodeConfig(effort=1, tile=tile, max_error=0.0)
    )
    with encoded(values, config) as opened:
        all_values = opened[...]
        index = data.draw(hnp.basic_indices(shape, allow_newaxis=False))
        assert same(np.asarray(opened[index]), np.asarray(all_values[index]))
        finite = np.isfinite(values)
        assert (np.isfinite(all_values) == finite).all()
        exact = [float(value) for value in values[finite]]
        error = max(
            (
                abs(float(decoded) - value)
                for decoded, value in zip(all_values[finite], exact, strict=True)
            ),
            default=0.0,
        )
        rounding = max(map(abs, exact)) * np.finfo(opened.float_dtype).eps
        assert error <= bound * (max(exact) - min(exact)) + rounding
