"""Report of a bench: the paper's tables with its figures beside, answers to its claims, curves."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

from fhash_bench.paper.cells import Cell, Group, by_data, by_protocol, groups, of_protocol, within
from fhash_bench.paper.claims import claims_table
from fhash_bench.paper.data import paper_parameters
from fhash_bench.paper.files import FileResult, files_table
from fhash_bench.paper.printed import (
    DECIBELS,
    ENCODINGS,
    FEATURES,
    NOTES,
    PARAMETERS,
    QUOTED,
    SETS,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    TABLE_4,
    TABLE_5,
    TABLE_6,
    PaperTable,
    Spread,
    Value,
    notes_of,
)
from fhash_codec.cost.report import require_matplotlib
from fhash_codec.paper.network import level_resolutions, parameter_count
from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.files import replacing

EPOCHS = 30
"""Epochs after which Table 4 compares."""
CLOCKS = {"seconds": "seconds", "epoch": "epochs", "step": "Adam steps"}
"""Fields of a point that measure the course of a training, and their names."""
M = 2**20
"""The paper's million."""
QUALITIES = {"picture_psnr": "of pictures", "coreset_psnr": "of the coreset's vertices"}
"""Figures whose course is compared, and their names."""
MARK = f"paper, {QUOTED}"
"""Heading of quoted figures."""


def paper_tables(cells: Sequence[Cell]) -> tuple[PaperTable, ...]:
    """Tables 1, and 3 to 6 of all protocols that the cells are of, and what each training was."""
    grouped = groups(cells)
    tables = [_trainings(grouped), _folds(), _configurations()]
    for protocol, mine in by_protocol(grouped).items():
        beside = of_protocol(grouped, protocol)
        tables += [_convergence(protocol, beside, quality) for quality in QUALITIES]
        tables += [_accuracy(protocol, beside), _ratios(protocol, mine)]
        if any(cell.latency for group in mine for cell in group.cells):
            tables.append(_latency(protocol, mine))
        if any(cell.between for group in mine for cell in group.cells):
            tables.append(_between(protocol, mine))
    return tuple(tables)


def _trainings(grouped: Sequence[Group]) -> PaperTable:
    """Parameters, samples and steps of each training."""
    rows: list[tuple[Value, ...]] = []
    for group in grouped:
        cell = group.first
        rows.append(
            (
                group.protocol,
                group.data_set,
                group.feature,
                group.encoding,
                cell.parameters["tables"],
                cell.parameters["mlp"],
                group.spread(lambda cell: 100 * cell.buckets_used),
                group.spread(lambda cell: cell.bytes / 1e6),
                100 * cell.coreset_share,
                cell.samples_an_epoch,
                cell.steps_an_epoch,
                group.spread(lambda cell: cell.samples_per_second / 1e6),
                group.spread(lambda cell: cell.training_seconds),
                len(group.cells),
            )
        )
    machines = {
        ", ".join(f"{name} {value}" for name, value in cell.machine.items())
        for group in grouped
        for cell in group.cells
    }
    return PaperTable(
        name="trainings",
        title="Trainings: what each encoding was given, and what it took",
        columns=(
            "protocol", "data set", "feature", "encoding", "table numbers", "MLP numbers",
            "buckets used %", "stored MB", "coreset %", "samples/epoch", "steps/epoch",
            "Msamples/s", "seconds", "seeds",
        ),
        rows=tuple(rows),
        notes=(
            "steps are of each model; per-frame models are trained at once, and each of them makes"
            " as many",
            *sorted(machines),
        ),
    )  # fmt: skip


def _configurations() -> PaperTable:
    """Table 3, right: parameters at the paper's own configuration, computed, and printed."""
    rows: list[tuple[Value, ...]] = []
    for name, title in SETS.items():
        computed = paper_parameters(name)
        for encoding, label in ENCODINGS.items():
            printed = PARAMETERS[name][encoding][-1]
            rows.append((title, label, computed[encoding], computed[encoding] / M, printed))
    return PaperTable(
        name="table-3-parameters",
        title="Table 3, right: parameters at the paper's configuration (F-Hash: segmentation)",
        columns=("data set", "encoding", "computed", "computed, M", f"{MARK}, M"),
        rows=tuple(rows),
        notes=("M is 2^20", *(note.text for note in NOTES if note.tables == (3,))),
    )


def _folds() -> PaperTable:
    """Table 1: levels and parameters by fold and embedding, computed, and the printed minutes."""
    data, rows = TABLE_2["bubble"], []
    x, y, z = data.box
    for (fold, size), minutes in TABLE_1.items():
        levels = level_resolutions((z, y, x), data.key_frames, fold)
        numbers = parameter_count(levels, size)
        rows.append((fold, size, len(levels), numbers, minutes, minutes / TABLE_1[fold, 1]))
    return PaperTable(
        name="table-1",
        title="Table 1: F-Hash on Argon Bubble (segmentation) by fold and embedding size",
        columns=("fold", "embedding", "levels, computed", "table numbers, computed",
                 f"minutes ({MARK})", "of embedding 1"),
        rows=tuple(rows),
        notes=("`fhash bench ablate` measures folds, embeddings and networks", *notes_of(1)),
    )  # fmt: skip


def _convergence(protocol: str, grouped: Sequence[Group], quality: str) -> PaperTable:
    """Table 3, left: seconds, epochs and Adam steps to a PSNR."""
    rows: list[tuple[Value, ...]] = []
    for (name, feature), mine in by_data(grouped):
        for decibels, (clock, label) in product(DECIBELS, CLOCKS.items()):
            if not any(
                cell.reached(decibels, quality) for group in mine.values() for cell in group.cells
            ):
                continue
            found = {
                encoding: group.reached(decibels, quality, clock)
                for encoding, group in mine.items()
            }
            rows.append(_convergence_row(name, feature, decibels, label, found))
        if quality != "picture_psnr" or name not in TABLE_3 or feature not in FEATURES:
            continue
        for decibels in DECIBELS:
            minutes = {
                encoding: Spread.of([three[FEATURES.index(feature)]])
                for encoding, three in TABLE_3[name][decibels].items()
            }
            rows.append(_convergence_row(name, feature, decibels, f"minutes ({MARK})", minutes))
    pictures = quality == "picture_psnr"
    return PaperTable(
        name=f"table-3-{'pictures' if pictures else 'volume'}-{protocol}",
        title=f"Table 3, left, protocol {protocol}: course to a PSNR {QUALITIES[quality]}",
        columns=("data set", "feature", "dB", "of", *ENCODINGS, "best other / fhash"),
        rows=tuple(rows),
        notes=(
            "NR: not reached, a dash: not measured; what no encoding reached has no row",
            *(("pictures are means over key frames of decoded values, marched",) if pictures else
              ("all vertices of the coreset at the key frames, also for encodings that were trained"
               " on more",)),
            *(notes_of(4) if pictures else ()),
        ),
    )  # fmt: skip


def _convergence_row(
    name: str, feature: str, decibels: int, label: str, found: Mapping[str, Spread | None]
) -> tuple[Value, ...]:
    """A row of times by encoding, and how many times longer the best other encoding took."""
    others = [one.median for key, one in found.items() if one is not None and key != "fhash"]
    own = found.get("fhash")
    ratio: Value = None
    if own is not None and others and own.median < float("inf"):
        ratio = min(others) / own.median if own.median else None
        ratio = "others NR" if ratio == float("inf") else ratio
    return name, feature, decibels, label, *(found.get(key) for key in ENCODINGS), ratio


def _accuracy(protocol: str, grouped: Sequence[Group]) -> PaperTable:
    """Table 4: PSNR and SSIM of pictures, and seconds, after 30 epochs."""
    kinds = {group.feature for group in grouped}
    chosen = "segmentation" if "segmentation" in kinds else sorted(kinds)[0]
    rows: list[tuple[Value, ...]] = []
    epochs = {within(cell, EPOCHS).epoch for group in grouped for cell in group.cells}
    for (name, feature), mine in by_data(grouped):
        if feature != chosen:
            continue
        untrained = {
            key: group.spread(lambda cell: cell.curve[0].picture_psnr)
            for key, group in mine.items()
        }
        rows.append(
            (name, "picture PSNR before training, dB", *(untrained.get(key) for key in ENCODINGS))
        )
        for figure, label, digits in (
            ("picture_psnr", "picture PSNR, dB", 3),
            ("picture_ssim", "picture SSIM", 4),
            ("coreset_psnr", "volume PSNR, dB", 3),
            ("seconds", "seconds", 3),
        ):
            found = {key: group.after(EPOCHS, figure, digits) for key, group in mine.items()}
            rows.append((name, label, *(found.get(key) for key in ENCODINGS)))
        if name in TABLE_4:
            printed = [TABLE_4[name][key] for key in ENCODINGS]
            rows.append((name, f"picture PSNR ({MARK})", *(cell.psnr for cell in printed)))
            rows.append((name, f"picture SSIM ({MARK})", *(cell.ssim for cell in printed)))
            rows.append((name, f"minutes ({MARK})", *(cell.minutes for cell in printed)))
    after = " or ".join(map(str, sorted(epochs)))
    return PaperTable(
        name=f"table-4-{protocol}",
        title=f"Table 4, protocol {protocol}: {chosen} after {after} epochs",
        columns=("data set", "figure", *ENCODINGS),
        rows=tuple(rows),
        notes=notes_of(4),
    )


def _ratios(protocol: str, grouped: Sequence[Group]) -> PaperTable:
    """Table 5: the paper's ratio, raw bytes of all steps over 4 bytes a parameter."""
    rows: list[tuple[Value, ...]] = []
    for (name, feature), mine in by_data(grouped):
        figures: dict[str, Callable[[Cell], float | None]] = {
            "raw / (4 B x parameters)": lambda c: c.raw_bytes / (4 * sum(c.parameters.values())),
            "raw / stored bytes": lambda c: c.raw_bytes / c.bytes,
            "PSNR at key frames, dB": lambda c: c.curve[-1].coreset_psnr,
            "PSNR at all steps, dB": lambda c: (c.between or {}).get("psnr"),
        }
        for label, figure in figures.items():
            found = {key: group.spread(figure) for key, group in mine.items()}
            rows.append((name, feature, label, *(found.get(key) for key in ENCODINGS)))
        if name in TABLE_5 and feature in FEATURES:
            place = FEATURES.index(feature)
            printed = [TABLE_5[name][key] for key in ENCODINGS]
            rows.append(
                (name, feature, f"ratio ({MARK})", *(p[min(place, len(p) - 1)] for p in printed))
            )
    return PaperTable(
        name=f"table-5-{protocol}",
        title=f"Table 5, protocol {protocol}: the paper's ratio, by parameters",
        columns=("data set", "feature", "figure", *ENCODINGS),
        rows=tuple(rows),
        notes=(
            "that ratio sets key frames of a feature against all steps of the whole domain, and"
            " asks for no quality: files at a quality are in the table of files",
            *notes_of(5),
        ),
    )


def _latency(protocol: str, grouped: Sequence[Group]) -> PaperTable:
    """Table 6: milliseconds, passes and evaluations of pictures, with and without occupancy."""
    rows: list[tuple[Value, ...]] = []
    for group in grouped:
        cells = [cell.latency for cell in group.cells if cell.latency]
        for switch in ("off", "on") if cells else ():
            entry = {
                key: Spread.of([one[switch][key] for one in cells]) for key in cells[0][switch]
            }
            gain = Spread.of([one[switch]["stream_ms"] / one[switch]["arm_ms"] for one in cells])
            printed = TABLE_6.get(group.data_set, {}).get(group.encoding)
            quoted = (
                f"{printed.stream:g} / {printed.arm:g} ({printed.gain:.2f}x)"
                if printed and switch == ("on" if group.encoding == "fhash" else "off")
                else None
            )
            rows.append(
                (
                    group.data_set, group.feature, group.encoding, switch, entry["stream_ms"],
                    entry["arm_ms"], gain, entry["stream_passes"], entry["arm_passes"],
                    entry["samples"], entry["evaluations"], quoted,
                )
            )  # fmt: skip
    return PaperTable(
        name=f"table-6-{protocol}",
        title=f"Table 6, protocol {protocol}: pictures of key frames straight through the encoding",
        columns=(
            "data set", "feature", "encoding", "occupancy", "stream ms", "ARM ms", "gain",
            "passes", "passes, ARM", "samples", "evaluations", f"ms, stream / ARM ({MARK})",
        ),
        rows=tuple(rows),
        notes=(
            "counts are means and milliseconds medians over random views; samples and evaluations"
            " are those of streaming",
            *notes_of(6),
        ),
    )  # fmt: skip


def _between(protocol: str, grouped: Sequence[Group]) -> PaperTable:
    """PSNR at all steps, beside the true key frames interpolated linearly."""
    figures = {
        "psnr_key_frames": "key frames, dB",
        "psnr_between": "between, dB",
        "psnr_linear": "true key frames, interpolated, dB",
        "psnr_inner": "without the fringe, dB",
        "psnr_inner_linear": "interpolated, dB",
        "psnr": "all steps, dB",
    }
    rows: list[tuple[Value, ...]] = []
    for group in grouped:
        if any(cell.between for cell in group.cells):
            found = [group.spread(lambda cell: (cell.between or {}).get(key)) for key in figures]  # noqa: B023
            missed = group.spread(lambda cell: _percent((cell.between or {}).get("missed_share")))
            rows.append((group.data_set, group.feature, group.encoding, *found, missed))
    return PaperTable(
        name=f"between-{protocol}",
        title=f"Between key frames, protocol {protocol}",
        columns=("data set", "feature", "encoding", *figures.values(), "feature missed %"),
        rows=tuple(rows),
        notes=(
            "over the vertices in the coreset of the key frame before or after a step; the fringe"
            " is in the coreset of one of them",
        ),
    )


def _percent(share: float | None) -> float | None:
    """A share in percent."""
    return None if share is None else 100 * share


COLOURS = {
    "hash": "#b07aa1",
    "tcnn": "#9c8b5a",
    "dense": "#8a8f98",
    "dense-multi": "#4a86c0",
    "fhash": "#d1604b",
}
"""Colour of each encoding."""
CLOCK_LABELS = {
    "seconds": "seconds of training",
    "epoch": "epochs",
    "step": "Adam steps of each model",
}
"""Fields of a point along the horizontal axes, and their labels."""
LOGARITHMIC = ("seconds", "step")
"""Clocks whose axis is logarithmic: encodings differ by factors in them."""
QUALITY_TITLES = {"coreset_psnr": "volume, coreset", "picture_psnr": "picture"}
"""Fields of a point along the vertical axes, and their labels."""


def plot_convergence(cells: Sequence[Cell], folder: Path) -> list[Path]:
    """Draw the curves of each data set, feature and protocol as PNG in a folder; old ones go.

    A line is the median over seeds, the band around it reaches from the smallest to the largest.
    Returns the files. Raises MissingDependencyError without matplotlib.
    """
    require_matplotlib()
    written = []
    for protocol, mine in by_protocol(groups(cells)).items():
        for (name, feature), encodings in by_data(mine):
            words = "-".join((name, feature, protocol))
            path = folder / f"convergence-{re.sub(r'[^A-Za-z0-9.-]+', '_', words)}.png"
            _draw(f"{SETS.get(name, name)} ({name}), {feature}, protocol {protocol}",
                  encodings, path)  # fmt: skip
            written.append(path)
    return written


def _draw(title: str, encodings: dict[str, Group], path: Path) -> None:
    """Draw the panels of one data set, feature and protocol."""
    figure = require_matplotlib().Figure(figsize=(15, 8), layout="constrained", dpi=110)
    qualities = [
        quality
        for quality in QUALITY_TITLES
        if any(
            getattr(point, quality) is not None
            for group in encodings.values()
            for cell in group.cells
            for point in cell.curve
        )
    ]
    panels = figure.subplots(max(len(qualities), 1), len(CLOCK_LABELS), squeeze=False, sharey="row")
    for row, quality in zip(panels, qualities, strict=False):
        for axes, clock in zip(row, CLOCK_LABELS, strict=True):
            _panel(axes, encodings, clock, quality)
        row[0].set_ylabel(f"PSNR, {QUALITY_TITLES[quality]}, dB")
    for axes, label in zip(panels[-1], CLOCK_LABELS.values(), strict=True):
        axes.set_xlabel(label)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(title, fontsize=12)
    with replacing(path, force=True) as temporary:
        figure.savefig(temporary, format="png")


def _panel(axes: Any, encodings: dict[str, Group], clock: str, quality: str) -> None:
    """Draw one quality over one clock."""
    for decibels in DECIBELS:
        axes.axhline(decibels, color="#c9cbd2", linestyle=":", linewidth=1)
    for name, group in encodings.items():
        curves = [_curve(cell, clock, quality) for cell in group.cells]
        # Points of one number are of one epoch: seeds differ in their seconds alone.
        points = [column for column in zip(*curves, strict=False) if None not in column]
        if clock in LOGARITHMIC:
            points = [column for column in points if min(at for at, _ in column) > 0]
        if not points:
            continue
        at = [median(x for x, _ in column) for column in points]
        middle = [median(y for _, y in column) for column in points]
        low, high = ([end(y for _, y in column) for column in points] for end in (min, max))
        axes.plot(
            at,
            middle,
            color=COLOURS.get(name, "#3b3f46"),
            label=ENCODINGS.get(name, name),
            linewidth=2.4 if name == "fhash" else 1.5,
            marker="o",
            markersize=3,
        )
        if len(group.cells) > 1:
            axes.fill_between(at, low, high, color=COLOURS.get(name, "#3b3f46"), alpha=0.18)
    if clock in LOGARITHMIC:
        axes.set_xscale("log", subs=(2, 5))
        for formatted in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            formatted(lambda value, _: f"{value:g}")
    axes.grid(True, which="major", color="#e9eaee", linewidth=0.8)
    axes.set_axisbelow(True)


def _curve(cell: Cell, clock: str, quality: str) -> list[tuple[float, float] | None]:
    """Points (clock, quality) of a curve, None where the quality was not measured."""
    return [
        None
        if getattr(point, quality) is None
        else (float(getattr(point, clock)), float(getattr(point, quality)))
        for point in cell.curve
    ]


FILENAME = "tables.md"
"""File of the tables in the folder of the cells."""


def tables_of(
    cells: Sequence[Cell], files: Sequence[FileResult] = (), refused: Sequence[str] = ()
) -> tuple[PaperTable, ...]:
    """Return the paper's tables of cells, and the answers to its claims; none without cells.

    Args:
        cells: of the bench.
        files: files at a quality, of `files.files_of`.
        refused: lines for files that could not be measured.
    """
    if not cells:
        return ()
    at_quality = (files_table(files, refused),) if files or refused else ()
    return (*paper_tables(cells), *at_quality, claims_table(cells, files))


def write_report(
    cells: Sequence[Cell], tables: Sequence[PaperTable], folder: Path
) -> tuple[list[Path], list[str]]:
    """Write the tables and the curves of some cells into a folder; older ones are replaced.

    Args:
        cells: what the curves show.
        tables: what the file of tables holds.
        folder: it exists.

    Returns:
        The files, and a line for what could not be drawn.
    """
    if not cells:
        return [], []
    path = folder / FILENAME
    with replacing(path, force=True) as temporary:
        text = "\n".join(table.markdown() for table in tables)
        temporary.write_text(text, encoding="utf-8")
    try:
        return [path, *plot_convergence(cells, folder)], []
    except MissingDependencyError as error:
        return [path], [f"no curves: {error}"]
