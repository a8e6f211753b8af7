"""Seconds and bytes of encoding, reading and drawing against accuracy: `fhash cost`."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

from fhash_codec.config import DEFAULT_PSNR, EncodeConfig
from fhash_codec.cost.encodings import ONE_SHARE, KeptFile, OwnEncodings, encoded_of
from fhash_codec.cost.peers import PeerEncodings
from fhash_codec.cost.plan import (
    EVERYTHING,
    PEERS,
    Allowance,
    Facts,
    described,
    facts_of,
    options_of,
    wishes,
)
from fhash_codec.cost.probe import growth_factors, growth_powers, probe_compact, sample_of
from fhash_codec.cost.results import (
    DEFAULT,
    OWN,
    CostReport,
    Curve,
    Encoded,
    Gain,
    Picture,
    Read,
    Stage,
    advise,
)
from fhash_codec.cost.uses import PictureCosts, measure_reads
from fhash_codec.devices import machine
from fhash_codec.features.selection import Source, mask_files, open_source, select_features
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import InputError
from fhash_formats.series import Series

BUDGET = 120.0
"""Seconds that are spent by default."""
ENCODE_SHARE = 0.65
"""Share of the time for further encodings, after those that are always measured."""
READ_SHARE = 0.5
"""Share of the time after encoding for reads; the rest is for pictures."""
WHOLE_ENCODINGS = 4 / 3
"""Time of the default settings and one quick encoding, which takes about a third of it, over that
of the default settings: the whole series is measured where these two fit."""
SAMPLE_ENCODINGS = 4.0
"""Time of the default settings and the advice, likewise, that fits for a sample."""
PROBED_VERTICES = 1 << 19
"""Vertices of the first quick encoding, by which the time of the others is predicted."""
MIN_VERTICES = 1 << 16
"""Vertices of a sample at least."""
MAX_READ_FILES = 8
"""Files that reads are measured from, at most."""
NOTES = (
    "seconds of fhash are those of the whole command: reading, scanning, encoding, writing, and the"
    " measurement of the written file; those of a peer are encoding and writing alone, on one"
    " thread, from memory",
    "bytes of fhash are those of the file, those of a peer the stored chunks alone",
    "PSNR is over all finite values measured, with the range of the whole series; the bulk is the"
    " middle 98 % of the values, relative to its own width",
    "a curve of training is measured on samples; with the schedule 'cosine' a training that is"
    " planned shorter ends higher than its curve at that time",
    "a read opens the file anew; the operating system has it in memory; medians of 5 random places",
    "levels of detail are compared with the source after linear interpolation to all vertices",
    "milliseconds of a picture are medians of 3 runs with the frame decoded, except for first"
    " pictures and encodings, which decode it",
    "pictures by step length, threshold and level of detail are compared with the finest of the"
    " group, those by encoding with the picture of the source",
    "of a sample, seconds and bytes are scaled up to the whole series: in proportion, and by the"
    " power with which they grew from a quarter of the sample to all of it, with at least a factor"
    " of 2 for seconds and below for bytes; its promises refer to the range of the whole",
    "encodings in less than 0.2 s, and those that took longer than a higher PSNR of their effort,"
    " are the fastest of 3 runs, or that time; the smallest is the fastest of those"
    " within 1 % of the fewest bytes, the default the smallest of its effort; each accuracy counts"
    " for the lower ones, too",
    "with features, errors count in them alone, and a peer encodes all vertices",
)


def measure_cost(
    source: Source,
    *,
    features: tuple[str, ...] = EVERYTHING,
    budget: float = BUDGET,
    progress: Progress = silent,
) -> CostReport:
    """Measure what accuracy costs on a series.

    The default settings are always measured. The most telling of the others come first; the result
    names what the time does not allow. Where the encodings of the whole series would take too long,
    a sample is measured, and seconds and bytes are scaled up to the whole. Ctrl-C ends the
    measurements, and what there is by then is returned.

    Args:
        source: a file, a Series or an array.
        features: what to keep of it, as `fhash encode` takes them.
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
        series, facts, scale = _measurable(whole, features, budget, progress)
        if not facts.width:
            raise InputError(
                f"{whole.source}: '{whole.name}' is constant; accuracy costs nothing there"
            )
        peers = PeerEncodings(series, facts, Path(folder), allowance, progress)
        reads: list[Read] = []
        pictures: list[Picture] = []
        own = OwnEncodings(series, facts, Path(folder), allowance, progress)
        powers = None
        with allowance.work("further encodings"):
            if series is not whole:
                quick = EncodeConfig(features=features, effort=1, psnr=DEFAULT_PSNR)
                powers = growth_powers(series, facts, quick)
            _encode(own, peers, allowance, features)
        if not allowance.interrupted:
            with allowance.work("further reads and pictures"):
                measure_uses(series, facts, own.files, allowance, progress, reads, pictures)
        points = [*own.points, *peers.points]
        if allowance.interrupted and not points:
            raise KeyboardInterrupt
        if powers is not None:
            vertices = prod(whole.shape) / prod(series.shape)
            points = [  # a peer encodes all vertices, and not the features alone
                point.grown(*growth_factors(powers, n), _raw_bytes(whole))
                for point in points
                for n in (scale if point.codec in OWN else vertices,)
            ]
        return report_on(
            whole,
            series,
            facts,
            allowance,
            encodings=tuple(points),
            curves=tuple(own.curves),
            reads=tuple(reads),
            pictures=tuple(pictures),
            advice=advise(points, facts.width),
            features=features,
        )


def _raw_bytes(series: Series) -> int:
    return prod(series.shape) * series.dtype.itemsize


def _encode(
    own: OwnEncodings, peers: PeerEncodings, allowance: Allowance, features: tuple[str, ...]
) -> None:
    """Measure every wish once, as far as time goes."""
    every = list(wishes(features))
    for wish in every:
        if wish.always and not allowance.interrupted:
            own.measure(wish)
    allowance.part(ENCODE_SHARE)
    # What was too long for its share may fit into what the others left.
    for share in (ONE_SHARE, 1.0):
        for wish in every:
            if allowance.interrupted:
                return
            if wish.codec in PEERS:
                peers.measure(wish)
            else:
                own.measure(wish, share=share)


def _measurable(
    whole: Series, features: tuple[str, ...], budget: float, progress: Progress
) -> tuple[Series, Facts, float]:
    """The series, or a sample where encodings of the whole take too much of the budget.

    Returns it, its figures, and how many times the work of it the whole is.
    """
    config = EncodeConfig(features=features)
    selected = select_features(whole, config, progress)
    value_range, extent = selected.scanned.value_range, selected.extent

    def sample(vertices: int) -> tuple[Series, Facts, float]:
        """The sample of so many vertices, or a larger one, which has something of the features."""
        while True:
            part = sample_of(whole, vertices, extent.box)
            try:
                facts = facts_of(part, silent, features)
                if part is not whole and facts.width:
                    samples = select_features(part, config, silent).extent.samples
                    decibels = 20 * math.log10((value_range.high - value_range.low) / facts.width)
                    facts = replace(
                        facts, value_range=value_range, sample=True, decibels=max(decibels, 0.0)
                    )
                    return part, facts, extent.samples / samples
            except InputError:  # nothing of the features
                pass
            if part is whole:
                return whole, facts_of(whole, progress, features), 1.0
            vertices *= 2

    if mask_files(config):  # masks are of the whole series
        return whole, facts_of(whole, progress, features), 1.0
    progress("predicting", 0, 1, "")
    part, facts, scale = sample(PROBED_VERTICES)
    if facts.width:
        # The first encoding of a process also pays for what is loaded.
        probe_compact(sample(MIN_VERTICES)[0], config)
        stages = probe_compact(part, config).stage_seconds(round(scale * prod(part.shape)))
        fitting = ENCODE_SHARE * budget / sum(stages.values())  # default encodings of the whole
        share = 1.0 if fitting >= WHOLE_ENCODINGS else fitting / SAMPLE_ENCODINGS
        part, facts, scale = sample(max(int(share * prod(whole.shape)), MIN_VERTICES))
    progress("predicting", 1, 1, "")
    return part, facts, scale


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

    The pictures are of the file with the default settings, or else of the first.
    """
    if not files:
        return
    default = next((file for file in files if file.name == DEFAULT), files[0])
    others = [file for file in files if file is not default]
    allowance.part(READ_SHARE)
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
        series=f"{Path(whole.source).name} {whole.name}",
        units=whole.units,
        dtype=whole.dtype.name,
        shape=whole.shape,
        measured=described(series),
        measured_shape=series.shape,
        raw_bytes=_raw_bytes(whole),
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
    point = encoded_of(
        figures,
        Encoded(
            name=Path(figures["path"]).name,
            codec=config.preset,
            group="this encoding",
            options=options_of(config),
        ),
        missed=missed,
    )
    file = KeptFile(name=point.name, path=Path(figures["path"]), psnr=point.psnr)
    allowance = Allowance(budget)
    facts = facts_of(series, progress, config.features)
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
        features=config.features,
    )
    seconds = figures["seconds"]
    return replace(report, seconds=report.seconds + seconds, budget_seconds=budget + seconds)
