"""Goldens that are not one encoding of one series: several variables, files that grew, parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

import fhash_codec
from fhash_codec import EncodeConfig, Writer
from fhash_codec.appending.parts import Part, encode_part
from fhash_formats.series import ArraySeries, Coordinate, SourceMetadata, SourceVariable

SHAPE = (5, 3, 6, 8)
TIME = Coordinate(
    name="time",
    values=np.array([0.0, 0.5, 2.0, 2.25, 9.0]),
    attributes={"units": "hours since 2000-01-01"},
)
EASY = EncodeConfig(max_error=0.05, effort=1, timings=False)


def wave(turn: float, shape: tuple[int, ...] = SHAPE) -> npt.NDArray[np.float32]:
    """A moving wave, float32 (t, z, y, x); another one for each `turn`."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    return (np.sin(5 * x + 3 * t + turn) * np.cos(4 * y) + z).astype(np.float32)


def coordinates(**more: Coordinate) -> dict[str, Coordinate]:
    """Uneven times, heights, and `more`."""
    heights = Coordinate(name="level", values=np.array([0.0, 10.0, 100.0]))
    return {"t": TIME, "z": heights, **more}


def basins() -> ArraySeries:
    """Labels in int8 with the fill value -100, on the grid of the winds."""
    y, x = np.meshgrid(np.arange(6), np.arange(8), indexing="ij")
    labels = np.broadcast_to((y // 2) * 40 + x // 3, SHAPE).astype(np.float32)
    labels[1:, :, 2:5, 3] = np.nan
    series = ArraySeries(labels, name="basin", coords=coordinates())
    series.source_dtype, series.fill = np.dtype(np.int8), -100
    return series


def write_variables(path: Path) -> None:
    """Winds on one grid, one with a promise of its own; a feature; labels; a variable of the
    published network; a name that is no name of an array."""
    staggered = Coordinate(name="x", values=np.arange(8) + 0.5, attributes={"units": "km"})
    rain = wave(2) * (wave(2) > 0.5)
    sources = {
        "u": ArraySeries(wave(0), name="u", units="m s-1", coords=coordinates()),
        "v": ArraySeries(wave(1), name="v", units="m s-1", coords=coordinates(x=staggered)),
        "surface/rain rate": ArraySeries(rain, name="rain rate", coords=coordinates()),
        "basin": basins(),
        "tracer": ArraySeries(wave(3), name="tracer", coords=coordinates()),
    }
    small = EncodeConfig(
        preset="published", hidden_layers=0, embedding_size=1, fold=3, tables="uint8", timings=False
    )
    configs = {
        "u": EASY,
        "v": replace(EASY, max_error=0.005),
        "surface/rain rate": replace(EASY, features=("interval:0.5:9",), dilation=0),
        "basin": replace(EASY, max_error=0.0, effort=2),
        "tracer": small,
    }
    fhash_codec.encode_dataset(sources, path, configs)


def write_curvilinear(path: Path) -> None:
    """Two variables that share coordinates of two dimensions and a grid mapping."""
    y, x = np.meshgrid(np.arange(18.0), np.arange(20.0), indexing="ij")
    beside = (
        SourceVariable(
            name="lat", dimensions=("y", "x"), values=50 + y + x * y / 99, is_coordinate=True
        ),
        SourceVariable(
            name="lon",
            dimensions=("y", "x"),
            values=(x - y**2 / 99).astype(np.float32),
            attributes={"units": "degrees_east"},
            is_coordinate=True,
        ),
        SourceVariable(
            name="crs",
            dimensions=(),
            values=np.array(0, dtype=np.int32),
            attributes={"grid_mapping_name": "rotated_latitude_longitude"},
        ),
    )
    sources = {}
    for turn, name in enumerate(("u", "v")):
        series = ArraySeries(wave(turn, (2, 1, 18, 20)), name=name, units="m s-1")
        series.metadata = SourceMetadata(
            dimensions={"time": "t", "y": "y", "x": "x"},
            variable_attributes={"coordinates": "lat lon", "grid_mapping": "crs"},
            variables=beside,
            attributes={"Conventions": "CF-1.8"},
        )
        sources[name] = series
    fhash_codec.encode_dataset(sources, path, EASY)


def write_grown(path: Path) -> None:
    """A file of `Writer`: four layers of two steps each, the last one of one step."""
    config = EncodeConfig(effort=1, tile="2x3x6x8", timings=False)
    coords = {"t": Coordinate(name="t", values=np.zeros(1), attributes={"units": "s"})}
    with Writer(
        path,
        shape=SHAPE[1:],
        max_error=0.02,
        value_range=(-1.0, 2.0),
        config=config,
        coords={**coords, "z": np.arange(3) ** 2},
        name="density",
        units="kg m-3",
    ) as writer:
        for step, frame in enumerate(wave(0, (7, *SHAPE[1:]))):
            writer.append(frame, time=0.75 * step)


def whole() -> ArraySeries:
    """The series of which parts are made: a gap, and an array beside the values."""
    values = wave(0)
    values[1, 2, 3, 4:6] = np.nan
    series = ArraySeries(values, name="density", units="kg m-3", coords=coordinates())
    series.metadata = SourceMetadata(
        dimensions={"time": "t", "level": "z", "y": "y", "x": "x"},
        variables=(SourceVariable(name="wide", dimensions=("n",), values=np.arange(300.0) ** 1.5),),
    )
    return series


def part_writer(number: int) -> Callable[[Path], None]:
    """The writer of one of two parts of `whole`."""
    config = replace(EASY, tile="2x3x6x8", max_error=0.02)

    def write(path: Path) -> None:
        encode_part(whole(), path, config, Part(number=number, of=2))

    return write


WRITERS: dict[str, Callable[[Path], None]] = {
    "compact-variables": write_variables,
    "compact-curvilinear": write_curvilinear,
    "compact-grown": write_grown,
    "compact-part-1": part_writer(1),
    "compact-part-2": part_writer(2),
}
"""Writers of the goldens by name."""
