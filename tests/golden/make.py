"""Writes golden containers, the conformance files of the format: `python tests/golden/make.py`.

What is there is frozen: every later 3.x reads it with the same bits (frozen.json has the digests).
Only what is missing is written. Tests only read them.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import numpy as np
import zarr
from grouped import WRITERS

import fhash_codec
from fhash_codec import Dataset, EncodeConfig, encoding
from fhash_codec.compact import encode as compact
from fhash_codec.compact import tiles
from fhash_codec.compact.encode import CodedTable
from fhash_formats.series import ArraySeries, Coordinate, SourceMetadata, SourceVariable
from fhash_formats.transform.head import Layer, NeighbourHead
from fhash_formats.transform.tile import CodedTile, Coding
from fhash_formats.transform.tile_format import TileSettings
from fhash_formats.transform.zarr_codec import TransformCodec

HERE = Path(__file__).parent
FROZEN = HERE / "frozen.json"

GOLDENS = {
    "paper-plain": EncodeConfig(
        preset="published", hidden_layers=1, width=8, timings=False, tables="float32"
    ),
    "paper-feature": EncodeConfig(
        preset="published",
        hidden_layers=1,
        width=8,
        timings=False,
        features=("interval:0.5:2", "isosurface:0"),
        key_frames="0,1,4",
        tables="float16",
    ),
    "paper-linear-uint8": EncodeConfig(
        preset="published",
        hidden_layers=0,
        embedding_size=1,
        fold=3,
        timings=False,
        key_frames="every:2",
        tables="uint8",
    ),
    "compact-psnr": EncodeConfig(psnr=50.0, effort=4, timings=False),
    "compact-bound": EncodeConfig(
        max_error=0.01, effort=2, tile="3x4x7x5", timings=False, features=("interval:0.5:2",)
    ),
    "compact-mask": EncodeConfig(psnr=50.0, effort=4, timings=False, features=("interval:0.5:2",)),
    "compact-predictor": EncodeConfig(
        max_error=0.3, effort=7, timings=False, preset="small", train="none"
    ),
    "compact-clip": EncodeConfig(max_error=0.2, effort=2, timings=False),
    "compact-labels": EncodeConfig(max_error=0.0, effort=2, timings=False, tile="3x6x24x30"),
    "compact-classes": EncodeConfig(max_error=0.0, effort=2, timings=False),
    "compact-counts": EncodeConfig(max_error=4.0, effort=2, timings=False),
    "compact-one-tile": EncodeConfig(psnr=50.0, effort=2, timings=False, tile="whole"),
    "compact-head": EncodeConfig(psnr=50.0, effort=2, timings=False, tile="3x6x4x9"),
    "compact-many-labels": EncodeConfig(
        max_error=0.0, effort=2, timings=False, features=("interval:700:9000",), dilation=0
    ),
    "compact-trellis": EncodeConfig(psnr=50.0, effort=2, timings=False),
    "compact-fast": EncodeConfig(psnr=60.0, effort=2, timings=False, preset="fast"),
    "compact-fast-bound": EncodeConfig(
        max_error=1e-4, effort=3, timings=False, preset="fast", features=("interval:0.5:2",)
    ),
    "compact-blocks": EncodeConfig(psnr=50.0, effort=1, timings=False),
    "compact-linear": EncodeConfig(max_error=8.0, effort=8, timings=False),
    "compact-signs": EncodeConfig(psnr=40.0, effort=2, timings=False),
    "paper-transform": EncodeConfig(
        preset="published",
        hidden_layers=1,
        width=8,
        timings=False,
        features=("interval:0.5:2",),
        tables="transform",
        psnr=60.0,
    ),
    "paper-coded-occupancy": EncodeConfig(
        preset="published",
        hidden_layers=1,
        width=32,
        embedding_size=4,
        timings=False,
        features=("interval:1:2",),
        tables="transform",
        key_frames="0,2,4",
    ),
    "paper-features": EncodeConfig(
        preset="published",
        hidden_layers=1,
        width=4,
        timings=False,
        features=("interval:1:2", "isosurface:0.5", "interval:-3:-0.5"),
        dilation=0,
        tables="uint8",
        key_frames="0,2,4",
    ),
    "paper-sparse": EncodeConfig(
        preset="published",
        hidden_layers=1,
        width=8,
        timings=False,
        features=("interval:1:1.2", "isosurface:0"),
        dilation=0,
        tables="sparse",
        key_frames="0,2,3",
    ),
    "paper-sparse-untrained": EncodeConfig(
        preset="published",
        hidden_layers=0,
        embedding_size=1,
        fold=3,
        timings=False,
        features=("interval:1:1.5",),
        samples="published",
        dilation=0,
        tables="uint8",
        key_frames="0,1,4",
    ),
    "compact-source": EncodeConfig(psnr=50.0, effort=1, timings=False),
    "compact-named": EncodeConfig(
        max_error=0.02, effort=1, timings=False, features=("interval:0.5:2",)
    ),
    "compact-origin": EncodeConfig(max_error=3.0, effort=2, timings=False, tile="3x6x4x9"),
    "compact-cubic": EncodeConfig(
        max_error=1e-4, effort=1, timings=False, features=("interval:0.2:2",), dilation=0
    ),
}

PLAIN = {
    "compact-plain-bound": "compact-bound",
    "compact-plain-cubic": "compact-cubic",
    "compact-plain-head": "compact-head",
    "compact-plain-labels": "compact-labels",
    "paper-plain-coded": "paper-coded-occupancy",
}
"""Goldens that are the plain export of another one."""

PACKED = ("compact-axes",)
"""Goldens of a Zarr store whose chunks were copied."""

TIME = Coordinate(
    name="time",
    values=np.array([0.0, 0.5, 2.0, 2.25, 9.0]),
    attributes={"units": "hours since 2000-01-01"},
)


def series() -> ArraySeries:
    """A small moving field with a moving hole, and uneven times."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 6, 7, 9)), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    for step in range(5):
        values[step, 2, 3, step : step + 2] = np.nan
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})


def with_source() -> ArraySeries:
    """The field with attributes, and arrays of all kinds beside it."""
    field = series()
    number = np.arange(2.0, 302.0, dtype=np.float32) ** 3
    field.metadata = SourceMetadata(
        dimensions={"lon": "x", "time": "t", "member": "", "y": "y", "lev": "z"},
        variable_attributes={"units": "kg m-3", "grid_mapping": "crs", "level": np.int16(3)},
        variables=(
            SourceVariable(
                name="time",
                dimensions=("time",),
                values=TIME.values,
                attributes={**TIME.attributes, "bounds": "time_bnds"},
                is_coordinate=True,
            ),
            SourceVariable(name="y", dimensions=("y",), values=np.arange(7, dtype=np.int32)),
            SourceVariable(name="time_bnds", dimensions=("time", "bnds"), values=np.eye(5)[:, :2]),
            SourceVariable(
                name="member",
                dimensions=("member",),
                values=np.array(["contrôle"], dtype=object),
                is_coordinate=True,
            ),
            SourceVariable(name="wide", dimensions=("n",), values=number),
            SourceVariable(name="code", dimensions=(), values=np.array(b"a\xff", dtype="S2")),
            SourceVariable(name="crs", dimensions=(), values=np.array(np.nan, dtype=np.float32)),
        ),
        attributes={"title": "golden", "range": np.array([0.1, np.inf], dtype=np.float32)},
        stored="int16",
        file="golden.nc",
        digest="0123",
    )
    return field


def fronts() -> ArraySeries:
    """Noise beside less noise, with a sharp moving edge and a hole: best coded by prediction."""
    t, z, y, x = np.meshgrid(
        np.arange(6), np.arange(16), np.arange(24), np.arange(24), indexing="ij"
    )
    inside = (x - 12) ** 2 + (y - 12) ** 2 + (z - 8) ** 2 < (4 + t) ** 2
    noise = np.random.default_rng(0).normal(0, 3, t.shape)
    values = np.where(inside, 800 + 40 * np.sin(x / 3) + noise, 20 + noise / 60).astype(np.float32)
    values[1, 2, 3, 4:6] = np.nan
    times = Coordinate(name="time", values=np.append(TIME.values, 10.0), attributes=TIME.attributes)
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": times})


def basins() -> ArraySeries:
    """Labels of regions that move, with missing ones: int8 whose fill value is -100."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in (5, 6, 24, 30)), indexing="ij")
    points = np.random.default_rng(0).uniform(0, 30, (12, 2))
    distances = [(y - v) ** 2 + (x - u + t) ** 2 for v, u in points]
    labels = (np.argmin(distances, axis=0) * 37 % 41).astype(np.float32)
    labels[(x - 15) ** 2 + (y - 12) ** 2 > (13 - z) ** 2] = np.nan
    labels_of_basins = ArraySeries(labels, name="density", units="kg m-3", coords={"t": TIME})
    labels_of_basins.source_dtype, labels_of_basins.fill = np.dtype(np.int8), -100
    return labels_of_basins


def classes() -> ArraySeries:
    """Classes of a field as float32, without a missing value: labels without a mask."""
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in (5, 6, 12, 20)), indexing="ij")
    numbers = np.array([-2.5, 0.125, 7.0, 1e-3], np.float32)
    values = numbers[((x + 2 * y + z) // 9 + (y - t) // 5) % 4]
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})


def counts() -> ArraySeries:
    """Counts in uint16 that reach both ends of their range, with missing ones: fill value 65535."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 6, 12, 20)), indexing="ij")
    waves = np.sin(9 * x + 2 * t) * np.cos(7 * y) * (1 + z)
    values = np.clip(np.rint(300 + 400 * waves), 0, 900).astype(np.float32)
    values[:, 2, 3, 4:9] = np.nan
    series = ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})
    series.source_dtype, series.fill = np.dtype(np.uint16), 65535
    return series


def grains() -> ArraySeries:
    """Columns of 600 numbers in a random order, some of which move: more labels than a byte has."""
    chance = np.random.default_rng(1)
    numbers = chance.permutation(600).reshape(20, 30).repeat(2, 0).repeat(2, 1) * 15
    values = np.broadcast_to(numbers, (5, 3, 40, 60)).astype(np.float32)
    values[1:, :, 10:20, 10:30] = values[1:, :, 11:21, 10:30]
    values[2, 1, 4:9, 5:9] = np.nan
    series = ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})
    series.source_dtype, series.fill = np.dtype(np.int16), -1
    return series


def nanoseconds() -> ArraySeries:
    """Times in nanoseconds, at the end of the range of uint64, where floats have few integers."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 6, 7, 9)), indexing="ij")
    waves = np.sin(5 * x + 3 * t) * np.cos(4 * y) + z
    values = np.uint64(2**64 - 1) - np.rint(500 + 200 * waves).astype(np.uint64)
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})


def cells() -> ArraySeries:
    """The values of `series`, at cell centres that no rule gives to the last bit."""
    plain = series()
    coords = {
        axis: Coordinate(name=axis, values=(np.arange(n) + 0.5) / 7, attributes={"units": "m"})
        for axis, n in zip("zyx", plain.shape[1:], strict=True)
    }
    return ArraySeries(plain.values, name="density", units="kg m-3", coords={"t": TIME, **coords})


def long_axis() -> ArraySeries:
    """A line of `series` again and again along x, at positions that need an array."""
    values = np.tile(series().values[:, 2:3, 3:4], (1, 1, 1, 115))
    along = np.cumsum(np.random.default_rng(0).integers(1, 9, values.shape[3])) / 7
    x = Coordinate(name="range", values=along, attributes={"units": "km"})
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME, "x": x})


def slow() -> ArraySeries:
    """A smooth field of eight uneven times with a moving hole: best between steps by cubics."""
    times = np.array([0.0, 0.5, 2.0, 2.25, 3.0, 4.5, 5.0, 6.25])
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (6, 7, 9)), indexing="ij")
    values = np.stack([np.sin(5 * x + 0.7 * time) * np.cos(4 * y) + z for time in times])
    for step in range(8):
        values[step, 2, 3, step % 4 : step % 4 + 2] = np.nan
    time = Coordinate(name="time", values=times, attributes=TIME.attributes)
    return ArraySeries(
        values.astype(np.float32), name="density", units="kg m-3", coords={"t": time}
    )


def grit() -> ArraySeries:
    """Noise, of which no basis makes less."""
    values = np.random.default_rng(0).normal(0, 1, (5, 6, 9, 14)).astype(np.float32)
    return ArraySeries(values, name="density", units="kg m-3", coords={"t": TIME})


def head() -> NeighbourHead:
    """A head of random weights that hardly changes a value, of one hidden layer."""
    chance = np.random.default_rng(3)
    layers = tuple(
        Layer(
            weights=chance.integers(-20, 21, shape).astype(np.int8),
            biases=chance.integers(-99, 100, shape[0]).astype(np.int8),
            weight_scale=0.0123291015625,
            bias_scale=0.0078125,
        )
        for shape in ((4, 28), (1, 4))
    )
    return NeighbourHead(layers=layers, sigma=0.015625, low=-1.0, high=2.0)


def encode_with_head(name: str, path: Path, config: EncodeConfig) -> None:
    """Encode `series` with a head that was not trained, as no head pays in so small a file."""
    code = compact.code_series

    def coded(*arguments: Any, **options: Any) -> CodedTable:
        table = code(*arguments, **options)
        settings = replace(table.plan.settings, head=head())
        return replace(table, plan=replace(table.plan, settings=settings), decoded={})

    with (
        mock.patch.object(compact, "code_series", coded),
        mock.patch.object(encoding, "missed_promise", return_value=None),
    ):
        fhash_codec.encode(SERIES.get(name, series)(), path, config)


def encode_in_blocks(name: str, path: Path, config: EncodeConfig) -> None:
    """Encode `series` in blocks, into which no tile of so small a file is cut."""
    code = tiles.encode_tile

    def coded(values: Any, settings: TileSettings, coding: Coding, **options: Any) -> CodedTile:
        logs = (0 if a.kind == "klt" else max(a.depth, 2) for a in settings.transform.axes)
        cut = sum(log << 4 * axis for axis, log in enumerate(logs))
        return code(values, settings, replace(coding, cut=cut), **options)

    with mock.patch.object(tiles, "encode_tile", coded):
        fhash_codec.encode(SERIES.get(name, series)(), path, config)


SERIES = {
    "compact-predictor": fronts,
    "compact-classes": classes,
    "compact-counts": counts,
    "compact-labels": basins,
    "compact-many-labels": grains,
    "compact-head": cells,
    "compact-linear": fronts,
    "compact-trellis": fronts,
    "compact-blocks": grit,
    "compact-source": with_source,
    "compact-named": long_axis,
    "compact-origin": nanoseconds,
    "compact-cubic": slow,
}
"""Sources of the goldens that are not made from `series`."""


def pack(path: Path) -> None:
    """Pack an array (time, y, x) in chunks of several steps, which the codec takes as z, y, x."""
    frames = series().values[:, 2]
    with TemporaryDirectory() as folder:
        group = zarr.create_group(Path(folder, "golden.zarr"))
        array = group.create_array(
            "density",
            shape=frames.shape,
            chunks=(3, 4, 9),
            dtype=frames.dtype,
            fill_value=np.nan,
            serializer=TransformCodec(max_error=0.01),
            dimension_names=["time", "y", "x"],
            attributes={"units": "kg m-3"},
        )
        array[...] = frames
        time = group.create_array("time", data=TIME.values, dimension_names=["time"])
        time.attrs.update(TIME.attributes)
        fhash_codec.pack(group.store.root, path, timings=False)


def make(name: str, path: Path) -> None:
    """Write a golden; those of PLAIN are made last, since each is made of another one."""
    if name in WRITERS:
        WRITERS[name](path)
    elif name in PACKED:
        pack(path)
    elif name in PLAIN:
        fhash_codec.export_plain(HERE / f"{PLAIN[name]}.fhz", path)
    elif name.endswith("-blocks"):
        encode_in_blocks(name, path, GOLDENS[name])
    elif name.endswith("-head"):
        encode_with_head(name, path, GOLDENS[name])
    else:
        fhash_codec.encode(SERIES.get(name, series)(), path, GOLDENS[name])


def main() -> None:
    for name in (*GOLDENS, *PACKED, *PLAIN, *WRITERS):
        path = HERE / f"{name}.fhz"
        if path.exists():  # goldens are never replaced
            continue
        make(name, path)
        with fhash_codec.open(path) as opened:
            volumes = opened.items() if isinstance(opened, Dataset) else [("", opened)]
            arrays: dict[str, Any] = {}
            for variable, volume in volumes:
                start, last = f"{variable}:" if variable else "", volume.shape[0] - 1.25
                arrays[f"{start}whole"] = volume[...]
                arrays[f"{start}between"] = np.stack([volume.read(t) for t in (0.5, last)])
        np.savez_compressed(HERE / f"{name}.npz", **arrays)
        freeze(name)


def freeze(name: str) -> None:
    """Note the digests of a new golden and of its values."""
    frozen = json.loads(FROZEN.read_text()) if FROZEN.exists() else {}
    frozen[name] = {kind: digest(name, kind) for kind in ("fhz", "npz")}
    FROZEN.write_text(json.dumps(frozen, indent=1, sort_keys=True) + "\n")


def digest(name: str, kind: str) -> str:
    """SHA-256 of a golden ("fhz") or of its values ("npz")."""
    return hashlib.sha256((HERE / f"{name}.{kind}").read_bytes()).hexdigest()


if __name__ == "__main__":
    main()
