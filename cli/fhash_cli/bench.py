"""`fhash bench`: how fast this machine is, with what it was measured on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from fhash_cli.options import RealRange, SourceOptions, config_options, json_option, quiet_option, series_options
from fhash_cli.output import Progress, emit, number, table

if TYPE_CHECKING:
    from fhash_codec.config import EncodeConfig


class EnginesType(click.ParamType[tuple[str, ...]]):
    """Names of engines, separated by commas."""

    name = "A,B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """The names; refuses one that is unknown."""
        from fhash_codec.config import ENGINES

        names = tuple(name.strip() for name in str(value).split(","))
        for name in names:
            if name not in ENGINES:
                self.fail(f"'{name}' is no engine; allowed, separated by commas: {', '.join(ENGINES)}", param, ctx)
        return names


@click.group("bench", short_help="measure speed on this machine")
def command() -> None:
    """Measure speed on this machine."""


@command.command("train", short_help="training and inference speed of each engine")
@click.argument("data", type=click.Path())
@series_options
@click.option("--engines", type=EnginesType(), help="Which to measure. Default: all there are.")
@click.option("--seconds", type=RealRange(0.1, 3600), default=12.0, show_default=True, metavar="X", help="Training of each engine.")
@config_options(
    "features", "dilation", "key_frames", "embedding_size", "hidden_layers", "width", "learning_rate", "batch", "device", "seed"
)
@json_option
@quiet_option
def train(
    data: str, source: SourceOptions, engines: tuple[str, ...] | None, seconds: float, config: EncodeConfig, as_json: bool, quiet: bool
) -> None:
    """Train the model of DATA with each engine for a while, in turns; speeds in million samples a second.

    "of peak" is the arithmetic of the network over the rate of a large matrix product measured in the same run.
    """
    from fhash_codec.config import ENGINES

    with source.open(data) as series, Progress(quiet=quiet) as progress:
        from fhash_codec.bench.train import bench_train

        result = bench_train(series, config, engines=engines or ENGINES, seconds=seconds, progress=progress)
    emit(result, _text(result), as_json)


def _text(result: dict[str, Any]) -> str:
    """A row of figures for each engine, and what they were taken on."""
    header = ("engine", "train M/s", "x naive", "infer M/s", "x naive", "of peak", "epochs", "PSNR dB")
    figures = ("train_msamples_s", "train_ratio", "infer_msamples_s", "infer_ratio", "fraction_of_peak", "epochs", "psnr")
    rows = [(entry["engine"], *(number(entry[name], digits=3) for name in figures)) for entry in result["engines"]]
    facts = {name.replace("_", " "): number(fact) if isinstance(fact, float) else fact for name, fact in result["machine"].items()}
    machine = ", ".join(f"{name} {fact}" for name, fact in facts.items())
    return f"{table([header, *rows])}\n{result['samples']:,} samples; {machine}"
