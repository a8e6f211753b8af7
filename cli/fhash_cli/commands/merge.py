"""`fhash merge`: the parts of a series, encoded on several machines, become one container."""

from __future__ import annotations

import click

from fhash_cli.base_command import BaseCommand
from fhash_cli.options import force_option, json_option, quiet_option
from fhash_cli.output import Progress, emit, number, size, table


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
