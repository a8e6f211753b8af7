"""`fhash bench`: measures speed and size on this machine, beside other codecs and engines."""

from __future__ import annotations

import click

from fhash_cli.commands.bench_ablate import ablate
from fhash_cli.commands.bench_labels import labels
from fhash_cli.commands.bench_paper import paper
from fhash_cli.commands.bench_rate import rate
from fhash_cli.commands.bench_render import render
from fhash_cli.commands.bench_table import rate_table
from fhash_cli.commands.bench_train import train
from fhash_cli.options import BaseGroup


@click.group("bench", cls=BaseGroup, short_help="measure speed and size on this machine")
def command() -> None:
    """Measure speed and size on this machine."""


for _bench in (ablate, labels, paper, rate, render, rate_table, train):
    command.add_command(_bench)
