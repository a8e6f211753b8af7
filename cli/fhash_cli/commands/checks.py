"""`fhash verify` and `fhash diff`: a container against its checksums, and against its data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

import click

from fhash_cli.options import (
    BaseCommand,
    RealRange,
    SourceOptions,
    json_option,
    quiet_option,
    run_argument,
    series_options,
    variable_option,
)
from fhash_cli.output import (
    Progress,
    compared,
    emit,
    extent,
    number,
    one_line,
    quality_rows,
    say,
    table,
)
from fhash_formats.errors import QualityError

if TYPE_CHECKING:
    from fhash_codec.comparison import Compared


class Verified(TypedDict):
    """A file that was read whole."""

    path: Annotated[str, "the file"]
    sound: Annotated[Literal[True], "a damaged file is an error"]
    arrays: Annotated[int, "number of arrays that were read and checked"]


@click.command("verify", cls=BaseCommand, epilog="fhash verify run.fhz")
@run_argument
@variable_option
@json_option
@quiet_option
def verify_command(run: str, variable: str | None, as_json: bool, quiet: bool) -> None:
    """Read and check every part of RUN.fhz; exit code 4 if it is damaged."""
    import fhash_codec

    with fhash_codec.open(run, variable=variable) as volume, Progress(quiet=quiet) as progress:
        arrays = volume.verify(progress=progress)
    result: Verified = {"path": run, "sound": True, "arrays": arrays}
    emit(result, f"{one_line(run)}: sound, {arrays} arrays checked", as_json)


@click.command(
    "diff",
    cls=BaseCommand,
    epilog="fhash diff demo/vortex.h5 run.fhz --max-error 0.01\n"
    "fhash encode demo/vortex.h5 -o quick.fhz --effort 1\n"
    "fhash diff quick.fhz run.fhz",
)
@click.argument("data", metavar="DATA|OTHER.fhz", type=click.Path())
@run_argument
@series_options
@click.option(
    "--min-psnr",
    metavar="DB",
    type=RealRange(0),
    help="Exit code 3 if the PSNR in the coreset is below this.",
)
@click.option(
    "--max-error",
    metavar="E",
    type=RealRange(0),
    help="Exit code 3 if the largest error in the coreset is above this.",
)
@json_option
@quiet_option
def diff_command(
    data: str,
    run: str,
    source: SourceOptions,
    min_psnr: float | None,
    max_error: float | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare RUN.fhz with the DATA it was made from, or with OTHER.fhz, over all steps.

    Where DATA has several variables, it is the one that RUN.fhz has the name of; where RUN.fhz has
    several, --var chooses one of both. Other differences than of values, such as of units or
    positions, are told on stderr.
    """
    import fhash_codec
    from fhash_codec.volume import open as open_volume

    encoded = data.endswith(".fhz")
    if encoded and not run.endswith(".fhz"):
        raise click.UsageError(f"the data come first: fhash diff {run} {data}")
    variable = _variable_of(run, source)
    with Progress(quiet=quiet) as progress, ExitStack() as stack:
        if encoded:
            dataclasses.replace(source, var=None).refuse(data)
            series = stack.enter_context(open_volume(data, variable=variable))
        else:
            series = stack.enter_context(_open(source, data, run, progress))
        report = fhash_codec.diff(series, run, variable=variable, progress=progress)
        fill = None
        if not encoded and not source.missing and series.fill is None:
            fill = _missing_of(run, variable)
    if fill is not None and not quiet:
        say(f"{run} was encoded with --missing {fill:.9g}; add it here, or it counts as a value")
    for line in report["differences"]:
        say(f"{data}: {line}")
    rows = [
        ("size", compared(report, part=source.part)),
        ("steps, z, y, x", extent(report["shape"])),
        *quality_rows(report, series.units),
    ]
    emit(report, table(rows), as_json, _missed_gate(run, report, min_psnr, max_error))


def _open(
    source: SourceOptions, data: str, run: str, progress: Callable[[str, int, int, str], None]
) -> Any:
    """The series of the data: of several variables, the one that the container has the name of."""
    from fhash_codec.volume import open as open_volume
    from fhash_formats.readers.variables import SeveralVariablesError
    from fhash_formats.series import meant

    try:
        return source.open(data, progress)
    except SeveralVariablesError as error:
        with open_volume(run) as volume:
            name = volume.name
        alike = meant(name, error.names)
        if len(alike) != 1:
            raise
        return dataclasses.replace(source, var=alike[0]).open(data, progress)


def _variable_of(run: str, source: SourceOptions) -> str | None:
    """The variable of a container of several that is compared; None where it has one.

    Raises InputError where it has several and `--var` names none of them.
    """
    from fhash_codec.volume import open as open_volume
    from fhash_formats.container import Container

    with Container.open(run) as container:
        if not container.variables:
            return None
        # A component of a vector: --var velocity --select component=0 is velocity_0.
        components = [f"{source.var}_{index}" for _, index in source.select]
        for name in (source.var, *components):
            if name in container.variables:
                return name
    with open_volume(run, variable=source.var) as volume:
        return volume.variable


def _missing_of(run: str, variable: str | None) -> float | None:
    """The number that stood for a missing value in the source of a container, if any."""
    from fhash_codec.volume import open as open_volume

    with open_volume(run, variable=variable) as volume:
        return volume.value_type.fill


def _missed_gate(
    run: str, report: Compared, min_psnr: float | None, max_error: float | None
) -> QualityError | None:
    """The error of the first gate that the figures miss; None if they miss none.

    Where nothing differs no PSNR is defined, and any gate is met. Where the data are constant, or
    nothing can be compared, none is defined either, and no gate is met.
    """
    if (
        min_psnr is not None
        and report["rmse"] != 0
        and not (report["psnr"] is not None and report["psnr"] >= min_psnr)
    ):
        reached = (
            "no PSNR is defined"
            if report["psnr"] is None
            else f"PSNR {number(report['psnr'], 'dB')}"
        )
        return QualityError(
            f"{run}: {reached} in the coreset; at least {min_psnr:g} dB was asked for"
        )
    worst = report["max_abs_error"]
    if max_error is not None and not (worst is not None and worst <= max_error):
        largest = "no value can be compared" if worst is None else f"largest error {worst:.6g}"
        return QualityError(f"{run}: {largest} in the coreset; at most {max_error:g} was asked for")
    return None
