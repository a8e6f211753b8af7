"""Registry of the readers: finds the right one, opens a series or a mask, lists the variables."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import FhashError, FhashWarning, InputError, MissingInputError
from fhash_formats.readers import (
    grids,
    hdf5,
    images,
    labelled,
    netcdf3,
    simulations,
    tiff,
    vtk,
    zarr_store,
)
from fhash_formats.readers.file_series import (
    HEAD_BYTES,
    FileSeries,
    RawLayout,
    Request,
    condense,
    parse_axes,
    refusing,
    selection,
)
from fhash_formats.readers.joined import JoinedSeries, files_of, is_pattern, warn_of_gaps
from fhash_formats.readers.listing import Listed, listed_series
from fhash_formats.readers.select import list_selected, open_selected
from fhash_formats.readers.stored_parts import require_inside
from fhash_formats.readers.variables import Source
from fhash_formats.series import Series, StepsSeries, warn_not_stored
from fhash_formats.support.files import is_url

CONTAINER_SUFFIX = ".fhz"


class Reader(NamedTuple):
    """One format.

    Attributes:
        name: name for messages.
        suffixes: file name suffixes.
        matches: whether a file is of the format, from its first bytes (none for a folder) and path.
        open: gives its variables; of a list of files, the series itself.
    """

    name: str
    suffixes: tuple[str, ...]
    matches: Callable[[bytes, Path], bool]
    open: Callable[[Path, Request], Source | JoinedSeries]

    def __str__(self) -> str:
        return f"{self.name} ({' '.join(self.suffixes)})" if self.suffixes else self.name


RAW = Reader("raw", (".raw", ".bin", ".dat"), images.is_raw, images.open_raw)
ZARR = Reader("Zarr", (".zarr", ".zip"), zarr_store.matches, zarr_store.open_zarr)
PLOTFILE = Reader("AMReX", (), simulations.is_plotfile, simulations.open_plotfile)
ADIOS = Reader("ADIOS2", simulations.ADIOS_SUFFIXES, simulations.is_adios, simulations.open_adios)
FOLDERS = (ZARR, PLOTFILE, ADIOS)
"""Formats of folders."""
REGISTRY = (
    RAW,
    Reader("VTKHDF", vtk.VTKHDF_SUFFIXES, vtk.is_vtkhdf, vtk.open_vtkhdf),
    Reader("NetCDF-3", (), netcdf3.matches, netcdf3.open_classic),
    Reader("NetCDF", hdf5.NETCDF_SUFFIXES, hdf5.says_netcdf, hdf5.open_netcdf),
    Reader("HDF5", hdf5.SUFFIXES, hdf5.matches, hdf5.open_hdf5),
    Reader("NumPy", (".npy",), images.is_npy, images.open_npy),
    ZARR,
    Reader("VTK", vtk.XML_SUFFIXES, vtk.is_vtk_xml, vtk.open_vtk),
    Reader("collection", vtk.COLLECTION_SUFFIXES, vtk.is_collection, vtk.open_pvd),
    Reader("NRRD", images.NRRD_SUFFIXES, images.is_nrrd, images.open_nrrd),
    Reader("MetaImage", images.METAIMAGE_SUFFIXES, images.is_metaimage, images.open_metaimage),
    Reader("NIfTI", grids.NIFTI_SUFFIXES, grids.is_nifti, grids.open_nifti),
    Reader("MRC", grids.MRC_SUFFIXES, grids.is_mrc, grids.open_mrc),
    Reader("OpenDX", grids.DX_SUFFIXES, grids.is_dx, grids.open_dx),
    Reader("cube", grids.CUBE_SUFFIXES, grids.is_cube, grids.open_cube),
    Reader("legacy VTK", grids.LEGACY_SUFFIXES, grids.is_legacy_vtk, grids.open_legacy_vtk),
    Reader("TIFF", tiff.SUFFIXES, tiff.matches, tiff.open_tiff),
    Reader("SEG-Y", grids.SEGY_SUFFIXES, grids.is_segy, grids.open_segy),
    Reader("GRIB", labelled.GRIB_SUFFIXES, labelled.is_grib, labelled.open_grib),
    PLOTFILE,
    ADIOS,
)
"""Formats in the order in which they are tried.

Raw comes first: its suffix says more than bytes that are values. VTKHDF and NetCDF come before
HDF5, since their files are HDF5 too.
"""


class Wishes(TypedDict, total=False):
    """Wishes for a reading, each of which may be left out; `open_series` explains them."""

    var: str | None
    axes: str | None
    raw: RawLayout | None
    missing: Sequence[float]
    raw_values: bool
    select: Mapping[str, int | str] | None
    keep_extremes: bool
    no_external: bool
    overlap: str | None


def _request(
    axes: str | None = None,
    raw: RawLayout | None = None,
    missing: Sequence[float] = (),
    select: Mapping[str, int | str] | None = None,
    **others: Any,
) -> Request:
    """The request that wishes make; raises InputError for axes of another form."""
    return Request(
        axes=None if axes is None else parse_axes(axes),
        raw=None if raw == RawLayout() else raw,
        missing=tuple(missing),
        select=selection(select),
        **others,
    )


def open_series(
    path: str | Path, *, steps: slice | None = None, **wishes: Unpack[Wishes]
) -> Series:
    """Open a time-varying volume in any supported format; its frames are read later, one by one.

    Args:
        path: a file, a zarr folder, the URL of a Zarr store or of a file of NetCDF-4 or HDF5
            ("s3://bucket/a.zarr"), or a pattern of files ("frames_*.raw") with one or more steps
            each, sorted by the numbers in their names.
        var: name of the variable.
        axes: the file's dimensions in its own order, such as "x,y,z,t"; axes left out have length
            1.
        steps: slice of the steps.
        raw: layout of headerless bytes.
        missing: numbers that stand for missing values, besides those that the file declares.
        raw_values: whether to read packed numbers as they are stored, without their unit.
        select: index (or label) along each dimension that is no axis, by its name, or by "dim3" or
            "3" where it has none: {"member": 2}.
        keep_extremes: whether extreme values that repeat far away from all others are data;
            encoding refuses them otherwise.
        no_external: whether no file outside the folder of the one that is read may be read for it:
            data behind a header, external links, sources of virtual datasets, pieces of a grid,
            links of the file system. For a service that encodes what others upload.
        overlap: of files that have the same span of time, as restarts write them, the steps of the
            "first" or of the "last" file count; None refuses them.

    Warns (FhashWarning) of values that nobody wrote, such as chunks that are not there. Raises
    MissingInputError, InputError for an unsuitable input, and MissingDependencyError that names
    what to install.
    """
    series = open_whole(path, _request(**wishes))
    if series.remark:
        warnings.warn(f"{path}: {series.remark}", FhashWarning, stacklevel=2)
    try:
        if steps is not None:
            _check_stride(path, steps)
            series = StepsSeries(series, range(*steps.indices(series.shape[0])))
        warn_not_stored(series)
        return series
    except BaseException:
        series.close()
        raise


def list_variables(
    path: str | Path, *, steps: slice | None = None, **wishes: Unpack[Wishes]
) -> list[Listed]:
    """The variables of anything that `open_series` reads, whether or not they can be encoded.

    The other arguments are those of `open_series`; they are wishes, and the listing says what they
    leave open. `var` lists that variable alone. The files of a pattern are alike: the first one is
    listed. Raises as `open_series` does for a source that cannot be read at all, and where no
    variable has one of the steps.
    """
    text, request = str(path), _request(**wishes)
    if is_url(path):
        opened: Source | JoinedSeries = labelled.open_url(text, request)
    else:
        place = files_of(text)[0] if is_pattern(text) else Path(path)
        opened = find_reader(place, request).open(place, request)
    if isinstance(opened, Source):
        listed = list_selected(opened, request)
    else:
        opened.close()
        listed = [listed_series(opened, request)]
    if steps is None:
        return listed
    _check_stride(path, steps)
    chosen = [entry.of_steps(steps, whole=not is_pattern(text)) for entry in listed]
    refused = [
        after.problem
        for before, after in zip(listed, chosen, strict=True)
        if after.problem and not before.problem
    ]
    if refused and not any(entry.options for entry in chosen):
        raise InputError(f"{path}: {refused[0]}")
    return chosen


def _check_stride(path: str | Path, steps: slice) -> None:
    """Raise InputError for a stride of 0."""
    if steps.step == 0:
        raise InputError(
            f"{path}: the steps {steps.start}:{steps.stop}:0 have a stride of 0; it is at"
            " least 1, or negative"
        )


def open_whole(path: str | Path, request: Request) -> Series:
    """Open all steps of the series in a file, folder or pattern of files."""
    text = str(path)
    if is_url(path):
        return open_selected(labelled.open_url(text, request), request)
    if not is_pattern(text):
        if request.overlap is not None:
            raise InputError(f"{path}: --overlap is for a pattern of files")
        return _open_one(Path(path), request)
    files = files_of(text)
    if all(tiff.matches(b"", file) for file in files):
        pages = tiff.open_pages(text, files, request)
        if pages is not None:
            warn_of_gaps(text, files)
            return open_selected(pages, request)
    return JoinedSeries(
        text, files, lambda file: _open_of_pattern(file, request), overlap=request.overlap
    )


def _open_of_pattern(path: Path, request: Request) -> FileSeries:
    """Open one file of a pattern."""
    part = _open_one(path, replace(request, digested=False))
    if isinstance(part, FileSeries):
        return part
    part.close()
    raise InputError(f"{path} lists many files, and cannot be one of a pattern; give it alone")


def _open_one(path: Path, request: Request) -> FileSeries | JoinedSeries:
    try:
        opened = find_reader(path, request).open(path, request)
        if isinstance(opened, Source):
            return open_selected(opened, request)
        return opened
    except OSError as error:  # a folder that may not be entered, wherever somebody looks into it
        if isinstance(error, FhashError):
            raise
        raise InputError(f"{path} cannot be read: {condense(error)}") from error


def find_reader(path: Path, request: Request) -> Reader:
    """The format of a file or folder; raises InputError that lists the formats for any other."""
    if not path.exists():
        raise MissingInputError(f"{path} does not exist")
    if path.is_dir():
        found = next((reader for reader in FOLDERS if reader.matches(b"", path)), None)
        if found is None:
            raise InputError(
                f"{path} is a folder without zarr metadata, and none of AMReX or ADIOS2; give a"
                f" file, such a folder, or a pattern such as '{path}/*.raw'"
            )
        if request.raw is not None:
            raise InputError(
                f"{path} is a folder of {found.name}; shape, type and byte order are given for raw"
                " files only"
            )
        if request.no_external:
            request.require_inside(path, path, *path.rglob("*"))
        return found
    if not path.is_file():
        raise InputError(f"{path} is not a regular file; write its data to a file first")
    request.require_inside(path, path)
    head = _head(path)
    if request.no_external and hdf5.is_hdf5(head):
        with refusing(f"{path} cannot be read as HDF5"):
            require_inside(path)
    suffix = path.suffix.lower()
    if request.raw is not None:
        other = next(
            (reader for reader in REGISTRY if reader is not RAW and suffix in reader.suffixes), None
        )
        if other is not None:
            raise InputError(
                f"{path} is a {other.name} file by its name; --shape, --dtype and --endian are for"
                " raw files only"
            )
        if suffix != CONTAINER_SUFFIX:
            return RAW
    if suffix == CONTAINER_SUFFIX or _is_container(path, head):
        raise InputError(f"{path} is encoded already; use: fhash decode {path.name}")
    matching = _matching(head, path)
    if matching is not None:
        return matching
    for reader in REGISTRY:
        if suffix in reader.suffixes:
            return reader
    raise InputError(f"{path} is of no format that can be read{_advice(path)}")


def recognised(path: str | Path) -> str | None:
    """The format of a file of data by its first bytes; None for another, and for no file."""
    try:
        with Path(path).open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return None
    found = None if head.startswith(zarr_store.ZIP) else _matching(head, Path(path))
    return None if found is None else found.name


def _matching(head: bytes, path: Path) -> Reader | None:
    """The format that knows the first bytes of a file."""
    return next((each for each in REGISTRY if each.matches(head, path)), None)


ELSEWHERE = {
    "ParaView, with the filter ResampleToImage": ".vtu .vts .pvtu .pvts .vtp .vtm .foam .case"
    " .e .exo .cgns .xmf .xdmf .plt .silo .msh .stl .ply .obj",
    "pydicom or SimpleITK": ".dcm .dicom",
    "rioxarray": ".hgt .asc .adf .vrt .ecw .jp2",
    "astropy.io.fits": ".fits .fit .fts",
    "pyopenvdb": ".vdb",
    "yt": ".enzo",
    "scipy.io.loadmat": ".mat",
    "pyarrow": ".parquet .feather",
    "pyhdf": ".hdf4 .h4",
    "aicsimageio": ".czi .lif .nd2 .oib .ims",
}
"""Ways to read other formats, each with the suffixes of files for which it is the usual one."""


def _advice(path: Path) -> str:
    """The way to read a file of a format that is not read here, else the formats that are."""
    suffix = path.suffix.lower()
    for way, suffixes in ELSEWHERE.items():
        if suffix in suffixes.split():
            return (
                f"; read it by {way}, and give the array or the xarray object to fhash_codec.encode"
            )
    return f": {', '.join(dict.fromkeys(reader.name for reader in REGISTRY))}"


def _head(path: Path) -> bytes:
    with refusing(f"{path} cannot be read"), path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if not head:
        raise InputError(f"{path} is empty (0 bytes)")
    return head


def _is_container(path: Path, head: bytes) -> bool:
    if not head.startswith(zarr_store.ZIP):
        return False
    from fhash_formats.container import is_container

    return is_container(path)


class Mask:
    """A mask over a series: `mask(step)` is the boolean frame (z, y, x).

    A file with a single frame serves every step.
    """

    def __init__(self, values: Series) -> None:
        self._values = values
        self.files = values.files

    def __call__(self, step: int) -> npt.NDArray[np.bool_]:
        """Frame (z, y, x), True where the file's value at this step is neither zero nor NaN.

        Raises InputError if the file cannot be read.
        """
        frame = self._values.read(step if self._values.shape[0] > 1 else 0)
        mask: npt.NDArray[np.bool_] = frame != 0
        return mask & ~np.isnan(frame) if frame.dtype.kind == "f" else mask

    def check(self) -> None:
        """Raise InputError if the file has changed since it was opened."""
        self._values.check()

    def close(self) -> None:
        """Close the file."""
        self._values.close()


def open_mask(path: str | Path, shape: Sequence[int]) -> Mask:
    """Open a mask for a series of `shape` (t, z, y, x).

    The file holds booleans or numbers of that shape, or of (z, y, x) for all steps alike, in any
    format that `open_series` reads. Raises InputError for another shape.
    """
    values = open_whole(path, Request(booleans=True, asked=False))
    if values.shape[1:] != tuple(shape[1:]) or values.shape[0] not in (1, shape[0]):
        values.close()
        raise InputError(
            f"{path}: the mask has shape {values.shape} (t, z, y, x), the series {tuple(shape)};"
            " it must be that, or one step of it"
        )
    return Mask(values)
