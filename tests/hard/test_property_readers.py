"""Any numbers, axis order, byte order, chunking and packing come out of every reader unchanged."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import INTEGERS, NUMBERS, Draw, arrays, chunks, looking, same

from fhash_formats import RawLayout, Region, open_series, save_region
from fhash_formats.errors import InputError
from fhash_formats.series import AXES, Coordinate

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
