"""`fhash selftest`: encodes, decodes and draws hard cases, and checks what must hold."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fhash_cli.options import BaseCommand, check_writable, force_option, json_option, quiet_option
from fhash_cli.output import Progress, emit, table

if TYPE_CHECKING:
    from fhash_codec.selftest.run import Summary


@click.command(
    "selftest",
    cls=BaseCommand,
    epilog="fhash selftest\nfhash selftest --group rays --report rays.md",
)
@click.option(
    "--all",
    "everything",
    is_flag=True,
    help="All cases under all settings: minutes instead of seconds.",
)
@click.option("--case", "names", metavar="NAME", multiple=True, help="Run this case; repeat.")
@click.option(
    "--group", "groups", metavar="NAME", multiple=True, help="Run the cases of this group; repeat."
)
@click.option(
    "--report",
    metavar="FILE.md",
    type=click.Path(),
    help="Write every case and its worst figure as Markdown.",
)
@click.option(
    "--processes",
    metavar="N",
    type=click.IntRange(1, 1024),
    help="Cases at the same time. Default: one for each processor.",
)
@force_option
@json_option
@quiet_option
@click.pass_context
def command(
    context: click.Context,
    everything: bool,
    names: tuple[str, ...],
    groups: tuple[str, ...],
    report: str | None,
    processes: int | None,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Encode, decode and draw data on which codecs break; exit code 1 if anything does not hold.

    Constant, infinite and missing values, extremes of every number type, thin and tiny shapes,
    steep fronts, features at the borders, strange times: each must keep its bounds, promises and
    bytes.
    What does not hold is listed with its figures.
    """
    if report is not None:
        check_writable(report, force)
    from fhash_codec.selftest.run import choose_cases, run_cases

    begun = time.perf_counter()
    cases = choose_cases(names=names, groups=groups, everything=everything)
    with Progress(quiet=quiet) as progress:
        summary = run_cases(cases, everything=everything, processes=processes, progress=progress)
    if report is not None:
        from fhash_codec.devices import choose_device, has_torch, machine
        from fhash_codec.selftest.run import markdown
        from fhash_formats.support.files import replacing

        given = "".join(
            [
                " --all" * everything,
                *(f" --case {name}" for name in names),
                *(f" --group {name}" for name in groups),
            ]
        )
        minutes = (time.perf_counter() - begun) / 60
        facts = machine(choose_device("auto") if has_torch() else None).items()
        where = f"It took {minutes:.1f} minutes: {', '.join(f'{a} {b}' for a, b in facts)}."
        with replacing(Path(report), force=force) as temporary:
            temporary.write_text(markdown(summary, options=given, where=where), encoding="utf-8")
    emit(summary.to_dict(), _text(summary), as_json)
    context.exit(0 if summary.holds else 1)


def _text(summary: Summary) -> str:
    """A table of the groups, the worst figures, and what does not hold."""
    from fhash_codec.selftest.run import relative

    groups = [("group", "cases", "figures", "failed")]
    for name, results in summary.groups.items():
        failed = sum(not result.holds for result in results)
        groups.append(
            (
                name,
                str(len(results)),
                str(sum(len(result.findings) for result in results)),
                str(failed),
            )
        )
    figures = [("property", "worst", "limit", "case")]
    for name, (result, finding) in summary.worst().items():
        if relative(finding) > 0:
            figures.append(
                (name, f"{finding.worst:.6g} {finding.unit}", f"{finding.limit:.6g}", result.name)
            )
    failures = summary.failures
    last = (
        ["everything holds"]
        if summary.holds
        else [f"what does not hold ({len(failures)}):", *failures]
    )
    return "\n".join(
        [table(groups), "", *([table(figures), ""] if len(figures) > 1 else []), *last]
    )
