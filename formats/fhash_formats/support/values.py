"""Types of arrays, and values of headers and attributes: plain JSON, typed attributes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import DamagedFileError, InputError

Values = npt.NDArray[Any]
"""Numbers of any type."""
Double = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


def is_number(text: str) -> bool:
    """Whether a text is a number as `float` reads it, infinities and NaN included."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def as_array(array: Any, what: str = "array") -> npt.NDArray[Any]:
    """The values of anything like an array, with NaN for masked ones: what a mask hides is no data.

    Arrays of dask are computed; lists may hold arrays. what: name of the array, for messages.

    Raises InputError for masked values of a type that has no NaN, and for what numpy cannot read.
    """
    if getattr(array, "dims", None) is not None and hasattr(array, "data"):
        array = array.data  # of xarray, which gives values without their mask
    if is_lazy(array):
        array = array.compute()
    if isinstance(array, list | tuple) and any(map(_is_array, array)):
        return _stacked([as_array(each, what) for each in array], what)
    try:
        if hasattr(array, "__dlpack__") and not hasattr(array, "__array__"):
            array = np.from_dlpack(array)
        mask = [each is np.ma.masked for each in array] if isinstance(array, list | tuple) else []
        if any(mask):
            shown = [0 if gone else each for gone, each in zip(mask, array, strict=True)]
            array = np.ma.array(shown, mask=mask)
        values = np.asanyarray(array)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        told = " ".join(str(error).split())[:200]
        raise InputError(f"{what}: it cannot become an array of numpy: {told}") from error
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        if values.dtype.kind != "f":
            raise InputError(
                f"{what}: masked values of type {values.dtype}, which has no NaN; "
                "convert it to float32 or float64 first"
            )
        values = values.filled(np.nan)
    return np.asarray(values)


def is_lazy(array: Any) -> bool:
    """Whether an array is one of dask, whose values are computed when they are asked for."""
    graph = getattr(array, "__dask_graph__", None)
    return graph is not None and graph() is not None


def _is_array(element: Any) -> bool:
    """Whether an element of a list is a list or an array itself."""
    return isinstance(element, list | tuple) or (
        getattr(element, "shape", ()) != () and not isinstance(element, str)
    )


def _stacked(arrays: Sequence[npt.NDArray[Any]], what: str) -> npt.NDArray[Any]:
    """The arrays of a list as one; raises InputError where they do not fit."""
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        told = " and ".join(map(str, sorted(shapes)[:2]))
        raise InputError(f"{what}: a list of arrays of shapes {told}; they must be the same")
    return np.stack(arrays)


DTYPE_NAMES = """int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64"""
DTYPES = {name: np.dtype(name) for name in DTYPE_NAMES.split()}
"""Number types of arrays by the name that Zarr gives them, in native byte order."""


def is_wide_integer(dtype: np.dtype[Any]) -> bool:
    """Whether a type is an integer of 64 bits: beyond 2^53, float64 has not each of them."""
    return dtype.kind in "iu" and dtype.itemsize == 8


def is_within(number: int, dtype: np.dtype[Any]) -> bool:
    """Whether an integer is one of an integer type."""
    limits = np.iinfo(dtype)
    return int(limits.min) <= number <= int(limits.max)


def exact_number(value: int | float) -> int | float:
    """The number as a float, or as an integer where it is one beyond 2^53."""
    return value if isinstance(value, int) and abs(value) > 1 << 53 else float(value)


def integer_origin(low: int | float, high: int | float, dtype: np.dtype[Any]) -> int:
    """The integer that is subtracted before values of a range become floats; 0 for most ranges.

    It is the middle of a range of 64-bit integers that has some beyond 2^53, so that float64 has
    all differences from it, unless the range itself is wider than 2^54. Each of them is an int64.
    """
    if not is_wide_integer(dtype) or max(abs(low), abs(high)) <= 1 << 53:
        return 0
    return (int(low) + int(high) + 1) // 2


MAX_DEPTH = 24
"""Objects and lists within each other; what lies deeper cannot be held."""
_NUMBERS = "biufSUTO"
"""Kinds of numpy types whose values have a form in JSON."""


class UnknownValueError(Exception):
    """A value that has no form in JSON."""


def plain_json(value: Any) -> Any:
    """A figure, or a list or object of figures, as JSON values.

    Numpy's numbers and arrays become numbers and lists. NaN, infinities, numbers beyond float64 and
    values of other kinds become null.
    """
    return _converted(value, 0, is_figure=True)


def attribute_json(value: Any) -> Any:
    """An attribute as JSON values.

    NaN, infinities and numbers beyond float64 become text. Raises UnknownValueError for values of
    other kinds.
    """
    return _converted(value, 0, is_figure=False)


def decoded_text(data: bytes) -> str:
    """Bytes as text: UTF-8, else Latin-1, in which older programs wrote units such as "\u00b0C"."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def plain_text(text: str) -> str:
    """The text without lone surrogates, which no file can hold.

    Python makes those of bytes that are no UTF-8: they are read as Latin-1. "?" stands for others.
    """
    if not any("\udc80" <= letter <= "\udcff" for letter in text):
        return text.encode("utf-8", errors="replace").decode("utf-8")
    letters = (chr(ord(c) - 0xDC00) if "\udc80" <= c <= "\udcff" else c for c in text)
    return plain_text("".join(letters))


def _converted(value: Any, depth: int, *, is_figure: bool) -> Any:
    """A value as JSON values, by the rule of figures or of attributes."""
    if isinstance(value, str):
        return plain_text(value)
    if value is None or isinstance(value, bool | np.bool_):
        return None if value is None else bool(value)
    if isinstance(value, int | float | np.number) and not isinstance(value, np.complexfloating):
        return _json_number(value, is_figure=is_figure)
    if isinstance(value, bytes):
        return decoded_text(value)
    if depth < MAX_DEPTH:
        if isinstance(value, np.ndarray | np.generic):
            if value.dtype.kind in "Mm":
                return np.asarray(value).astype(str).tolist()
            if value.dtype.kind in _NUMBERS:
                return _converted(value.tolist(), depth, is_figure=is_figure)
        if isinstance(value, Mapping):
            return {
                plain_text(str(name)): _converted(member, depth + 1, is_figure=is_figure)
                for name, member in value.items()
            }
        if isinstance(value, list | tuple):
            return [_converted(member, depth + 1, is_figure=is_figure) for member in value]
    if is_figure:
        return None
    raise UnknownValueError


def _json_number(value: Any, *, is_figure: bool) -> Any:
    """A number of Python or numpy as an int or float; null or text where float64 cannot hold it."""
    try:
        wide = float(value)
    except OverflowError:
        wide = math.inf
    if math.isfinite(wide):
        return int(value) if isinstance(value, int | np.integer) else wide
    if is_figure:
        return None
    if isinstance(value, int):
        try:
            return str(value)
        except ValueError as error:  # Python refuses to write out thousands of digits
            raise UnknownValueError from error
    if value != value:
        return "NaN"
    if value in (math.inf, -math.inf):
        return "Infinity" if value > 0 else "-Infinity"
    return str(value)  # a long double beyond float64


STORAGE_NAMES = """CLASS NAME DIMENSION_LIST REFERENCE_LIST DIMENSION_LABELS _ARRAY_DIMENSIONS
_Netcdf4Dimid _Netcdf4Coordinates _NCProperties _nc3_strict"""
PLUMBING = frozenset(STORAGE_NAMES.split())
"""Attributes by which HDF5, NetCDF and zarr tie datasets together; they describe no values."""

PACKING_NAMES = """_FillValue missing_value scale_factor add_offset _Unsigned _Encoding dtype
valid_min valid_max valid_range"""
PACKING = frozenset(PACKING_NAMES.split())
"""Attributes that describe stored numbers and are wrong for unpacked ones.

A reader would undo a packing a second time. A valid range in packed units would hide good values
from readers that obey it.
"""

REFERENCE_NAMES = """coordinates grid_mapping bounds climatology cell_measures
ancillary_variables formula_terms compress geometry node_coordinates node_count
part_node_count interior_ring"""
REFERENCES = frozenset(REFERENCE_NAMES.split())
"""Attributes that name other variables of the same file."""


STORED = PLUMBING | PACKING | REFERENCES
"""Attributes that tell of a stored array and of its file, and not of its values."""


def json_attributes(
    attributes: Mapping[str, Any], *, without: frozenset[str] = PLUMBING
) -> dict[str, Any]:
    """The attributes as JSON values: numbers, text, lists, objects.

    Bytes are read as UTF-8, else as Latin-1. Not-a-number, infinities and numbers beyond float64
    become text, as in zarr. References, compound values and others that JSON cannot hold are
    dropped, and so are the names in `without`.
    """
    result: dict[str, Any] = {}
    for name in attributes:
        if name not in without:
            try:
                result[plain_text(str(name))] = attribute_json(attributes[name])
            except (UnknownValueError, TypeError, OSError):
                # h5py raises TypeError or OSError for types of attributes that it does not know.
                continue
    return result


def text_of(value: Any) -> str:
    """An attribute as text; see `decoded_text` for bytes."""
    return decoded_text(value) if isinstance(value, bytes) else str(value)


TEXT = "text"
"""Name of the type of arrays of texts of any length."""
JSON = "json"
"""Name of the type of attributes that are any JSON values, as Zarr has them."""
MAX_BYTES_LENGTH = 1 << 16
"""Bytes of one text of a fixed length."""
MAX_BYTES = 1 << 28
"""Bytes of the values of one list: texts of a fixed length may take far more than in a file."""
_BYTES = re.compile(r"bytes([1-9][0-9]{0,4})")
_NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}


def stored_type(values: npt.NDArray[Any]) -> str | None:
    """Name of the type of an array; None for a type that no container holds."""
    dtype = values.dtype
    if dtype.kind == "S":
        size = max(1, dtype.itemsize)
        return f"bytes{size}" if size <= MAX_BYTES_LENGTH else None
    if dtype.kind in "UT" or (
        dtype.kind == "O" and all(isinstance(text, str) for text in values.reshape(-1))
    ):
        return TEXT
    name = dtype.newbyteorder("=").name
    return name if name in DTYPES else None


def type_of_name(name: object) -> np.dtype[Any]:
    """The type of a name; texts are objects. Raises DamagedFileError for another name."""
    if isinstance(name, str):
        if name in DTYPES:
            return DTYPES[name]
        sized = _BYTES.fullmatch(name)
        if sized is not None and int(sized[1]) <= MAX_BYTES_LENGTH:
            return np.dtype(f"S{sized[1]}")
        if name == TEXT:
            return np.dtype(object)
    raise DamagedFileError(f"type {ascii(name)[:40]} is not known")


def inline_values(values: npt.NDArray[Any], name: str) -> list[Any] | None:
    """The values in C order as JSON values; None where these would not give every bit back.

    name: `stored_type` of the values.
    """
    flat = values.reshape(-1)
    if name == TEXT:
        texts = [str(text) for text in flat]
        return texts if all(_has_form(text) for text in texts) else None
    if values.dtype.kind == "S":
        return [bytes(text).decode("latin-1") for text in flat]
    listed = [_number(value) for value in flat]
    plain = values.astype(values.dtype.newbyteorder("="))
    return listed if inline_array(listed, name, plain.shape).tobytes() == plain.tobytes() else None


def inline_array(
    listed: object, name: str, shape: tuple[int, ...], most: int = MAX_BYTES
) -> npt.NDArray[Any]:
    """The array of a list of JSON values, of at most `most` bytes.

    Raises DamagedFileError where they are not its values.
    """
    dtype = type_of_name(name)
    if not isinstance(listed, list) or len(listed) != math.prod(shape):
        raise DamagedFileError(f"a list of {math.prod(shape)} values is needed")
    if len(listed) * dtype.itemsize > most:
        raise DamagedFileError(f"{len(listed)} values of type {name} take too many bytes")
    plain = _numbers(listed, dtype)
    if plain is not None:
        return plain.reshape(shape)
    result: npt.NDArray[Any] = np.empty(len(listed), dtype=dtype)
    for number, value in enumerate(listed):
        result[number] = _stored(value, dtype)
    return result.reshape(shape)


def typed_attribute(value: Any) -> Any:
    """An attribute as JSON values that keep its type.

    Raises UnknownValueError for a value that no container holds.
    """
    if isinstance(value, str):
        if any("\ud800" <= letter < "\udc80" for letter in value):
            raise UnknownValueError
        return plain_text(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, bytes):
        return typed_attribute(decoded_text(value))
    if isinstance(value, list) and value and all(isinstance(each, str) for each in value):
        return [typed_attribute(each) for each in value]
    if isinstance(value, Mapping | list | tuple) or value is None:
        return {JSON: attribute_json(value)}
    array = np.asarray(value)
    name = stored_type(array)
    if name is None or array.ndim > 1:
        raise UnknownValueError
    listed = inline_values(array, name)
    if listed is None:
        raise UnknownValueError
    plain: Any = listed if array.ndim else listed[0]
    natural = TEXT if name == TEXT else name if name in ("int64", "float64") else None
    finite = listed and not (name == "float64" and any(isinstance(each, str) for each in listed))
    return plain if natural is not None and finite else {name: plain}


def attribute_value(value: Any, most: int = MAX_BYTES) -> Any:
    """The attribute that JSON values stand for, of at most `most` bytes.

    Raises DamagedFileError for others.
    """
    if isinstance(value, str | bool):
        return value
    if isinstance(value, int | float):
        return _scalar(value, "int64" if isinstance(value, int) else "float64")
    if isinstance(value, list) and value:
        if all(isinstance(each, str) for each in value):
            return list(value)
        whole = all(type(each) is int for each in value)
        return inline_array(value, "int64" if whole else "float64", (len(value),), most)
    if isinstance(value, Mapping) and len(value) == 1:
        ((name, inner),) = value.items()
        if name == JSON:
            return inner
        if isinstance(inner, list):
            array = inline_array(inner, name, (len(inner),), most)
            return array.tolist() if name == TEXT else array
        return _scalar(inner, name)
    raise DamagedFileError(f"attribute {ascii(value)[:80]} has no known type")


def _scalar(value: Any, name: str) -> Any:
    """One value of a type."""
    return inline_array([value], name, (1,))[0]


def _numbers(listed: list[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any] | None:
    """The numbers of a list at once; None where one of them needs a closer look."""
    types = set(map(type, listed))
    if dtype.kind in "iu" and types == {int}:
        inside = is_within(min(listed), dtype) and is_within(max(listed), dtype)
        return np.array(listed, dtype=dtype) if inside else None
    if dtype.kind != "f" or not types <= {int, float}:
        return None
    try:
        with np.errstate(over="ignore"):
            numbers = np.array(listed, dtype=np.float64).astype(dtype)
    except OverflowError:
        return None
    return numbers if np.isfinite(numbers).all() else None


def _number(value: Any) -> Any:
    """A number as JSON has it: the shortest text that gives its bits back."""
    if value.dtype.kind in "iu":
        return int(value)
    if np.isnan(value):
        return "NaN"
    if np.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return float(str(value))


def _stored(value: Any, dtype: np.dtype[Any]) -> Any:
    """One JSON value as an element of an array of a type; raises DamagedFileError."""
    if dtype.kind == "O" and isinstance(value, str):
        return value
    if dtype.kind == "S" and isinstance(value, str) and len(value) <= dtype.itemsize:
        try:
            return value.encode("latin-1")
        except UnicodeEncodeError:
            pass
    if dtype.kind in "iu" and type(value) is int and is_within(value, dtype):
        return value
    if dtype.kind == "f":
        if isinstance(value, str) and value in _NOT_FINITE:
            return _NOT_FINITE[value]
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                with np.errstate(over="ignore"):
                    narrow = dtype.type(value)
            except OverflowError:
                narrow = dtype.type(math.inf)
            if np.isfinite(narrow):
                return narrow
    raise DamagedFileError(f"{ascii(value)[:40]} is no value of type {dtype}")


def _has_form(text: str) -> bool:
    """Whether a text is Unicode that a file can hold, without lone surrogates."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)
