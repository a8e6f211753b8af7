"""Folders as tests see them, and fenced blocks of code in a document."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

Listing = dict[str, bytes | None]
"""Bytes by path, None for a folder."""


def listing(folder: Path) -> Listing:
    """Everything below a folder; shows the traces of a command."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def store(path: Path, text: str = "old") -> Path:
    """An output that is a folder, as a Zarr store is."""
    (path / "c").mkdir(parents=True)
    (path / "zarr.json").write_text("{}")
    (path / "c" / "0").write_text(text)
    return path


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, text, and the line of the page where it begins."""

    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(match[1], match[2], text[: match.start()].count("\n") + 1)
        for match in re.finditer(r"^```(\S*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    ]
