"""Files and folders: locations, atomic replacing, leftovers of killed runs, interrupts, space."""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import signal
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from types import FrameType
from typing import Any

from fhash_formats.errors import FhashError, InputError, OutputError, OutputExistsError

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(::[A-Za-z][A-Za-z0-9+.-]+)*://")
_LOCAL = re.compile(r"(?:file|local)://(?!.*::)(?:/(?=[A-Za-z]:[/\\]))?", re.IGNORECASE)
_USER = re.compile(r"://[^/@]*@")


def is_url(place: object) -> bool:
    """Whether a place is the text of a URL: "https://host/run.fhz", "zip://run.fhz::s3://a/b.zip".

    A scheme has two characters at least, since a drive of Windows has one.
    """
    return isinstance(place, str) and _URL.match(place) is not None


OBJECT_STORES = ("s3", "gs")
"""Schemes of URLs that mean the same to obstore and to fsspec."""


def object_store(url: str) -> Any:
    """The file system of a URL by obstore, as one of fsspec.

    None for other schemes, where obstore is not installed, and where fsspec has settings for the
    scheme. obstore imports in 5 ms, the packages that fsspec needs for these stores in a second.
    """
    from fsspec.config import conf

    scheme = url.partition("://")[0]
    if scheme not in OBJECT_STORES or conf.get(scheme) or find_spec("obstore") is None:
        return None
    return import_module("obstore.fsspec").FsspecStore(scheme)


def local_path(place: str | os.PathLike[str]) -> Path | None:
    """The path of a local file, also of one that a URL names; None for another URL.

    As in fsspec, "%20" in such a URL stands for itself.
    """
    if not is_url(place):
        return Path(place)
    found = _LOCAL.match(str(place))
    return None if found is None else Path(str(place)[found.end() :])


def file_name(place: str | os.PathLike[str]) -> str:
    """The last name of a place: "run.fhz" of "https://host/a/run.fhz?signature=1"."""
    if not is_url(place):
        return Path(place).name
    urls = without_secrets(place).split("::")  # the first may be a cache alone, without a path
    return PurePosixPath(next(url for url in urls if "://" in url).partition("://")[2]).name


def without_secrets(place: str | os.PathLike[str]) -> str:
    """The text of a place to be kept in other files: a URL without user, query and fragment."""
    if not is_url(place):
        return str(place)
    urls = str(place).split("::")
    return "::".join(re.split(r"[?#]", _USER.sub("://", url), maxsplit=1)[0] for url in urls)


def check_space(path: str | Path, needed: int) -> None:
    """Raise OutputError where the disk of an output has less than `needed` bytes free.

    A folder that does not exist or cannot be asked is not refused here: writing says what is wrong.
    """
    folder = Path(os.path.realpath(path)).parent
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        return
    if free < needed:
        raise OutputError(
            f"{path}: up to {_size(needed)} are needed, and the disk of {folder} has"
            f" {_size(free)} free; make room, or choose another folder"
        )


def _size(count: int) -> str:
    """Bytes for people, in decimal units."""
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 999.5:
            break
        value, unit = value / 1000, larger
    return f"{value:.3g} {unit}"


OTHERS = 64
"""Files that a process may open meanwhile beside those that are asked for."""


@contextmanager
def many_files(count: int) -> Iterator[None]:
    """Let the process open `count` files in the context, as far as the system allows it.

    A process may raise its own limit up to the hard one. Where that is not enough, or where there
    is no such limit (Windows), nothing else changes.
    """
    try:
        import resource
    except ImportError:
        yield
        return
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = count + OTHERS + open_files()
    if most != resource.RLIM_INFINITY:
        needed = min(needed, most)
    if limit == resource.RLIM_INFINITY or needed <= limit:
        yield
        return
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, most))
    try:
        yield
    finally:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))


def open_files() -> int:
    """Number of files, sockets and pipes that this process has open; 0 where nothing tells."""
    try:
        return len(os.listdir("/dev/fd"))
    except OSError:
        return 0


PARTIAL = ".partial"
"""Ending of the name of a temporary."""
OLD = ".old"
"""Ending of the name of an older output that is being replaced."""
MAX_NAME = 40
"""Characters of an output's name in the name of its temporary.

The name of the temporary so stays below the 255 bytes of most file systems.
"""
_NAME = re.compile(
    r"\.(?P<output>.+)\.(?P<machine>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{8}(?P<kind>\.partial|\.old)",
    re.DOTALL,
)


def new_stem(name: str) -> str:
    """The name of an output's temporary without its ending; no other writer has the same."""
    return f".{_short(name)}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"


def clear_leftovers(targets: Iterable[Path]) -> None:
    """Clear away the leftovers of killed writers of these outputs.

    An output that a killed writer had moved aside but not replaced gets its name back.
    """
    folders: dict[Path, dict[str, Path]] = {}
    for target in targets:
        folders.setdefault(target.parent, {})[_short(target.name)] = target
    for folder, outputs in folders.items():
        # The checks of the output give a better message for a folder that cannot be listed.
        with suppress(OSError):
            for name in sorted(os.listdir(folder)):
                match = _NAME.fullmatch(name) if name.endswith((PARTIAL, OLD)) else None
                if (
                    match
                    and match["output"] in outputs
                    and not _may_live(match["machine"], int(match["process"]))
                ):
                    target = outputs[match["output"]]
                    _clear(folder / name, target, moved_aside=match["kind"] == OLD)


def remove(path: Path) -> None:
    """Delete a file or a folder; a failure is ignored."""
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _clear(leftover: Path, target: Path, *, moved_aside: bool) -> None:
    if moved_aside and not os.path.lexists(target):
        with suppress(OSError):
            os.rename(leftover, target)
        return
    remove(leftover)


def _short(name: str) -> str:
    """The output's name in that of its temporary: at most MAX_NAME characters.

    A longer name is cut and gets a digest of all of it, so that no two outputs share leftovers.
    """
    if len(name) <= MAX_NAME:
        return name
    return f"{name[: MAX_NAME - 9]}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"


@cache
def _machine() -> str:
    """A digest of the place in which process numbers are unique.

    That is this machine, and on Linux this container on it.
    """
    names = [platform.node()]
    with suppress(OSError):
        names.append(Path("/etc/machine-id").read_text(encoding="utf-8", errors="replace"))
    with suppress(OSError):
        names.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("\n".join(names).encode(errors="replace")).hexdigest()[:8]


def _may_live(machine: str, process: int) -> bool:
    """Whether a writer may still run; False only for a process that is known to be gone."""
    # A temporary with this process's number belongs to one of its threads. On Windows, asking by
    # signal 0 would end the process.
    if machine != _machine() or process == os.getpid() or os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # the process is another user's
        return True
    # A zombie was killed, and its parent has not waited for it yet.
    with suppress(OSError):
        fields = Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2]
        return fields.split()[:1] != ["Z"]
    return True


STOP_SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
"""Signals that ask to stop: Ctrl-C, the end of a batch job, a lost connection (not on Windows)."""
SAME_REQUEST_SECONDS = 1.0
"""Time within which a second signal repeats the first: shells and batch systems send several."""

Handler = Callable[[int, FrameType | None], Any]


class StopRequest:
    """A request to stop: `asked` says whether it was made, `since` when (`time.monotonic`)."""

    def __init__(self) -> None:
        self.asked = False
        self.since = 0.0


@contextmanager
def deferred_interrupts() -> Iterator[StopRequest]:
    """A block in which a stop signal sets `asked` of the request, which the work then looks at.

    A further signal more than SAME_REQUEST_SECONDS later raises KeyboardInterrupt at once. A signal
    that is ignored stays ignored: `nohup` ignores SIGHUP.
    """
    request = StopRequest()

    def ask(number: int, frame: FrameType | None) -> None:
        if request.asked and time.monotonic() > request.since + SAME_REQUEST_SECONDS:
            raise KeyboardInterrupt
        if not request.asked:
            request.asked, request.since = True, time.monotonic()

    with _handled_by(ask, lambda handler: handler is not signal.SIG_IGN):
        yield request


@contextmanager
def signals_held() -> Iterator[None]:
    """A block within which no Python handler of a stop signal runs; the handlers run after it.

    A signal without a Python handler, such as SIGTERM by default, ends the process at once as ever.
    """
    missed: list[int] = []

    def hold(number: int, frame: FrameType | None) -> None:
        missed.append(number)

    handlers: dict[signal.Signals, Any] = {}
    try:
        with _handled_by(hold, callable) as handlers:
            yield
    finally:
        for number in missed:
            handlers[signal.Signals(number)](number, None)


@contextmanager
def _handled_by(
    handler: Handler, replaced: Callable[[object], bool]
) -> Iterator[dict[signal.Signals, Any]]:
    """A block in which `handler` gets the stop signals whose present handler is to be `replaced`.

    Yields the handlers that were replaced, and puts them back after the block. Outside the main
    thread, which alone may set handlers, none is replaced.
    """
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        present = {number: signal.getsignal(number) for number in STOP_SIGNALS}
        before = {number: previous for number, previous in present.items() if replaced(previous)}
    try:
        for number in before:
            signal.signal(number, handler)
        yield before
    finally:
        _restore(before)


def _restore(handlers: dict[signal.Signals, Any]) -> None:
    """Put handlers back, all of them, even where one that is back already raises on the way."""
    remaining = list(handlers)
    raised: BaseException | None = None
    while remaining:
        try:
            while remaining:
                signal.signal(remaining[-1], handlers[remaining[-1]])
                remaining.pop()
        except BaseException as error:
            raised = error
    if raised is not None:
        raise raised


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
    clear_leftovers(output.target for output in outputs)
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
                output.take_name(force, directory)
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
        stem = new_stem(self.target.name)
        self.temporary = self.target.with_name(stem + PARTIAL)
        self.old = self.target.with_name(stem + OLD)
        self.placed = False

    def take_name(self, force: bool, directory: bool) -> None:
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
