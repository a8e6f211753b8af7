"""The formats that can be written, and the steps common to them all.

Every output is checked first, written to temporaries, and takes its name last.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashError, InputError
from fhash_formats.support.files import check_output, replacing_all
from fhash_formats.writers.common import Frame, Region, Writer, safe_name
from fhash_formats.writers.labelled import HDF5, NETCDF, NPY, RAW, ZARR
from fhash_formats.writers.vtk import VTK, VTKHDF

WRITERS = (NPY, HDF5, NETCDF, ZARR, RAW, VTK, VTKHDF)


def save_check(
    path: str | Path,
    force: bool = False,
    region: Region | None = None,
    sources: Sequence[str | Path] = (),
    *,
    variables: int = 1,
) -> None:
    """Make the checks of `save_region` that need no work; all checks where the region is given.

    variables: how many will be written.

    Raises:
        InputError: a suffix that no writer has, a region that the format cannot hold, a format that
            holds fewer variables, or an output that is one of the `sources`.
        OutputExistsError: the path, or with `region` any file that goes with it, exists and `force`
            is not given.
        OutputError: no such folder, no permission, or an existing object that must not be replaced.
    """
    target = Path(path)
    writer = _writer(target)
    if variables > 1 and not writer.several:
        able = ", ".join(suffix for each in WRITERS if each.several for suffix in each.suffixes)
        raise InputError(
            f"{path}: {writer.name} holds one variable, and there are {variables}; choose one, or"
            f" use one of {able}"
        )
    check_output(target, force, directory=writer.directory, sources=sources)
    if region is not None:
        for output in writer.outputs(target, region):
            check_output(output, force, directory=writer.directory, sources=sources)


def save_region(
    path: str | Path,
    region: Region,
    frames: Iterable[npt.NDArray[np.generic]],
    *,
    force: bool = False,
    sources: Sequence[str | Path] = (),
) -> list[Path]:
    """Write the frames of a region in the format of the suffix of `path`; complete or absent.

    Args:
        path: ends in .npy, .h5, .hdf5, .nc, .nc4, .zarr, .raw, .vti, .vtr, .pvd or .vtkhdf.
        region: description of the frames.
        frames: as `save_regions` takes them.
        force: replace outputs that exist; the old ones stay until the new are complete.
        sources: files and folders that the frames come from, which are never replaced.

    Returns:
        The paths written: one, or for several steps in VTK's formats and for .raw all files that
            belong together.

    Raises:
        InputError: an error of `save_check`, or frames that differ from the region's description.
        OutputError: it cannot be written, as on a full disk; nothing is left behind, and an old
            output is as it was.
    """
    return save_regions(path, [(region, frames)], force=force, sources=sources)


def save_regions(
    path: str | Path,
    variables: Sequence[tuple[Region, Iterable[npt.NDArray[np.generic]]]],
    *,
    force: bool = False,
    sources: Sequence[str | Path] = (),
) -> list[Path]:
    """Write regions of several variables into one output, as `save_region` writes one.

    Formats that hold several are HDF5, NetCDF and Zarr; coordinates that are equal are there once.

    Args:
        path: of the output.
        variables: at least one region, each with its frames: one array (z, y, x) of `region.dtype`
            for each step, taken one by one, one variable after the other: never are two held here.
        force: see `save_region`.
        sources: see `save_region`.

    Raises:
        InputError: also for variables that cannot share an output, because they have one name, or,
            in NetCDF and Zarr, dimensions or arrays of one name that differ.
    """
    target = Path(path)
    regions = [region for region, _ in variables]
    save_check(target, force, regions[0], sources, variables=len(regions))
    names = [safe_name(region.name) for region in regions]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two variables would have the name {name}")
    writer = _writer(target)
    outputs = writer.outputs(target, regions[0])
    with (
        replacing_all(outputs, force=force, directory=writer.directory) as temporaries,
        writer.open(regions, outputs, temporaries) as puts,
    ):
        for (region, frames), put in zip(variables, puts, strict=True):
            source, steps = iter(frames), region.shape[0]
            for step in range(steps):
                # no variable: the frame must be gone before the next one is made
                put(step, _frame(region, source, step))
            if _next(region, source) is not None:
                raise InputError(f"region {region.name!r}: more frames than its {steps} steps")
    return outputs


def _writer(path: Path) -> Writer:
    suffix = path.suffix.lower()
    for writer in WRITERS:
        if suffix in writer.suffixes:
            return writer
    suffixes = ", ".join(suffix for writer in WRITERS for suffix in writer.suffixes)
    what = f"the suffix {path.suffix!r}" if suffix else "a name without a suffix"
    raise InputError(f"{path}: cannot write {what}; use one of {suffixes}")


def _frame(region: Region, source: Iterator[npt.NDArray[np.generic]], step: int) -> Frame:
    frame = _next(region, source)
    if frame is None:
        raise InputError(
            f"region {region.name!r}: only {step} frames came for its {region.shape[0]} steps"
        )
    if frame.shape != region.shape[1:] or frame.dtype.newbyteorder("=") != region.dtype:
        raise InputError(
            f"region {region.name!r}: frame {step} is {frame.dtype} {frame.shape}; {region.dtype}"
            f" {region.shape[1:]} (z, y, x) is needed"
        )
    return np.ascontiguousarray(frame, dtype=region.dtype)


def _next(region: Region, source: Iterator[npt.NDArray[np.generic]]) -> Frame | None:
    try:
        return next(source, None)
    except OSError as error:
        if isinstance(error, FhashError):
            raise
        # Not the output's failure, and an OSError would be reported as one.
        raise InputError(
            f"region {region.name!r}: the values could not be read: {error}"
        ) from error
