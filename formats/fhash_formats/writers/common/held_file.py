"""Writing through the HDF5 library so that neither a full disk nor Ctrl-C does damage.

HDF5 (seen with 2.0.0 under h5py 3.16) does not survive a failed write: on a full disk h5py raises,
and the process crashes with a segmentation fault when the library closes the file at exit. So HDF5
writes through a Python file that keeps the first failure to itself, drops all later writes, and
lets the writer raise the failure where that is safe.

Ctrl-C, in turn, would be delivered in that Python file, inside HDF5's call. h5py was seen to
swallow it while it released an object, which left a file with a hole that looked complete. So
Python's signal handlers wait until the call has returned.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fhash_formats.support.interrupts import signals_held


class HeldFile(io.FileIO):
    """A new, writable binary file whose writes never fail; `check` raises the first failure."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "x+")
        self.failure: Exception | None = None

    def write(self, data: Any, /) -> int:
        """Write all of `data`, or nothing once a write has failed."""
        view = memoryview(data).cast("B")
        length = len(view)
        try:
            while self.failure is None and len(view):
                view = view[super().write(view) :]
        except Exception as error:
            self.failure = error
        return length

    def truncate(self, size: int | None = None, /) -> int:
        """Set the length, unless a write has failed."""
        try:
            if self.failure is None:
                return super().truncate(size)
        except Exception as error:
            self.failure = error
        return size or 0

    @contextmanager
    def calling(self) -> Iterator[None]:
        """A block that calls HDF5.

        Signals wait until the block ends; then the first failure of the file is raised.
        """
        with signals_held():
            try:
                yield
            except Exception:
                self.check()  # what HDF5 says after a write that was dropped is only a consequence
                raise
        self.check()

    def check(self) -> None:
        """Raise the first failure."""
        if self.failure is not None:
            raise self.failure


@contextmanager
def held_hdf5(path: Path, opening: Callable[[HeldFile], Any]) -> Iterator[tuple[HeldFile, Any]]:
    """A new file at `path`, and the object that `opening` (h5py, h5netcdf) makes of it.

    The object is closed before the file in every case.
    """
    root = None
    with HeldFile(path) as file:
        try:
            with file.calling():
                root = opening(file)
            yield file, root
        finally:
            if root is not None:
                with file.calling():
                    root.close()
