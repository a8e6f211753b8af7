"""The command `fhash bench paper`: options, and results as text."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import click

from fhash_bench.commands import one_of
from fhash_cli.options import BaseCommand, SourceOptions, json_option, quiet_option, series_options
from fhash_cli.output import Progress, emit, extent, table

if TYPE_CHECKING:
    from fhash_bench.paper.bench import BenchPlan, PaperBench
    from fhash_bench.paper.files import FileResult
    from fhash_bench.paper.printed import PaperTable, TableReport
    from fhash_formats.series import Series


def _names(constant: str) -> Callable[[], tuple[str, ...]]:
    """The names in a constant of the bench."""

    def names() -> tuple[str, ...]:
        from fhash_bench.paper import data

        return tuple(getattr(data, constant))

    return names


@click.command(
    "paper",
    cls=BaseCommand,
    short_help="the paper's encodings, trained side by side",
    epilog="fhash bench paper --quick",
)
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option(
    "--quick",
    is_flag=True,
    help="An eighth of the paper's lengths, segmentation, one seed.",
)
@click.option(
    "--scale",
    type=one_of("scale", _names("SCALES")),
    metavar="NAME",
    help="Of the scenes: full, half, quarter or eighth of the paper's lengths. Default: full.",
)
@click.option(
    "--protocol",
    "protocols",
    type=one_of("protocol", _names("PROTOCOLS")),
    metavar="NAME",
    multiple=True,
    help="published, released, equal or best; repeat. Default: all.",
)
@click.option(
    "--data-set",
    "data_sets",
    type=one_of("data set", _names("SETS")),
    metavar="NAME",
    multiple=True,
    help="flame, bubble or shell; repeat. Default: all.",
)
@click.option(
    "--encoding",
    "encodings",
    type=one_of("encoding", _names("ENCODINGS")),
    metavar="NAME",
    multiple=True,
    help="dense, dense-multi, hash, tcnn or fhash; repeat. Default: all.",
)
@click.option(
    "--feature",
    "features",
    metavar="F",
    multiple=True,
    help="interval, isosurface or segmentation of the scenes, or as fhash encode takes it; repeat."
    " Default: all three; segmentation of DATA.",
)
@click.option(
    "--key-frames",
    metavar="K",
    help="As fhash encode takes it. Default: as many as the paper has, by auto:N.",
)
@click.option(
    "--epochs", type=click.IntRange(1, 10000), metavar="N", help="Of each training. Default: 60."
)
@click.option(
    "--seeds", type=click.IntRange(1, 100), metavar="N", help="Trainings of each cell. Default: 3."
)
@click.option(
    "--latency/--no-latency",
    default=True,
    show_default=True,
    help="Time pictures straight through the encodings of the protocol published.",
)
@click.option(
    "--files/--no-files",
    default=True,
    show_default=True,
    help="Encode each data set at 45 dB over all steps, by fhash and by the codecs of bench rate.",
)
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    show_default=True,
    help="Where to train.",
)
@click.option(
    "--parameters",
    is_flag=True,
    help="Only print the numbers of parameters at the paper's configurations.",
)
@click.option(
    "-o",
    "folder",
    metavar="DIR",
    type=click.Path(file_okay=False),
    default="bench-paper",
    show_default=True,
    help="Folder of the cells, one JSON file each; finished cells are not run again.",
)
@json_option
@quiet_option
def paper(
    data: str | None,
    source: SourceOptions,
    parameters: bool,
    files: bool,
    folder: str,
    as_json: bool,
    quiet: bool,
    **choices: Any,
) -> None:
    """Train the input encodings of the F-Hash paper's evaluation side by side.

    Without DATA: the scenes flame, bubble and shell, which resemble the paper's data sets. Each
    encoding is trained by each protocol: published as the paper does, released as the authors'
    code does (F-Hash alone), equal with the same samples, steps and network, best with the fastest
    engine and number of steps of each. An interrupted bench goes on where it was. The tables are
    those of the paper, its own figures beside ours, marked as quoted.
    """
    if parameters:
        emit(*_parameters(), as_json)
        return
    from fhash_codec.devices import need_torch

    need_torch("bench paper")
    if data is None:
        source.refuse_without_data()
    with Progress(quiet=quiet) as progress, ExitStack() as stack:
        from fhash_bench.paper.bench import bench_paper

        plan = _plan(data is None, **choices)
        series = None if data is None else stack.enter_context(source.open(data, progress))
        name = "data" if data is None else Path(data).name
        result = bench_paper(plan, Path(folder), series, name=name, progress=progress)
        from fhash_bench.paper.report import tables_of, write_report

        encoded, refused = (
            _files(result, plan, series, Path(folder), quick=choices["quick"], progress=progress)
            if files
            else ([], [])
        )
        tables = tables_of(result.cells, encoded, refused)
        written, missing = write_report(result.cells, tables, Path(folder))
    result = replace(result, notes=(*result.notes, *missing))
    report: PaperReport = {
        "cells": [cell.to_dict() for cell in result.cells],
        "tables": [entry.to_dict() for entry in tables],
        "notes": list(result.notes),
        "files": [str(path) for path in written],
    }
    emit(report, _text(result, tables, written), as_json)


def _files(
    result: PaperBench,
    plan: BenchPlan,
    series: Series | None,
    folder: Path,
    *,
    quick: bool,
    progress: Progress,
) -> tuple[list[FileResult], list[str]]:
    """Files at a quality of the bench's data sets, and lines for those that were not made."""
    from fhash_bench.paper.data import simulated
    from fhash_bench.paper.files import NUMBER_TYPES, files_of

    def series_of(name: str) -> Series:
        return simulated(name, plan.scale) if series is None else series

    number_types = ("float16",) if quick else NUMBER_TYPES
    found, refused = files_of(
        result.cells, series_of, folder, number_types=number_types, progress=progress
    )
    left_out = ["--quick leaves F-Hash with float32 tables out, which trains once more"]
    return found, [*refused, *(left_out if quick and found else [])]


def _plan(scenes: bool, *, quick: bool, **choices: Any) -> BenchPlan:
    """The plan of the options; those that were not given keep the plan's own values."""
    from fhash_bench.paper.bench import BenchPlan

    given = {name: value for name, value in choices.items() if value not in (None, ())}
    if not scenes:
        given.setdefault("features", ("segmentation",))
    return BenchPlan.quick(**given) if quick else BenchPlan(**given)


class Parameters(TypedDict):
    """Sizes of the models at the paper's configurations."""

    parameters: Annotated[dict[str, dict[str, int]], "numbers by data set and encoding"]


class PaperReport(TypedDict):
    """The paper's tables, quoted figures beside ours."""

    cells: Annotated[list[dict[str, Any]], "each training, as in its file"]
    tables: Annotated[list[TableReport], "the tables, and the paper's claims"]
    notes: Annotated[list[str], "what was not measured, and why"]
    files: Annotated[list[str], "tables and curves that were written"]


def _parameters() -> tuple[Parameters, str]:
    """Numbers of parameters at the paper's configurations, and their table."""
    from fhash_bench.paper.data import ENCODINGS, SETS, paper_parameters

    counts = {name: paper_parameters(name) for name in SETS}
    rows: list[tuple[str, ...]] = [("parameters", *ENCODINGS)]
    rows += [
        (SETS[name].title, *(f"{counts[name][encoding]:,}" for encoding in ENCODINGS))
        for name in SETS
    ]
    note = "tcnn with its networks, the others their tables; fhash for the segmentation"
    return {"parameters": counts}, f"{table(rows)}\n{note}"


def _text(result: PaperBench, tables: Sequence[PaperTable], files: Sequence[Path]) -> str:
    """The tables, how the cells were measured, and what was left out or written."""
    lines: list[str] = []
    told: set[str] = set()
    for entry in tables:
        body = _claims(entry) if entry.name == "claims" else table(entry.lines())
        notes = [f"- {note}" for note in entry.notes if note not in told]
        told.update(entry.notes)
        lines += [entry.title, body, *notes, ""]
    if result.cells:
        cell = result.cells[-1]
        facts = ", ".join(f"{name} {fact}" for name, fact in cell.machine.items())
        lines.append(f"{len(result.cells)} cells, such as {extent(cell.shape)}; {facts}")
    return "\n".join([*lines, *result.notes, *(f"wrote {path}" for path in files)])


def _claims(entry: PaperTable) -> str:
    """Claims with their verdicts, each in two lines: the figures are too long for a table."""
    lines = []
    for claim, protocol, verdict, figures in entry.lines()[1:]:
        where = f" [{protocol}]" if protocol not in ("all", "files", "-") else ""
        lines += [f"{verdict.upper()}: {claim}{where}", f"    {figures}"]
    return "\n".join(lines)
