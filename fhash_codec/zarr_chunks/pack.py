"""`pack`: the coded arrays of a Zarr store become a container, without coding them again."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fhash_codec.config import EncodeConfig
from fhash_codec.container_name import check_name
from fhash_codec.coreset.scan import Scan
from fhash_codec.dataset_encoding import encodable
from fhash_codec.header import (
    describe_source,
    write_missing,
    write_series,
)
from fhash_codec.measure.value_range import ValueRange
from fhash_codec.progress import Progress, silent
from fhash_codec.provenance import PACKED
from fhash_codec.report import bytes_on_disk
from fhash_codec.zarr_chunks.tiles import Tiles
from fhash_formats import list_variables
from fhash_formats.container import ContainerWriter
from fhash_formats.container.header import TABLE
from fhash_formats.errors import FhashWarning, InputError, MissingInputError
from fhash_formats.readers.common.file_series import FileSeries
from fhash_formats.readers.common.request import Request, selection
from fhash_formats.readers.zarr_coded import CodedArray, coded_names, open_coded
from fhash_formats.support.atomic import check_output
from fhash_formats.support.attributes import json_attributes
from fhash_formats.support.number_types import exact_number

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["ABSENT", "pack"]

ABSENT = ("refuse", "fill")
"""Values of `absent`."""


def pack(
    source: str | Path,
    path: str | Path,
    *,
    variables: Sequence[str] | None = None,
    axes: Sequence[str] | None = None,
    select: Mapping[str, int | str] | None = None,
    absent: str = ABSENT[0],
    timings: bool = True,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make a container of the arrays of a Zarr store that `fhash.transform` coded.

    The bytes of the chunks are copied, so that every value has the bits that zarr decodes from the
    store. Each chunk is decoded once, for the range of the values and to check it. Figures that
    need the original data, such as the PSNR, are not in the file.

    source: a folder or a ZIP of Zarr format 3.
    variables: names of those to pack. By default all that are coded; a further variable of numbers
        is then refused, since it would be lost.
    axes, select: as in `open_series`. A dimension along which an index is selected has chunks of
        length 1.
    absent: "fill" takes the fill value for chunks that the store lacks; "refuse" does so only where
        that value marks missing values, with a warning.
    timings: keep the date; without it the same store gives the same bytes.
    force: replace a file that exists.

    Returns `path`, `bytes`, `source_bytes`, `raw_bytes`, `ratio`, `seconds`, and in `variables` the
    figures of each. Raises InputError for arrays that have to be coded again, and for chunks that
    are missing; DamagedFileError for damaged chunks; OutputExistsError and OutputError.
    """
    begun = time.perf_counter()
    source, path = _folder(source), Path(os.path.normpath(path))
    if absent not in ABSENT:
        raise InputError(f"absent is '{absent}'; allowed: {', '.join(ABSENT)}")
    check_name(path)
    check_output(path, force, sources=[source])
    root, names = _all_coded(source) if variables is None else (source, list(variables))
    request = Request(axes=None if axes is None else tuple(axes), select=selection(select))
    job = _Job(source=root, request=request, absent=absent, timings=timings, progress=progress)
    figures: dict[str, Any] = {}
    several = names if len(names) > 1 else ()
    with ContainerWriter(path, force=force, variables=several) as writer:
        if len(names) == 1:
            with job.opened(names[0]) as (series, array):
                header, figures[array.name] = job.write(writer, series, array, "")
            size = writer.commit(header)
        else:
            size = _write_several(writer, job, names, figures)
    raw = sum(each["raw_bytes"] for each in figures.values())
    return {
        "path": str(path),
        "bytes": size,
        "source_bytes": bytes_on_disk([source]),
        "raw_bytes": raw,
        "ratio": raw / size,
        "seconds": time.perf_counter() - begun,
        "variables": figures,
    }


def _write_several(
    writer: ContainerWriter, job: _Job, names: Sequence[str], figures: dict[str, Any]
) -> int:
    """Write several variables, and add the figures of each; the bytes of the file."""
    for name in names:
        # Every variable is opened once, so that one that cannot be taken is refused at once.
        with job.opened(name) as (series, _):
            metadata = series.metadata
    writer.attributes = {} if metadata is None else json_attributes(metadata.attributes)
    for number, name in enumerate(names, start=1):
        with job.opened(name) as (series, array):
            note = f"{name}, {number} of {len(names)}"
            header, figures[name] = job.write(writer, series, array, note)
        writer.finish(header)
    return writer.commit()


@dataclass(frozen=True, kw_only=True)
class _Job:
    """The wishes about a store, and how one of its variables is written."""

    source: Path
    request: Request
    absent: str
    timings: bool
    progress: Progress

    @contextmanager
    def opened(self, name: str) -> Iterator[tuple[FileSeries, CodedArray]]:
        """The series of a variable and its chunks."""
        request = Request(var=name, axes=self.request.axes, select=self.request.select)
        with open_coded(self.source, request) as opened:
            yield opened

    def write(
        self, writer: ContainerWriter, series: FileSeries, array: CodedArray, note: str
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Write the arrays of a variable; its header and its figures."""
        nothing = Scan(value_range=ValueRange(0.0, 0.0), mean=0.0, finite_count=0, missing={})
        described = write_series(
            writer,
            series,
            nothing,
            range(series.shape[0]),
        )
        tiles = Tiles(array, series.source, fill_absent=self.absent == "fill")
        total = len(tiles)
        self.progress("packing", 0, total, note)
        table: dict[str, Any] = {
            "shape": array.shape,
            "dtype": array.dtype,
            "chunk_shape": array.tile,
            "dimension_names": ("t", "z", "y", "x"),
            "codecs": tiles.codecs,
            "chunks": tiles.streams(lambda done: self.progress("packing", done, total, note)),
        }
        if tiles.shard is None:
            writer.add_array(TABLE, **table)
        else:
            writer.add_sharded(TABLE, shard_shape=tiles.shard, **table)
        tiles.check_against_store()
        series.check()
        facts = tiles.facts
        if facts.absent and self.absent != "fill":
            warnings.warn(
                f"{self.source}: the store lacks {facts.absent} of {total} chunks of {array.name}, "
                "which have no value in the container either; pack it again if it was still being"
                " written",
                FhashWarning,
                stacklevel=4,
            )
        if facts.mean.count == 0:
            raise InputError(
                f"{series.source}: variable {array.name} has no finite value; nothing to pack"
            )
        scan = Scan(
            value_range=facts.value_range,
            mean=min(max(facts.mean.value(), facts.low), facts.high),
            finite_count=facts.mean.count,
            missing=facts.missing,
        )
        if scan.missing:
            write_missing(writer, series.shape, scan)
        config = EncodeConfig(timings=self.timings)
        header = _header(series, array, tiles, scan, described, config)
        raw = prod(array.shape) * array.dtype.itemsize
        return header, {
            "shape": list(array.shape),
            "tile": list(array.tile),
            "tiles": total,
            "absent": facts.absent,
            "bytes": facts.bytes,
            "raw_bytes": raw,
            "value_range": [scan.value_range.low, scan.value_range.high],
            "codec": array.quality,
        }


def _header(
    series: FileSeries,
    array: CodedArray,
    tiles: Tiles,
    scan: Scan,
    described: Mapping[str, Any],
    config: EncodeConfig,
) -> dict[str, Any]:
    """The header of a variable. What only the original data could tell is not in it."""
    settings, facts = tiles.metadata.coder.settings, tiles.facts
    source = describe_source(series, scan.value_range, config)
    weights, head = 0, None
    if settings is not None and settings.head is not None:
        weights = settings.head.size
        head = {"hidden": list(settings.head.hidden), "cross": settings.head.cross}
    bound = {name: array.quality[name] for name in ("max_error",) if name in array.quality}
    encoder = {**source["encoder"], "command": PACKED}
    return {
        **source,
        **described,
        "required_features": ["transform"],
        "encoder": {**encoder, **({"codec": array.quality} if array.quality else {})},
        "background": exact_number(_in_type(scan.mean, array.dtype)),
        "feature_bounding_box": [[0, n] for n in array.shape[1:]],
        "features": ["all"],
        "dilation": 0,
        "coreset_fraction": facts.occupied / prod(array.shape),
        "model": {
            "profile": "compact",
            "levels": [list(array.shape)],
            "embedding_size": 1,
            "tables": array.dtype.name,
            "parameters": weights,
            "head": head,
        },
        "config": {**config.to_dict(), **bound},
        "quality": {},
        "training": {"seconds": None, "steps": 0, "epochs": 0, "device": "none"},
        "history": {},
    }


def _in_type(value: float, dtype: np.dtype[Any]) -> float:
    """A number within the range of the type of the values."""
    return float(dtype.type(value)) if dtype.kind == "f" else value


def _folder(source: str | Path) -> Path:
    """The path of a store; raises InputError for a URL, MissingInputError without a file."""
    if "://" in str(source):
        raise InputError(f"{source}: a store is packed from a folder or a ZIP; copy it here first")
    if not Path(source).exists():
        raise MissingInputError(f"{source}: no such file or folder")
    return Path(os.path.normpath(source))


def _all_coded(source: Path) -> tuple[Path, list[str]]:
    """The store, and the names of its variables, all of which are coded.

    Raises InputError where there is none, and where others would be lost.
    """
    root, coded = coded_names(source)
    names = [name for name, is_coded in coded.items() if is_coded]
    if not names:
        raise InputError(
            f"{source} has no variable that fhash.transform coded in Zarr format 3: "
            f"fhash encode {source}"
        )
    lost = [name for name in encodable(list_variables(root))[0] if name in coded.keys() - names]
    if lost:
        raise InputError(
            f"{source}: variable {lost[0]} is not coded by fhash.transform and would be left out; "
            f"name those to pack by --var {','.join(names)}, or use fhash encode {source}"
        )
    return root, names
