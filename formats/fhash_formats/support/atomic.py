"""Atomic outputs: every file that fhash writes is complete or absent, never half written.

The bytes go to a temporary in the folder of the output, are synced to the disk, and only then take
the output's name. An error, a full disk or Ctrl-C before that removes the temporary and leaves an
older output unchanged. The temporary of a killed writer stays until the next writer of the same
output clears it away (see `leftovers`).
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
from fhash_formats.support.locations import local_path

ZARR_METADATA = ("zarr.json", ".zgroup", ".zarray")
"""Files by which a folder is recognised as a Zarr store, which `force` may replace."""


def check_output(
    path: Path, force: bool, *, directory: bool = False, sources: Sequence[str | Path] = ()
) -> None:
    """Check an output as far as that is possible before any work.

    Args:
        path: of the output; a link is followed.
        force: whether an existing output may be replaced.
        directory: whether the output is a directory (a Zarr store) and not a file.
        sources: files and folders that the output is made from; `force` does not allow it to
            replace them.

    Raises:
        InputError: the output is one of the sources, lies inside one or contains one.
        OutputExistsError: the output exists and `force` is not given.
        OutputError: the folder does not exist or gives no permission, or something exists at the
            path that must not be replaced even with `force`.
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
                f"{path} is a link to {target}, and the folder {folder} does not exist; "
                "create it, or choose another name"
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
            f"{path} is a directory but no Zarr store: --force does not replace it; "
            "give another name"
        )
    if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
        raise OutputError(
            f"{path} is not an ordinary file and cannot be replaced; give another name"
        )


def _check_source(path: Path, target: Path, source: str | Path) -> None:
    """Refuse an output `path`, resolved to `target`, that would replace or contain a source."""
    local = local_path(source)
    if local is None:
        return
    resolved = Path(os.path.realpath(local))
    if _same(target, resolved):
        raise InputError(f"{path} is the input itself; choose another name")
    if resolved.is_dir() and any(_same(folder, resolved) for folder in target.parents):
        raise InputError(f"{path} lies inside the input {source}; choose a name outside it")
    if target in resolved.parents:
        raise InputError(f"{path} contains the input {source}; choose another name")


def _same(first: Path, second: Path) -> bool:
    """Whether two resolved paths are one file or folder, also by hard links or another case."""
    try:
        return os.path.samefile(first, second)
    except OSError:  # one of the two does not exist
        return first == second


@contextmanager
def replacing(path: Path, *, force: bool, directory: bool = False) -> Iterator[Path]:
    """A block that writes to a temporary path, which becomes `path` when the block ends.

    The block creates a file (or with `directory` a directory) at the path that it is given:
    `.NAME.<writer>.partial` in the same folder. The temporary is removed if the block fails.
    Raises what `check_output` raises, before the block; an OSError of the block becomes an
    OutputError.
    """
    with replacing_all([path], force=force, directory=directory) as temporaries:
        yield temporaries[0]


@contextmanager
def replacing_all(
    paths: Sequence[Path], *, force: bool, directory: bool = False
) -> Iterator[list[Path]]:
    """A block that writes to several temporary paths, which become `paths` when the block ends.

    The outputs take their names in the order of `paths`; if one cannot, none does. Guarantees and
    errors are those of `replacing`. Only a process that is killed between two renames leaves some
    outputs without the others; so an output that refers to the others should be the last.
    """
    outputs = [_Output(path) for path in paths]
    leftovers.clear(output.target for output in outputs)
    for path in paths:
        check_output(path, force, directory=directory)
    try:
        yield [output.temporary for output in outputs]
        for output in outputs:
            _sync(output.temporary)
        # Ctrl-C comes before the first output takes its name or after the last one has taken its
        # own; then all can be undone.
        with signals_held():
            for output in outputs:
                output.place(force, directory)
        for folder in {output.target.parent for output in outputs}:
            sync_folder(folder)
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
            f"{path}: no space left on the disk of {folder}; nothing was written: "
            "make room or choose another folder"
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
    """An output on its way from its temporary name to its final one.

    Attributes:
        path: as the caller gave it.
        target: the resolved path, which is the final name.
        temporary: path of the new output while it is written.
        old: path of an older output while it is being replaced.
        placed: whether the new output has its final name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.target = Path(os.path.realpath(path))
        stem = leftovers.new_stem(self.target.name)
        self.temporary = self.target.with_name(stem + leftovers.PARTIAL)
        self.old = self.target.with_name(stem + leftovers.OLD)
        self.placed = False

    def place(self, force: bool, directory: bool) -> None:
        """Give the temporary its final name.

        An older output stays under the name `old` until `forget_old` or `undo`.
        """
        if force:
            # Hours may have passed since the first check: a folder of another process may be there
            # by now, which must not be deleted.
            check_output(self.path, force, directory=directory)
            if os.path.lexists(self.target):
                self._keep_mode()
                self._keep_old()
            try:
                os.replace(self.temporary, self.target)
            except OSError as error:
                # A folder cannot take a name that another process took meanwhile.
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                    raise OutputError(
                        f"{self.path}: another process wrote it meanwhile, and that is kept"
                    ) from error
                raise
        else:
            self._create()
        self.placed = True

    def _keep_mode(self) -> None:
        """Give the new file the permissions of the old one, which may be private."""
        if not self.target.is_dir():
            with suppress(OSError):  # file systems such as exFAT have no permissions
                os.chmod(self.temporary, stat.S_IMODE(os.stat(self.target).st_mode))

    def _keep_old(self) -> None:
        """Give the older output the name `old`; with a hard link it keeps its present name, too."""
        if not self.target.is_dir():
            with suppress(OSError):  # file systems such as exFAT have no hard links
                os.link(self.target, self.old)
                return
        os.rename(self.target, self.old)

    def _create(self) -> None:
        """Take the final name only if it is still free.

        Unlike a rename, a hard link never replaces a file that appeared meanwhile.
        """
        if not self.temporary.is_dir():
            try:
                os.link(self.temporary, self.target)
            except FileExistsError:
                raise self._appeared() from None
            except OSError:  # without hard links: check again, then rename
                pass
            else:
                os.unlink(self.temporary)
                return
        if os.path.lexists(self.target):
            raise self._appeared()
        try:
            os.rename(self.temporary, self.target)
        except OSError as error:
            # A folder appeared between the check and the rename.
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise self._appeared() from None
            raise

    def _appeared(self) -> OutputExistsError:
        return OutputExistsError(
            f"{self.path} exists: it appeared meanwhile; "
            "use --force (force=True) to replace it, or another name"
        )

    def undo(self) -> None:
        """Restore the state before the block: the older output, and no new one."""
        # A failure here is ignored, so that the user sees the first one.
        with suppress(OSError):
            if self.placed:
                remove(self.target)
            if not os.path.lexists(self.target):
                os.rename(self.old, self.target)
            elif not self.placed:
                # The target is the older output itself, or another process's new one.
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
    """Write a file, or all files and folders below a directory, to the disk itself (fsync).

    They then survive a loss of power.
    """
    if not path.is_dir():
        with path.open("rb") as handle:
            os.fsync(handle.fileno())
        return
    for folder, _, names in os.walk(path):
        for name in names:
            _sync(Path(folder, name))
        sync_folder(Path(folder))


def sync_folder(folder: Path) -> None:
    """Write a folder's list of names to the disk itself.

    Some file systems and Windows cannot. The bytes of its files are safe nevertheless; only their
    new names may be lost with the power.
    """
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
