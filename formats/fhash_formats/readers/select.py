"""One variable of an open source as a series: its axes, steps, packing, positions, surroundings.

Every format comes here as labelled variables (`Source`). What names, coordinates and attributes
mean is decided once, by the CF conventions (1.11) where a source follows them.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers.cf import (
    SCALING,
    Column,
    Packing,
    beside,
    coordinate,
    counts_steps,
    missing_values,
    only_counts,
    packing,
    real_time,
    role_of_coordinate,
    role_of_name,
    unapplied,
    usable,
    valid_limits,
    written_times,
)
from fhash_formats.readers.file_series import (
    FileSeries,
    FolderStamp,
    Request,
    Stored,
    refusing,
    require_length,
)
from fhash_formats.readers.layout import (
    Dimension,
    Layout,
    Read,
    arrange,
    shared_roles,
    with_roles,
)
from fhash_formats.readers.listing import Listed, listing
from fhash_formats.readers.stored_parts import not_stored, warn_of_column
from fhash_formats.readers.surroundings import (
    MAX_ARRAYS,
    Wanted,
    is_small,
    metadata_of,
    named_dimensions,
    size_of,
    warn_left_out,
)
from fhash_formats.readers.variables import (
    FIELD_DIMENSIONS,
    Source,
    Variable,
    choose,
    component_by_number,
    expand,
    join,
    plain_name,
    series_like,
    stacked,
    times,
)
from fhash_formats.series import (
    AXES,
    AXIS_NAMES,
    COORDINATES,
    UNNAMED,
    Coordinate,
    SourceMetadata,
    references,
    shown_name,
)
from fhash_formats.support.values import STORED, json_attributes

SELF_NAMING = (".vti", ".vtr", ".pvti", ".pvtr", ".vtk", ".vtkhdf", ".h5", ".hdf5", ".hdf", ".he5")
"""Suffixes of formats that name their variables."""


def is_named(opened: Source, variable: Variable) -> bool:
    """Whether a source names a variable; else its name was made of that of the file."""
    path, one = opened.path, len(opened.variables) == 1
    if path is None:
        return variable.name != UNNAMED
    if path.suffix.lower() in SELF_NAMING or (opened.naming and not (path.is_dir() and one)):
        return True
    return not (variable.name and path.stem.startswith(variable.name))


class Selection:
    """The variables of an open source, what their dimensions are, and how they are read."""

    def __init__(self, opened: Source, request: Request) -> None:
        request = replace(request, var=request.var or opened.only or None)
        self.opened, self.request, self.source = opened, request, opened.name
        self._groups: dict[str, dict[str, Variable]] = {}
        for each in opened.variables:
            self._groups.setdefault(each.group, {})[each.label] = each
        self._by_name = {each.name: each for each in opened.variables}
        self._lists: dict[tuple[str, str, str | None], list[Variable]] = {}
        self._columns: dict[str, Column] = {}
        self._auxiliary = self._describing()
        self._auxiliary |= {each.name for each in opened.variables if each.auxiliary}
        marked = [
            replace(each, auxiliary=each.name in self._auxiliary) for each in opened.variables
        ]
        found = join(expand(marked), self.attributes)
        fields = max(
            (size_of(each.shape, each.dtype) for each in series_like(found) if len(each.shape) > 2),
            default=0,
        )
        self.variables = [
            replace(each, note=self._no_map(each, fields)) if len(each.shape) == 2 else each
            for each in found
        ]

    def _describing(self) -> set[str]:
        """Full names of the variables that only describe others.

        They are what a dimension is called, and what attributes of CF name, if all that one
        attribute names is there.
        """
        found = set()
        for group, arrays in self._groups.items():
            large = [each for each in arrays.values() if each.shape and not each.error]
            names = {
                name
                for each in large
                for name in each.dimensions
                if name in arrays and len(arrays[name].shape) < FIELD_DIMENSIONS
            }
            of_group = {COORDINATES: self.opened.groups.get(group, {}).get(COORDINATES)}
            for told in (of_group, *(each.attributes for each in large)):
                for key, pairs in groupby(references(told), itemgetter(0)):
                    named = {name for _, name in pairs}
                    whole = named <= arrays.keys() and key != "ancillary_variables"
                    if key == COORDINATES or whole:
                        names |= named
            found |= {arrays[name].name for name in names if name in arrays}
        return found

    def _no_map(self, variable: Variable, fields: int) -> str:
        """Why an array of two dimensions is no map that anybody meant, "" if it is one.

        fields: bytes of the largest array of three and more, beside which maps are small, and
            other arrays are tables; 0 without any.
        """
        roles = [
            None if each is None else self._role(each, variable) for each in variable.dimensions
        ]
        if set(roles) == {"y", "x"}:
            small = self.opened.naming and is_small(size_of(variable.shape, variable.dtype), fields)
            told = f"a map that is kept beside the others; --var {variable.name} encodes it"
            return told if fields and small else ""
        if fields or not {*roles} <= {"y", "x", None}:
            return (
                f"2 dimensions {variable.shape} that are no y and x; --var {variable.name} reads it"
            )
        return ""

    def attributes(self, path: str) -> Mapping[str, Any]:
        """Attributes of a group or a variable by its path."""
        known = self.opened.groups.get(path)
        if known is None:
            known = self._by_name[path].attributes if path in self._by_name else {}
        return known

    def choose(self) -> Variable:
        """The variable that is wanted; see `variables.choose`."""
        request = self.request
        var = self.opened.aliases.get(request.var, request.var) if request.var else None
        return choose(
            self.source,
            self.variables,
            component_by_number(var, self.variables),
            booleans=request.booleans,
            selected=len(request.select),
        )

    def packing(self, variable: Variable) -> Packing | None:
        """The packing of the values, None where the user wants them as stored."""
        return None if self.request.raw_values else self.declared(variable)

    def declared(self, variable: Variable) -> Packing | None:
        """The packing that the attributes say; None for types that cannot be packed."""
        if variable.field or variable.dtype.kind not in "iuf":
            return None
        told = variable.attributes if variable.values is None else variable.handle
        return packing(self.source, variable.dtype, told, gaps=variable.hidden is not None)

    def _unpacking(self, variable: Variable) -> Read:
        """The function that reads values in physical units, NaN for hidden ones."""
        packed, hidden = self.packing(variable), variable.hidden
        if packed is None or variable.values is not None:
            return variable.read

        def read(places: tuple[slice | int, ...]) -> npt.NDArray[Any]:
            values = packed.unpack(np.array(variable.read(places), copy=hidden is not None or None))
            if hidden is not None:
                values[np.broadcast_to(hidden(places), values.shape)] = np.nan
            return values

        return read

    def reading(self, variable: Variable) -> Read:
        """The function that reads the values of a variable, of all its steps."""
        if not variable.members:
            return self._unpacking(variable)
        types = {
            member.name: (made.dtype if made is not None else member.dtype.newbyteorder("="))
            for member, made in ((member, self.packing(member)) for member in variable.members)
        }
        first = variable.members[0].name
        for name, dtype in types.items():
            if dtype != types[first]:
                raise InputError(
                    f"{self.source}: {name} has values of type {dtype}, {first} of type"
                    f" {types[first]}; the steps of one series must be alike, --raw-values reads"
                    " the numbers as stored"
                )
        return stacked([self._unpacking(member) for member in variable.members])

    def arrange(self, variable: Variable) -> Layout:
        """The reading of a variable; see `layout.arrange`."""
        return arrange(self.source, variable.name, self.dimensions(variable), self.request)

    def dimensions(self, variable: Variable) -> list[Dimension]:
        """The dimensions of a variable, with what the source says about each.

        Raises InputError for those of a mesh, unless the user says what they are.
        """
        found = with_roles(self._dimensions(variable), self._roles)
        if self.request.axes is None:
            self._require_grid(variable, found)
        return found

    def _require_grid(self, variable: Variable, dimensions: Sequence[Dimension]) -> None:
        """Raise InputError for a variable on the cells, edges or nodes of a mesh.

        Conventions: UGRID 1.0 (mesh, location), CDI_grid_type of CDO and ICON, dimensions of MPAS;
        else positions of both horizontal axes along a dimension that has no own.
        """
        told = {key.lower(): str(each) for key, each in variable.attributes.items()}
        ugrid = "mesh" in told and "location" in told
        if ugrid or told.get("cdi_grid_type", "") == "unstructured":
            raise InputError(_mesh(variable, dimensions[-1]))
        for each in dimensions:
            own = each.name and (
                role_of_name(each.name)
                or self._named(each.name, variable)
                or each.name in self.opened.left_out
            )
            if each.name is None or own:
                continue  # also time, along which a moving grid has positions
            along = self._along(each.name, variable)
            roles = {role_of_coordinate(n.label, n.attributes) for n in along}
            if each.name in MESH_DIMENSIONS or {"y", "x"} <= roles:
                raise InputError(_mesh(variable, each))

    @cached_property
    def _roles(self) -> dict[str, str]:
        return shared_roles(map(self._dimensions, series_like(self.variables)))

    def _dimensions(self, variable: Variable) -> list[Dimension]:
        if variable.members:
            steps = Dimension(name="step", length=len(variable.members), role="t")
            return [steps, *self._dimensions(variable.members[0])]
        return [
            Dimension(
                name=name,
                length=length,
                role=None if name is None else self._role(name, variable),
                column=None if name is None else self._labels(name, length, variable),
            )
            for name, length in zip(variable.dimensions, variable.shape, strict=True)
        ]

    def _scope(self, variable: Variable) -> list[str]:
        """The group of a variable and those around it, the nearest first."""
        parts = variable.first.group.split("/")
        around = ("/".join(parts[:count]) for count in range(len(parts), -1, -1))
        return list(dict.fromkeys(around))

    def _near(self, variable: Variable) -> Iterator[tuple[str, Variable]]:
        """Variables in the group of one and around it, by name, those of the nearest group first.

        Names of one variable come but once.
        """
        seen = set()
        for group in self._scope(variable):
            for name, each in self._groups.get(group, {}).items():
                if each.name not in seen:
                    seen.add(each.name)
                    yield name, each

    def _along(self, dimension: str, variable: Variable) -> list[Variable]:
        """Number variables along one dimension: its namesake, then coordinates, then the rest."""
        owner = variable.first
        key = (dimension, owner.group, owner.scales.get(dimension))
        if key not in self._lists:
            ranked: tuple[list[Variable], ...] = ([], [], [])
            tied = self._by_name.get(owner.scales.get(dimension, ""))
            if tied is not None and usable(tied.dtype) and len(tied.shape) == 1:
                ranked[0].append(tied)
            for name, each in self._near(owner):
                alone = name == dimension and each.dimensions == (None,)
                if not usable(each.dtype) or len(each.shape) != 1 or each is tied:
                    continue
                if each.dimensions == (dimension,) or alone:
                    rank = 0 if name == dimension else 1 if each.name in self._auxiliary else 2
                    ranked[rank].append(each)
            self._lists[key] = [each for rank in ranked for each in rank]
        return self._lists[key]

    def _named(self, dimension: str, variable: Variable) -> Variable | None:
        """The variable that a dimension is named after, or tied to; it may hold texts."""
        scales = variable.first.scales
        if dimension in scales:
            return self._by_name.get(scales[dimension])
        near = self._near(variable)
        return next((each for name, each in near if name == dimension), None)

    def _role(self, dimension: str, variable: Variable) -> str | None:
        for each in self._along(dimension, variable):
            role = role_of_coordinate(each.label, each.attributes)
            if role is not None:
                return role
        return role_of_name(dimension)

    def _labels(self, dimension: str, length: int, variable: Variable) -> Column | None:
        """The column along a dimension: its namesake, also of texts, else numbers along it."""
        named = self._named(dimension, variable)
        if (
            named is not None
            and named.shape[:1] == (length,)
            and named.dtype.kind in "iufMSUTO"
            and (len(named.shape) == 1 or named.is_letters)
        ):
            return self._column(named)
        return next(
            (
                self._column(one)
                for one in self._along(dimension, variable)
                if one.shape == (length,)
            ),
            None,
        )

    def _column(self, variable: Variable) -> Column:
        """A variable of at most one dimension, or of letters, as positions or labels.

        It is read but once.
        """
        if variable.name not in self._columns:
            self._columns[variable.name] = self._made_column(variable)
        return self._columns[variable.name]

    def _made_column(self, variable: Variable) -> Column:
        @cache
        def read() -> npt.NDArray[Any]:
            require_length(variable.name, max(variable.shape, default=1))
            parts = variable.behind().parts
            if parts is not None and parts.fill == parts.fill:
                warn_of_column(variable.name, parts)
            packed = self.declared(variable)
            stored = variable.texts()
            if packed is None or variable.values is not None:
                return stored
            return packed.unpack(np.array(stored))

        return Column(
            name=variable.name,
            length=variable.shape[0] if variable.shape else 1,
            read=read,
            attributes=variable.attributes,
            numeric=usable(variable.dtype),
        )

    def coordinates(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes of a variable.

        Raises InputError if a step has positions of its own that differ from those of the first.
        """
        coords = self._positions(variable, layout)
        if not variable.members or "t" not in layout.axes or 0 in layout.picked:
            return coords
        coords["t"] = times(variable.members, self.attributes, self._scalar)
        for member in variable.members[1:]:
            place = self._candidates(member.group, owned=True)
            own = beside(self.source, layout.axes, layout.shape, [place], certain=True, tied="t")
            for axis, one in own.items():
                if axis in coords and not np.array_equal(one.values, coords[axis].values):
                    raise InputError(
                        f"{self.source}: {member.name} has other coordinates along {axis} than"
                        f" {variable.members[0].name}; the steps of one series must be alike"
                    )
        return coords

    def _scalar(self, path: str) -> tuple[float, str] | None:
        """Value and unit of a number by its path, None if there is no number."""
        each = self._by_name.get(path)
        if each is None or set(each.shape) - {1} or each.dtype.kind not in "iuf":
            return None
        return float(each.whole().reshape(-1)[0]), each.units

    def _candidates(self, group: str, *, owned: bool) -> dict[str, Column]:
        """Variables of a group that may be positions of a dimension without a name.

        They are scalars and along no named dimension; those along their own one if `owned`.
        """
        found = {}
        for name, each in self._groups.get(group, {}).items():
            free = all(one is None or (owned and one == name) for one in each.dimensions)
            if len(each.shape) < 2 and free and usable(each.dtype) and not each.error:
                found[name.lower()] = self._column(each)
        return found

    def _positions(self, variable: Variable, layout: Layout) -> dict[str, Coordinate]:
        """Coordinates of the axes: what is along a dimension by its name, else by conventions."""
        coords = layout.coordinates(self.source, {})
        named = dict(zip(layout.axes, layout.kept, strict=True))
        for axis, dimension in named.items():
            if dimension.name is not None:
                coords |= self._along_axis(axis, dimension, variable)
        counted = "t" in coords and not coords["t"].attributes.get("units")
        if counted and counts_steps(coords["t"].values):
            steps = coords.pop("t")  # a time beside the numbers of steps comes first
            return {"t": steps, **self._by_convention(variable, layout, coords)}
        return self._by_convention(variable, layout, coords)

    def _by_convention(
        self, variable: Variable, layout: Layout, coords: dict[str, Coordinate]
    ) -> dict[str, Coordinate]:
        """The coordinates, and those that the names of variables without dimensions tell."""
        named = dict(zip(layout.axes, layout.kept, strict=True))
        certain = self.request.axes is not None or all(each.role for each in layout.kept)
        unnamed = [axis for axis, each in named.items() if each.name is None]
        for owned, open_axes in (
            (False, [axis for axis in AXES if axis not in unnamed]),
            (True, unnamed),
        ):
            places = [self._candidates(group, owned=owned) for group in self._scope(variable)]
            tied = [axis for axis in AXES if axis in coords or axis not in open_axes]
            found = beside(
                self.source, layout.axes, layout.shape, places, certain=certain, tied=tied
            )
            coords = found | coords
        coords |= self._scalars(variable, layout, coords)
        if "t" in unnamed and ("t" not in coords or not coords["t"].attributes):
            written = self._texts(variable, named["t"])
            coords |= {} if written is None else {"t": written}
        return coords

    def _along_axis(
        self, axis: str, dimension: Dimension, variable: Variable
    ) -> dict[str, Coordinate]:
        """The positions along a named dimension: its namesake's, or of one with the role."""
        name = str(dimension.name)
        role_differs = dimension.role is not None and dimension.role != axis
        if not self.opened.naming and self.request.axes is not None and role_differs:
            return {}  # positions of another axis than the user says that it is
        along = [e for e in self._along(name, variable) if e.shape == (dimension.length,)]
        tied = self._named(name, variable)
        others = [self._column(each) for each in along if each is not tied]
        first = self._column(tied) if tied is not None and tied in along else None
        roles = (
            self._column(each)
            for each in along
            if each is not tied and role_of_coordinate(each.label, each.attributes) == axis
        )
        found = real_time(first, others) if axis == "t" else first
        found = found or next(roles, None)
        if axis == "t" and (found is None or only_counts(found)):
            written = self._texts(variable, dimension)
            if written is not None:
                return {axis: written}
        if found is None:
            return {}
        return {axis: coordinate(self.source, found.name, found.read(), found.attributes)}

    def _texts(self, variable: Variable, dimension: Dimension) -> Coordinate | None:
        """Times that are texts along a dimension; None without."""
        near = [each for _, each in self._near(variable)]
        return written_times(dimension.name, dimension.length, near)

    def _scalars(
        self, variable: Variable, layout: Layout, coords: Mapping[str, Coordinate]
    ) -> dict[str, Coordinate]:
        """Positions of axes that a variable lacks: scalar coordinates of its group."""
        found: dict[str, Coordinate] = {}
        scales = variable.first.scales
        for axis in (each for each in AXES if each not in (*layout.axes, *coords)):
            tied = self._by_name.get(scales.get(AXIS_NAMES[axis], ""))
            if tied is not None and tied.shape == (1,):
                found[axis] = coordinate(self.source, tied.name, tied.whole(), tied.attributes)
        for name, each in self._groups.get(self._scope(variable)[0], {}).items():
            if each.shape or not usable(each.dtype) or each.name not in self._auxiliary:
                continue
            role = role_of_coordinate(name, each.attributes)
            if role in AXES and role not in (*layout.axes, *coords, *found):
                column = self._column(each)
                found[role] = coordinate(self.source, name, column.read(), each.attributes)
        return found

    def series(self) -> FileSeries:
        """The series of the wanted variable; see `series_of`."""
        variable = self.choose()
        return self.series_of(variable, self.arrange(variable))

    def series_of(self, variable: Variable, layout: Layout) -> FileSeries:
        """The series of a variable as it was arranged, which closes the source with it."""
        opened, request = self.opened, self.request
        members = variable.members or (variable,)
        for member in members:
            member.require()
        packed = self.packing(variable)
        dtype = variable.values or (variable.dtype if packed is None else packed.dtype)
        # counts have not the unit of the values
        scaled = request.raw_values and SCALING & set(variable.attributes)
        without = STORED | ({"units"} if scaled else frozenset())
        behind = [one.behind() for one in members]
        parts = [each.parts for each in behind]
        folder = opened.folder if variable.members else behind[0].folder
        coords = self.coordinates(variable, layout)
        names = {
            word
            for axis, each in zip(layout.axes, layout.kept, strict=True)
            for word in ((axis, AXIS_NAMES[axis]) if each.name is None else (each.name,))
        }
        if not opened.naming:
            names |= {each.name for each in coords.values()}
        fill = opened.default_fill(variable.dtype)
        told = {"_FillValue", "missing_value"} & variable.attributes.keys()
        default = None
        if fill is not None and packed is not None and not told:
            default = packed.unpack(np.array([fill], packed.stored))[0].item()
        stored = Stored(
            source=self.source,
            stamp=(None if variable.members else behind[0].stamp) or opened.stamp,
            slow=opened.slow if folder is None else FolderStamp.of(folder),
            close=opened.close,
            beside=[*opened.files, *dict.fromkeys(n for each in behind for n in each.files)],
            shape=layout.shape,
            dtype=dtype,
            axes=layout.axes,
            fetch=layout.fetch(self.reading(variable)),
            chunks=layout.chunks(variable.chunks),
            packing=None if opened.computed else packed,
            not_stored=not_stored(parts, layout, joined=bool(variable.members)),
            default_fill=default,
        )
        name = plain_name(shown_name(variable.name, names))
        attributes = json_attributes(variable.attributes, without=without) | layout.attributes()
        series = FileSeries(name, stored, coords, attributes)
        if variable.dtype.kind in "iuf" and not variable.field and not scaled:
            limits = packed or missing_values(self.source, variable.dtype, ())
            series.valid = valid_limits(limits, variable.attributes)
        if (scales := unapplied(variable.attributes)) and not request.raw_values:
            warnings.warn(
                f"{self.source}: {name} has {scales}, which no convention known here applies; its"
                " numbers are read as they are stored",
                FhashWarning,
                stacklevel=2,
            )
        series.named = is_named(opened, variable)
        # who names the variable means it in whatever group it is
        series.group = "" if self.request.var else variable.group
        if not variable.members and not variable.field:
            unfit = without if request.raw_values else frozenset[str]()
            series.metadata = partial(
                self._metadata, variable, layout, packed, series.coords, unfit
            )
        return series

    def _metadata(
        self,
        variable: Variable,
        layout: Layout,
        packed: Packing | None,
        coords: Mapping[str, Coordinate],
        without: frozenset[str],
    ) -> SourceMetadata | None:
        """All that belongs to a variable.

        None where its dimensions have no names and nothing but positions is beside it. They then
        have the names of the axes, and in what is beside it names of their own.
        """
        opened = self.opened
        warn_left_out(f"{self.source}: not everything beside it is kept", opened.left_out)
        beside_it = self._beside(variable)
        taken = {plain_name(each.name) for each in coords.values()}
        named = opened.naming and None not in variable.dimensions
        arrays, positions = {}, 0
        for name, each in beside_it.items():
            is_position = name in taken and each.shape in ((), *((n,) for n in layout.shape))
            positions += is_position
            if len(each.shape) >= FIELD_DIMENSIONS and not named:
                continue  # what has so many dimensions can be encoded itself
            own = [
                (name if is_position else f"{name}_dim_{n}") if given is None else given
                for n, given in enumerate(each.dimensions)
            ]
            arrays[name] = replace(each, dimensions=tuple(own))
        if not named and len(arrays) == positions:
            return None
        if len(arrays) > MAX_ARRAYS and not named:
            more = len(arrays) - MAX_ARRAYS
            warn_left_out(
                f"{self.source}: not everything beside {variable.name} is kept",
                {f"{more} datasets": f"more than {MAX_ARRAYS}"},
            )
            arrays = dict(list(arrays.items())[:MAX_ARRAYS])
        own_name = self._flat(variable, variable)
        whole = replace(variable, name=own_name, dimensions=tuple(named_dimensions(layout, coords)))
        wanted = Wanted(
            source=self.source,
            name=own_name,
            coordinates=opened.coordinates,
            used=[*taken],
            without=without,
            path=opened.path,
        )
        groups = opened.groups
        of_file = groups.get(self._scope(variable)[0], {}) if opened.naming else groups.get("", {})
        with refusing(f"{self.source} cannot be read"):
            known = {own_name: whole, **arrays}
            return metadata_of(wanted, known, of_file, layout, self.request, packed, coords["t"])

    def _flat(self, variable: Variable, other: Variable) -> str:
        """A name without groups for what lies beside a variable, or for itself."""
        if self.opened.naming:
            return other.label
        return other.name.removeprefix(f"{variable.group}/").replace("/", "_")

    def _beside(self, variable: Variable) -> dict[str, Variable]:
        """Variables beside one, by names without groups; of two names the nearest."""
        near = {each.name: each for _, each in self._near(variable)}
        if self.opened.spread:
            near |= {each.name: each for each in self.opened.variables if each.name not in near}
        found: dict[str, Variable] = {}
        for each in near.values():
            if each.name != variable.name and not each.error and not each.computed:
                found.setdefault(self._flat(variable, each), each)
        if self.opened.naming:  # where nothing else is beside, positions need no mention
            tied = map(self._by_name.get, variable.first.scales.values())
            found |= {each.label: each for each in tied if each is not None and each.computed}
        return found

    def listed(self) -> list[Listed]:
        """Description of each variable; see `listing`."""
        return listing(self.source, self.variables, self.dimensions, self.request, self.declared)


MESH_NAMES = "nCells nEdges nVertices ncells ncol nMesh2_face nface nnode"
MESH_DIMENSIONS = frozenset(MESH_NAMES.split())
"""Names of dimensions of meshes in MPAS, ICON, CESM and FVCOM."""


def _mesh(variable: Variable, dimension: Dimension) -> str:
    """The message for a variable on a mesh."""
    return (
        f"{variable.name} lies on the {dimension.length} places of a mesh ({dimension.name}), not"
        " on a grid of z, y and x; resample it first, such as with cdo remapcon or uxarray"
    )


def open_selected(opened: Source, request: Request) -> FileSeries:
    """The series that is asked for of an open source, which is closed with it, or on errors.

    Raises InputError where it is not clear what is wanted.
    """
    try:
        with refusing(f"{opened.name} cannot be read"):
            return Selection(opened, request).series().as_asked(request)
    except BaseException:
        opened.close()
        raise


def list_selected(opened: Source, request: Request) -> list[Listed]:
    """The variables of an open source, which is closed."""
    try:
        with refusing(f"{opened.name} cannot be read"):
            return Selection(opened, request).listed()
    finally:
        opened.close()
