"""`fhash merge`: the parts of a series, encoded on several machines, become one container."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import click
from click.core import ParameterSource

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import force_option, json_option, quiet_option
from fhash_cli.output import Progress, emit, number, size, table

if TYPE_CHECKING:
    from fhash_codec.config import EncodeConfig
    from fhash_formats.series import Series


@click.command("merge", cls=BaseCommand)
@click.argument("parts", metavar="PART.fhz...", nargs=-1, required=True, type=click.Path())
@click.option(
    "-o", "output", metavar="RUN.fhz", required=True, type=click.Path(), help="Where to write."
)
@force_option
@json_option
@quiet_option
def command(parts: tuple[str, ...], output: str, force: bool, as_json: bool, quiet: bool) -> None:
    """Join the files that `fhash encode --part 1/N` to `N/N` wrote, in any order, to RUN.fhz.

    Tiles are copied and their checksums checked; nothing is coded again. Parts that are missing,
    given twice or of another encoding are refused. RUN.fhz is, byte for byte, what one `fhash
    encode` with the same settings and --no-timings writes.
    """
    from fhash_codec.appending.merging import merge

    with Progress(quiet=quiet) as progress:
        report = merge(parts, output, force=force, progress=progress)
    rows = [
        ("written", output),
        ("size", size(report["bytes"])),
        ("steps", f"{report['steps']}, of {report['parts']} parts with {report['tiles']} tiles"),
        ("largest error", number(report["max_abs_error"])),
    ]
    emit(report, table(rows), as_json)


class WishedPart(NamedTuple):
    """The part that a command line names, such as "3/16", and its plan; None to make one."""

    text: str
    plan: str | None

    @classmethod
    def of(cls, text: str | None, plan: str | None, *, with_others: bool) -> WishedPart | None:
        """The part that two options name; None for all of the series.

        with_others: whether there are options that need all of it.
        """
        if text is None and plan is not None:
            raise click.UsageError("--plan goes with --part")
        if text is not None and with_others:
            raise click.UsageError("--part goes without --explain, --time-budget and --report")
        return None if text is None else cls(text, plan)


def encode_all_or_part(
    series: Series,
    output: str,
    config: EncodeConfig,
    part: WishedPart | None,
    force: bool,
    progress: Progress,
    predicted: dict[str, Any] | None,
) -> dict[str, Any]:
    """Encode a series, or one part of it; the report, with its stages."""
    import fhash_codec
    from fhash_codec.appending.parts import Part, encode_part
    from fhash_codec.appending.series_plan import SeriesPlan

    if part is None:
        return fhash_codec.encode(
            series, output, config, force=force, progress=progress, predicted=predicted
        )
    one, plan = Part.parse(part.text), None
    if part.plan is not None:
        plan = SeriesPlan.read(part.plan)
        plan.require_settings(_given(config))
    report = encode_part(
        series,
        output,
        config if plan is None else None,
        one,
        plan=plan,
        force=force,
        progress=progress,
    )
    return {**report, "stages": []}


def _given(config: EncodeConfig) -> dict[str, Any]:
    """The settings that the command line names, by name."""
    default, context = ParameterSource.DEFAULT, click.get_current_context()
    return {
        name: value
        for name, value in vars(config).items()
        if context.get_parameter_source(name) not in (None, default)
    }
