"""What a container's header holds, for both profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_FLOOR, Context
from importlib.metadata import version
from math import prod
from typing import Any

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.scan import Scan
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import ContainerWriter, describe_coordinates
from fhash_formats.series import AXIS_NAMES, Series


def describe_source(
    series: Series, value_range: ValueRange, config: EncodeConfig
) -> dict[str, Any]:
    """What the headers of both profiles say of the series."""
    return {
        "encoder": {"version": version("fhash"), "seed": config.seed},
        "variable": {
            "name": series.name,
            "units": series.units,
            "dtype": series.dtype.name,
            "attributes": dict(series.attributes),
        },
        "domain": {"shape": list(series.shape)},
        "value_range": [value_range.low, value_range.high],
        "dilation": config.dilation,
        "quality": {},
    }


MISSING_CHUNK_BYTES = 1 << 20  # a member of its own for each step would cost 130 bytes a step


def write_series(
    writer: ContainerWriter,
    series: Series,
    scanned: Scan,
    key_frames: Sequence[int],
    *,
    brief: bool = False,
) -> dict[str, Any]:
    """Coordinates, key frames, and where the source has no finite value; what the header has to say of them.

    brief: only what the header cannot say in fewer bytes, as the profile compact allows.
    """
    steps = series.shape[0]
    described = describe_coordinates(series.coords) if brief else {}
    for axis, stored in AXIS_NAMES.items():
        if stored not in described:
            coordinate = series.coords[axis]
            writer.add_whole(
                f"coords/{stored}",
                coordinate.values,
                attributes={**coordinate.attributes, "name": coordinate.name},
            )
    if not brief or len(key_frames) < steps:
        writer.add_whole("key_frames", np.array(key_frames, dtype=np.int64))
    if scanned.missing:
        empty = np.zeros(-(-prod(series.shape[1:]) // 8), dtype=np.uint8)
        rows = max(1, min(steps, MISSING_CHUNK_BYTES // empty.size))
        writer.add_array(
            "missing/bits",
            shape=(steps, empty.size),
            dtype=empty.dtype,
            chunk_shape=(rows, empty.size),
            chunks=(
                np.stack(
                    [
                        scanned.missing.get(step, empty)
                        for step in range(start, min(start + rows, steps))
                    ]
                )
                for start in range(0, steps, rows)
            ),
        )
    return {"coordinates": described} if brief else {}


MAX_POINTS = 24
"""Of a training's history in a file."""


DIGITS, STEP_DIGITS = 6, 5
"""Significant digits of figures in a file: over all steps, of one step."""


def brief_quality(quality: Mapping[str, Any]) -> dict[str, Any]:
    """Figures (`metrics.Quality` as JSON values) as a header has them: rounded to the worse side, those of the steps as lists."""
    brief = {
        name: _figure(name, value, DIGITS) if isinstance(value, float) else value
        for name, value in quality.items()
    }
    steps = quality["per_step"]
    brief["per_step"] = {
        name: [_figure(name, step[name], STEP_DIGITS) for step in steps]
        for name in ("psnr", "rmse", "max_abs_error")
    }
    return brief


def brief_history(
    history: Sequence[Mapping[str, float | None]], *, timings: bool
) -> list[dict[str, float]]:
    """The history of a training as a header has it: at most 24 points, the last among them; milliseconds and hundredths of a dB."""
    kept = min(len(history), MAX_POINTS)
    chosen = [history[(number + 1) * len(history) // kept - 1] for number in range(kept)]
    points = [
        {
            "seconds": _rounded(point["seconds"], 3) if timings else None,
            "epoch": point["epoch"],
            "psnr": _rounded(point["psnr"], 2),
        }
        for point in chosen
    ]
    return [{name: value for name, value in point.items() if value is not None} for point in points]


def _figure(name: str, value: float | None, digits: int) -> float | None:
    """A figure with so many significant digits, never better than it was."""
    rounding = ROUND_FLOOR if name.startswith(("psnr", "ssim")) else ROUND_CEILING
    return (
        None
        if value is None
        else float(Context(prec=digits, rounding=rounding).create_decimal_from_float(value))
    )


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)
