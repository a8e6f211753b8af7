"""Outputs that are complete or absent, and never half of one: the one helper for every file that fhash writes.

The bytes go to a temporary sibling in the same folder, are synced to the disk, and only then take the output's name.
Whatever happens before (an error, a full disk, Ctrl-C) removes the temporary and leaves an older output as it was. Of a writer that was
killed the temporary stays, until the next writer of that output clears it away (see `leftovers`).
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from fhash_formats.errors import FhashError, InputError, OutputError, OutputExistsError
from fhash_formats.support import leftovers
from fhash_formats.support.interrupts import signals_held
from fhash_formats.support.leftovers import remove

ZARR_METADATA = ("zarr.json", ".zgroup", ".zarray")


def check_output(
    path: Path, force: bool, *, directory: bool = False, sources: Sequence[str | Path] = ()
) -> None:
    """The checks of an output that can be made before any work.

    Args:
        path: of the output; a link is followed.
        force: whether an output that is there already may be replaced.
        directory: whether the output is a directory (a Zarr store) and not a file.
        sources: files and folders that the output is made from, which not even `force` lets it replace.

    Raises:
        InputError: the output is one of the sources, lies inside one or contains one.
        OutputExistsError: it is there already and `force` is not given.
        OutputError: no such folder, no permission, or something is there that must not be replaced even with `force`.
    """
    target = Path(os.path.realpath(path))
    for source in sources:
        _check_source(path, target, source)
    folder = target.parent
    try:
        if not stat.S_ISDIR(os.stat(folder).st_mode):
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        mode = os.lstat(target).st_mode
    except FileNotFoundError as error:
        if folder.is_dir():
            return
        if folder != Path(os.path.realpath(path.parent)):
            raise OutputError(
                f"{path} is a link to {target}, and the folder {folder} does not exist; create it, or choose another name"
            ) from error
        raise explained(path, error) from error
    except OSError as error:
        raise explained(path, error) from error
    if stat.S_ISDIR(mode) and not directory:
        raise OutputError(f"{path} is a directory; give the name of a file")
    if not force:
        raise OutputExistsError(
            f"{path} exists; use --force (force=True) to replace it, or another name"
        )
    if stat.S_ISDIR(mode) and not any(os.path.isfile(target / name) for name in ZARR_METADATA):
        raise OutputError(
            f"{path} is a directory but no Zarr store: --force does not replace it; give another name"
        )
    if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
        raise OutputError(
            f"{path} is not an ordinary file and cannot be replaced; give another name"
        )


def _check_source(path: Path, target: Path, source: str | Path) -> None:
    own = Path(os.path.realpath(source))
    if _same(target, own):
        raise InputError(f"{path} is the input itself; choose another name")
    if own.is_dir() and any(_same(folder, own) for folder in target.parents):
        raise InputError(f"{path} lies inside the input {source}; choose a name outside it")
    if target in own.parents:
        raise InputError(f"{path} contains the input {source}; choose another name")


def _same(one: Path, other: Path) -> bool:
    """Whether two resolved paths are one file or folder, by whatever names (hard links, another case)."""
    try:
        return os.path.samefile(one, other)
    except OSError:  # one of them is not there
        return one == other


@contextmanager
def replacing(path: Path, *, force: bool, directory: bool = False) -> Iterator[Path]:
    """A temporary path that becomes `path` when the block ends, and vanishes when the block fails.

    The block creates a file (or with `directory` a directory) at the path it is given, `.NAME.<writer>.partial` in the
    same folder. Raises what `check_output` raises, before the block; an OSError of the block becomes an OutputError.
    """
    with replacing_all([path], force=force, directory=directory) as temporaries:
        yield temporaries[0]


@contextmanager
def replacing_all(
    paths: Sequence[Path], *, force: bool, directory: bool = False
) -> Iterator[list[Path]]:
    """Temporary paths that become `paths`, in that order, when the block ends; if one cannot, none does.

    Raises and guarantees what `replacing` does. Only a process that is killed between two renames can leave some of
    several outputs without the others: name the one that refers to the others last.
    """
    outputs = [_Output(path) for path in paths]
    leftovers.clear(output.target for output in outputs)
    for path in paths:
        check_output(path, force, directory=directory)
    try:
        yield [output.temporary for output in outputs]
        for output in outputs:
            _sync(output.temporary)
        with signals_held():  # Ctrl-C comes before the first takes its name, or after the last, when all can be undone
            for output in outputs:
                output.place(force, directory)
        for folder in {output.target.parent for output in outputs}:
            _sync_folder(folder)
    except BaseException as error:
        with signals_held():
            for output in reversed(outputs):
                output.undo()
        if isinstance(error, OSError) and not isinstance(error, FhashError):
            raise explained(paths[0], error) from error
        raise
    with signals_held():
        for output in outputs:
            output.forget_old()


def explained(path: Path, error: OSError) -> OutputError:
    """The OutputError that says in one line why `path` could not be written, and what to do."""
    folder = path.parent
    code = error.errno
    if code in (errno.ENOSPC, errno.EDQUOT):
        return OutputError(
            f"{path}: no space left on the disk of {folder}; nothing was written: make room or choose another folder"
        )
    if code == errno.ENOENT and not folder.exists():
        return OutputError(f"{path}: the folder {folder} does not exist; create it first")
    if code == errno.ENOTDIR:
        return OutputError(f"{path}: {folder} is not a folder; choose one that is")
    if code in (errno.EACCES, errno.EPERM, errno.EROFS):
        return OutputError(f"{path}: no permission to write in {folder}; choose another folder")
    if code == errno.EISDIR:
        return OutputError(f"{path} is a directory; give the name of a file")
    reason = " ".join((error.strerror or str(error)).split())
    return OutputError(f"{path}: cannot be written: {reason}")


class _Output:
    """One output on its way from its temporary name to its own."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.target = Path(os.path.realpath(path))
        stem = leftovers.new_stem(self.target.name)
        self.temporary = self.target.with_name(stem + leftovers.PARTIAL)
        self.old = self.target.with_name(stem + leftovers.OLD)
        self.placed = False

    def place(self, force: bool, directory: bool) -> None:
        """Give the temporary its own name; an older output stays under another until `forget_old` or `undo`."""
        if force:
            # Once more, because hours may have passed: a folder that appeared meanwhile is not ours to delete.
            check_output(self.path, force, directory=directory)
            if os.path.lexists(self.target):
                self._keep_mode()
                self._keep_old()
            try:
                os.replace(self.temporary, self.target)
            except OSError as error:
                if error.errno in (
                    errno.ENOTEMPTY,
                    errno.EEXIST,
                ):  # a folder takes no name that another took since
                    raise OutputError(
                        f"{self.path}: another process wrote it meanwhile, and that is kept"
                    ) from error
                raise
        else:
            self._create()
        self.placed = True

    def _keep_mode(self) -> None:
        """Give the new file the permissions of the old one, which may have been meant for no one else's eyes."""
        if not self.target.is_dir():
            with suppress(OSError):  # no permissions here, as on exFAT
                os.chmod(self.temporary, stat.S_IMODE(os.stat(self.target).st_mode))

    def _keep_old(self) -> None:
        if not self.target.is_dir():
            with suppress(OSError):  # no hard links here, as on exFAT
                os.link(self.target, self.old)
                return
        os.rename(self.target, self.old)

    def _create(self) -> None:
        """Take the name only if it is still free: a link, unlike a rename, never replaces what appeared meanwhile."""
        if not self.temporary.is_dir():
            try:
                os.link(self.temporary, self.target)
            except FileExistsError:
                raise self._appeared() from None
            except OSError:  # no hard links here: look once more, then rename
                pass
            else:
                os.unlink(self.temporary)
                return
        if os.path.lexists(self.target):
            raise self._appeared()
        try:
            os.rename(self.temporary, self.target)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):  # a folder, just now
                raise self._appeared() from None
            raise

    def _appeared(self) -> OutputExistsError:
        return OutputExistsError(
            f"{self.path} exists: it appeared meanwhile; use --force (force=True) to replace it, or another name"
        )

    def undo(self) -> None:
        """Everything as it was before."""
        with suppress(OSError):  # what went wrong first is what the user must see
            if self.placed:
                remove(self.target)
            if not os.path.lexists(self.target):
                os.rename(self.old, self.target)
            elif (
                not self.placed
            ):  # what is there is the older output itself, or what another process put in its place
                remove(self.old)
        remove(self.temporary)

    def forget_old(self) -> None:
        """Delete the older output that was replaced."""
        remove(self.old)
        if os.path.lexists(self.old):
            raise OutputError(
                f"{self.path} is written, but the older one could not be deleted; delete {self.old}"
            )


def _sync(path: Path) -> None:
    """Make a file, or every file and folder below a directory, survive a loss of power."""
    if not path.is_dir():
        with path.open("rb") as handle:
            os.fsync(handle.fileno())
        return
    for folder, _, names in os.walk(path):
        for name in names:
            _sync(Path(folder, name))
        _sync_folder(Path(folder))


def _sync_folder(folder: Path) -> None:
    # Some file systems and Windows cannot sync a folder. The bytes are safe by then; only the new name is less so.
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
