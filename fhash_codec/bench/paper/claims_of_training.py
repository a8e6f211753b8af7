"""Claims of the paper about training: speed, accuracy, collisions and times between key frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from fhash_codec.bench.paper.answer import Answer, spread, verdict
from fhash_codec.bench.paper.groups import Group
from fhash_codec.bench.paper.printed import DECIBELS

__all__ = ["accuracy", "collisions", "convergence", "super_resolution"]

FASTER = 10.0
"""Times by which F-Hash converges faster than the best other encoding, as the paper claims."""
EARLY = 8
"""Epochs after which accuracy counts as early."""
CLOCKS = {"seconds": "seconds", "epoch": "epochs", "step": "steps"}
"""Fields of a point that measure the course of a training, and their names."""
QUALITIES = {"picture_psnr": "of pictures", "coreset_psnr": "of the coreset"}
"""Figures whose course is compared, and their names."""
CLOSE = 1.0
"""dB by which two encodings must differ to be told apart."""
FRINGE_TRAINED = ("equal", "best")
"""Protocols that train vertices which only a neighbouring key frame's coreset has."""
Encodings = dict[str, Group]
"""Groups of one protocol, data set and feature, by encoding."""


def convergence(protocol: str, data: Sequence[Encodings]) -> Answer:
    """Answer whether F-Hash reaches a quality in a tenth of the best other encoding's time.

    The paper compares pictures, and so does the verdict where pictures were drawn.
    """
    courses = {quality: _Course.of(data, quality) for quality in QUALITIES}
    known = {quality: course for quality, course in courses.items() if course}
    decisive = next(iter(known.values()), _Course({}, 0))
    return Answer(
        f"F-Hash converges {FASTER:g} to 100 times faster than the best other encoding",
        protocol,
        verdict(decisive.ratios.get("seconds", []), FASTER, 1),
        f"best other / F-Hash to {', '.join(map(str, DECIBELS))} dB "
        + "; ".join(f"{QUALITIES[quality]}: {course}" for quality, course in known.items())
        if known
        else "F-Hash, another encoding, or a quality that F-Hash reaches is missing",
    )


@dataclass(frozen=True)
class _Course:
    """Ratio of the best other encoding's time to that of F-Hash, by clock.

    Attributes:
        ratios: of all data and decibels that F-Hash reached, for each of CLOCKS.
        alone: how often the others did not get there.
    """

    ratios: dict[str, list[float]]
    alone: int

    @classmethod
    def of(cls, data: Sequence[Encodings], quality: str) -> _Course:
        """Compare times to a figure of `QUALITIES`."""
        ratios: dict[str, list[float]] = {clock: [] for clock in CLOCKS}
        alone = 0
        for encodings, decibels, clock in product(data, DECIBELS, CLOCKS):
            own = encodings.get("fhash")
            others = [group for name, group in encodings.items() if name != "fhash"]
            if own is None or not others:
                continue
            took = own.reached(decibels, quality, clock).median
            best = min(group.reached(decibels, quality, clock).median for group in others)
            if not math.isfinite(took) or not took > 0:
                continue
            if math.isfinite(best):
                ratios[clock].append(best / took)
                continue
            # Encodings that do not get there took at least as long as they were trained: this
            # counts where it decides.
            alone += clock == "seconds"
            limit = min(getattr(cell.curve[-1], clock) for group in others for cell in group.cells)
            if limit / took >= FASTER:
                ratios[clock].append(limit / took)
        return cls(ratios, alone)

    def __bool__(self) -> bool:
        """Answer whether anything was compared."""
        return bool(self.ratios.get("seconds") or self.alone)

    def __str__(self) -> str:
        """The ratios of all clocks."""
        figures = [f"{label} {spread(self.ratios[clock], 'x')}" for clock, label in CLOCKS.items()]
        return f"{', '.join(figures)} ({self.alone} that F-Hash alone reached)"


def accuracy(protocol: str, data: Sequence[Encodings]) -> Answer:
    """Answer whether F-Hash is the most accurate after the last epoch that all have."""
    ahead = []
    for encodings in data:
        quality = _quality(encodings)
        cells = [cell for group in encodings.values() for cell in group.cells]
        epochs = min(cell.curve[-1].epoch for cell in cells)
        found = {name: group.after(epochs, quality) for name, group in encodings.items()}
        last = {name: None if one is None else one.median for name, one in found.items()}
        others = [value for name, value in last.items() if name != "fhash" and value is not None]
        own = last.get("fhash")
        if own is not None and others:
            ahead.append(own - max(others))
    return Answer(
        "F-Hash is the most accurate after the same epochs",
        protocol,
        verdict(ahead, CLOSE, -CLOSE),
        f"ahead of the best other by {spread(ahead, ' dB')}" if ahead else "no other encoding",
    )


def super_resolution(protocol: str, data: Sequence[Encodings]) -> Answer:
    """Answer whether F-Hash is better between key frames than its key frames, interpolated.

    Where the fringe was not trained, the other vertices decide.
    """
    found = [
        cell.between
        for encodings in data
        if "fhash" in encodings
        for cell in encodings["fhash"].cells
        if cell.between
    ]

    def ahead(part: str, linear: str) -> list[float]:
        pairs = [(one[part], one[linear]) for one in found]
        return [own - source for own, source in pairs if None not in (own, source)]

    every = ahead("psnr_between", "psnr_linear")
    inner = ahead("psnr_inner", "psnr_inner_linear")
    fringe = ahead("psnr_fringe", "psnr_fringe_linear")
    return Answer(
        "F-Hash offers super-resolution in time",
        protocol,
        verdict(every if protocol in FRINGE_TRAINED else inner, CLOSE, -CLOSE),
        f"between key frames beside the source's key frames, interpolated linearly:"
        f" {spread(every, ' dB')}, {spread(fringe, ' dB')} in the fringe, {spread(inner, ' dB')}"
        " elsewhere"
        if every
        else "no cell of F-Hash with steps between key frames",
    )


def collisions(protocol: str, data: Sequence[Encodings]) -> Answer:
    """Answer whether a hash table with collisions ends less accurate than grids without any."""
    early: list[float] = []
    late: list[float] = []
    shares: list[float] = []
    for encodings in data:
        if not {"hash", "dense-multi"} <= encodings.keys():
            continue
        hashed, grids = encodings["hash"], encodings["dense-multi"]
        shares += [cell.collisions for cell in hashed.cells]
        for values, epochs in ((early, EARLY), (late, 10**9)):
            figures = [group.after(epochs, "coreset_psnr") for group in (grids, hashed)]
            if None not in figures:
                values.append(figures[0].median - figures[1].median)  # type: ignore[union-attr]
    return Answer(
        "Collisions limit the accuracy of MHE",
        protocol,
        verdict(late, CLOSE, -CLOSE),
        f"collision-free multi-resolution grids are ahead by {spread(early, ' dB')} after {EARLY}"
        f" epochs, {spread(late, ' dB')} at the end; corners that share a bucket"
        f" {spread([100 * share for share in shares], ' %')}"
        if late
        else "MHE or multi-resolution grids are missing",
    )


def _quality(encodings: Encodings) -> str:
    """The figure that the paper compares by, of pictures; that of vertices where none is drawn."""
    drawn = all(
        point.picture_psnr is not None
        for group in encodings.values()
        for cell in group.cells
        for point in cell.curve[-1:]
    )
    return "picture_psnr" if drawn else "coreset_psnr"
