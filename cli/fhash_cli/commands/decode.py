"""`fhash decode`: rebuilds a region of a container as a file, or prints statistics of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.conversion import check_fill, convert
from fhash_cli.frame_statistics import Statistics
from fhash_cli.intervals import IntervalsType, NumberType, SliceType
from fhash_cli.options import (
    check_writable,
    feature_option,
    force_option,
    json_option,
    quiet_option,
    run_argument,
    variable_option,
)
from fhash_cli.output import Progress, apart, emit, extent, listed, number, say, spans, table
from fhash_cli.selection import (
    Span,
    coordinates,
    count_inside,
    dates_of,
    metadata,
    opened,
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

INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
TYPES = ("float16", "float32", "float64", *INTEGERS)


@click.command("decode", cls=BaseCommand)
@run_argument
@variable_option
@click.option(
    "--t",
    "steps",
    type=SliceType(),
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
    type=NumberType(),
    help="Value of vertices that have none. Default: the source's own for integers, else NaN.",
)
@feature_option
@force_option
@json_option
@quiet_option
def command(
    run: str,
    variable: str | None,
    features: tuple[str, ...],
    steps: slice | None,
    times: tuple[str, ...],
    roi: Sequence[Sequence[int | None]] | None,
    box: Sequence[Sequence[float | None]] | None,
    lod: int | None,
    output: str | None,
    isosurface: float | None,
    outside: Literal["nan", "background"],
    dtype: str | None,
    fill: float | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Rebuild a region of RUN.fhz; without -o, print statistics of it."""
    if steps is not None and times:
        raise click.UsageError("--t and --time exclude each other")
    if roi is not None and box is not None:
        raise click.UsageError("--roi and --box exclude each other")
    if lod is not None and outside != "nan":
        raise click.UsageError("--lod has NaN outside the coreset; leave out --outside")
    _check_output(output, isosurface, dtype, force, run)
    if isosurface is not None and fill is not None:
        raise click.UsageError("--isosurface has no fill value; leave out --fill")
    with opened(run, fill, features, variable) as volume, Progress(quiet=quiet) as progress:
        if isosurface is not None:
            dtype = volume.float_dtype.name
        selection = Selection.of(volume, steps, times, roi, box, lod, outside, dtype, fill)
        frames = selection.frames(volume, statistics := Statistics(), progress)
        paths: list[str] = []
        if output is None:
            sum(1 for _ in frames)
        elif isosurface is not None:
            paths = _save_surface(output, isosurface, volume, selection, frames, force, run)
        else:
            paths = _save_region(output, volume, selection, frames, force, run)
        if dtype is None and not quiet:
            _say_why_floats(volume, selection)
        result = {
            "paths": paths,
            "shape": selection.shape,
            "dtype": selection.kind.name,
            "steps": selection.steps,
            "region": [(vertices.start, vertices.stop) for vertices in selection.vertices],
            **statistics.result(),
        }
        emit(result, table(_rows(result, volume)), as_json)


def _say_why_floats(volume: Volume, selection: Selection) -> None:
    """One line where integers come as floats."""
    own = volume.value_type.own
    if own.kind in "iu" and selection.kind.kind == "f":
        why = "between steps they are interpolated"
        if all(float(step).is_integer() for step in selection.steps):
            why = f"some vertices have no value; --fill V keeps {own}"
        say(f"the integers of the source come as {selection.kind}: {why}")


def _check_output(
    output: str | None, isosurface: float | None, dtype: str | None, force: bool, run: str
) -> None:
    """Refuse an output before any work."""
    from fhash_codec.isosurface import require_marching_cubes
    from fhash_formats.writers.mesh import check_mesh_output

    if isosurface is not None:
        if output is None or dtype is not None:
            raise click.UsageError(
                "--isosurface writes a file of triangles: give -o s.vtp or -o s.ply, and no --dtype"
            )
        check_mesh_output(output, force, [run])
        require_marching_cubes()
    elif output is not None:
        check_writable(output, force, region=True, sources=[run])


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
    def of(
        cls,
        volume: Volume,
        steps: slice | None,
        times: tuple[str, ...],
        roi: Sequence[Sequence[int | None]] | None,
        box: Sequence[Sequence[float | None]] | None,
        lod: int | None,
        outside: Literal["nan", "background"],
        dtype: str | None,
        fill: float | None,
    ) -> Selection:
        """Resolve the options; raises RegionError where they leave the series or its domain."""
        import numpy as np

        chosen = steps_at(volume, times) if times else steps_of(volume, steps)
        region = region_of_box(volume, box) if box is not None else region_of(volume, roi)
        # A level of detail has its own vertices: those of the feature bounding box in the region.
        z, y, x = (
            (range(low, high) for low, high in region)
            if lod is None
            else volume.lod_vertices(lod, region)
        )
        whole = all(float(step).is_integer() for step in chosen)
        kind = np.dtype(dtype or (volume.dtype if whole else volume.float_dtype))
        own = volume.value_type.fill
        if fill is None and own is not None and kind.kind in "iu":
            fill = own
        check_fill(kind, fill)
        return cls(
            steps=chosen,
            region=region,
            vertices=(z, y, x),
            lod=lod,
            outside=outside,
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
        """Decode the frames (z, y, x), small ones together; all are added to the statistics."""
        from fhash_formats.support.number_types import is_wide_integer

        background, done = self.outside == "background", 0
        exact = self.kind == volume.dtype and is_wide_integer(self.kind) and self.lod is None
        for steps, frames in self._decoded(volume):
            inside = count_inside(volume, steps, self.region, frames, self.outside)
            statistics.add(frames, inside)
            if exact:
                # float64 has not every integer of 64 bits.
                whole = range(int(steps[0]), int(steps[-1]) + 1)
                frames = volume.values_of_steps(whole, self.region, outside=self.outside)
            yield from convert(frames, self.kind, fill=self.fill, background=background)
            done += len(steps)
            progress("decoding", done, len(self.steps), "")

    def _decoded(self, volume: Volume) -> Iterator[tuple[Sequence[float], npt.NDArray[Any]]]:
        """Some steps at a time, and their frames (t, z, y, x)."""
        import numpy as np

        from fhash_codec.indexing import step_blocks

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


def _save_surface(
    output: str,
    isosurface: float,
    volume: Volume,
    selection: Selection,
    frames: Iterator[npt.NDArray[Any]],
    force: bool,
    run: str,
) -> list[str]:
    """Write the isosurface of the one selected step; the paths written."""
    from fhash_codec.isosurface import isosurface as surface
    from fhash_formats.writers.mesh import save_mesh

    if len(selection.steps) != 1:
        raise InputError(
            f"--isosurface is of one step; {len(selection.steps)} were chosen:"
            " give --t N or --time T"
        )
    coords = coordinates(volume, selection.steps, selection.vertices)
    (frame,) = frames
    mesh = surface(frame, isosurface, coords, name=volume.name, time=float(coords["t"].values[0]))
    return [str(save_mesh(output, mesh, force=force, sources=[run]))]


def _save_region(
    output: str,
    volume: Volume,
    selection: Selection,
    frames: Iterator[npt.NDArray[Any]],
    force: bool,
    run: str,
) -> list[str]:
    """Write the frames in the format of the output's suffix; the paths written."""
    from fhash_formats import Region, save_region

    region = Region(
        name=volume.name,
        units=volume.units,
        dtype=selection.kind,
        fill=selection.fill if volume.value_type.has_gaps else None,
        shape=selection.shape,
        coords=coordinates(volume, selection.steps, selection.vertices),
        attributes=volume.attrs,
        metadata=metadata(volume, selection.steps, selection.vertices),
    )
    return [str(path) for path in save_region(output, region, frames, force=force, sources=[run])]


def _rows(result: dict[str, Any], volume: Volume) -> list[tuple[str, str]]:
    from fhash_formats.writers.vtkhdf import needed_by

    dates, units = dates_of(volume, result["steps"]), volume.units
    return [
        *(("written", path) for path in result["paths"]),
        *(("opens in", text) for text in needed_by(result["paths"], len(result["steps"]))),
        ("steps", listed(apart(*result["steps"]))),
        *([("dates", listed(dates))] if dates else []),
        ("region", spans(result["region"])),
        ("t, z, y, x", f"{extent(result['shape'])}, {result['dtype']}"),
        ("smallest", number(result["min"], units, digits=6)),
        ("largest", number(result["max"], units, digits=6)),
        ("mean", number(result["mean"], units, digits=6)),
        ("in the coreset", f"{result['inside_fraction']:.3%}"),
    ]
