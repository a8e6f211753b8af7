"""Variables of a file side by side in one undecoded dataset of xarray.

Each variable brings its dimensions and the arrays beside it. Those that are the same as of a
variable before are shared. Other ones of the same name, such as the positions of a staggered grid,
get a number: `x_2`. Attributes that name them follow.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from hashlib import sha256
from typing import Any

import numpy as np
import xarray as xr

from fhash_formats.source_metadata import renamed

__all__ = ["SideBySide", "shown_names"]

Key = tuple[Any, ...]


def shown_names(names: Mapping[str, str]) -> dict[str, str]:
    """The name under which each variable of a file is shown, by its name in the file.

    names: of the variables in their sources, by their names in the file. Where several have the
        same name in their sources, all variables are shown by their names in the file.
    """
    if len(set(names.values())) == len(names):
        return dict(names)
    return {name: name for name in names}


class SideBySide:
    """A dataset that takes one variable after the other.

    Attributes:
        variables: those of the dataset so far, by name.
    """

    def __init__(self, data: Mapping[str, Collection[str]]) -> None:
        """Keep names free. data: dimensions of the variables that will be added, by name."""
        self.variables: dict[str, xr.Variable] = {}
        self._data = data
        # A variable alone may have the name of its own dimension.
        self._taken = set(data) if len(data) > 1 else set()
        self._counts: dict[str, int] = {}
        self._known: dict[Key, str] = {}
        # Length of each dimension, and what its coordinate holds; None without a coordinate.
        self._dimensions: dict[str, tuple[int, Key | None]] = {}

    def add(
        self, name: str, values: xr.Variable, beside: Mapping[str, xr.Variable]
    ) -> dict[str, str]:
        """Add a variable and the arrays beside it; return the names of these in the dataset."""
        sizes: dict[str, int] = {}
        for variable in (values, *beside.values()):
            sizes |= {str(dim): size for dim, size in variable.sizes.items()}
        names = {dim: self._dimension(dim, size, beside.get(dim)) for dim, size in sizes.items()}
        for other, variable in beside.items():
            if other in names:
                continue
            dimensions = tuple(names[str(dim)] for dim in variable.dims)
            if other in self._data and set(variable.dims) == set(self._data[other]):
                names[other] = other  # the values of another variable of the file
                continue
            key = (other, dimensions, _content(variable))
            names[other] = self._named(other, key, lambda free: free not in self._taken)
        changed = {old: new for old, new in names.items() if old != new}
        for other, variable in beside.items():
            if names[other] not in self._data:
                self.variables.setdefault(names[other], _renamed(variable, names, changed))
        self.variables[name] = _renamed(values, names, changed)
        return {other: names[other] for other in beside}

    def _dimension(self, name: str, size: int, coordinate: xr.Variable | None) -> str:
        """The name in the dataset of a dimension, which is shared where nothing contradicts."""
        content = None if coordinate is None else _content(coordinate)

        def fits(free: str) -> bool:
            if free not in self._dimensions:
                return free not in self._taken
            length, other = self._dimensions[free]
            return length == size and (content is None or other in (None, content))

        found = self._named(name, (name, size, content), fits)
        before = self._dimensions.get(found, (size, None))[1]
        self._dimensions[found] = size, content if before is None else before
        return found

    def _named(self, wish: str, key: Key, fits: Callable[[str], bool]) -> str:
        """The name of what a key says, or a new one: the wish, or with a number."""
        if key not in self._known:
            name = wish
            while not fits(name):
                self._counts[wish] = self._counts.get(wish, 1) + 1
                name = f"{wish}_{self._counts[wish]}"
            self._known[key] = name
            self._taken.add(name)
        return self._known[key]


def _content(variable: xr.Variable) -> Key:
    """The form, values and attributes of an array, for comparison with others."""
    values = np.asarray(variable.values)
    data = repr(values.tolist()).encode() if values.dtype.kind == "O" else values.tobytes()
    attributes = repr(sorted(variable.attrs.items(), key=lambda item: str(item[0])))
    form = (variable.dims, values.shape, values.dtype.str)
    return (*form, sha256(data).digest(), attributes)


def _renamed(
    variable: xr.Variable, names: Mapping[str, str], changed: Mapping[str, str]
) -> xr.Variable:
    """A variable with other names of its dimensions and in its attributes."""
    if not changed:
        return variable
    dimensions: Sequence[str] = [names[str(dim)] for dim in variable.dims]
    attributes = renamed(variable.attrs, changed)
    return xr.Variable(dimensions, variable._data, attributes, encoding=variable.encoding)
