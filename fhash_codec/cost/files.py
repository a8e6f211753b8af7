"""The files of a cost report: a page, a PNG and JSON in a folder, all of them or none."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from fhash_codec.cost.page import json_text, page, require_plotly
from fhash_codec.cost.plot import plot, require_matplotlib
from fhash_codec.cost.results import CostReport
from fhash_formats.errors import InputError, OutputError, OutputExistsError
from fhash_formats.support.files import check_output, explained, replacing_all

__all__ = ["NAMES", "check_folder", "write_report"]

NAMES = ("cost.json", "cost.png", "cost.html")
"""Files of a report."""


def check_folder(folder: Path, force: bool, sources: tuple[Path, ...] = ()) -> None:
    """Check a folder before any work, and that plotly and matplotlib are there.

    The folder need not exist, but the one above it must.

    Raises InputError for a folder that is one of the sources or lies in one, OutputExistsError for
    one that holds anything while `force` is not given, OutputError for a file or where nothing can
    be written, and MissingDependencyError.
    """
    require_plotly()
    require_matplotlib()
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; name a folder for the report")
    if not folder.exists():
        check_output(folder, force, sources=sources)
        return
    if not force and any(folder.iterdir()):
        raise OutputExistsError(
            f"{folder} holds files; use --force (force=True) to write a report beside them,"
            " or name another folder"
        )
    for name in NAMES:
        check_output(folder / name, True, sources=sources)
    if any(Path(os.path.realpath(source)) == Path(os.path.realpath(folder)) for source in sources):
        raise InputError(f"{folder} is the input itself; choose another name")


def write_report(report: CostReport, folder: Path, *, force: bool = False) -> list[Path]:
    """Write a report; the paths of its page, PNG and JSON.

    force: whether files of an older report may be replaced. Other files in the folder stay. Raises
    what `check_folder` raises.
    """
    check_folder(folder, force)
    texts = {"cost.json": json_text(report) + "\n", "cost.html": page(report)}
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise explained(folder, error) from error
    paths = [folder / name for name in NAMES]
    try:
        with replacing_all(paths, force=force) as temporaries:
            for name, temporary in zip(NAMES, temporaries, strict=True):
                if name in texts:
                    temporary.write_text(texts[name], encoding="utf-8")
                else:
                    plot(report, temporary)
    except BaseException:
        if made:
            with suppress(OSError):
                folder.rmdir()
        raise
    return paths[::-1]
