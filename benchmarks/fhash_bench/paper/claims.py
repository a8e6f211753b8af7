"""Claims of the paper, answered from cells: confirmed, refuted, not reached, not testable here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import median
from typing import Any

from fhash_bench.paper.cells import Cell, Group, by_data, by_protocol, groups, of_protocol
from fhash_bench.paper.data import SETS, paper_parameters
from fhash_bench.paper.files import TARGET, FileResult
from fhash_bench.paper.printed import DECIBELS, PaperTable

CONFIRMED = "confirmed"
"""Verdict where the figures bear a claim out."""
REFUTED = "refuted"
"""Verdict where the figures contradict a claim."""
NOT_REACHED = "not reached here"
"""Verdict where the figures neither bear a claim out nor contradict it."""
NOT_TESTABLE = "not testable here"
"""Verdict where the cells hold no figure about a claim."""


@dataclass(frozen=True)
class Answer:
    """A claim, the protocol that it was tested in, the verdict, and the figures."""

    claim: str
    protocol: str
    verdict: str
    figures: str


def verdict(values: Sequence[float], claimed: float, opposite: float) -> str:
    """The verdict on values of which a claim says that they are large; not testable without any.

    Args:
        values: what was measured.
        claimed: the median that confirms the claim, or any larger one.
        opposite: a median below it refutes the claim.
    """
    if not values:
        return NOT_TESTABLE
    middle = median(values)
    return CONFIRMED if middle >= claimed else REFUTED if middle < opposite else NOT_REACHED


def spread(values: Sequence[float], unit: str) -> str:
    """The median of values with the smallest and the largest, three digits; a dash without any."""
    if not values:
        return "-"
    middle, low, high = (f"{value:.3g}" for value in (median(values), min(values), max(values)))
    return f"{middle}{unit}" if low == high else f"{middle}{unit} ({low} to {high})"


FASTER_TRAINING = 10.0
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
        f"F-Hash converges {FASTER_TRAINING:g} to 100 times faster than the best other encoding",
        protocol,
        verdict(decisive.ratios.get("seconds", []), FASTER_TRAINING, 1),
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
            if limit / took >= FASTER_TRAINING:
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
    found = _between(group for encodings in data for group in encodings.values())

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


MISSED = 0.01
"""Share of a feature between key frames up to which none of it counts as missed."""
FASTER = 1.1
"""Times by which pictures must be faster to be told apart from as fast."""
ARM_GAIN = 1.44
"""Smallest gain of ARM in the paper's Table 6."""


def claims_table(cells: Sequence[Cell], files: Sequence[FileResult] = ()) -> PaperTable:
    """The answers as a table; arguments as of `answers`."""
    found = answers(cells, files)
    return PaperTable(
        name="claims",
        title="Claims of the paper",
        columns=("claim", "protocol", "verdict", "figures"),
        rows=tuple((each.claim, each.protocol, each.verdict, each.figures) for each in found),
        notes=(
            "figures are medians over data sets, features and seeds unless they name them, with the"
            " smallest and the largest in brackets; they hold for our analogues of the data sets",
        ),
    )


def answers(cells: Sequence[Cell], files: Sequence[FileResult] = ()) -> list[Answer]:
    """Answer every claim.

    Args:
        cells: of any protocols; those that a claim needs decide it.
        files: sizes of files at a quality, for the claim about other codecs.
    """
    grouped = groups(cells)
    found: list[Answer] = []
    for about in (convergence, accuracy, collisions, super_resolution):
        for protocol in by_protocol(grouped):
            if about is not collisions or protocol != "released":
                mine = of_protocol(grouped, protocol)
                found.append(about(protocol, [encodings for _, encodings in by_data(mine)]))
    found += [
        _parameters(grouped),
        _used(grouped),
        _steady(grouped),
        _adaptive(grouped),
        _latency(grouped),
        _codecs(files),
    ]
    return [*found, *_elsewhere()]


def _parameters(grouped: Sequence[Group]) -> Answer:
    """Whether F-Hash has the fewest numbers, at the paper's configuration of each data set."""
    printed: list[float] = []
    for name in SETS:
        numbers = paper_parameters(name)
        own = numbers.pop("fhash")
        printed.append(min(numbers.values()) / own)
    same: list[float] = []
    for _, encodings in by_data(of_protocol(grouped, "equal")):
        if {"fhash", "dense"} <= encodings.keys():
            dense, own = (encodings[key].first.parameters["tables"] for key in ("dense", "fhash"))
            same.append(dense / own)
    return Answer(
        "F-Hash has the least number of parameters",
        "computed",
        CONFIRMED if min(printed) > 1 else REFUTED,
        f"at the paper's configurations the least of the others has {spread(printed, 'x')} those of"
        f" F-Hash; a dense grid of the same box {spread(same, 'x')}",
    )


def _used(grouped: Iterable[Group]) -> Answer:
    """Whether the hash of F-Hash is bijective, and how much of its tables is trained."""
    used = [
        100 * cell.buckets_used
        for group in grouped
        if group.encoding == "fhash"
        for cell in group.cells
    ]
    return Answer(
        "The hash is bijective: no collision, and 100 % of the buckets have a corner",
        "by construction",
        CONFIRMED,
        "a bucket is a corner's place in its grid; a gradient reaches those near the coreset,"
        f" {spread(used, ' %')} of the embeddings",
    )


def _steady(grouped: Iterable[Group]) -> Answer:
    """Whether key frames cover all changes, and the occupancy stays valid between them."""
    found = _between(grouped)
    missed, between = _values(found, "missed_share"), _values(found, "psnr_between")
    drop = [
        one["psnr_between"] - one["psnr_key_frames"]
        for one in found
        if None not in (one.get("psnr_key_frames"), one.get("psnr_between"))
    ]
    lost = bool(missed) and median(missed) > MISSED
    return Answer(
        "Key frames cover all critical changes; the occupancy remains consistent between them",
        "all",
        REFUTED if lost else verdict(drop, -CLOSE, -CLOSE),
        f"{spread([100 * share for share in missed], ' %')} of a feature between key frames lies"
        f" outside; PSNR {spread(_values(found, 'psnr_key_frames'), ' dB')} at key frames,"
        f" {spread(between, ' dB')} between, where the source's own key frames, interpolated, have"
        f" {spread(_values(found, 'psnr_linear'), ' dB')}"
        if missed
        else "no cell of F-Hash with steps between key frames",
    )


def _adaptive(grouped: Iterable[Group]) -> Answer:
    """Whether ARM shortens pictures by a third."""
    gains: dict[str, list[float]] = {"off": [], "on": []}
    passes: dict[str, list[float]] = {"off": [], "on": []}
    for found, switch in product(_measured(grouped, None), gains):
        entry = found[switch]
        gains[switch].append(entry["stream_ms"] / entry["arm_ms"])
        passes[switch].append(entry["stream_passes"] / max(entry["arm_passes"], 1))
    return Answer(
        "ARM cuts the latency of every encoding by a third (1.44 to 1.55 times)",
        "all",
        verdict(gains["on"], ARM_GAIN, 1),
        "; ".join(
            f"occupancy {switch}: {spread(gains[switch], 'x')} in ms,"
            f" {spread(passes[switch], 'x')} in passes"
            for switch in gains
        )
        if gains["on"]
        else "no cell with pictures through an encoding",
    )


def _latency(grouped: Sequence[Group]) -> Answer:
    """Whether F-Hash is the fastest to render, with the occupancy granted to all."""
    ratios: dict[str, list[float]] = {"off": [], "on": [], "as printed": []}
    for mine in by_protocol(grouped).values():
        for _, encodings in by_data(mine):
            own = _measured(encodings.values(), "fhash")
            others = _measured([encodings[key] for key in encodings if key != "fhash"], None)
            if not own or not others:
                continue
            for name, (mine_is, theirs) in {
                "off": ("off", "off"), "on": ("on", "on"), "as printed": ("on", "off"),
            }.items():  # fmt: skip
                best = min(found[theirs]["arm_ms"] for found in others)
                ratios[name].append(best / own[0][mine_is]["arm_ms"])
    return Answer(
        "F-Hash renders faster than every other encoding",
        "all",
        verdict(ratios["on"], FASTER, 1),
        "best other / F-Hash, ARM: "
        + "; ".join(
            f"{label} {spread(ratios[name], 'x')}"
            for name, label in (
                ("on", "occupancy for all"),
                ("off", "for none"),
                ("as printed", "for F-Hash alone, as in the paper"),
            )
        )
        if ratios["on"]
        else "no cells with pictures through F-Hash and another encoding",
    )


def _codecs(files: Sequence[FileResult]) -> Answer:
    """Whether F-Hash's files are larger than those of other codecs at a quality."""
    worse: list[float] = []
    coded: list[float] = []
    default: list[float] = []
    for data_set in dict.fromkeys(file.data_set for file in files):
        here = [file for file in files if file.data_set == data_set and file.reached]
        peers = [file.bytes for file in here if file.kind == "peer"]
        paper = [file.bytes for file in here if file.kind == "paper"]
        ours = [file.bytes for file in here if file.kind == "coded"]
        own = [file.bytes for file in here if file.kind == "default" and file.whole]
        if peers and paper:
            worse.append(min(paper) / min(peers))
        if peers and ours:
            coded.append(min(ours) / min(peers))
        if peers and own:
            default.append(min(peers) / min(own))
    return Answer(
        "F-Hash falls short of SZ3 and TTHRESH in compression",
        "files",
        verdict(worse, 1, 1),
        f"at {TARGET:g} dB over all steps: file of F-Hash / that of the best peer"
        f" {spread(worse, 'x')}, with tables coded by the transform {spread(coded, 'x')};"
        f" best peer / default preset {spread(default, 'x')}; TTHRESH and NeurComp were not run"
        if worse
        else "no files of F-Hash and a peer at that quality; SZ3, SPERR and ZFP are part of"
        " fhash[bench]",
    )


def _elsewhere() -> list[Answer]:
    """Claims about which cells say nothing."""
    return [
        Answer(
            "A smaller fold and a larger embedding are better per iteration; the depth of the MLP"
            " matters little",
            "-",
            NOT_TESTABLE,
            "cells have fold 2, embedding 2, two hidden layers; `fhash bench ablate` varies them",
        ),
        Answer(
            "Features are less than 20 % of the volume, in a box of 32 to 64 %",
            "-",
            NOT_TESTABLE,
            "it is about the paper's data; the table of trainings has the share of ours",
        ),
        Answer(
            "Irregular grids are too slow",
            "-",
            NOT_TESTABLE,
            "no encoding here has an irregular grid",
        ),
    ]


def _between(grouped: Iterable[Group]) -> list[dict[str, Any]]:
    """Figures between key frames of all cells of F-Hash that have them."""
    return [
        cell.between
        for group in grouped
        if group.encoding == "fhash"
        for cell in group.cells
        if cell.between
    ]


def _measured(grouped: Iterable[Group], encoding: str | None) -> list[dict[str, Any]]:
    """Figures of pictures of all cells of an encoding, or of all if None."""
    return [
        cell.latency
        for group in grouped
        if encoding in (None, group.encoding)
        for cell in group.cells
        if cell.latency
    ]


def _values(found: Iterable[dict[str, Any]], name: str) -> list[float]:
    """A figure of some results, where it is known."""
    return [one[name] for one in found if one.get(name) is not None]
