"""Folders as tests see them: all that lies in one, and an output that stands there already."""

from __future__ import annotations

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
