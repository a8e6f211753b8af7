"""Laws of reading: any source comes back, and any region is that part of the whole."""

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
from properties import INTEGERS, NUMBERS, Draw, arrays, chunks, looking, same

import fhash_codec
from fhash_codec import EncodeConfig, Volume
from fhash_formats.errors import InputError
from fhash_formats.readers.file_series import RawLayout
from fhash_formats.readers.hdf5 import default_fill
from fhash_formats.readers.registry import open_series
from fhash_formats.series import AXES, Coordinate
from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_region

pytestmark = pytest.mark.hard

ORDERS = st.permutations(AXES)


@contextmanager
def folder() -> Iterator[Path]:
    """A new folder for each example; a fixture would give all examples the same one."""
    with tempfile.TemporaryDirectory(prefix="fhash-") as path:
        yield Path(path)


def read(path: Path, **options: object) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with open_series(path, **options) as series:  # type: ignore[arg-type]
            series.check()
            frames = np.stack(list(series.frames()))
            assert frames.shape == series.shape
            assert all(
                same(series.read(step), frames[step]) for step in reversed(range(series.shape[0]))
            )
            return frames


def turned(values: np.ndarray, order: list[str]) -> np.ndarray:
    """Return the values (t, z, y, x) with their axes in another order."""
    return values.transpose([AXES.index(axis) for axis in order])


@looking(40)
@given(values=arrays(), order=ORDERS, swapped=st.booleans(), fortran=st.booleans())
def test_npy(values: np.ndarray, order: list[str], swapped: bool, fortran: bool) -> None:
    stored = turned(values, order).astype(values.dtype.newbyteorder("S" if swapped else "="))
    with folder() as place:
        np.save(
            place / "a.npy", np.asfortranarray(stored) if fortran else np.ascontiguousarray(stored)
        )
        assert same(read(place / "a.npy", axes=",".join(order)), values)


@looking(40)
@given(values=arrays(), order=ORDERS, endian=st.sampled_from(["little", "big"]))
def test_raw(values: np.ndarray, order: list[str], endian: str) -> None:
    kind = values.dtype.newbyteorder({"little": "<", "big": ">"}[endian])
    layout = RawLayout(dict(zip(AXES, values.shape, strict=True)), values.dtype.name, endian)
    with folder() as place:
        (place / "a.bin").write_bytes(turned(values, order).astype(kind).tobytes())
        assert same(read(place / "a.bin", axes=",".join(order), raw=layout), values)


@looking(15)
@given(
    values=arrays(),
    order=ORDERS,
    swapped=st.booleans(),
    packed=st.sampled_from([None, "gzip", "lzf"]),
    data=st.data(),
)
def test_hdf5(
    values: np.ndarray, order: list[str], swapped: bool, packed: str | None, data: Draw
) -> None:
    import h5py

    stored = turned(values, order)
    chunk = (
        data.draw(st.one_of(st.none(), chunks(stored.shape)))
        if packed is None
        else data.draw(chunks(stored.shape))
    )
    with folder() as place:
        with h5py.File(place / "a.h5", "w") as file:
            kind = stored.dtype.newbyteorder("S" if swapped else "=")
            file.create_dataset(
                "v",
                data=stored.astype(kind),
                chunks=chunk,
                compression=packed,
                shuffle=packed is not None,
            )
        assert same(read(place / "a.h5", axes=",".join(order)), values)


@looking(15)
@given(values=arrays(), order=ORDERS, form=st.sampled_from([2, 3]), data=st.data())
def test_zarr(values: np.ndarray, order: list[str], form: int, data: Draw) -> None:
    import zarr

    stored = turned(values, order)
    chunk = data.draw(chunks(stored.shape))
    names = {} if form == 2 else {"dimension_names": order}
    with folder() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on float16 and similar types
        array = zarr.create_array(
            place / "a.zarr",
            shape=stored.shape,
            dtype=stored.dtype,
            chunks=chunk,
            zarr_format=form,
            **names,
        )
        array[...] = stored
        assert same(read(place / "a.zarr", axes=",".join(order)), values)


@looking(15)
@given(values=arrays(), order=ORDERS, data=st.data())
def test_zarr_without_some_of_its_chunks(values: np.ndarray, order: list[str], data: Draw) -> None:
    """Chunks that were never written hold the fill value of the array, whatever it is."""
    import zarr

    stored = turned(values, order)
    chunk = data.draw(chunks(stored.shape))
    fill = stored.flat[data.draw(st.integers(0, stored.size - 1))]
    corner = tuple(slice(0, n) for n in data.draw(chunks(stored.shape)))
    expected = np.full_like(stored, fill)
    expected[corner] = stored[corner]
    with folder() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        array = zarr.create_array(
            place / "a.zarr",
            shape=stored.shape,
            dtype=stored.dtype,
            chunks=chunk,
            fill_value=fill,
            zarr_format=3,
        )
        array[corner] = stored[corner]
        back = expected.transpose([order.index(axis) for axis in AXES])
        assert same(read(place / "a.zarr", axes=",".join(order)), back)


@looking(12)
@given(values=arrays((*INTEGERS, "float32", "float64")), order=ORDERS, data=st.data())
def test_netcdf_with_fill_values(values: np.ndarray, order: list[str], data: Draw) -> None:
    """The fill value becomes NaN; integers become the float type that xarray gives them."""
    pytest.importorskip("h5netcdf")
    import h5netcdf

    stored = turned(values, order)
    fill = data.draw(st.one_of(st.none(), st.sampled_from(list(stored.flat))))
    chunk = data.draw(st.one_of(st.none(), chunks(stored.shape)))
    names = dict(zip(AXES, ("time", "z", "y", "x"), strict=True))
    expected = values
    if fill is not None and not np.isnan(fill):
        kind = (
            values.dtype
            if values.dtype.kind == "f"
            else np.dtype("float32" if values.dtype.itemsize <= 2 else "float64")
        )
        expected = np.where(values == fill, np.nan, values.astype(kind)).astype(kind)
    elif fill is not None and values.dtype.kind != "f":
        return
    else:  # where no fill value is declared, that of NetCDF stands for one that nobody wrote
        assume(not np.isin(values, [default_fill(values.dtype)]).any())
    with folder() as place:
        with h5netcdf.File(place / "a.nc", "w") as file:
            file.dimensions = {names[axis]: stored.shape[order.index(axis)] for axis in order}
            dimensions = tuple(names[axis] for axis in order)
            variable = file.create_variable(
                "v", dimensions, stored.dtype, data=stored, fillvalue=fill, chunks=chunk
            )
            assert variable.shape == stored.shape
        values_read = read(place / "a.nc")
        np.testing.assert_array_equal(values_read.astype(expected.dtype), expected)
        if fill is not None:
            assert values_read.dtype == expected.dtype


@looking(15)
@given(
    values=arrays(NUMBERS),
    suffix=st.sampled_from(["npy", "h5", "nc", "zarr", "raw"]),
    data=st.data(),
)
def test_what_a_writer_wrote_a_reader_reads(values: np.ndarray, suffix: str, data: Draw) -> None:
    """The coordinates ascend with any spacing; name and units consist of any letters."""
    steps = st.floats(1e-6, 1e6)
    coords = {}
    for axis, length in zip(AXES, values.shape, strict=True):
        spans = data.draw(st.lists(steps, min_size=length, max_size=length))
        coords[axis] = Coordinate(name=axis, values=np.cumsum(np.array(spans, dtype=np.float64)))
    name = data.draw(st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=8))
    units = data.draw(st.text(st.characters(categories=["L", "N", "Zs"]), max_size=8))
    region = Region(name=name, units=units, dtype=values.dtype, shape=values.shape, coords=coords)
    with folder() as place:
        path = place / f"a.{suffix}"
        save_region(path, region, values)
        layout = None
        if suffix == "raw":
            stored = "float32" if values.dtype == np.float16 else values.dtype.name
            layout = RawLayout(dict(zip(AXES, values.shape, strict=True)), stored, "little")
        with open_series(
            path, raw=layout, axes=None if suffix in ("h5", "nc", "zarr") else "t,z,y,x"
        ) as series:
            values_read = np.stack(list(series.frames()))
            exact = values.astype(series.dtype)
            assert same(values_read, exact)
            assert same(exact.astype(values.dtype), values)
            if suffix in ("h5", "nc", "zarr"):
                assert series.units == units
                for axis in AXES:
                    np.testing.assert_array_equal(series.coords[axis].values, coords[axis].values)


@looking(10)
@given(values=arrays(INTEGERS), data=st.data())
def test_any_split_into_files_is_one_series(values: np.ndarray, data: Draw) -> None:
    """Whoever names no axes is asked where the last one may hold the components of a vector."""
    with folder() as place:
        start = number = 0
        while start < values.shape[0]:
            stop = start + data.draw(st.integers(1, values.shape[0] - start))
            np.save(place / f"part_{number}.npy", values[start:stop])
            start, number = stop, number + 1
        assert same(read(place / "part_*.npy", axes="t,z,y,x"), values)
        _, z, y, x = values.shape
        if 2 <= x <= 9 and x < min(y, z):
            with pytest.raises(InputError, match=f"field of {x} components"):
                read(place / "part_*.npy")
        else:
            assert same(read(place / "part_*.npy"), values)


SHAPE = (5, 7, 9, 11)
SETTINGS = {
    "compact": EncodeConfig(effort=1, tile="2x3x4x5"),
    "compact, a feature": EncodeConfig(
        effort=1, tile="4x4x4x4", features=("interval:0.2:2",), dilation=0
    ),
    "paper": EncodeConfig(preset="published", tables="float16", epochs=1, width=4),
    "paper, a feature": EncodeConfig(
        preset="published",
        tables="float16",
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
