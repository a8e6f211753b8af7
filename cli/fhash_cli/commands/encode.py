"""`fhash encode`: a series in, a container out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import (
    SourceOptions,
    check_writable,
    config_options,
    force_option,
    json_option,
    quiet_option,
    series_options,
)
from fhash_cli.output import (
    Progress,
    compared,
    emit,
    extent,
    loss_rows,
    number,
    quality_rows,
    say,
    size,
    spans,
    table,
)
from fhash_formats.errors import QualityError

if TYPE_CHECKING:
    from fhash_codec.config import EncodeConfig

MAX_LABELS = 64
"""Range of integers up to which they may be labels."""


@click.command("encode")
@click.argument("data", type=click.Path())
@click.option(
    "-o", "output", metavar="RUN.fhz", required=True, type=click.Path(), help="Where to write."
)
@series_options
@config_options()
@force_option
@json_option
@quiet_option
def command(
    data: str,
    output: str,
    source: SourceOptions,
    config: EncodeConfig,
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Find the features of DATA, encode them and write them as RUN.fhz.

    DATA is a file of HDF5, NetCDF, numpy or raw values, a Zarr folder, or a pattern of such files
    in quotes ('step_*.raw'). With --profile paper Ctrl-C saves a checkpoint beside RUN.fhz; the
    same command resumes from it.
    """
    import fhash_codec

    # The reader says whether a folder is data at all; `encode` then keeps it from being replaced.
    check_writable(output, force, sources=[] if Path(data).is_dir() else [data])
    with source.open(data) as series, Progress(quiet=quiet) as progress:
        missed = None
        try:
            report = fhash_codec.encode(series, output, config, force=force, progress=progress)
        except QualityError as error:
            # The file is written, and its figures are a result all the same.
            missed, report = error, error.figures
    integers = (series.source_dtype or series.dtype).kind in "iu"
    if integers and not quiet and looks_categorical(report):
        say("few different integers: if they are labels, --max-error 0 keeps each exactly")
    emit(report, table(report_rows(report, series.units)), as_json)
    if missed is not None:
        raise missed


def looks_categorical(report: Mapping[str, Any]) -> bool:
    """Whether integers are so few that they may be labels, and some of them were changed."""
    return bool(report["data_range"] <= MAX_LABELS and report["max_abs_error"])


def report_rows(report: dict[str, Any], units: str) -> list[tuple[str, str]]:
    """An encoding's report as a table."""
    paper = report["profile"] == "paper"
    model = (
        f"{report['parameters']:,} parameters, {report['epochs']} epochs"
        if paper
        else f"{report['parameters']:,} numbers that are not zero"
    )
    return [
        ("written", str(report["path"])),
        ("size", compared(report)),
        *gain_rows(report),
        ("steps, z, y, x", extent(report["shape"])),
        *([("key frames", str(len(report["key_frames"])))] if paper else []),
        (
            "coreset",
            f"{report['coreset_fraction']:.3%} of the domain,"
            f" in {spans(report['feature_bounding_box'])}",
        ),
        *quality_rows(report, units),
        ("model", f"{model}, {report['profile']}"),
        *loss_rows(report),
        ("time", f"{number(report['seconds'], 's', digits=3)} on {report['device']}"),
    ]


def gain_rows(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The size after each stage of a compact encoding, and when the stage was done.

    All but the last are estimated from a sample.
    """
    last = len(report["gains"]) - 1
    return [
        (
            "  " + gain["what"],
            f"{'' if stage == last else 'about '}{size(gain['bytes'])}{_after(gain)}",
        )
        for stage, gain in enumerate(report["gains"])
    ]


def _after(gain: Mapping[str, Any]) -> str:
    return f" after {number(gain['seconds'], 's', digits=2)}" if "seconds" in gain else ""
