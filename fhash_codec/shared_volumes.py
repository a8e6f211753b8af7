"""Open volumes that lazy arrays share within a process, each closed after its last user.

Arrays are pickled without them: a process that gets one opens the file for itself, and takes it
only if it is the same file.
"""

from __future__ import annotations

import os
import weakref
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from fhash_codec.dataset import Dataset
from fhash_codec.dataset import open as open_file
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError
from fhash_formats.support.fork_lock import ForkLock

__all__ = ["Handle", "acquire", "place_of", "release", "volumes_of"]

KEPT = 16
"""Files that stay open although nobody holds them: a task after the other uses them again."""

Key = tuple[Any, ...]


def volumes_of(path: str, storage_options: Mapping[str, Any] | None = None) -> Mapping[str, Volume]:
    """The variables of a container by name, opened; `storage_options` are for a URL."""
    options: dict[str, Any] = {"storage_options": storage_options} if storage_options else {}
    opened = open_file(path, **options)
    return opened if isinstance(opened, Dataset) else {opened.name: opened}


def place_of(path: str | os.PathLike[str]) -> str:
    """A path as another process finds it: absolute, or a URL."""
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
    place: str, storage_options: Mapping[str, Any] | None = None, digest: str | None = None
) -> Handle:
    """The volumes of a file, opened once for each of its states.

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
        _kept[key] = handle
        _kept.move_to_end(key)
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
    return handle


def release(handle: Handle) -> None:
    """Keep a file open no longer than others hold it."""
    with _lock:
        _kept.pop(handle.key, None)


def _state(place: str) -> Key:
    """The place, and what changes with its content; of a URL the place alone."""
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
