"""Cells of the table of `fhash bench table`: a codec on a series at a quality, kept as JSON."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from fhash_codec.bench.rate.measuring import Best
from fhash_codec.bench.rate.results import Access, Speed, TilePrice
from fhash_codec.bench.rate.timing import shown_psnr
from fhash_formats.support.files import replacing

__all__ = ["RateCell", "Request", "cell_of", "load", "save"]

CELL_VERSION = 1
"""Number of the way in which cells are measured; cells of another number are not taken."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """A cell that is wanted.

    Attributes:
        series: name of the series.
        codec: as the user names it.
        goal, asked: the quality.
        settings: everything else that the figures depend on.
    """

    series: str
    codec: str
    goal: str
    asked: float
    settings: Mapping[str, Any]

    @property
    def filename(self) -> str:
        """Name of the cell's file; another setting has another name."""
        words = (self.series, self.codec, f"{self.goal}{self.asked:g}")
        plain = "_".join(re.sub(r"[^A-Za-z0-9.-]+", "-", word) for word in words)
        told = {**self.settings, "words": words, "version": CELL_VERSION}
        digits = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:8]
        return f"{plain[:120]}_{digits}.json"


@dataclass(frozen=True, kw_only=True)
class RateCell:
    """Figures of a codec on a series at a quality.

    Attributes:
        series, shape, dtype, raw_bytes: the series.
        codec: as the user names it.
        goal, asked: the quality: `psnr` in dB, or `bound` as a share of the range.
        reached: whether the codec reached it; where it did not, the other figures are of its
            closest trial.
        bytes, psnr, max_error, setting: as of `Point`; None where nothing was measured.
        encode_mb_s, decode_mb_s, encode_core_mb_s, decode_core_mb_s: as of `Speed`.
        region_ms, region_bytes: as of `Access`.
        one_tile_bytes, tile_price, tile_steps: as of `TilePrice`, of the profile compact alone.
        why: why nothing was measured.
    """

    series: str
    shape: tuple[int, ...]
    dtype: str
    raw_bytes: int
    codec: str
    goal: str
    asked: float
    reached: bool
    bytes: int | None = None
    psnr: float | None = None
    max_error: float | None = None
    setting: str = ""
    encode_mb_s: float | None = None
    encode_core_mb_s: float | None = None
    decode_mb_s: float | None = None
    decode_core_mb_s: float | None = None
    region_ms: float | None = None
    region_bytes: int | None = None
    one_tile_bytes: int | None = None
    tile_price: float | None = None
    tile_steps: int | None = None
    why: str = ""

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return {**asdict(self), "shape": list(self.shape)}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> RateCell:
        """The cell of JSON values; raises TypeError or KeyError for others."""
        if values.keys() != {field.name for field in fields(cls)}:
            raise KeyError("not the keys of a cell")
        return cls(**{**values, "shape": tuple(values["shape"])})


def cell_of(
    about: Mapping[str, Any],
    best: Best,
    speed: Speed | None,
    access: Access | None,
    tiles: TilePrice | None,
) -> RateCell:
    """A cell of what was measured. about: series, codec and quality."""
    figures: dict[str, Any] = {
        "reached": best.reached,
        "bytes": best.trial.bytes,
        "psnr": shown_psnr(best.trial),
        "max_error": best.trial.max_error,
        "setting": best.setting,
    }
    if speed is not None:
        for name in ("encode_mb_s", "encode_core_mb_s", "decode_mb_s", "decode_core_mb_s"):
            figures[name] = getattr(speed, name)
    if access is not None:
        figures |= {"region_ms": access.milliseconds, "region_bytes": access.bytes_read}
    if tiles is not None:
        figures |= {
            "one_tile_bytes": tiles.one_tile_bytes,
            "tile_price": tiles.price,
            "tile_steps": tiles.steps,
        }
    return RateCell(**about, **figures)


def load(folder: Path, request: Request) -> RateCell | None:
    """A finished cell; None where there is none, or one that cannot be read."""
    try:
        text = (folder / request.filename).read_text(encoding="utf-8")
        return RateCell.from_dict(json.loads(text))
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def save(folder: Path, request: Request, cell: RateCell) -> None:
    """Write a cell into a folder, which is made if it is missing: complete or not at all.

    Raises OutputError where it cannot be written.
    """
    text = json.dumps(cell.to_dict(), indent=1, allow_nan=False)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / request.filename, force=True) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
