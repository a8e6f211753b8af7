"""Seconds and bytes of encoding, reading and drawing against accuracy: `fhash cost`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.encodings import ONE_SHARE, KeptFile, OwnEncodings, encoded_of
from fhash_codec.cost.peers import PeerEncodings
from fhash_codec.cost.plan import (
    PEERS,
    Allowance,
    Facts,
    Wish,
    cropped,
    described,
    facts_of,
    wishes,
)
from fhash_codec.cost.prediction import predictor
from fhash_codec.cost.results import CostReport, Curve, Encoded, Gain, Picture, Read, Stage, advise
from fhash_codec.cost.uses import PictureCosts, measure_reads
from fhash_codec.devices import machine
from fhash_codec.features.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError
from fhash_formats.series import Series

BUDGET = 120.0
"""Seconds that are spent by default."""
ENCODE_END = 0.65
"""Share of the budget at which encoding ends."""
READ_END = 0.8
"""Share of the budget at which reading ends."""
FAST_SHARE = 0.12
"""Share of the budget that the fastest encoding may take, else a crop is measured."""
MAX_READ_FILES = 8
"""Files that reads are measured from, at most."""
NOTES = (
    "seconds of fhash are those of the whole command: reading, scanning, encoding, writing, and the"
    " measurement of the written file; those of a peer are encoding and writing alone, on one"
    " thread, from memory",
    "bytes of fhash are those of the file, those of a peer the stored chunks alone",
    "PSNR is over all finite values with the range of what was measured; the bulk is the middle"
    " 98 % of the values, relative to its own width",
    "a curve of training is measured on samples; with the schedule 'cosine' a training that is"
    " planned shorter ends higher than its curve at that time",
    "a read opens the file anew; the operating system has it in memory; medians of 5 random places",
    "levels of detail are compared with the source after linear interpolation to all vertices",
    "milliseconds of a picture are medians of 3 runs with the frame decoded, except for first"
    " pictures and encodings, which decode it",
    "pictures by step length, threshold and level of detail are compared with the finest of the"
    " group, those by encoding with the picture of the source",
    "hollow points are predicted, not measured",
)


def measure_cost(
    source: Source, *, budget: float = BUDGET, progress: Progress = silent
) -> CostReport:
    """Measure what accuracy costs on a series.

    The most telling measurements come first; what the time does not allow is named in the result.
    Ctrl-C ends the measurements, and what there is by then is returned.

    Args:
        source: a file, a Series or an array.
        budget: seconds to spend, roughly: work that has begun may exceed its part by a quarter.
        progress: called with each step of the work.

    Raises InputError for a series that cannot be encoded, or is constant, and KeyboardInterrupt
    before anything is measured.
    """
    if not budget > 0:
        raise InputError(f"budget is {budget:g} s; a positive time is needed")
    allowance = Allowance(budget)
    with (
        open_source(source) as whole,
        tempfile.TemporaryDirectory(prefix="fhash-cost-") as folder,
    ):
        series = _measurable(whole, budget, progress)
        facts = facts_of(series, progress)
        if not facts.width:
            raise InputError(
                f"{whole.source}: '{whole.name}' is constant; accuracy costs nothing there"
            )
        peers = PeerEncodings(series, facts, Path(folder), allowance, progress)
        reads: list[Read] = []
        pictures: list[Picture] = []
        allowance.part(ENCODE_END)
        with predictor(series) as foretold:
            own = OwnEncodings(series, Path(folder), allowance, foretold.predict, progress)
            with allowance.work("further encodings"):
                _encode(own, peers, allowance)
        if not allowance.interrupted:
            with allowance.work("further reads and pictures"):
                measure_uses(series, facts, own.files, allowance, progress, reads, pictures)
        points = [*own.points, *peers.points]
        if allowance.interrupted and not any(point.measured for point in points):
            raise KeyboardInterrupt
        return report_on(
            whole,
            series,
            facts,
            allowance,
            encodings=tuple(points),
            curves=tuple(own.curves),
            reads=tuple(reads),
            pictures=tuple(pictures),
            advice=advise(points),
        )


def _encode(own: OwnEncodings, peers: PeerEncodings, allowance: Allowance) -> None:
    """Measure every wish once, as far as time goes."""
    # What was too long for its share may fit into what the others left.
    for share in (ONE_SHARE, 1.0):
        for wish in wishes():
            if allowance.interrupted:
                return
            if wish.codec in PEERS:
                peers.measure(wish)
            else:
                own.measure(wish, share=share)


def _measurable(whole: Series, budget: float, progress: Progress) -> Series:
    """The series, or a crop of it where its fastest encoding takes too much of the budget."""
    fastest = EncodeConfig(effort=1, psnr=50.0)
    progress("predicting", 0, 1, "")
    with predictor(whole) as foretold:
        prediction = foretold.predict(fastest)
    progress("predicting", 1, 1, "")
    allowed = FAST_SHARE * budget
    if prediction.seconds <= allowed:
        return whole
    return cropped(whole, int(prod(whole.shape) * allowed / prediction.seconds))


def measure_uses(
    series: Series,
    facts: Facts,
    files: Sequence[KeptFile],
    allowance: Allowance,
    progress: Progress,
    reads: list[Read],
    pictures: list[Picture],
) -> None:
    """Measure reads from files and pictures of them; adds to `reads` and `pictures`.

    The first part of the time, up to READ_END of the budget, is for reads. The pictures are of the
    file with the default settings, or else of the first.
    """
    if not files:
        return
    default = next((file for file in files if "default" in file.name), files[0])
    others = [file for file in files if file is not default]
    allowance.part(READ_END)
    chosen = [default, *others][:MAX_READ_FILES]
    for read in measure_reads(series, chosen, facts, allowance, progress):
        reads.append(read)
    if allowance.interrupted:
        return
    allowance.part(1.0)
    with open_volume(default.path) as volume:
        PictureCosts(volume, allowance, progress, pictures).measure(series, files)


def report_on(
    whole: Series, series: Series, facts: Facts, allowance: Allowance, **parts: Any
) -> CostReport:
    """The report on a series, of which `series` was measured.

    parts: the fields of CostReport that hold measurements, by name; others stay empty.
    """
    return CostReport(
        series=f"{whole.source} {whole.name}",
        units=whole.units,
        dtype=whole.dtype.name,
        shape=whole.shape,
        measured=described(series),
        measured_shape=series.shape,
        raw_bytes=facts.raw_bytes,
        value_range=(facts.value_range.low, facts.value_range.high),
        budget_seconds=allowance.seconds,
        seconds=allowance.spent,
        interrupted=allowance.interrupted,
        left_out=tuple(allowance.left_out),
        machine=machine(),
        notes=NOTES,
        **parts,
    )


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
