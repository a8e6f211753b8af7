"""Encoding of several variables into one container, one after the other."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fhash_codec.config import EncodeConfig
from fhash_codec.container_name import check_name
from fhash_codec.coreset.selection import Source, mask_files, open_source
from fhash_codec.dataset import Dataset
from fhash_codec.encoding import (
    EncodedVariable,
    encode_variable,
    missed_path,
    missed_text,
)
from fhash_codec.progress import Progress, silent
from fhash_codec.promises import remarks
from fhash_codec.report import report
from fhash_codec.stage_clock import recording
from fhash_codec.training.devices import choose_device, need_torch
from fhash_formats import list_variables, open_series
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import FhashWarning, InputError, QualityError
from fhash_formats.readers.common.listing import Listed
from fhash_formats.series import Series
from fhash_formats.source_metadata import shown_name
from fhash_formats.support.atomic import check_output
from fhash_formats.support.attributes import json_attributes

__all__ = ["encodable", "encode_dataset"]

Configs = EncodeConfig | Mapping[str, EncodeConfig]
"""Settings of all variables, or of each by its name."""


def encode_dataset(
    source: str | Path | Mapping[str, Source],
    path: str | Path,
    config: Configs | None = None,
    *,
    variables: Sequence[str] | None = None,
    open_variable: Callable[[str], Series] | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Encode several variables into the container `path`, complete or not at all.

    They are encoded one after the other: no more is held than for the largest one alone. A single
    variable makes a file of several as well; `encode` makes the file of one.

    source: a file, or sources of `encode` by name, such as a dict of arrays or an xarray.Dataset,
        of which arrays of numbers with 3 dimensions and more are variables.
    config: the settings of all, or of each by name; the defaults where a name is not in it.
    variables: names of those to encode, in this order. All by default: of a file those that
        `fhash info` says a command for without `--select` and the like.
    open_variable: opens a variable of a file, in place of `open_series(source, var=name)`.
    force: replace a file that exists.

    Returns the figures of the written file: `path`, `bytes`, `raw_bytes`, `ratio`, `seconds`, and
    in `variables` those of each by name, as `encode` returns them; their `bytes` are those of its
    own arrays, without shared coordinates and the header.

    Raises what `encode` raises, with the name of the variable. All variables are opened before the
    first is encoded. QualityError names each variable that misses its promise.
    """
    path = Path(os.path.normpath(path))
    begun = time.perf_counter()
    check_name(path)
    check_output(path, force)
    names = list(variables) if variables is not None else _all_variables(source)
    configs = _by_name(config, names)
    sources = _Sources(source, open_variable)
    files = _files_of(sources, names, configs)
    check_output(path, force, sources=files)
    encoded: dict[str, EncodedVariable] = {}
    stages: dict[str, list[dict[str, Any]]] = {}
    with ContainerWriter(path, force=force, variables=names) as writer:
        writer.attributes = json_attributes(getattr(source, "attrs", {}))
        for number, name in enumerate(names):
            told = _of_variable(progress, f"{name}, {number + 1} of {len(names)}")
            # A function of its own, so that nothing of a variable is held with the next one.
            encoded[name], stages[name] = _encoded(sources, name, writer, configs[name], path, told)
        missed = [name for name in names if encoded[name].missed is not None]
        if missed and os.path.lexists(path):
            writer.divert(missed_path(path))
        written = writer.path
        progress("writing", 0, 1, "")
        writer.commit()
        progress("writing", 1, 1, "")
    for variable in encoded.values():
        variable.remove_checkpoint()
    figures = _report(written, encoded, stages, time.perf_counter() - begun)
    if missed:
        texts = [f"{name}: {encoded[name].missed}" for name in missed]
        raise QualityError(
            missed_text(path, written, "; ".join(texts), encoded[missed[0]].advice), figures
        )
    for name in names:
        promised = {**figures["variables"][name], "ratio": encoded[name].ratio}
        for remark in remarks(configs[name], promised):
            warnings.warn(f"{name}: {remark}", FhashWarning, stacklevel=2)
    return figures


class _Sources:
    """The variables of a source, opened one at a time."""

    def __init__(
        self,
        source: str | Path | Mapping[str, Source],
        open_variable: Callable[[str], Series] | None,
    ) -> None:
        self._source, self._open = source, open_variable

    @contextmanager
    def opened(self, name: str) -> Iterator[Series]:
        """The series of a variable, closed at the end of the context where it was opened here."""
        if isinstance(self._source, Mapping):
            try:
                source = self._source[name]
            except KeyError:
                listed = ", ".join(map(str, self._source))[:400]
                raise InputError(f"no variable {name[:80]!r}; the source has {listed}") from None
            with open_source(source) as series:
                if not isinstance(source, Series | str | Path):
                    series.name = shown_name(name, [each.name for each in series.coords.values()])
                yield series
            return
        with (self._open or self._open_file)(name) as series:
            yield series

    def _open_file(self, name: str) -> Series:
        assert isinstance(self._source, str | Path)
        return open_series(self._source, var=name)


def _encoded(
    sources: _Sources,
    name: str,
    writer: ContainerWriter,
    config: EncodeConfig,
    path: Path,
    progress: Progress,
) -> tuple[EncodedVariable, list[dict[str, Any]]]:
    """Write one variable; what is known of it, and what the stages took."""
    with recording() as clock, _named(name), sources.opened(name) as series:
        encoded = encode_variable(writer, series, config, None, path, progress)
        writer.finish(encoded.header)
    return encoded, clock.to_list()


def _files_of(
    sources: _Sources, names: Sequence[str], configs: Mapping[str, EncodeConfig]
) -> list[str | Path]:
    """The files that are read.

    Every variable is opened once, so that one that cannot be read is refused before the work.
    """
    files: list[str | Path] = []
    for name in names:
        config = configs[name]
        if config.profile == "paper":
            need_torch("profile paper")
            choose_device(config.device)
        # A function of its own, so that nothing of a variable is held with the next one.
        files += [*_read_from(sources, name), *mask_files(config)]
    return files


def _read_from(sources: _Sources, name: str) -> tuple[Path, ...]:
    """The files that a variable is read from."""
    with sources.opened(name) as series:
        return tuple(series.files)


def _by_name(config: Configs | None, names: Sequence[str]) -> dict[str, EncodeConfig]:
    """The settings of each variable; raises InputError for a name that is no variable."""
    if not isinstance(config, Mapping):
        return dict.fromkeys(names, config or EncodeConfig())
    unknown = [name for name in config if name not in names]
    if unknown:
        raise InputError(
            f"settings are given for {unknown[0][:80]!r}, which is none of the variables"
            f" {', '.join(names)[:400]}"
        )
    return {name: config.get(name, EncodeConfig()) for name in names}


def encodable(listed: Sequence[Listed], selected: int = 0) -> tuple[list[str], list[str]]:
    """The names of the variables of a file that can be encoded as they are, and of the others.

    listed: as `list_variables` gives them. selected: number of dimensions along which an index was
        selected for the listing; a variable that needs another one is left out.
    """
    names: list[str] = []
    others: list[str] = []
    for entry in listed:
        plain = len(entry.options) == 1 and entry.options[0].count("--select") == selected
        (names if plain else others).append(entry.name)
    return names, others


def _all_variables(source: str | Path | Mapping[str, Source]) -> list[str]:
    """The names of all variables of a source that can be encoded as they are."""
    if isinstance(source, str | Path):
        names = encodable(list_variables(source))[0]
    elif hasattr(source, "data_vars"):
        arrays = source.data_vars.items()
        names = [str(name) for name, a in arrays if a.ndim >= 3 and a.dtype.kind in "iuf"]
    else:
        names = [str(name) for name in source]
    if not names:
        raise InputError("the source has no variable that can be encoded as it is")
    return names


def _of_variable(progress: Progress, name: str) -> Progress:
    """A progress whose notes begin with the name of the variable."""

    def told(stage: str, done: int, total: int, note: str) -> None:
        progress(stage, done, total, f"{name}: {note}" if note else name)

    return told


@contextmanager
def _named(name: str) -> Iterator[None]:
    """A block whose errors begin with the name of a variable."""
    try:
        yield
    except InputError as error:
        raise type(error)(f"variable {name}: {error}") from error


def _report(
    path: Path,
    encoded: Mapping[str, EncodedVariable],
    stages: Mapping[str, list[dict[str, Any]]],
    seconds: float,
) -> dict[str, Any]:
    """The figures of a written file and of each variable."""
    figures = {}
    with Dataset(Container.open(path)) as dataset:
        for name, volume in dataset.items():
            took = sum(stage["seconds"] for stage in stages[name])
            figures[name] = report(volume, encoded[name].quality, seconds=took)
            figures[name]["stages"] = stages[name]
        size = dataset.container.size
    raw = sum(each["raw_bytes"] for each in figures.values())
    return {
        "path": str(path),
        "bytes": size,
        "raw_bytes": raw,
        "ratio": raw / size,
        "seconds": seconds,
        "variables": figures,
    }
