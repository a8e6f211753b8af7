"""Fields of compound types and parts of complex numbers as variables: "state.rho", "psi.real"."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.readers.common.variables import Variable

Read = Callable[[tuple[slice, ...]], npt.NDArray[Any]]

PARTS = ("real", "imag")
"""Fields of a complex number, by numpy's names."""


def leaves(
    dtype: np.dtype[Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], np.dtype[Any], tuple[int, ...]]]:
    """Path, type and shape of each number in a type, nested fields included.

    A field that is an array has a shape; others have ().
    """
    if dtype.subdtype is not None:
        inner, shape = dtype.subdtype
        for deeper, leaf, rest in leaves(inner, path):
            yield deeper, leaf, (*shape, *rest)
    elif dtype.names is not None and dtype.fields is not None:
        for name in dtype.names:
            yield from leaves(dtype.fields[name][0], (*path, name))
    elif dtype.kind == "c":
        part = np.empty(0, dtype).real.dtype
        yield from (((*path, name), part, ()) for name in PARTS)
    else:
        yield path, dtype, ()


def expand(variables: Sequence[Variable]) -> list[Variable]:
    """The variables, with one for each field in place of those of a compound type.

    The parts of a complex array are there by name only, beside the array itself.
    """
    expanded = []
    for variable in variables:
        if variable.dtype.names is None and variable.dtype.kind != "c":
            expanded.append(variable)
            continue
        if variable.dtype.kind == "c":
            expanded.append(variable)
        expanded += [
            replace(
                variable,
                name=".".join((variable.name, *path)),
                shape=(*variable.shape, *shape),
                dtype=dtype,
                field=path,
                auxiliary=variable.auxiliary or variable.dtype.kind == "c",
            )
            for path, dtype, shape in leaves(variable.dtype)
        ]
    return expanded


def reading(read: Read, variable: Variable, stored: int) -> Read:
    """`read` of an array of `stored` dimensions as that of a variable's field of it."""
    if not variable.field:
        return read

    def field(ranges: tuple[slice, ...]) -> npt.NDArray[Any]:
        values: Any = read(ranges[:stored])
        for name in variable.field:
            values = getattr(values, name) if values.dtype.kind == "c" else values[name]
        # a copy, so that the other fields are not held in memory
        return np.array(values[(..., *ranges[stored:])])

    return field
