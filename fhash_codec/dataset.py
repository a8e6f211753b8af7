"""Dataset: the volumes of a file by variable, and volumes shared within a process."""

from __future__ import annotations

import os
import weakref
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume, open_container
from fhash_formats.container import Container, Place, StorageOptions
from fhash_formats.errors import InputError
from fhash_formats.series import meant
from fhash_formats.support.threads import ForkLock


def open(
    path: Place,
    *,
    variable: str | None = None,
    fill: int | float | None = None,
    storage_options: StorageOptions = None,
) -> Volume | Dataset:
    """Open a `.fhz` file for reading, a URL or an open binary file; nothing is decoded yet.

    variable: name of the variable to open. None for the only one of a file, or for all of them.
    fill: what `volume[...]` gives at vertices without a value, see `Volume`.
    storage_options: options of a URL's file system in fsspec.

    Returns the Volume of one variable, or the Dataset of a file of several. Raises what
    `Container.open` raises, and InputError where the file does not hold the variable.
    """
    container = open_container(path, storage_options)
    try:
        if container.variables and variable is None:
            return Dataset(container, fill=fill)
        return Volume(container.select(variable), fill=fill)
    except BaseException:
        container.close()
        raise


class Dataset(Mapping[str, Volume]):
    """The variables of a file of several by name, in the file's order.

    `dataset["u"]` is a Volume, the same one each time. It is open as long as the dataset is;
    closing it does nothing.

    Attributes:
        path: of the file; a URL is text.
        container: the file, with the containers of its variables.
        attributes: of the whole, JSON values.
    """

    def __init__(self, container: Container, *, fill: int | float | None = None) -> None:
        """Read from an open container of several variables, which `close` closes.

        fill: of the volumes, see `Volume`.
        """
        self.container = container
        self.path = container.path
        self.attributes: Mapping[str, Any] = container.attributes
        self._fill = fill
        self._volumes: dict[str, Volume] = {}

    def __getitem__(self, name: str) -> Volume:
        """The volume of a variable, by its name or a last part that no other has.

        Raises KeyError that lists the names for no such variable, and for several.
        """
        if name not in self._volumes:
            found = meant(name, self.container.names)
            if len(found) != 1:
                listed = ", ".join(self.container.names)[:400]
                what = f"{len(found)} variables named" if found else "no variable"
                raise KeyError(f"{self.path} has {what} {name!r:.80}; it holds {listed}")
            if found != [name]:
                return self[found[0]]
            volume = Volume(self.container.variables.get(name, self.container), fill=self._fill)
            # Another thread may have made it meanwhile.
            return self._volumes.setdefault(name, volume)
        return self._volumes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.container.names)

    def __len__(self) -> int:
        return len(self.container.names)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and len(meant(name, self.container.names)) == 1

    def verify(self, progress: Progress = silent) -> int:
        """Read and check every array; return their number. Raises DamagedFileError."""
        return self.container.verify(lambda done, total: progress("verifying", done, total, ""))

    def close(self) -> None:
        """Release the file, and so all volumes."""
        self.container.close()

    def __enter__(self) -> Dataset:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, tuple[Place]]:
        return partial(open, fill=self._fill), (self.container.reopening(),)

    def __repr__(self) -> str:
        return f"<fhash Dataset {', '.join(self)[:200]} of {self.path}>"


KEPT = 128
"""Files that stay open, as many as xarray's own engines keep: a task after the other uses them
again, and a dataset of any number of files needs no more descriptors."""

Key = tuple[Any, ...]


def volumes_of(
    path: Place, storage_options: Mapping[str, Any] | None = None
) -> Mapping[str, Volume]:
    """The variables of a container by name, opened; `storage_options` are for a URL."""
    options: dict[str, Any] = {"storage_options": storage_options} if storage_options else {}
    opened = open(path, **options)
    return opened if isinstance(opened, Dataset) else {opened.name: opened}


def absolute(path: Any) -> Any:
    """A path as another process finds it: absolute, or a URL; an open file as it is."""
    if not isinstance(path, str | os.PathLike):
        return path
    text = os.fspath(path)
    return text if "://" in text else os.path.abspath(text)


class Handle:
    """The variables of an open container.

    Attributes:
        volumes: by name, in the file's order.
        digest: of the container.
        key: place, state and process for which it was opened.
    """

    def __init__(self, key: Key, volumes: Mapping[str, Volume]) -> None:
        self.key, self.volumes = key, volumes
        self.digest = next(iter(volumes.values())).container.digest
        # Volumes of a dataset are closed with it alone.
        owners = (volumes,) if isinstance(volumes, Dataset) else tuple(volumes.values())
        weakref.finalize(self, _close, owners)

    def is_of_this_process(self) -> bool:
        """Whether it was opened here; a forked process shares the offset of an open file."""
        return bool(self.key[-1] == os.getpid())


_lock = ForkLock()
_open: weakref.WeakValueDictionary[Key, Handle] = weakref.WeakValueDictionary()
_kept: OrderedDict[Key, Handle] = OrderedDict()


def acquire(
    place: Any, storage_options: Mapping[str, Any] | None = None, digest: str | None = None
) -> Handle:
    """The volumes of a file, opened once for each of its states; `KEPT` of them stay open.

    place: as `absolute` gives it; an open file is read as long as somebody holds its handle.
    digest: of the container that is meant; None for any. Raises InputError where the file is
        another one by now, and as `fhash_codec.open` does.
    """
    key = (*_state(place), repr(sorted((storage_options or {}).items())), os.getpid())
    with _lock:
        handle = _open.get(key)
        if handle is None:
            handle = _open[key] = Handle(key, volumes_of(place, storage_options))
        if digest is not None and handle.digest != digest:
            raise InputError(f"{place} is another file than the one that was opened; open it again")
        if isinstance(place, str):
            _keep(handle)
    return handle


def held_again(handle: Handle) -> None:
    """Note that a file is read, so that others are closed before it."""
    with _lock:
        _keep(handle)


def _keep(handle: Handle) -> None:
    _kept[handle.key] = handle
    _kept.move_to_end(handle.key)
    while len(_kept) > KEPT:
        _kept.popitem(last=False)


def release(handle: Handle) -> None:
    """Keep a file open no longer than others hold it."""
    with _lock:
        _kept.pop(handle.key, None)


def _state(place: Any) -> Key:
    """The place, and what changes with its content; of a URL and an open file the place alone."""
    if not isinstance(place, str):
        return (id(place),)
    if "://" in place:
        return (place,)
    try:
        found = os.stat(place)
    except OSError:
        return (place,)  # opening says what is wrong
    return place, found.st_mtime_ns, found.st_size, found.st_ino


def _close(owners: tuple[Dataset | Volume, ...]) -> None:
    for owner in owners:
        owner.close()
