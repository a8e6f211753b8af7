"""`Dataset`: the variables of a `.fhz` file of several, each a `Volume`; `open` for any file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from types import TracebackType
from typing import Any

from fhash_codec.progress import Progress, silent
from fhash_codec.volume import Volume
from fhash_formats.container import Container, Place, StorageOptions
from fhash_formats.source_metadata import meant

__all__ = ["Dataset", "open"]


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
    container = Container.open(path, storage_options=storage_options)
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __reduce__(self) -> tuple[Any, tuple[Place]]:
        return partial(open, fill=self._fill), (self.container.reopening(),)

    def __repr__(self) -> str:
        return f"<fhash Dataset {', '.join(self)[:200]} of {self.path}>"
