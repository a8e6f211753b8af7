"""Files at a quality for the data sets of a bench, kept in the folder of its cells."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from fhash_codec.bench.paper.cell import Cell, settings_id
from fhash_codec.bench.paper.ratios import (
    EFFORT,
    EPOCHS,
    NUMBER_TYPES,
    PEERS,
    TARGET,
    FileResult,
    measure_files,
)
from fhash_codec.progress import Progress, silent
from fhash_formats.errors import InputError
from fhash_formats.series import Series
from fhash_formats.support.files import replacing

__all__ = ["MAX_BYTES", "files_of"]

MAX_BYTES = 1 << 29
"""Bytes of the largest series that files are made of: its F-Hash trains on all steps, and the peers
hold it in memory."""


def files_of(
    cells: Sequence[Cell],
    series_of: Callable[[str], Series],
    folder: Path,
    *,
    number_types: Sequence[str] = NUMBER_TYPES,
    progress: Progress = silent,
) -> tuple[list[FileResult], list[str]]:
    """Measure the files of every data set and feature of some cells.

    What the folder has is not measured again.

    Args:
        cells: of the bench.
        series_of: name of a data set -> all of its steps.
        folder: of the cells, one file is added for each data set and feature.
        number_types: of F-Hash's tables, as for `measure_files`.
        progress: is told about each file.

    Returns:
        The files, and a line for what could not be measured.
    """
    results: list[FileResult] = []
    refused: list[str] = []
    for data_set, kind in dict.fromkeys((cell.data_set, cell.feature) for cell in cells):
        cell = next(each for each in cells if (each.data_set, each.feature) == (data_set, kind))
        if cell.raw_bytes > MAX_BYTES:
            refused.append(
                f"no files of {data_set}: it has {cell.raw_bytes / 1e9:.2g} GB, at most"
                f" {MAX_BYTES / 1e9:.2g} GB are encoded; take a smaller scale"
            )
            continue
        feature = cell.settings.get("feature_resolved", kind)
        path = folder / _filename(cell, feature, number_types)
        kept = _load(path)
        if kept is None:
            found, missing = measure_files(
                data_set,
                series_of(data_set),
                feature,
                kind=kind,
                number_types=number_types,
                progress=progress,
            )
            _save(path, found, missing)
            kept = found, missing
        results += kept[0]
        refused += kept[1]
    return results, list(dict.fromkeys(refused))


def _filename(cell: Cell, feature: str, number_types: Sequence[str]) -> str:
    """The name of the file of results; other data or settings have another name."""
    settings: dict[str, Any] = {
        "shape": list(cell.shape),
        "source": cell.settings.get("source"),
        "feature": feature,
        "target": TARGET,
        "epochs": list(EPOCHS),
        "effort": EFFORT,
        "peers": list(PEERS),
        "number_types": list(number_types),
    }
    words = re.sub(r"[^A-Za-z0-9.-]+", "-", f"{cell.data_set}_{cell.feature}")
    return f"files_{words[:100]}_{settings_id(settings)}.json"


def _load(path: Path) -> tuple[list[FileResult], list[str]] | None:
    """Results that were kept; None where there are none, or where a codec was missing then."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["refused"]:
            return None
        return [FileResult.from_dict(each) for each in values["files"]], []
    except (OSError, ValueError, TypeError, KeyError, AttributeError, InputError):
        return None


def _save(path: Path, results: Sequence[FileResult], refused: Sequence[str]) -> None:
    """Keep results; their file is complete or absent."""
    values = {"files": [each.to_dict() for each in results], "refused": list(refused)}
    with replacing(path, force=True) as temporary:
        temporary.write_text(json.dumps(values, indent=1, allow_nan=False) + "\n", encoding="utf-8")
