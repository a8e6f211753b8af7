"""Files of a bench beside its cells: the paper's tables, answers to its claims, and curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fhash_codec.bench.paper.cell import Cell
from fhash_codec.bench.paper.claims import claims_table
from fhash_codec.bench.paper.plot import plot_convergence
from fhash_codec.bench.paper.ratios import FileResult, files_table
from fhash_codec.bench.paper.table import PaperTable
from fhash_codec.bench.paper.tables import paper_tables
from fhash_formats.errors import MissingDependencyError
from fhash_formats.support.files import replacing

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
