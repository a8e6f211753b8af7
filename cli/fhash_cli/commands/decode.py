"""`fhash decode`: rebuilds a region of a container as a file, or prints statistics of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

import click

from fhash_cli.options import (
    NUMBER,
    SLICE,
    BaseCommand,
    IntervalsType,
    check_writable,
    feature_option,
    force_option,
    json_option,
    option_group,
    quiet_option,
    run_argument,
    variables_option,
)
from fhash_cli.output import Progress, apart, emit, extent, listed, number, say, spans, table
from fhash_cli.selection import (
    Span,
    coordinates,
    count_inside,
    dates_of,
    metadata,
    opened_variables,
    region_of,
    region_of_box,
    steps_at,
    steps_of,
)
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fhash_codec import Volume
    from fhash_codec.progress import Progress as Callback
    from fhash_formats.writers.common import Region


def check_fill(kind: np.dtype[Any], fill: float | None) -> None:
    """Raise InputError for a fill value that a number type cannot hold; None is always held."""
    from fhash_codec.volume import holds

    if fill is not None and not holds(kind, fill):
        raise InputError(f"the fill value {fill:g} does not fit {kind}; give another, or --dtype")


def convert(
    frame: npt.NDArray[Any],
    kind: np.dtype[Any],
    *,
    fill: float | None = None,
    background: bool = False,
    integers: npt.NDArray[Any] | None = None,
) -> npt.NDArray[Any]:
    """Convert a decoded frame to another number type; for integers it is rounded and clipped.

    fill: value in place of NaN; None for NaN itself. background: vertices outside the coreset hold
    the background's value; NaN means a missing value. integers: the values as integers, where
    floats have not all of them. Raises InputError where the type cannot hold a value.
    """
    import numpy as np

    gaps = np.isnan(frame)
    frame = frame if integers is None else integers
    if not gaps.any():
        return _converted(frame, kind)
    if fill is None:
        if kind.kind != "f":
            what = (
                "the data have no value (NaN) at some vertices of the region"
                if background
                else "the region holds vertices without a value (NaN)"
            )
            other = "" if background else "add --outside background, "
            raise InputError(
                f"{what}, which {kind} cannot hold; {other}give --fill V, or take a float type"
            )
        return _converted(frame, kind)
    result = _converted(np.where(gaps, 0, frame), kind)
    result[gaps] = fill
    return result


def _converted(frame: npt.NDArray[Any], kind: np.dtype[Any]) -> npt.NDArray[Any]:
    """A frame without NaN in another number type; `kind` may be a float type for any frame."""
    import numpy as np

    if kind == frame.dtype:
        return frame
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            narrow = frame.astype(kind)
        if np.isinf(narrow).any():
            raise InputError(
                f"a value of {float(np.nanmax(np.abs(frame))):.6g} does not fit {kind};"
                " choose a wider type"
            )
        return narrow
    limits = np.iinfo(kind)
    if frame.dtype.kind != "f":
        own = np.iinfo(frame.dtype)
        low, high = max(int(limits.min), int(own.min)), min(int(limits.max), int(own.max))
        return np.asarray(np.clip(frame, low, high).astype(kind))
    rounded = np.rint(frame.astype(np.float64))
    # No float64 equals the largest 64-bit integer: the float of the limit lies one above it.
    clipped = rounded >= float(limits.max)
    integers = np.where(clipped, 0.0, np.maximum(rounded, float(limits.min))).astype(kind)
    integers[clipped] = limits.max
    return np.asarray(integers)


class DecodedVariable(TypedDict):
    """A region of a variable."""

    shape: Annotated[Sequence[int], "of the region, (t, z, y, x)"]
    dtype: Annotated[str, "number type of the values"]
    steps: Annotated[list[float], "steps, fractional between two of them"]
    region: Annotated[list[tuple[int, int]], "[first, end) along z, y and x"]
    min: Annotated[float | None, "smallest value; null without any"]
    max: Annotated[float | None, "largest value"]
    mean: Annotated[float | None, "mean value"]
    inside_fraction: Annotated[float, "share of the region in the coreset"]


class Decoded(DecodedVariable):
    """A region of the one variable."""

    paths: Annotated[list[str], "files written; empty without `-o`"]


class DecodedSeveral(TypedDict):
    """A region of several variables."""

    paths: Annotated[list[str], "files written; empty without `-o`"]
    variables: Annotated[dict[str, DecodedVariable], "the variables by name"]


class Statistics:
    """Smallest, largest and mean value, and share inside the coreset, of frames added one by one.

    NaN is left out.
    """

    def __init__(self) -> None:
        from fhash_codec.measure.value_range import Mean

        self.low, self.high, self.mean = float("inf"), float("-inf"), Mean()
        self.inside = self.all = 0

    def add(
        self, frame: npt.NDArray[Any], inside: int, integers: npt.NDArray[Any] | None = None
    ) -> None:
        """Add values of any shape.

        inside: number of their vertices in the coreset. integers: the values as integers, where
        floats have not all of them.
        """
        import numpy as np

        from fhash_codec.features.scan import scan_rows
        from fhash_codec.measure.value_range import pieces

        self.all, self.inside = self.all + frame.size, self.inside + inside
        for piece in pieces(frame if integers is None else integers[~np.isnan(frame)]):
            _, low, high = scan_rows(piece[None], self.mean)
            self.low, self.high = min(self.low, low), max(self.high, high)


@dataclass(frozen=True, kw_only=True)
class RegionOptions:
    """Options of `fhash decode` that say what is decoded, and as which numbers."""

    variable: str | None = None
    features: tuple[str, ...] = ()
    steps: slice | None = None
    times: tuple[str, ...] = ()
    roi: Sequence[Sequence[int | None]] | None = None
    box: Sequence[Sequence[float | None]] | None = None
    lod: int | None = None
    outside: Literal["nan", "background"] = "nan"
    dtype: str | None = None
    fill: float | None = None

    def __post_init__(self) -> None:
        if self.steps is not None and self.times:
            raise click.UsageError("--t and --time exclude each other")
        if self.roi is not None and self.box is not None:
            raise click.UsageError("--roi and --box exclude each other")
        if self.lod is not None and self.outside != "nan":
            raise click.UsageError("--lod has NaN outside the coreset; leave out --outside")


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Frames that the options select of an open container, and how their values are given.

    Attributes:
        steps: step indices, fractional for times between steps.
        region: vertices ((z0, z1), (y0, y1), (x0, x1)) of the domain.
        vertices: vertices of the domain along z, y and x that a frame has.
        lod: level of detail, None for every vertex.
        outside: `nan` or `background`, the values outside the coreset.
        kind: number type of the output.
        fill: value of vertices that have none; None for NaN.
    """

    steps: list[float]
    region: tuple[Span, Span, Span]
    vertices: tuple[range, range, range]
    lod: int | None
    outside: Literal["nan", "background"]
    kind: np.dtype[Any]
    fill: float | None

    @classmethod
    def of(cls, volume: Volume, options: RegionOptions) -> Selection:
        """Resolve the options; raises RegionError where they leave the series or its domain."""
        import numpy as np

        from fhash_codec.volume import holds

        lod, box, fill = options.lod, options.box, options.fill
        chosen = (
            steps_at(volume, options.times) if options.times else steps_of(volume, options.steps)
        )
        region = region_of_box(volume, box) if box is not None else region_of(volume, options.roi)
        # A level of detail has its own vertices: those of the feature bounding box in the region.
        z, y, x = (
            (range(low, high) for low, high in region)
            if lod is None
            else volume.lod_vertices(lod, region)
        )
        whole = all(float(step).is_integer() for step in chosen)
        kind = np.dtype(options.dtype or (volume.dtype if whole else volume.float_dtype))
        own = volume.value_type.fill
        if fill is None and own is not None and kind.kind in "iu" and holds(kind, own):
            fill = own
        check_fill(kind, fill)
        return cls(
            steps=chosen,
            region=region,
            vertices=(z, y, x),
            lod=lod,
            outside=options.outside,
            kind=kind,
            fill=fill,
        )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape (t, z, y, x) of the output."""
        z, y, x = self.vertices
        return len(self.steps), len(z), len(y), len(x)

    def frames(
        self, volume: Volume, statistics: Statistics, progress: Callback
    ) -> Iterator[npt.NDArray[Any]]:
        """Decode the frames (z, y, x), small ones together; all are added to the statistics.

        The next ones are decoded while the caller writes those that it has.
        """
        from fhash_formats.support.threads import one_ahead

        for frames in one_ahead(self._blocks(volume, statistics, progress)):
            yield from frames

    def _blocks(
        self, volume: Volume, statistics: Statistics, progress: Callback
    ) -> Iterator[npt.NDArray[Any]]:
        """Frames (t, z, y, x) of some steps at a time."""
        from fhash_formats.support.values import is_wide_integer

        background, done = self.outside == "background", 0
        wide = is_wide_integer(volume.dtype) and all(float(t).is_integer() for t in self.steps)
        for steps, frames in self._decoded(volume):
            inside = count_inside(volume, steps, self.region, frames, self.outside)
            # float64 has not every integer of 64 bits.
            integers = self._integers(volume, steps) if wide else None
            statistics.add(frames, inside, integers)
            done += len(steps)
            progress("decoding", done, len(self.steps), "")
            yield convert(
                frames, self.kind, fill=self.fill, background=background, integers=integers
            )

    def _integers(self, volume: Volume, steps: Sequence[float]) -> npt.NDArray[Any]:
        """The frames (t, z, y, x) of some whole steps as the integers that the file holds."""
        if self.lod is None:
            whole = range(int(steps[0]), int(steps[-1]) + 1)
            return volume.values_of_steps(whole, self.region, outside=self.outside)
        return volume.decoded_lod(steps[0], self.lod, self.region)[0][None]

    def _decoded(self, volume: Volume) -> Iterator[tuple[Sequence[float], npt.NDArray[Any]]]:
        """Some steps at a time, and their frames (t, z, y, x)."""
        import numpy as np

        from fhash_formats.series import step_blocks

        first = int(self.steps[0])
        neighbours = range(first, first + len(self.steps))
        if self.lod is None and list(neighbours) == self.steps:
            for _, steps in step_blocks(neighbours, self.shape[1:]):
                yield steps, volume.read_steps(steps, self.region, outside=self.outside)
            return
        for step in self.steps:
            frame = (
                volume.read(step, self.region, outside=self.outside)
                if self.lod is None
                else volume.read_lod(step, self.lod, self.region)
            )
            yield [step], np.expand_dims(frame, 0)


INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
TYPES = ("float16", "float32", "float64", *INTEGERS)


@click.command(
    "decode",
    cls=BaseCommand,
    epilog="fhash decode run.fhz\n"
    "fhash decode run.fhz --t 12 --roi 0:16,20:36,: -o part.vti\n"
    "fhash decode run.fhz --time 0.55 -o between.npy",
)
@run_argument
@variables_option
@click.option(
    "--t",
    "steps",
    type=SLICE,
    help="Steps, half-open as in Python: 42, 40:50, ::2, -1. Default: all.",
)
@click.option(
    "--time",
    "times",
    metavar="T",
    multiple=True,
    help="A number or a date such as 2001-02-10T06:00, between steps too; may be repeated.",
)
@click.option(
    "--roi",
    metavar="z0:z1,y0:y1,x0:x1",
    type=IntervalsType(int),
    help="Region in vertices, half-open as in Python; 5 is one layer, and axes left out are whole.",
)
@click.option(
    "--box",
    metavar="z0:z1,y0:y1,x0:x1",
    type=IntervalsType(float),
    help="Region in physical positions, both ends included.",
)
@click.option(
    "--lod",
    type=click.IntRange(0, 10),
    metavar="N",
    help="Level of detail: every 2^N-th vertex of the feature bounding box.",
)
@click.option(
    "-o",
    "output",
    metavar="OUT",
    type=click.Path(),
    help="File to write: .npy, .h5, .nc, .zarr, .raw, .vti, .vtr, .pvd, .vtkhdf.",
)
@click.option(
    "--isosurface",
    type=float,
    metavar="V",
    help="Write the surface of this value at one step, as triangles: -o s.vtp or s.ply.",
)
@click.option(
    "--outside",
    type=click.Choice(["nan", "background"]),
    default="nan",
    show_default=True,
    help="Values outside the coreset.",
)
@click.option(
    "--dtype",
    type=click.Choice(TYPES),
    help="Convert the values; integers are rounded and clipped to the type's range. "
    "Default: the type of the source for integers, else float32 or float64.",
)
@click.option(
    "--fill",
    metavar="V",
    type=NUMBER,
    help="Value of vertices that have none. Default: the source's own for integers, else NaN.",
)
@feature_option
@force_option
@json_option
@quiet_option
@option_group(RegionOptions, "chosen")
def command(
    run: str,
    output: str | None,
    isosurface: float | None,
    chosen: RegionOptions,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Rebuild a region of RUN.fhz; without -o, print statistics of it.

    Of several variables all are rebuilt, or those of --var u,v; one output holds them in HDF5,
    NetCDF and Zarr.
    """
    _check_output(output, isosurface, chosen, force, run)
    with (
        opened_variables(
            run, chosen.fill, chosen.features, chosen.variable, several=isosurface is None
        ) as volumes,
        Progress(quiet=quiet) as progress,
    ):
        if isosurface is not None:
            chosen = replace(chosen, dtype=volumes[0].float_dtype.name)
        parts = [Part.of(volume, Selection.of(volume, chosen), progress) for volume in volumes]
        paths: list[str] = []
        if output is None:
            for part in parts:
                sum(1 for _ in part.frames)
        elif isosurface is not None:
            paths = _save_surface(output, isosurface, parts[0], force, run)
        else:
            paths = _save_regions(output, parts, force, run)
        if chosen.dtype is None and not quiet:
            for part in parts:
                _say_why_floats(part)
        blocks = [_rows(part) for part in parts]
        blocks[0] = [*_file_rows(paths, parts), *blocks[0]]
        emit(_result(paths, parts), "\n\n".join(map(table, blocks)), as_json)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A variable with what is decoded of it.

    Attributes:
        volume: the variable.
        selection: what is decoded.
        frames: the frames (z, y, x), decoded one after the other.
        statistics: of the frames that came.
    """

    volume: Volume
    selection: Selection
    frames: Iterator[npt.NDArray[Any]]
    statistics: Statistics

    @classmethod
    def of(cls, volume: Volume, selection: Selection, progress: Callback) -> Part:
        """The part that a selection is of a variable; nothing is decoded yet."""
        frames = selection.frames(volume, statistics := Statistics(), progress)
        return cls(volume=volume, selection=selection, frames=frames, statistics=statistics)

    def result(self) -> DecodedVariable:
        """The keys of `--json`, once all frames were decoded."""
        chosen, found = self.selection, self.statistics
        defined = found.mean.count > 0
        return {
            "shape": chosen.shape,
            "dtype": chosen.kind.name,
            "steps": chosen.steps,
            "region": [(vertices.start, vertices.stop) for vertices in chosen.vertices],
            "min": found.low if defined else None,
            "max": found.high if defined else None,
            "mean": found.mean.value() if defined else None,
            "inside_fraction": found.inside / found.all,
        }


def _result(paths: list[str], parts: Sequence[Part]) -> Decoded | DecodedSeveral:
    if len(parts) == 1:
        return {"paths": paths, **parts[0].result()}
    return {
        "paths": paths,
        "variables": {str(part.volume.variable): part.result() for part in parts},
    }


def _say_why_floats(part: Part) -> None:
    """One line where integers come as floats."""
    own, chosen = part.volume.value_type.own, part.selection
    if own.kind in "iu" and chosen.kind.kind == "f":
        why = "between steps they are interpolated"
        if all(float(step).is_integer() for step in chosen.steps):
            why = f"some vertices have no value; --fill V keeps {own}"
        say(f"the integers of {part.volume.name} come as {chosen.kind}: {why}")


def _check_output(
    output: str | None, isosurface: float | None, chosen: RegionOptions, force: bool, run: str
) -> None:
    """Refuse an output before any work."""
    if isosurface is not None:
        from fhash_codec.isosurface import require_marching_cubes
        from fhash_formats.writers.vtk import check_mesh_output

        if output is None or chosen.dtype is not None:
            raise click.UsageError(
                "--isosurface writes a file of triangles: give -o s.vtp or -o s.ply, and no --dtype"
            )
        check_mesh_output(output, force, [run])
        require_marching_cubes()
        if chosen.fill is not None:
            raise click.UsageError("--isosurface has no fill value; leave out --fill")
    elif output is not None:
        check_writable(output, force, region=True, sources=[run])


def _save_surface(output: str, isosurface: float, part: Part, force: bool, run: str) -> list[str]:
    """Write the isosurface of the one selected step; the paths written."""
    from fhash_codec.isosurface import isosurface as surface
    from fhash_formats.writers.vtk import save_mesh

    steps = part.selection.steps
    if len(steps) != 1:
        raise InputError(
            f"--isosurface is of one step; {len(steps)} were chosen: give --t N or --time T"
        )
    coords = coordinates(part.volume, steps, part.selection.vertices)
    (frame,) = part.frames
    time = float(coords["t"].values[0])
    mesh = surface(frame, isosurface, coords, name=part.volume.name, time=time)
    return [str(save_mesh(output, mesh, force=force, sources=[run]))]


def _save_regions(output: str, parts: Sequence[Part], force: bool, run: str) -> list[str]:
    """Write the frames in the format of the output's suffix; the paths written."""
    from fhash_formats.writers.registry import save_regions

    regions = [(_region(part), part.frames) for part in parts]
    return [str(path) for path in save_regions(output, regions, force=force, sources=[run])]


def _region(part: Part) -> Region:
    """The description of the frames for a writer."""
    from fhash_codec.header import without_figures
    from fhash_formats.writers.common import Region

    volume, chosen = part.volume, part.selection
    beside = metadata(volume, chosen.steps, chosen.vertices)
    if beside is not None:
        own = without_figures(beside.variable_attributes)
        beside = replace(beside, variable_attributes=own)
    return Region(
        name=volume.name,
        units=volume.units,
        dtype=chosen.kind,
        fill=chosen.fill if volume.value_type.has_gaps else None,
        shape=chosen.shape,
        coords=coordinates(volume, chosen.steps, chosen.vertices),
        attributes=without_figures(volume.attrs),
        metadata=beside,
    )


def _file_rows(paths: list[str], parts: Sequence[Part]) -> list[tuple[str, str]]:
    from fhash_formats.writers.vtk import needed_by

    return [
        *(("written", path) for path in paths),
        *(("opens in", text) for text in needed_by(paths, len(parts[0].selection.steps))),
    ]


def _rows(part: Part) -> list[tuple[str, str]]:
    result, volume = part.result(), part.volume
    dates, units = dates_of(volume, result["steps"]), volume.units
    return [
        *([("variable", volume.variable)] if volume.variable else []),
        ("steps", listed(apart(*result["steps"]))),
        *([("dates", listed(dates))] if dates else []),
        ("region", spans(result["region"])),
        ("t, z, y, x", f"{extent(result['shape'])}, {result['dtype']}"),
        ("smallest", number(result["min"], units, digits=6)),
        ("largest", number(result["max"], units, digits=6)),
        ("mean", number(result["mean"], units, digits=6)),
        ("in the coreset", f"{result['inside_fraction']:.3%}"),
    ]
