"""Colours and opacities of ParaView's preset files.

They are JSON with the keys Name, ColorSpace, RGBPoints, Points and NanColor.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.colour.colours import NAN, SPACES, ColourMap
from fhash_formats.errors import InputError, MissingInputError

__all__ = ["Preset", "read_preset"]

Floats = npt.NDArray[np.float64]

MAX_BYTES = 16 * 2**20
"""Most bytes of a preset file; all of ParaView's own presets in one file are below 1 MiB."""
PIECES = 128
"""Straight pieces that stand for one curved piece of an opacity."""
SPACE_NAMES = {"rgb": "RGB", "hsv": "HSV", "lab": "Lab", "diverging": "Diverging", "step": "Step"}
"""Colour spaces by ParaView's names for them, in lower case."""
PLAIN = (0.5, 0.0)
"""Midpoint and sharpness of a straight piece."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Preset:
    """A preset.

    Attributes:
        name: of the preset, else of its file.
        colours: the colour map.
        opacity: points (value, opacity), float64 (n, 2), values strictly ascending; or None.
    """

    name: str
    colours: ColourMap
    opacity: Floats | None

    @property
    def is_relative(self) -> bool:
        """Whether the preset reaches from 0 or -1 to 1, as ParaView's own do, not over data."""
        return (
            float(self.colours.positions[0]) in (0.0, -1.0)
            and float(self.colours.positions[-1]) == 1.0
        )

    def rescaled(self, low: float, high: float) -> Preset:
        """Move the preset to the values `low` to `high`; the opacities move with the colours."""
        opacity = None
        if self.opacity is not None:
            first, last = self.colours.positions[[0, -1]]
            share = (self.opacity[:, 0] - first) / ((last - first) or 1.0)
            opacity = np.stack([low * (1 - share) + high * share, self.opacity[:, 1]], axis=-1)
        return Preset(name=self.name, colours=self.colours.rescaled(low, high), opacity=opacity)


def read_preset(path: str | Path) -> Preset:
    """Read the first preset with colours of a file, which holds one preset or a list of them.

    Raises InputError with one line for anything else.
    """
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB; not a preset of ParaView")
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise MissingInputError(f"{path}: no such preset") from error
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not a preset of ParaView: {error}") from error
    for preset in content if isinstance(content, list) else [content]:
        if isinstance(preset, dict) and "RGBPoints" in preset:
            return _preset(path, preset)
    raise InputError(
        f"{path}: holds no preset with RGBPoints"
        + (" (IndexedColors are for categories)" if "IndexedColors" in str(content)[:10000] else "")
    )


def _preset(path: Path, preset: dict[str, Any]) -> Preset:
    """Check a preset and convert it; raises InputError."""
    rows = _rows(path, "RGBPoints", preset["RGBPoints"])
    positions, points = rows[:, 0], rows[:, 1:]
    if np.any(np.diff(positions) < 0) or (len(positions) > 1 and positions[0] == positions[-1]):
        raise InputError(f"{path}: the values of RGBPoints do not ascend")
    if np.any((points < 0) | (points > 1)):
        raise InputError(f"{path}: RGBPoints has a colour outside 0 to 1")
    stated = preset.get("ColorSpace", "RGB")
    space = SPACE_NAMES.get(str(stated).lower().replace("cielab", "lab"))
    if space is None:
        raise InputError(f"{path}: ColorSpace is '{stated!s:.40}'; allowed: {', '.join(SPACES)}")
    nan = (
        _rows(path, "NanColor", preset["NanColor"], columns=3)[0]
        if "NanColor" in preset
        else np.array(NAN)
    )
    colours = ColourMap(
        positions=positions, points=points, space=space, nan=tuple(np.clip(nan, 0.0, 1.0).tolist())
    )
    opacity = (
        _opacity(path, _rows(path, "Points", preset["Points"])) if preset.get("Points") else None
    )
    return Preset(name=str(preset.get("Name", path.stem)), colours=colours, opacity=opacity)


def _rows(path: Path, key: str, values: Any, columns: int = 4) -> Floats:
    """The flat list of a key as rows of finite numbers; raises InputError for anything else."""
    is_list = isinstance(values, list) and all(
        isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
        for value in values
    )
    if not is_list or not values or len(values) % columns:
        raise InputError(f"{path}: {key} is not a list of finite numbers, {columns} for each point")
    return np.array(values, dtype=np.float64).reshape(-1, columns)


def _opacity(path: Path, rows: Floats) -> Floats:
    """Opacities as straight pieces (n, 2); a curved piece becomes PIECES of them.

    Args:
        path: of the file, for messages.
        rows: value, opacity, midpoint and sharpness, as vtkPiecewiseFunction takes them.
    """
    if np.any(np.diff(rows[:, 0]) <= 0):
        raise InputError(f"{path}: the values of Points do not ascend")
    if np.any((rows[:, 1:] < 0) | (rows[:, 1:] > 1)):
        raise InputError(f"{path}: Points has an opacity, midpoint or sharpness outside 0 to 1")
    pieces = [rows[:1, :2]]
    for first, second in pairwise(rows):
        if (first[2], first[3]) != PLAIN and first[1] != second[1]:
            pieces.append(_between(first, second))
        pieces.append(second[None, :2])
    return np.concatenate(pieces)


def _between(first: Floats, second: Floats) -> Floats:
    """Points (n, 2) of the curve between two rows, without its ends; values strictly ascending."""
    share = np.arange(1, PIECES) / PIECES
    values = first[0] * (1 - share) + second[0] * share
    # Rounding may make values equal where the rows lie close together.
    ascending = (
        np.concatenate([[True], np.diff(values) > 0]) & (values > first[0]) & (values < second[0])
    )
    opacities = _curve(share, float(first[1]), float(second[1]), float(first[2]), float(first[3]))
    return np.asarray(np.stack([values, opacities], axis=-1)[ascending], dtype=np.float64)


def _curve(share: Floats, first: float, second: float, midpoint: float, sharpness: float) -> Floats:
    """Opacities between `first` and `second` at shares 0..1, as vtkPiecewiseFunction::GetTable."""
    midpoint = min(max(midpoint, 1e-5), 1 - 1e-5)
    share = np.where(
        share < midpoint, 0.5 * share / midpoint, 0.5 + 0.5 * (share - midpoint) / (1 - midpoint)
    )
    if sharpness < 0.01:
        return first + share * (second - first)
    power = 1 + 10 * sharpness
    share = np.where(share < 0.5, 0.5 * (2 * share) ** power, 1 - 0.5 * (2 * (1 - share)) ** power)
    square, cube = share**2, share**3
    slope = (1 - sharpness) * (second - first)
    mixed = (
        (2 * cube - 3 * square + 1) * first
        + (3 * square - 2 * cube) * second
        + (cube - 2 * square + share) * slope
    )
    mixed += (cube - square) * slope
    return np.clip(mixed, min(first, second), max(first, second))
