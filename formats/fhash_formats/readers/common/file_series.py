"""A series in a file: frames come out as (z, y, x), whatever the order of the file's dimensions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError
from fhash_formats.readers.common.cf_packing import Packing, missing_values, note_packing
from fhash_formats.readers.common.failures import FolderStamp, Stamp, refusing
from fhash_formats.readers.common.request import Request
from fhash_formats.readers.common.times import settled
from fhash_formats.series import AXES, Coordinate, NotStored, Series, check_values, index_coordinate
from fhash_formats.source_metadata import plain_form
from fhash_formats.support.attributes import plain_text

SLAB_BYTES = 64 * 2**20
"""Bytes of a file that are kept between frames, at most.

A chunk that spans many steps would be decompressed again for each of them. With this limit, chunks
of several frames of 128^3 float64 are decompressed once, and memory stays small beside the
encoder's own.
"""

Fetch = Callable[[tuple[slice, ...]], npt.NDArray[Any]]


def native(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Type of the frames of stored values: native byte order, booleans as the numbers 0 and 1."""
    return np.dtype(np.uint8) if dtype.kind == "b" else dtype.newbyteorder("=")


class FileSeries(Series):
    """A series whose frames are fetched from a file as slices in the file's own order of
    dimensions.

    Args:
        shape, axes: lengths and axes of the dimensions, in the file's order.
        dtype: type of the physical values, in any byte order.
        fetch: `fetch(slices)` returns a fresh array of the file's dimensions.
        chunks: shape of a stored chunk, None without chunks. As many steps of one chunk as fit
            SLAB_BYTES are fetched at once and kept until the next fetch; without chunks, one frame
            at a time.
        stamp: checked before and after every fetch.
        beside: further files that hold values, checked likewise.
        folder: stamp of all files, which `check` alone looks at.
        packing: the packing that `fetch` undoes, if any; it says what stood for missing values.
        not_stored: what nobody wrote, with the number that stands there as it is stored.
        default_fill: value as it is read that stands for one that nobody wrote, see
            `Series.defaults`.

    Raises InputError for a shape or type that cannot be a series.

    Attributes:
        given: axes whose coordinate the file gives.
        stamps: stamps of everything that is read, from when it was opened.
    """

    def __init__(
        self,
        *,
        source: str,
        name: str,
        shape: Sequence[int],
        dtype: np.dtype[Any],
        axes: Sequence[str],
        fetch: Fetch,
        stamp: Stamp,
        coords: Mapping[str, Coordinate] | None = None,
        attributes: Mapping[str, Any] | None = None,
        chunks: Sequence[int] | None = None,
        close: Callable[[], None] = lambda: None,
        beside: Sequence[Path] = (),
        folder: FolderStamp | None = None,
        packing: Packing | None = None,
        not_stored: NotStored | None = None,
        default_fill: float | None = None,
    ) -> None:
        lengths = dict(zip(axes, shape, strict=True))
        self.source, self.name, self.dtype = source, plain_text(name), native(dtype)
        self.files = (Path(source), *beside)
        self.shape = check_values(source, [lengths.get(axis, 1) for axis in AXES], self.dtype)
        self.attributes = dict(attributes or {})
        self.units = str(self.attributes.get("units", ""))
        coords = dict(coords or {})
        if "t" in coords:
            coords["t"], self.remark = settled(coords["t"])
        self.given = frozenset(coords)
        self.coords = {
            axis: index_coordinate(axis, length)
            for axis, length in zip(AXES, self.shape, strict=True)
        } | {axis: replace(each, name=plain_form(each.name)) for axis, each in coords.items()}
        self._axes, self._fetch, self._close = tuple(axes), fetch, close
        self._quick = (stamp, *map(Stamp.of, beside))
        self.stamps: tuple[Stamp | FolderStamp, ...] = (
            self._quick if folder is None else (*self._quick, folder)
        )
        frame_bytes = self.dtype.itemsize * prod(self.shape[1:])
        self._together = max(
            1, min(_steps_of_a_chunk(self._axes, shape, chunks), SLAB_BYTES // frame_bytes)
        )
        self._slab: tuple[int, npt.NDArray[Any]] | None = None
        self._missing: Packing | None = None
        self._sought: dict[float, Any] = {}
        self._met: set[float] = set()
        self.occurring = self._met
        self.not_stored = not_stored
        self._default, self._defaults = default_fill, set[float]()
        self.defaults = self._defaults
        if packing is not None:
            note_packing(self, packing)
        self._unpack_fill(packing)

    def hide(self, missing: Sequence[float]) -> None:
        """Make some values missing: they become NaN, and integers become floats.

        missing: as they are read, after unpacking.
        """
        if missing:
            self._missing = missing_values(self.source, self.dtype, missing)
            for value in missing:
                for fill in missing_values(self.source, self.dtype, [value]).fills:
                    self._sought[value] = fill
                    self._default = None if fill == self._default else self._default
            note_packing(self, self._missing)
            self.dtype = self._missing.dtype
            self._unpack_fill(self._missing)

    def _unpack_fill(self, packing: Packing | None) -> None:
        """Make the number that stands for what nobody wrote a value; a missing one tells itself."""
        found = self.not_stored
        if found is None:
            return
        stored = np.array([found.fill], self.dtype if packing is None else packing.stored)
        fill = stored[0] if packing is None else packing.unpack(stored)[0]
        self.not_stored = None if fill != fill else replace(found, fill=fill.item())

    def as_asked(self, request: Request) -> Self:
        """Return this series with the values missing, or kept, that the user named."""
        self.hide(request.missing)
        self.keep_extremes = request.keep_extremes
        if self.keep_extremes:
            self._default = None
        told = self.not_stored
        if told is not None and told.fill == self._default and self.dtype.kind == "f":
            self.not_stored = None  # missing, as the frames will show
        return self

    def read(self, step: int) -> npt.NDArray[Any]:
        self.require_step(step)
        start = step - step % self._together
        if self._together == 1:
            return np.ascontiguousarray(self._block(step, step + 1)[0], dtype=self.dtype)
        slab = self._slab
        if slab is None or slab[0] != start:
            self._slab = None  # before the fetch, so that two slabs are never held
            slab = self._slab = (
                start,
                self._block(start, min(start + self._together, self.shape[0])),
            )
        else:
            self._check_files()
        return np.array(slab[1][step - start], dtype=self.dtype, order="C")

    def check(self) -> None:
        for stamp in self.stamps:
            stamp.check()

    def close(self) -> None:
        self._slab = None
        self._close()

    def _check_files(self) -> None:
        for stamp in self._quick:
            stamp.check()

    def _block(self, start: int, stop: int) -> npt.NDArray[Any]:
        """Steps start to stop as (t, z, y, x)."""
        steps = f"step {start}" if stop == start + 1 else f"steps {start} to {stop - 1}"
        self._check_files()
        with refusing(f"{self.source}: {steps} of {self.name} cannot be read"):
            ranges = {
                axis: slice(0, length) for axis, length in zip(AXES, self.shape, strict=True)
            } | {"t": slice(start, stop)}
            values = self._fetch(tuple(ranges[axis] for axis in self._axes))
        self._check_files()
        expected = {**dict(zip(AXES, self.shape, strict=True)), "t": stop - start}
        if values.shape != tuple(expected[axis] for axis in self._axes):
            raise InputError(
                f"{self.source}: {steps} of {self.name} came as {values.shape}; the file changed"
                " while it was being read"
            )
        if self._default is not None and (unwritten := values == self._default).any():
            self._defaults.add(self._default)
            if values.dtype.kind == "f":
                values = np.where(unwritten, values.dtype.type(np.nan), values)
        if self._missing is not None:
            self._met.update(
                value
                for value, fill in self._sought.items()
                if value not in self._met and (values == fill).any()
            )
            values = self._missing.unpack(values.astype(self._missing.stored, copy=False))
        present = [axis for axis in AXES if axis in self._axes]
        ordered = values.transpose([self._axes.index(axis) for axis in present])
        return np.expand_dims(
            ordered, tuple(place for place, axis in enumerate(AXES) if axis not in present)
        )


def _steps_of_a_chunk(
    axes: Sequence[str], shape: Sequence[int], chunks: Sequence[int] | None
) -> int:
    """Steps in one chunk.

    Without chunks it is 1, or all steps where time is not the slowest dimension.
    """
    if "t" not in axes:
        return 1
    place = axes.index("t")
    if chunks is not None:
        return chunks[place]
    return 1 if place == 0 else shape[place]
