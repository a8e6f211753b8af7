"""`fhash plan`: one plan of a series for all machines that encode parts of it."""

from __future__ import annotations

from typing import Any

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import (
    SourceOptions,
    check_writable,
    force_option,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, number, size, table
from fhash_cli.variables import config_of


@click.command("plan", cls=BaseCommand)
@click.argument("data", type=click.Path())
@click.option(
    "-o", "output", metavar="RUN.plan", required=True, type=click.Path(), help="Where to write."
)
@series_options
@setting_options()
@force_option
@json_option
@quiet_option
def command(
    data: str,
    output: str,
    source: SourceOptions,
    settings: dict[str, Any],
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Choose tiles and settings of DATA once, for `fhash encode DATA --part I/N --plan RUN.plan`.

    All steps are read once for their range, and some tiles for the choices. A part then reads its
    own steps alone, and takes its settings from the plan. RUN.plan is JSON; it is refused with
    other data, other settings and another version of fhash. Needs --max-error or --max-error-rel.
    """
    from fhash_codec.appending.series_plan import plan_parts

    # The reader says whether a folder is data at all; `plan_parts` keeps it from being replaced.
    check_writable(output, force, sources=[])
    with Progress(quiet=quiet) as progress, source.open(data, progress) as series:
        plan = plan_parts(series, output, config_of(settings), force=force, progress=progress)
        units = series.units
    low, high = plan.value_range.low, plan.value_range.high
    report: dict[str, Any] = {
        "path": output,
        "bytes": len(plan.to_bytes()),
        "shape": list(plan.shape),
        "tile": list(plan.recipe.tile),
        "layers": plan.layers,
        "value_range": [low, high],
    }
    rows = [
        ("written", output),
        ("size", size(report["bytes"])),
        ("steps, z, y, x", extent(plan.shape)),
        ("tiles", f"{extent(plan.recipe.tile)}; {plan.layers} layers, so at most as many parts"),
        ("values", f"{number(low, units)} to {number(high, units)}"),
    ]
    emit(report, table(rows), as_json)
