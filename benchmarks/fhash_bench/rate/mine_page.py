"""Page of `fhash bench mine`: slices, error maps, spectra and all figures in one HTML file."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from html import escape
from pathlib import Path
from statistics import median
from string import Template

import numpy as np

from fhash_bench.rate.mine import GOALS, MEASURES, OWN, MineBench, Shown, Verdict
from fhash_codec.cost.report import require_matplotlib

PAGE = Template("""<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><title>$title</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1200px; margin: 1rem auto; padding: 0 1rem;
  color: #1c2026; background: #fff; }
h1 { font-size: 1.3rem; overflow-wrap: anywhere; } h2 { font-size: 1.05rem; }
img { width: 100%; } .scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .6rem; border-bottom: 1px solid #d9dde3; text-align: right; }
th:first-child, td:first-child, td:last-child { text-align: left; }
.loss { background: #fbe3dc; } .loss td:last-child { font-weight: 600; color: #a5300f; }
</style>
<h1>$title</h1>
<p>$facts</p>
$tables
<h2>Slices at equal bytes, and their errors on one scale</h2>
<p>$place</p>
<img alt="Slices of the source and of each codec, their errors, and spectra"
  src="data:image/png;base64,$picture">
<h2>How it was measured</h2>
<ul>$notes</ul>
</html>
""")


def verdict_text(verdict: Verdict | None) -> str:
    """A verdict in words; empty where there is nothing to compare."""
    if verdict is None:
        return ""
    if verdict["verdict"] == "equal":
        return f"equal to {verdict['peer']}"
    ratio = "infinite ratio" if verdict["ratio"] is None else f"{verdict['ratio']:.3g}x"
    return f"{verdict['verdict']}: {ratio}, {verdict['peer']}"


def figures(result: MineBench, goal: str) -> list[tuple[str, ...]]:
    """The table of a comparison: a header, and a row of each measure with the verdict on fhash."""
    rows = result.of(goal)
    verdicts = {each["measure"]: each for each in result.verdicts() if each["goal"] == goal}
    table = [(GOALS[goal], *rows, "fhash beside the best peer")]
    for measure, words in MEASURES.items():
        values = (getattr(row, measure) for row in rows.values())
        cells = (
            f"{v:,}" if isinstance(v, int) else "-" if v is None else f"{v:.4g}" for v in values
        )
        table.append((words, *cells, verdict_text(verdicts.get(measure))))
    return table


def conclusion(result: MineBench) -> str:
    """How often fhash is best and loses in each comparison."""
    parts = []
    for goal, words in GOALS.items():
        said = [each["verdict"] for each in result.verdicts() if each["goal"] == goal]
        count = {word: said.count(word) for word in ("best", "equal", "loss")}
        parts.append(f"{words}: best in {count['best']}, equal in {count['equal']}, loses"
                     f" {count['loss']} of {len(said)} measures")  # fmt: skip
    return "fhash " + "; ".join(parts)


def page(result: MineBench, shown: Shown) -> str:
    """The page, which loads nothing; raises MissingDependencyError without matplotlib."""
    facts = [
        f"{result.dtype} {' x '.join(map(str, result.shape))}, {result.raw_bytes:,} bytes",
        f"measured: {result.measured}",
        f"isosurface at {result.isovalue:.4g} {result.units}".rstrip(),
        conclusion(result),
    ]
    rows = result.of("psnr").values()
    notes = [
        *result.notes,
        *(f"{row.codec}: {row.setting}" for row in rows),
        *(f"not measured: {name}: {why}" for name, why in result.refused.items()),
        " ".join(f"{key}: {value};" for key, value in result.machine.items()),
    ]
    return PAGE.substitute(
        title=escape(f"fhash and other codecs on {result.series}"),
        facts="<br>".join(map(escape, facts)),
        tables="".join(_table(figures(result, goal)) for goal in GOALS),
        place=escape(shown.place),
        picture=base64.b64encode(picture(result, shown)).decode(),
        notes="".join(f"<li>{escape(note)}</li>" for note in notes),
    )


def _table(rows: list[tuple[str, ...]]) -> str:
    def line(cells: Iterable[str], tag: str, kind: str = "") -> str:
        return f"<tr{kind}>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = (line(row, "td", ' class="loss"' * row[-1].startswith("loss")) for row in rows[1:])
    return f'<div class="scroll"><table>{line(rows[0], "th")}{"".join(body)}</table></div><br>'


def picture(result: MineBench, shown: Shown) -> bytes:
    """PNG of slices and errors of each codec at equal bytes, and of their spectra."""
    source, rows = shown.planes["source"], result.of("bytes")
    height = 3.2 * min(max(source.shape[0] / source.shape[1], 0.3), 1.5)
    count = 1 + len(rows)
    figure = require_matplotlib().Figure(figsize=(3.2 * count, 2 * height + 1), dpi=110)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2, count)
    errors = {name: shown.planes[name] - source for name in rows}
    # The codec in the middle sets the scale: that of the worst would show nothing of the best.
    bound = median(np.nanpercentile(np.abs(error), 99.5) for error in errors.values()) or 1.0
    low, high = np.nanpercentile(source, [0.5, 99.5])
    scale = {"vmin": low, "vmax": high, "cmap": "viridis", "origin": "lower"}
    differences = {"vmin": -bound, "vmax": bound, "cmap": "RdBu_r", "origin": "lower"}
    image = axes[0, 0].imshow(source, **scale)
    axes[0, 0].set_title("source")
    for number, (name, row) in enumerate(rows.items(), 1):
        axes[0, number].imshow(shown.planes[name], **scale)
        psnr = "exact" if row.psnr is None else f"{row.psnr:.1f} dB"
        axes[0, number].set_title(f"{name}: {row.bytes:,} bytes, {psnr}", fontsize=10)
        difference = axes[1, number].imshow(errors[name], **differences)
        axes[1, number].set_title(f"{name}: decoded - source", fontsize=10)
        ratio = shown.spectra[name] / np.maximum(shown.spectra["source"], 1e-300)
        style = {"color": "#d1604b", "linewidth": 2.2} if name == OWN else {"linewidth": 1.2}
        axes[1, 0].loglog(np.arange(1, 1 + len(ratio)), ratio, label=name, **style)
    for each in [*axes[0], *axes[1, 1:]]:
        each.set(xticks=[], yticks=[])
    axes[1, 0].set(xlabel="wave number", title="power, decoded / source", ylim=(0.1, 10))
    axes[1, 0].set_box_aspect(height / 3.2)
    axes[1, 0].axhline(1, color="#8a8f98", linewidth=0.8)
    axes[1, 0].legend(frameon=False, fontsize=8)
    figure.colorbar(image, ax=axes[0], shrink=0.85, label=result.units)
    figure.colorbar(difference, ax=axes[1], shrink=0.85, label=result.units)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def write_page(result: MineBench, shown: Shown, path: Path) -> None:
    """Write the page at a path."""
    path.write_text(page(result, shown), encoding="utf-8")
