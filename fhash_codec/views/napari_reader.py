"""Reader of `.fhz` files for napari: a layer for each variable, decoded where it is looked at.

napari finds it by the manifest napari.yaml.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from fhash_codec.dataset import volumes_of
from fhash_codec.paraview_reader import ascending, is_even

Layers = list[tuple[Any, dict[str, Any], str]]
"""Data, keywords and kind of each layer, as napari takes them."""


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], Layers] | None:
    """The function that reads a path; None for what is no `.fhz` file, as napari asks."""
    return read if isinstance(path, str) and path.lower().endswith(".fhz") else None


def read(path: str | Sequence[str]) -> Layers:
    """Image layers (t, z, y, x) of a file's variables, on their positions where these are even."""
    layers: Layers = []
    for name, volume in volumes_of(str(path)).items():
        lines = [_line(volume.coords[axis].values) for axis in "tzyx"]
        keywords = {
            "name": name,
            "scale": [step for _, step in lines],
            "translate": [start for start, _ in lines],
            "contrast_limits": volume.value_range.floats,
            "metadata": {"units": volume.units, "attributes": dict(volume.attrs)},
        }
        layers.append((volume, keywords, "image"))
    return layers


def _line(positions: Any) -> tuple[float, float]:
    """Start and distance of evenly spaced positions (n,); 0 and 1 for others."""
    upwards, turn = ascending(positions)
    if not is_even(upwards):
        return 0.0, 1.0
    intervals = len(positions) - 1
    step = turn * float(upwards[-1] - upwards[0]) / intervals if intervals else 1.0
    return float(upwards[0 if turn > 0 else -1]), step
