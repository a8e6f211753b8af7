"""The report on one encoding that was just done: stages, quality, reads and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.allowance import Allowance
from fhash_codec.cost.cost import measure_uses, report_on
from fhash_codec.cost.facts import facts_of
from fhash_codec.cost.own import KeptFile, encoded_of
from fhash_codec.cost.plan import Wish
from fhash_codec.cost.results import CostReport, Curve, Encoded, Gain, Picture, Read, Stage
from fhash_codec.progress import Progress, silent
from fhash_formats.series import Series

__all__ = ["USE_BUDGET", "report_on_encode"]

USE_BUDGET = 40.0
"""Seconds for reads and pictures of an encoding that was just done."""


def report_on_encode(
    series: Series,
    figures: Mapping[str, Any],
    config: EncodeConfig,
    *,
    missed: bool = False,
    budget: float = USE_BUDGET,
    progress: Progress = silent,
) -> CostReport:
    """The report on a container that `encode` wrote.

    Args:
        series: what was encoded.
        figures: what `encode` returned.
        config: its settings.
        missed: whether it missed its promise.
        budget: seconds for reads and pictures.
        progress: called with each step of the work.
    """
    wish = Wish(codec=config.profile, group="this encoding", config=config)
    point = encoded_of(
        figures,
        Encoded(
            name=Path(figures["path"]).name,
            codec=config.profile,
            group="this encoding",
            options=wish.options,
        ),
        missed=missed,
    )
    file = KeptFile(name=point.name, path=Path(figures["path"]), psnr=point.psnr)
    allowance = Allowance(budget)
    facts = facts_of(series, progress)
    reads: list[Read] = []
    pictures: list[Picture] = []
    try:
        measure_uses(series, facts, [file], allowance, progress, reads, pictures)
    except KeyboardInterrupt:
        allowance.interrupted = True
    course = Curve(name=point.name, points=tuple(figures["curve"]))
    report = report_on(
        series,
        series,
        facts,
        allowance,
        encodings=(point,),
        curves=tuple(curve for curve in (course,) if curve.points),
        stages=tuple(
            Stage(**{name: entry[name] for name in ("stage", "seconds", "times", "why")})
            for entry in figures["stages"]
        ),
        gains=tuple(
            Gain(what=gain["what"], bytes=gain["bytes"], seconds=gain.get("seconds"))
            for gain in figures["gains"]
        ),
        per_step=tuple(figures["quality"]["per_step"]),
        reads=tuple(reads),
        pictures=tuple(pictures),
    )
    seconds = figures["seconds"]
    return replace(report, seconds=report.seconds + seconds, budget_seconds=budget + seconds)
