"""The group `fhash bench`: measures speed and size on this machine, beside others."""

from __future__ import annotations

import click

from fhash_bench.commands.mine import mine
from fhash_bench.commands.paper import paper
from fhash_bench.commands.rate import kinds, labels, rate, rate_table
from fhash_bench.commands.render import render
from fhash_bench.commands.train import ablate, train
from fhash_cli.options import BaseGroup


@click.group("bench", cls=BaseGroup, short_help="measure speed and size on this machine")
def command() -> None:
    """Measure speed and size on this machine."""


for _bench in (ablate, kinds, labels, mine, paper, rate, render, rate_table, train):
    command.add_command(_bench)
