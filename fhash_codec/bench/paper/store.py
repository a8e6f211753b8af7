"""Cells in a folder: one JSON file each, by which an interrupted bench goes on."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fhash_codec.bench.paper.cell import Cell, settings_id
from fhash_formats.errors import InputError
from fhash_formats.support.files import replacing


@dataclass(frozen=True, kw_only=True)
class Request:
    """A cell that is wanted.

    Attributes:
        encoding, protocol, data_set, feature, seed: as of `Cell`.
        settings: everything else that the figures depend on.
    """

    encoding: str
    protocol: str
    data_set: str
    feature: str
    seed: int
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def filename(self) -> str:
        """Name of the cell's file; another setting has another name."""
        words = (self.data_set, self.feature, self.protocol, self.encoding, f"seed{self.seed}")
        plain = "_".join(re.sub(r"[^A-Za-z0-9.-]+", "-", word) for word in words)
        return f"{plain[:120]}_{settings_id(dict(self.settings) | {'words': words})}.json"

    def __str__(self) -> str:
        return f"{self.data_set} {self.feature} {self.protocol} {self.encoding} {self.seed}"


def load(folder: Path, request: Request) -> Cell | None:
    """Return a finished cell; None where there is none, or one that cannot be read."""
    return _read(folder / request.filename)


def save(folder: Path, request: Request, cell: Cell) -> None:
    """Write a cell into a folder, which is made if it is missing.

    The file is complete or absent. Raises OutputError where it cannot be written.
    """
    text = json.dumps(cell.to_dict(), indent=1, allow_nan=False)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / request.filename, force=True) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def load_all(folder: Path) -> list[Cell]:
    """Return every cell in a folder, by file name; files that hold none are left out."""
    cells = [_read(path) for path in sorted(folder.glob("*.json"))]
    return [cell for cell in cells if cell is not None]


def _read(path: Path) -> Cell | None:
    """Return the cell in a file; None where the file holds none."""
    try:
        return Cell.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, KeyError, AttributeError, InputError):
        return None
