"""The command `fhash bench mine`: options, and results as text."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import click

from fhash_bench.commands import check_plot, save_plot
from fhash_bench.commands.rate import PEER, Peer, filters_of, opened, programs_of
from fhash_cli.options import (
    DURATION,
    BaseCommand,
    RealRange,
    SourceOptions,
    force_option,
    json_option,
    quiet_option,
    series_options,
    setting_options,
)
from fhash_cli.output import Progress, emit, extent, table
from fhash_formats.errors import InputError

if TYPE_CHECKING:
    from fhash_bench.rate.mine import MineBench


@click.command(
    "mine",
    cls=BaseCommand,
    short_help="gradients, spectra, extrema and isosurfaces of DATA beside other codecs",
    epilog="fhash bench mine demo/vortex.h5 --psnr 50",
)
@click.argument("data", type=click.Path())
@click.option(
    "-o",
    "output",
    metavar="FILE.html",
    type=click.Path(dir_okay=False),
    help="The page, one file.  [default: DATA.mine.html here]",
)
@series_options
@click.option(
    "--psnr",
    type=RealRange(5, 200),
    default=50.0,
    show_default=True,
    help="PSNR in dB that fhash is encoded for.",
)
@click.option(
    "--isovalue",
    type=float,
    help="Value of the isosurface.  [default: the middle of the bulk of the middle step]",
)
@click.option(
    "--peer",
    "peers",
    type=PEER,
    multiple=True,
    help="SPERR, SZ3 or ZFP, or besides, as NAME=PATH, a program as for bench rate; repeat."
    " Default: all three.",
)
@click.option(
    "--budget",
    type=DURATION,
    default="2m",
    show_default=True,
    help="Approximate time; larger DATA are cropped, which the page says.",
)
@setting_options("psnr_bulk", "effort", "tile")
@force_option
@json_option
@quiet_option
def mine(
    data: str,
    output: str | None,
    source: SourceOptions,
    psnr: float,
    isovalue: float | None,
    peers: tuple[Peer, ...],
    budget: float,
    settings: dict[str, Any],
    force: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare what codecs keep of DATA, at equal PSNR and at equal bytes, beside fhash.

    Errors of gradients, spectra, extrema and isosurfaces, seams of tiles, bytes and seconds, with
    every loss of fhash marked. SPERR, SZ3 and ZFP come with pip install 'fhash[bench]'. DATA may
    also be generated:KIND, as for bench rate.
    """
    page = output if output is not None else Path(data).stem + ".mine.html"
    check_plot(page, force, [data])
    with Progress(quiet=quiet) as progress:
        from fhash_bench.rate.mine import FILTERS, Wish, bench_mine
        from fhash_bench.rate.mine_page import write_page

        names = filters_of(peers, FILTERS)
        for name in names:
            if name not in FILTERS:
                raise InputError(f"{name} has no quality to set; allowed: {', '.join(FILTERS)}")
        with opened(data, source, progress) as series:
            wish = Wish(
                psnr=psnr,
                isovalue=isovalue,
                settings=settings,
                names=names,
                named=programs_of(peers),
                budget=budget,
            )
            result, shown = bench_mine(series, wish, progress)
    save_plot(page, force, partial(write_page, result, shown))
    written: PageFile = {"path": page}
    emit({**written, **result.to_dict()}, _text(result, page), as_json)


class PageFile(TypedDict):
    """File of the page."""

    path: Annotated[str, "of the page"]


def _text(result: MineBench, page: str) -> str:
    """Both tables with the losses of fhash, what was measured, and where the page is."""
    from fhash_bench.rate.mine import GOALS
    from fhash_bench.rate.mine_page import conclusion, figures

    return "\n".join(
        [
            *(table(figures(result, goal)) + "\n" for goal in GOALS),
            conclusion(result),
            f"{result.series}, {result.dtype} {extent(result.shape)}, {result.measured}",
            *(f"not measured: {name}: {why}" for name, why in result.refused.items()),
            f"page: {page}",
        ]
    )
