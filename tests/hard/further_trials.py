"""A hostile file through C, through xarray, as Zarr, with further steps, and merged with another
part."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import mutations
import numpy as np
import xarray
import zarr

import fhash_codec
from fhash_codec import Volume, zarr_store
from fhash_codec.xarray_backend import shown_names
from fhash_formats.errors import FhashError
from fhash_formats.native import ffi, library, pointer
from fhash_formats.series import ArraySeries
from fhash_formats.support.values import DTYPES
from fhash_formats.transform.tile import checked

FEW = 1 << 14
"""Most vertices of a frame that is appended, and of a file whose steps are compared."""
STRIDE = 5
"""One of so many files that are no file of `Writer` is appended to as well."""
Region = list[tuple[int, int]]


class Further:
    """One mutated file, and what other programs do with it.

    Each method returns what is wrong with its result, or None.

    Attributes:
        grows: whether steps are to be appended to the file.
        is_part: whether it is to be merged.
    """

    def __init__(
        self,
        path: Path,
        folder: Path,
        mutation: mutations.Mutation,
        variable: str | None,
        region: Region,
    ) -> None:
        self.path, self.folder, self.mutation = path, folder, mutation
        self.variable = variable
        self.region = tuple(slice(low, high) for low, high in region)
        grown = mutation.golden.endswith("-grown")
        self.grows = mutation.sealed and (grown or mutation.number % STRIDE == 0)
        self.is_part = "-part-" in mutation.golden

    def by_c(self) -> str | None:
        """Read a region of one step and the positions through the C interface."""
        step, found, refused = self.region[0].start, None, None
        with fhash_codec.open(self.path) as opened:
            names = [opened.name] if isinstance(opened, Volume) else list(opened)
            volume = opened if isinstance(opened, Volume) else opened[self.variable or names[0]]
            number = names.index(self.variable) if self.variable in names else 0
            space = tuple((span.start, span.stop) for span in self.region[1:])
            wanted = volume.read(step, space)
            try:
                found, positions = self._read_by_c(number, step, volume.float_dtype, volume.shape)
            except FhashError as error:
                refused = error
            if found is None:
                return f"C refuses what Python reads: {refused}"
            for own, theirs in zip(volume.coords.values(), positions, strict=True):
                if own.values.tobytes() != theirs.tobytes():
                    return "C: other positions"
            # Sums of the published network are made in another order.
            same = volume.profile != "compact" or np.array_equal(found, wanted, equal_nan=True)
        return None if same else "C: other values than in Python"

    def _read_by_c(self, number: int, step: int, dtype: Any, shape: Any) -> Any:
        """Values of the region at a step, and positions along each axis."""
        context, made = library().fhash_context_create(0, 1), ffi.new("fhash_file **")
        try:
            checked("fhash_open_path", context, os.fsencode(self.path), made)
            values = np.empty([span.stop - span.start for span in self.region[1:]], dtype)
            ends = [end for span in self.region[1:] for end in (span.start, span.stop)]
            kind = list(DTYPES).index(np.dtype(dtype).name) + 1
            checked("fhash_read", made[0], number, step, ends, 0, kind, pointer(values))
            positions = [np.empty(length) for length in shape]
            for axis, room in enumerate(positions):
                place = (number, axis, pointer(room), ffi.NULL)
                checked("fhash_coordinate", made[0], *place)
            return values, positions
        finally:
            library().fhash_close(made[0])
            library().fhash_context_destroy(context)

    def by_xarray(self) -> str | None:
        """Open the file by xarray, and read a region of a variable."""
        with (
            xarray.open_dataset(self.path, engine="fhash", decode_cf=False) as dataset,
            fhash_codec.open(self.path) as opened,
        ):
            volumes = {opened.name: opened} if isinstance(opened, Volume) else opened
            volume = opened if isinstance(opened, Volume) else opened[self.variable or ""]
            names = shown_names({name: each.name for name, each in volumes.items()})
            array = dataset[names[self.variable or volume.name]]
            if prod(array.shape) != prod(volume.shape):
                return f"xarray: shape {array.shape} instead of {volume.shape}"
            if array.shape == volume.shape:
                return _difference(array[self.region].values, volume, self.region)
        return None

    def by_zarr(self) -> str | None:
        """Read a region of a variable from the Zarr view."""
        store = zarr_store(self.path)
        try:
            view = store.view
            key = self.variable if self.variable in view.volumes else next(iter(view.volumes))
            group = zarr.open_group(store, mode="r", zarr_format=3)
            array: Any = group[view.names[key]]
            volume = view.volumes[key]
            list(group.members(max_depth=1))
            if array.shape == volume.shape:
                return _difference(array[self.region], volume, self.region)
            return None if prod(array.shape) == prod(volume.shape) else f"zarr: {array.shape}"
        finally:
            store.close()

    def append(self) -> str | None:
        """Append a layer to a copy of the file; what was there stays."""
        copy = self.folder / "grown.fhz"
        shutil.copy(self.path, copy)
        appended = False
        try:
            with fhash_codec.open(self.path, variable=self.variable) as volume:
                shape, dtype = volume.shape, volume.dtype
                few = prod(shape[1:]) <= FEW
                before = volume[: min(shape[0], 4)] if few else None
                coords = dict(volume.coords)
            if not few:
                return None
            frames = np.full((3, *shape[1:]), 1, dtype=dtype)
            keep = shape[0] - shape[0] % 2
            if self.mutation.number % 2:
                with fhash_codec.Writer.resume(copy, steps=keep or None) as writer:
                    for frame in frames:
                        writer.append(frame)
            else:
                last = coords["t"].values[(keep or shape[0]) - 1]
                coords["t"] = replace(coords["t"], values=last + 1 + np.arange(3.0))
                fhash_codec.append(ArraySeries(frames, coords=coords), copy, keep=keep or None)
            appended = True  # tiles that were there are copied; only `verify` decodes them
            with fhash_codec.open(copy) as volume:
                volume.verify()
                if volume.shape[0] != (keep or shape[0]) + 3:
                    return f"append: {volume.shape[0]} steps"
                kept = volume[: min(keep, 4)]
                same = np.array_equal(kept, before[: len(kept)], equal_nan=True)
            return None if same else "append: other values in the steps that were there"
        except fhash_codec.FhashError:
            if not appended and copy.read_bytes() != self.path.read_bytes():
                return "append: refused, but the file is another one"
            raise
        finally:
            copy.unlink()

    def merge(self) -> str | None:
        """Merge the file with the other part of its series; its values are in the whole."""
        number = int(self.mutation.golden[-1])
        other = mutations.GOLDENS / f"{self.mutation.golden[:-1]}{3 - number}.fhz"
        whole = self.folder / "whole.fhz"
        whole.unlink(missing_ok=True)
        try:
            fhash_codec.merge([self.path, other], whole)
        except BaseException:
            if whole.exists():
                return "merge: refused, but there is a file"
            raise
        with fhash_codec.open(whole) as volume, fhash_codec.open(self.path) as part:
            volume.verify()
            first = part.container.header["part"]["first"]
            steps = slice(first, first + min(part.shape[0], 4))
            same = np.array_equal(volume[steps], part[: min(part.shape[0], 4)], equal_nan=True)
        return None if same else "merge: other values than in the part"


def _difference(values: Any, volume: Volume, region: tuple[slice, ...]) -> str | None:
    """Whether a region has other values than the volume gives."""
    if np.array_equal(values, volume[region], equal_nan=True):
        return None
    return "other values than the volume's"
