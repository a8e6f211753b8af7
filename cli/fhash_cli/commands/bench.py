"""`fhash bench`: measures speed and size on this machine, beside other codecs and engines."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import click

from fhash_cli.base_command import BaseGroup
from fhash_cli.commands.bench_ablate import ablate
from fhash_cli.commands.bench_labels import labels
from fhash_cli.commands.bench_paper import paper
from fhash_cli.commands.bench_rate import rate
from fhash_cli.commands.bench_render import render
from fhash_cli.commands.bench_table import rate_table
from fhash_cli.options import (
    RealRange,
    SourceOptions,
    config_options,
    json_option,
    quiet_option,
    series_options,
)
from fhash_cli.output import Progress, emit, number, table

if TYPE_CHECKING:
    from fhash_codec.config import EncodeConfig


class EnginesType(click.ParamType[tuple[str, ...]]):
    """Names of engines, separated by commas."""

    name = "A,B"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """The names; refuses one that is unknown."""
        from fhash_codec.config import ENGINES

        names = tuple(name.strip() for name in str(value).split(","))
        for name in names:
            if name not in ENGINES:
                self.fail(
                    f"'{name}' is no engine; allowed, separated by commas: {', '.join(ENGINES)}",
                    param,
                    ctx,
                )
        return names


@click.group("bench", cls=BaseGroup, short_help="measure speed and size on this machine")
def command() -> None:
    """Measure speed and size on this machine."""


command.add_command(ablate)
command.add_command(labels)
command.add_command(paper)
command.add_command(rate)
command.add_command(render)
command.add_command(rate_table)


@command.command("train", short_help="training and inference speed of each engine")
@click.argument("data", type=click.Path(), required=False)
@series_options
@click.option("--engines", type=EnginesType(), help="Which to measure. Default: all of the device.")
@click.option(
    "--seconds",
    type=RealRange(0.1, 3600),
    default=12.0,
    show_default=True,
    metavar="X",
    help="Training of each engine.",
)
@config_options(
    "features",
    "dilation",
    "key_frames",
    "embedding_size",
    "hidden_layers",
    "width",
    "learning_rate",
    "batch",
    "device",
    "seed",
    profile="paper",
)
@json_option
@quiet_option
def train(
    data: str | None,
    source: SourceOptions,
    engines: tuple[str, ...] | None,
    seconds: float,
    config: EncodeConfig,
    as_json: bool,
    quiet: bool,
) -> None:
    """Train the model of DATA with each engine in turns; speeds in million samples a second.

    With a feature, the whole DATA is measured too: bricks around a feature are partly empty.
    Without DATA: a made series, a blast's shell as a feature, and whole. "of peak" is the
    arithmetic of the network over the rate of a large matrix product, measured in the same run.
    """
    from fhash_codec.training.devices import need_torch

    need_torch("bench train")
    if data is None:
        source.refuse_without_data()
    with Progress(quiet=quiet) as progress, ExitStack() as stack:
        from fhash_codec.bench.train import bench_train

        series = None if data is None else stack.enter_context(source.open(data, progress))
        result = bench_train(series, config, engines=engines, seconds=seconds, progress=progress)
    emit(result, _text(result), as_json)


def _text(result: dict[str, Any]) -> str:
    """A row of figures for each engine on each series, how full bricks are, and the machine."""
    header = (
        "features",
        "engine",
        "train M/s",
        "x naive",
        "infer M/s",
        "x naive",
        "of peak",
        "epochs",
        "PSNR dB",
    )
    figures = (
        "train_msamples_s",
        "train_ratio",
        "infer_msamples_s",
        "infer_ratio",
        "fraction_of_peak",
        "epochs",
        "psnr",
    )
    rows = [
        (
            ", ".join(entry["features"]),
            run["engine"],
            *(number(run[name], digits=3) for name in figures),
        )
        for entry in result["series"]
        for run in entry["engines"]
    ]
    facts = {
        name.replace("_", " "): number(fact) if isinstance(fact, float) else fact
        for name, fact in result["machine"].items()
    }
    lines = [
        f"{', '.join(entry['features'])}: {entry['samples']:,} samples in bricks"
        f" {entry['brick_fill']:.0%} full; decoding"
        f" {number(entry['decode_msamples_s'], digits=3)} M/s,"
        f" {number(entry['decode_ratio'], digits=3)} times as fast as by whole blocks"
        for entry in result["series"]
    ]
    machine = ", ".join(f"{name} {fact}" for name, fact in facts.items())
    return "\n".join([table([header, *rows]), *lines, machine])
