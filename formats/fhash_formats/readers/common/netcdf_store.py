"""Opening NetCDF files with xarray: NetCDF4 through h5netcdf, classic NetCDF3 through scipy.

Times are not decoded, and nothing is read before it is asked for.
"""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import Packing, packing
from fhash_formats.readers.common.failures import condense
from fhash_formats.readers.common.hdf5_tree import require_filters
from fhash_formats.support.number_types import is_wide_integer
from fhash_formats.support.plain_json import decoded_text

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

CLASSIC = (b"CDF\x01", b"CDF\x02")
CLASSIC_64 = b"CDF\x05"


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
    if head == CLASSIC_64:
        raise InputError(
            f"{source} is NetCDF of the kind CDF-5, which cannot be read here; convert it with:"
            " nccopy -k nc4 IN OUT"
        )
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
        return {"/": _open_classic(source, path, options)}
    # dimensions without a scale get a made-up name, so that HDF5 files named .nc open too
    return xr.open_groups(path, engine="h5netcdf", phony_dims="access", **options)


def _open_classic(source: str, path: Path, options: Mapping[str, Any]) -> xr.Dataset:
    import xarray as xr

    try:
        dataset = xr.open_dataset(path, engine="scipy", **options)
        return _read_again(path, dataset, options) if _is_misread(dataset) else dataset
    except Exception as error:
        message = condense(error)
    # the error is not chained: its traceback holds scipy's half-open file, which warns when it is
    # dropped, and here nobody hears that
    gc.collect()
    raise InputError(
        f"{source} cannot be read as classic NetCDF3: {message}; nccopy -k nc4 IN OUT may convert"
        " it"
    )


def _is_misread(dataset: xr.Dataset) -> bool:
    """Whether a classic file has names that are no ASCII, or texts that are no UTF-8."""
    places: list[Any] = [dataset, *dataset.variables.values()]
    texts = [text for each in places for text in (*each.attrs.values(), *each.encoding.values())]
    return any(not str(name).isascii() for name in (*dataset.variables, *dataset.sizes)) or any(
        isinstance(text, str) and "\ufffd" in text for text in texts
    )


def _read_again(path: Path, dataset: xr.Dataset, options: Mapping[str, Any]) -> xr.Dataset:
    """The dataset of a classic file with all names and texts as UTF-8, else as Latin-1.

    scipy takes names for Latin-1, and xarray drops the letters of texts that are no UTF-8.
    """
    import xarray as xr
    from scipy.io import netcdf_file

    dataset.close()
    stored = xr.open_dataset(path, engine="scipy", decode_cf=False, cache=False, chunks=None)
    with netcdf_file(path) as file:
        texts = {None: dict(file._attributes)} | {
            name: dict(variable._attributes) for name, variable in file.variables.items()
        }
    for name, attributes in texts.items():
        target = stored.attrs if name is None else stored.variables[name].attrs
        target.update(
            {key: decoded_text(v) for key, v in attributes.items() if isinstance(v, bytes)}
        )
    names = {name: decoded_text(str(name).encode("latin-1")) for name in texts if name is not None}
    names |= {name: decoded_text(str(name).encode("latin-1")) for name in stored.sizes}
    renamed = stored.rename({old: new for old, new in names.items() if old != new})
    renamed.set_close(stored.close)
    keys = ("decode_times", "decode_timedelta", "decode_coords", "mask_and_scale")
    decoded: xr.Dataset = xr.decode_cf(
        renamed,
        concat_characters=options.get("concat_characters", True),
        **{key: options[key] for key in keys},
    )
    return decoded


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
    import h5py

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
        with h5py.File(path, "r") as file:
            return packed.unpack(np.asarray(file[name][ranges]))

    return exact


def check_filters(source: str, path: Path, name: str) -> None:
    """Raise an error that says what is missing, if a variable cannot be decompressed here."""
    import h5py

    if not h5py.is_hdf5(path):
        return
    with h5py.File(path, "r") as file:
        dataset = file.get(name)
        if isinstance(dataset, h5py.Dataset):
            require_filters(source, name, dataset)
