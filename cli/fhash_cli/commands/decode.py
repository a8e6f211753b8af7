"""`fhash decode`: a region of a container at any steps or times, as a file or as a short table of statistics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal

import click

from fhash_cli.options import (
    IntervalsType,
    SliceType,
    check_writable,
    force_option,
    json_option,
    quiet_option,
    run_argument,
)
from fhash_cli.output import Progress, apart, emit, extent, listed, number, spans, table
from fhash_cli.selection import Span, coordinates, region_of, region_of_box, steps_of
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fhash_codec import Volume

TYPES = (
    "float16",
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
)


@click.command("decode")
@run_argument
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
    type=float,
    multiple=True,
    help="A physical time, between steps too; may be repeated.",
)
@click.option(
    "--roi",
    metavar="z0:z1,y0:y1,x0:x1",
    type=IntervalsType(int),
    help="Region in vertices, half-open as in Python.",
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
    help="Convert the values; integers are rounded and clipped to the type's range.",
)
@force_option
@json_option
@quiet_option
def command(
    run: str,
    steps: slice | None,
    times: tuple[float, ...],
    roi: Sequence[Sequence[int | None]] | None,
    box: Sequence[Sequence[float | None]] | None,
    lod: int | None,
    output: str | None,
    isosurface: float | None,
    outside: Literal["nan", "background"],
    dtype: str | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Rebuild a region of RUN.fhz; without -o, print statistics of it."""
    import numpy as np

    import fhash_codec
    from fhash_codec.isosurface import isosurface as surface
    from fhash_codec.isosurface import require_marching_cubes
    from fhash_formats import Region, save_region
    from fhash_formats.writers.mesh import check_mesh_output, save_mesh

    if steps is not None and times:
        raise click.UsageError("--t and --time exclude each other")
    if roi is not None and box is not None:
        raise click.UsageError("--roi and --box exclude each other")
    if lod is not None and outside != "nan":
        raise click.UsageError("--lod has NaN outside the coreset; leave out --outside")
    if isosurface is not None:
        if output is None or dtype is not None:
            raise click.UsageError(
                "--isosurface writes a file of triangles: give -o s.vtp or -o s.ply, and no --dtype"
            )
        check_mesh_output(output, force, [run])
        require_marching_cubes()
    elif output is not None:
        check_writable(output, force, region=True, sources=[run])
    with fhash_codec.open(run) as volume, Progress(quiet=quiet) as progress:
        chosen = [volume.step_of_time(time) for time in times] if times else steps_of(volume, steps)
        region = region_of_box(volume, box) if box is not None else region_of(volume, roi)
        # A level of detail has its own vertices, those of the feature bounding box that lie in the region.
        z, y, x = (
            (range(low, high) for low, high in region)
            if lod is None
            else volume.lod_vertices(lod, region)
        )
        kind = np.dtype(dtype or volume.dtype)
        statistics = Statistics()

        def frames() -> Iterator[npt.NDArray[Any]]:
            for done, step in enumerate(chosen):
                frame = (
                    volume.read(step, region, outside=outside)
                    if lod is None
                    else volume.read_lod(step, lod, region)
                )
                statistics.add(frame, _inside(volume, step, region, frame, outside))
                yield convert(frame, kind, filled=outside == "background")
                progress("decoding", done + 1, len(chosen))

        shape = (len(chosen), len(z), len(y), len(x))
        paths = []
        if output is not None and isosurface is not None:
            if len(chosen) != 1:
                raise InputError(
                    f"--isosurface is of one step; {len(chosen)} were chosen: give --t N or --time T"
                )
            coords = coordinates(volume, chosen, (z, y, x))
            (frame,) = frames()
            mesh = surface(
                frame, isosurface, coords, name=volume.name, time=float(coords["t"].values[0])
            )
            paths = [str(save_mesh(output, mesh, force=force, sources=[run]))]
        elif output is None:
            for _ in frames():
                pass
        else:
            whole = Region(
                name=volume.name,
                units=volume.units,
                dtype=kind,
                shape=shape,
                coords=coordinates(volume, chosen, (z, y, x)),
                attributes=volume.attrs,
            )
            paths = [
                str(path)
                for path in save_region(output, whole, frames(), force=force, sources=[run])
            ]
        within = [(part.start, part.stop) for part in (z, y, x)]
        result = {
            "paths": paths,
            "shape": shape,
            "dtype": kind.name,
            "steps": chosen,
            "region": within,
            **statistics.result(),
        }
        emit(result, table(_rows(result, volume.units)), as_json)


class Statistics:
    """Smallest, largest and mean value, and the share inside the coreset, of frames that are seen one at a time; NaN is left out."""

    def __init__(self) -> None:
        from fhash_codec.measure.value_range import Mean

        self.low, self.high, self.mean = float("inf"), float("-inf"), Mean()
        self.inside = self.all = 0

    def add(self, frame: npt.NDArray[Any], inside: int) -> None:
        """Take in a frame of any shape, `inside` of whose vertices belong to the coreset."""
        import numpy as np

        from fhash_codec.measure.value_range import pieces

        known = frame[~np.isnan(frame)]
        self.all += frame.size
        self.inside += inside
        if known.size:
            self.low, self.high = (
                min(self.low, float(known.min())),
                max(self.high, float(known.max())),
            )
        for piece in pieces(known):
            self.mean.add(piece)

    def result(self) -> dict[str, float | None]:
        """JSON values; None where no vertex has a value."""
        found = self.mean.count > 0
        return {
            "min": self.low if found else None,
            "max": self.high if found else None,
            "mean": self.mean.value() if found else None,
            "inside_fraction": self.inside / self.all,
        }


def convert(
    frame: npt.NDArray[np.floating[Any]], kind: np.dtype[Any], *, filled: bool = False
) -> npt.NDArray[Any]:
    """A decoded frame in another number type: rounded and clipped for integers; raises InputError where the type cannot hold a value.

    `filled`: vertices outside the coreset have the background's value, so that NaN is what the data had none for.
    """
    import numpy as np

    if kind == frame.dtype:
        return frame
    if kind.kind == "f":
        with np.errstate(over="ignore"):
            narrow = frame.astype(kind)
        if np.isinf(narrow).any():
            raise InputError(
                f"a value of {float(np.nanmax(np.abs(frame))):.6g} does not fit {kind}; choose a wider type"
            )
        return narrow
    if np.isnan(frame).any():
        if filled:
            raise InputError(
                f"the data have no value (NaN) at some vertices of the region, which {kind} cannot hold; take a float type"
            )
        raise InputError(
            f"the region holds vertices without a value (NaN), which {kind} cannot hold; add --outside background, or take a float type"
        )
    limits = np.iinfo(kind)
    rounded = np.rint(frame.astype(np.float64))
    # The largest 64-bit integers have no float64 of their own: the float of the limit lies one above it.
    full = rounded >= float(limits.max)
    whole = np.where(full, 0.0, np.maximum(rounded, float(limits.min))).astype(kind)
    whole[full] = limits.max
    return np.asarray(whole)


def _inside(
    volume: Volume,
    step: float,
    region: tuple[Span, Span, Span],
    frame: npt.NDArray[Any],
    outside: str,
) -> int:
    """How many vertices of a decoded frame belong to the coreset."""
    import numpy as np

    if outside == "nan":
        return frame.size - int(np.isnan(frame).sum())
    return int(volume.occupancy(step, region).sum())


def _rows(result: dict[str, Any], units: str) -> list[tuple[str, str]]:
    return [
        *(("written", path) for path in result["paths"]),
        ("steps", listed(apart(*result["steps"]))),
        ("region", spans(result["region"])),
        ("t, z, y, x", f"{extent(result['shape'])}, {result['dtype']}"),
        ("smallest", number(result["min"], units, digits=6)),
        ("largest", number(result["max"], units, digits=6)),
        ("mean", number(result["mean"], units, digits=6)),
        ("in the coreset", f"{result['inside_fraction']:.3%}"),
    ]
