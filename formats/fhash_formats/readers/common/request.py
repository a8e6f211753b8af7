"""A caller's wishes about an input beyond its path: variable, axes, layout of raw bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fhash_formats.errors import InputError
from fhash_formats.series import AXES

DTYPES = {
    f"{kind}{8 * size}": f"{letter}{size}"
    for kind, letter in (("uint", "u"), ("int", "i"))
    for size in (1, 2, 4, 8)
}
DTYPES |= {f"float{8 * size}": f"f{size}" for size in (2, 4, 8)}
"""Number types of raw files by long name; the short names are the values."""

ENDIANS: dict[str, Literal["<", ">"]] = {"little": "<", "big": ">"}


def parse_dtype(text: str) -> np.dtype[Any]:
    """The number type of a long or short name ("float32", "f4"), in native byte order.

    Raises InputError for any other name.
    """
    short = DTYPES.get(text.lower(), text.lower())
    if short not in DTYPES.values():
        raise InputError(
            f"'{text}' is not a number type; allowed: {', '.join(DTYPES)} or short, such as f4 and"
            " u1"
        )
    return np.dtype(short)


def parse_shape(text: str) -> dict[str, int]:
    """Lengths by axis from text such as "x=64,y=64,z=32,t=10", in the order given.

    Raises InputError for text of another form.
    """
    shape: dict[str, int] = {}
    for part in text.split(","):
        axis, equals, length = (word.strip() for word in part.partition("="))
        if (
            axis not in AXES
            or not equals
            or not length.isascii()
            or not length.isdigit()
            or axis in shape
        ):
            raise InputError(
                f"shape '{text}': cannot use '{part.strip()}'; write each axis once, such as"
                " x=64,y=64,z=32,t=10"
            )
        shape[axis] = int(length)
    return shape


def parse_axes(text: str) -> tuple[str, ...]:
    """The axis of each dimension of the file from text such as "t,z,y,x", in any case.

    Raises InputError for text of another form.
    """
    letters = tuple(word.strip().lower() for word in text.split(","))
    if not set(letters) <= set(AXES) or len(set(letters)) != len(letters):
        raise InputError(
            f"axes '{text}': name the file's dimensions in their order, each once, by t, z, y and"
            " x, such as t,z,y,x"
        )
    return letters


def selection(select: Mapping[str, int | str] | None) -> tuple[tuple[str, str], ...]:
    """Pairs of names and indices, as `Request` holds them."""
    return tuple((str(name), str(index)) for name, index in (select or {}).items())


def inside_folder(path: Path, file: Path) -> None:
    """Raise InputError if a file that another one refers to is outside the folder of that.

    Links of the file system are followed.
    """
    if not file.resolve().is_relative_to(path.parent.resolve()):
        raise InputError(
            f"{path} refers to {file}, which is outside its folder; without --no-external"
            " (no_external=True) it is read"
        )


@dataclass(frozen=True)
class RawLayout:
    """Layout of a headerless file; the file's name replaces what is None.

    Attributes:
        shape: lengths by axis, for at least three of t, z, y, x; axes left out have length 1. x is
            the fastest in the file, then y, z, t.
        dtype: a key or value of DTYPES.
        endian: "little" (also where neither this nor the name says) or "big".

    Raises InputError for a value that is not allowed.
    """

    shape: Mapping[str, int] | None = None
    dtype: str | None = None
    endian: str | None = None

    def __post_init__(self) -> None:
        if self.shape is not None:
            if not set(self.shape) <= set(AXES) or len(self.shape) < 3:
                raise InputError(
                    f"raw shape names {', '.join(self.shape) or 'no axis'}; name three or four of"
                    " t, z, y, x, as in x=64,y=64,z=32"
                )
            for axis, length in self.shape.items():
                if length < 1:
                    raise InputError(f"raw shape: {axis}={length}; a length is at least 1")
        if self.dtype is not None:
            parse_dtype(self.dtype)
        if self.endian is not None and self.endian not in ENDIANS:
            raise InputError(f"byte order '{self.endian}'; allowed: {', '.join(ENDIANS)}")


@dataclass(frozen=True, kw_only=True)
class Request:
    """A request to a reader: name of the variable, axes of its dimensions, layout of raw bytes.

    None stands for what was not said.

    Attributes:
        booleans: lets boolean arrays through (for masks), as the numbers 0 and 1.
        missing: numbers that stand for missing values, besides those that the file declares. They
            are compared with the values after unpacking; `open_series` sees to it for all formats.
        raw_values: the numbers are read as stored; fill values, scale and offset are not applied.
        select: for dimensions that are no axis, (name, index) as texts; see layout.py.
        keep_extremes: extreme values that repeat are data, see `Series`.
        digested: the digest of the file is taken where its metadata are asked for.
        no_external: no file outside the folder of the one that is read may be read for it.
        asked: a last dimension that may hold components is asked about; else it is x.
    """

    var: str | None = None
    axes: tuple[str, ...] | None = None
    raw: RawLayout | None = None
    booleans: bool = False
    missing: tuple[float, ...] = ()
    raw_values: bool = False
    select: tuple[tuple[str, str], ...] = ()
    keep_extremes: bool = False
    asked: bool = True
    digested: bool = True
    no_external: bool = False

    def require_inside(self, path: Path, *files: Path) -> None:
        """Raise InputError if a file refers to others that may not be read; see `no_external`."""
        if self.no_external:
            for file in files:
                inside_folder(path, file)

    def refuse_var(self, source: str) -> None:
        """Raise InputError if a variable was named for a format that has none."""
        if self.var is not None:
            raise InputError(
                f"{source}: --var {self.var} cannot be used, this format holds one array without a"
                " name"
            )
