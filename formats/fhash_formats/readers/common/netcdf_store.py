"""Opening NetCDF files with xarray: NetCDF4 through h5netcdf, classic NetCDF3 through netcdf3.py.

Times are not decoded, and nothing is read before it is asked for.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.cf_packing import Packing, packing
from fhash_formats.readers.common.failures import refusing
from fhash_formats.readers.common.hdf5_tree import require_filters
from fhash_formats.support.number_types import is_wide_integer

if TYPE_CHECKING:
    import xarray as xr

Values = npt.NDArray[Any]
Exact = Callable[[Values, tuple[slice, ...]], Values]

DEFAULT_FILLS = {
    "i2": -32767,
    "u2": 65535,
    "i4": -2147483647,
    "u4": 4294967295,
    "i8": -9223372036854775806,
    "u8": 18446744073709551614,
    "f4": 9.969209968386869e36,
    "f8": 9.969209968386869e36,
}
"""NC_FILL_SHORT and so on of netcdf.h; bytes have none that counts."""

CLASSIC = (b"CDF\x01", b"CDF\x02", b"CDF\x05")
"""First bytes of classic files."""


def magic_of(path: Path) -> bytes:
    """The first four bytes of a file."""
    with path.open("rb") as file:
        return file.read(4)


@contextmanager
def quietly() -> Iterator[None]:
    """Silence xarray's warnings about a file (several fill values, bounds that are missing).

    None of them changes the values that are read.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def open_groups(
    source: str, path: Path, head: bytes, *, raw: bool = False, decoded: bool = True
) -> Mapping[str, xr.Dataset]:
    """Datasets of all groups by path, "/" first.

    raw: leave values packed. decoded: whether attributes that name variables are taken out, and
    these made coordinates; if not, everything is as it is stored.
    """
    import xarray as xr

    options: dict[str, Any] = {
        "decode_times": False,
        "decode_timedelta": False,
        "decode_coords": "all",
        "cache": False,
        "chunks": None,
        "mask_and_scale": not raw,
    }
    if not decoded:
        options |= {"decode_coords": False, "concat_characters": False, "mask_and_scale": False}
    if head in CLASSIC:
        from fhash_formats.readers.common.netcdf3 import ClassicStore

        with refusing(f"{source} cannot be read as classic NetCDF"):
            return {"/": xr.open_dataset(ClassicStore(path), engine="store", **options)}
    # dimensions without a scale get a made-up name, so that HDF5 files named .nc open too
    return xr.open_groups(path, engine="h5netcdf", phony_dims="access", **options)


def close_groups(groups: Mapping[str, xr.Dataset]) -> None:
    """Close the datasets of all groups."""
    with quietly():
        for dataset in groups.values():
            dataset.close()


def declared(source: str, array: xr.Variable) -> Packing | None:
    """The packing of a variable that xarray unpacks; None for types that cannot be packed."""
    stored = np.dtype(array.encoding.get("dtype", array.dtype))
    return packing(source, stored, array.encoding) if stored.kind in "iuf" else None


def default_fill(array: xr.Variable, packed: Packing | None) -> float | int | None:
    """The number that NetCDF puts where nobody wrote, as it is read.

    None for bytes, and where the variable declares a fill value of its own.
    """
    if packed is None or {"_FillValue", "missing_value"} & {*array.encoding, *array.attrs}:
        return None
    stored = DEFAULT_FILLS.get(packed.stored.str[1:])
    if stored is None:
        return None
    value: float | int = packed.unpack(np.array([stored], packed.stored))[0].item()
    return value


def exactly_filled(source: str, path: Path, name: str, encoding: Mapping[str, Any]) -> Exact | None:
    """A test that tells a fill value from its neighbours; None where float64 suffices.

    xarray compares as float64, in which many 64-bit integers beyond 2^53 are equal.
    """
    stored = np.dtype(encoding.get("dtype", np.float32))
    if not is_wide_integer(stored):
        return None
    plain = {
        key: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in encoding.items()
    }
    packed = packing(source, stored, plain)
    if all(abs(int(fill)) < 1 << 53 for fill in packed.fills):
        return None

    def exact(values: Values, ranges: tuple[slice, ...]) -> Values:
        if not np.isnan(values).any():
            return values
        return packed.unpack(_stored(path, name, ranges))

    return exact


def _stored(path: Path, name: str, ranges: tuple[slice, ...]) -> Values:
    if magic_of(path) in CLASSIC:
        from fhash_formats.readers.common.netcdf3 import read_header

        return read_header(path).variables[name].read(ranges)
    import h5py

    with h5py.File(path, "r") as file:
        return np.asarray(file[name][ranges])


def check_filters(source: str, path: Path, name: str) -> None:
    """Raise an error that says what is missing, if a variable cannot be decompressed here."""
    import h5py

    if not h5py.is_hdf5(path):
        return
    with h5py.File(path, "r") as file:
        dataset = file.get(name)
        if isinstance(dataset, h5py.Dataset):
            require_filters(source, name, dataset)
