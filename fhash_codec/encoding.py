"""Encoding of a series, or of the variables of a dataset, into a container."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.encode import DecodedTiles, encode_compact
from fhash_codec.compact.goal import missed_promise, remarks
from fhash_codec.comparison import EncodeReport, Sizes, measure, report, ssim_budget, steps_of_ssim
from fhash_codec.config import EncodeConfig
from fhash_codec.dataset import Dataset
from fhash_codec.devices import check_cuda
from fhash_codec.features.selection import Source, mask_files, open_source
from fhash_codec.header import brief_quality, check_name
from fhash_codec.paper.encode import encode_paper
from fhash_codec.progress import Progress, recording, silent, skip, stage
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import FhashWarning, InputError, QualityError
from fhash_formats.readers.labelled import labelled_series, list_dataset
from fhash_formats.readers.listing import Listed
from fhash_formats.readers.registry import list_variables, open_series
from fhash_formats.series import Series, shown_name
from fhash_formats.support.files import check_output
from fhash_formats.support.values import json_attributes

DECODED_AGAIN = 8
"""Tiles of which one is decoded from the file where the encoder knows their decoded values."""
_NONE_DECODED: DecodedTiles = {}
PREDICTED = ("seconds", "bytes", "psnr")
"""Figures of a prediction that a header keeps."""


def encode(
    source: Source,
    path: str | Path,
    config: EncodeConfig | None = None,
    *,
    mask: npt.ArrayLike | None = None,
    force: bool = False,
    progress: Progress = silent,
    predicted: Mapping[str, Any] | None = None,
    client: Any = None,
) -> EncodeReport:
    """Encode a series into the container `path`, complete or not at all.

    source: a file (opened by `open_series` of `readers`), a Series, or an array (t, z, y, x) or
        (z, y, x), labelled or not.
    config: the settings; the defaults if None.
    mask: booleans (t, z, y, x) or (z, y, x), one more feature. It is the only feature if the
        settings name none.
    force: replace a file that exists.
    predicted: seconds, bytes and psnr that were predicted, for the header; see `fhash info`.
    client: of a dask cluster (`dask.distributed.Client`), on whose workers the series is coded.
        The file is that of this function without `client` and with `timings=False`, byte for byte.
        The source is a file that all workers see, or an array of dask, labelled or not; the
        promise is a bound of the error.

    Returns the figures of the written file, and as "stages" what took the time. With
    the preset published Ctrl-C during the training saves a checkpoint beside `path` and raises
    InterruptedEncodingError; the same call then continues from the checkpoint to the same result.
    With the others nothing is kept: KeyboardInterrupt passes through, and the same call starts
    again.

    Raises InputError for a source or settings that cannot be encoded, or for a promise that is seen
    to be out of reach, and MissingDependencyError for CUDA without torch. Raises QualityError, with
    the figures of the file in the error, if the file misses what the settings promise. It is
    written beside `path`, as RUN.missed.fhz (`missed_path`); an older `path` stays as it is. Warns
    (FhashWarning) where the bulk of the values is far worse than an explicit promise sounds. Raises
    ClusterError where a worker of `client` fails.
    """
    config, path = config or EncodeConfig(), Path(os.path.normpath(path))
    if client is not None:
        return _on_cluster(source, path, config, client, mask, force, progress)
    begun = time.perf_counter()
    with recording() as clock, _opened(source, path, force, config) as series:
        check_output(path, force, sources=[*series.files, *mask_files(config)])
        with ContainerWriter(path, force=force) as writer:
            encoded = encode_variable(writer, series, config, mask, path, progress)
            if encoded.missed is not None:
                writer.divert(missed_path(path))
            written = writer.path
            progress("writing", 0, 1, "")
            with stage("writing", "header, and the file takes its name"):
                writer.commit(_with_prediction(encoded.header, predicted, config, begun))
            progress("writing", 1, 1, "")
        encoded.remove_checkpoint()
    with open_volume(written) as volume:
        seconds = time.perf_counter() - begun
        told = report(volume, encoded.quality, seconds=seconds, files=series.files)
    figures: EncodeReport = {**told, "stages": clock.to_list()}
    if encoded.missed is not None:
        raise QualityError(missed_text(path, written, encoded.missed, encoded.advice), figures)
    for remark in remarks(config, figures):
        warnings.warn(remark, FhashWarning, stacklevel=2)
    return figures


def _on_cluster(
    source: Source,
    path: Path,
    config: EncodeConfig,
    client: Any,
    mask: npt.ArrayLike | None,
    force: bool,
    progress: Progress,
) -> EncodeReport:
    """Encode on a cluster; raises InputError for a mask, which only this process has."""
    from fhash_codec.appending.cluster import encode_on_cluster

    if mask is not None:
        raise InputError("mask is an array of this process; with client= give a feature mask:FILE")
    return encode_on_cluster(source, path, config, client, force=force, progress=progress)


@dataclass(frozen=True, kw_only=True)
class EncodedVariable:
    """A variable whose arrays are written.

    Attributes:
        header: complete, with the measured quality.
        quality: `metrics.Quality` as JSON values.
        ratio: of the bytes of the series to those by which the file grows by the variable.
        checkpoint: of the training, to be removed once the file is complete.
        missed: what was promised and is missed; None where the promise is kept.
        advice: what may help where it is missed.
    """

    header: dict[str, Any]
    quality: dict[str, Any]
    ratio: float
    checkpoint: Path | None
    missed: str | None
    advice: str

    def remove_checkpoint(self) -> None:
        """Remove the checkpoint, whose file is complete."""
        if self.checkpoint is not None:
            self.checkpoint.unlink(missing_ok=True)


def encode_variable(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    path: Path,
    progress: Progress,
) -> EncodedVariable:
    """Write the arrays of one variable, and measure them as they decode.

    mask: as in `encode`. path: of the file, beside which checkpoints lie.
    """
    measured = _Measured(writer, series, config, progress)
    checkpoint, advice, rounding = None, "", 0.0
    if config.published:
        network = encode_paper(writer, series, config, mask, path, progress, measured.complete)
        header, checkpoint = network.header, network.checkpoint
        advice, rounding = network.advice, network.rounding
    else:
        header = encode_compact(writer, series, config, mask, progress, measured.complete)
    series.check()  # what was scanned, coded and measured is of one state
    figures = measured.figures(header)
    return EncodedVariable(
        header=header,
        quality=measured.quality,
        ratio=figures["ratio"],
        checkpoint=checkpoint,
        missed=missed_promise(config, figures, rounding),
        advice=advice,
    )


@contextmanager
def _opened(source: Source, path: Path, force: bool, config: EncodeConfig) -> Iterator[Series]:
    """The series of a source; raises what can be told at once, and not after the planning."""
    with ExitStack() as stack:
        with stage("opening", "paths, libraries and the source"):
            check_name(path)
            check_output(path, force)
            check_cuda(config.device, torch=config.preset == "published")
            series = stack.enter_context(open_source(source))
        yield series


def _with_prediction(
    header: dict[str, Any], predicted: Mapping[str, Any] | None, config: EncodeConfig, begun: float
) -> dict[str, Any]:
    """Return the header with what was predicted, and the seconds that the whole job took.

    Without timings the header stays as it is: a prediction may follow from the clock, and the same
    input and settings give the same bytes.
    """
    if predicted is None or not config.timings:
        return header
    took = round(time.perf_counter() - begun, 3)
    told = {name: predicted[name] for name in PREDICTED if name in predicted}
    return {**header, "encoder": {**header["encoder"], "predicted": told, "took_seconds": took}}


class _Measured:
    """Measurement of a container that is being written.

    Attributes:
        quality: the figures of the last header that was completed, as JSON values.
    """

    def __init__(
        self, writer: ContainerWriter, series: Series, config: EncodeConfig, progress: Progress
    ) -> None:
        self.quality: dict[str, Any] = {}
        self._writer, self._series, self._progress = writer, series, progress
        self._config = config

    def complete(
        self, header: dict[str, Any], decoded: DecodedTiles = _NONE_DECODED
    ) -> dict[str, Any]:
        """The header with the quality of the arrays written so far, as they decode.

        decoded: tiles whose decoded values the encoder knows. The written bytes of all tiles are
            checked by their checksums, and one tile of DECODED_AGAIN is decoded from them.
        """
        if "ssim" in self._config.without:
            skip("ssim", "--without ssim")
        why = "errors of the written bytes, as a reader decodes them"
        if decoded:
            why = f"errors as the encoder decoded them, 1 tile of {DECODED_AGAIN} from the file"
        with (
            stage("measuring", why),
            Volume(self._writer.preview(header)) as volume,
        ):
            if decoded:
                _take_decoded(volume.container, decoded)
            measured = steps_of_ssim(self._series, ssim_budget(self._config))
            self.quality = measure(self._series, volume, self._progress, measured)
        low, high = header["value_range"]
        shape = header["domain"]["shape"]
        quality = brief_quality(self._writer, self.quality, high - low, shape)
        return {**header, "quality": quality}

    def figures(self, header: dict[str, Any]) -> dict[str, Any]:
        """Figures that a promise is checked by; see `report`."""
        low, high = header["value_range"]
        raw_bytes = prod(self._series.shape) * self._series.dtype.itemsize
        return {
            **self.quality,
            "quality": self.quality,
            "data_range": high - low,
            "ratio": raw_bytes / self._writer.size(header),
            "promised": self._config.to_dict() | header["config"],
        }


def _take_decoded(container: Container, decoded: DecodedTiles) -> None:
    """Give a container the decoded values of its table, so that it decodes few tiles of them."""
    name = "table_1"
    for number, (index, values) in enumerate(decoded.items()):
        if number % DECODED_AGAIN == 0:
            read = container.arrays[name].decode_chunk(index)
            # Equal bits are found five times as fast as equal floats, which NaN and -0 need.
            bits = np.dtype(f"u{values.dtype.itemsize}")
            if not np.array_equal(read.view(bits), values.view(bits)) and not np.array_equal(
                read, values, equal_nan=values.dtype.kind == "f"
            ):
                raise RuntimeError(f"tile {index} decodes to other values than its encoder found")
    container.arrays[name].take_decoded(decoded)


def missed_path(path: Path) -> Path:
    """The name of a file that misses its promise, so that `path` never names one.

    It is RUN.missed.fhz for RUN.fhz, or RUN.missed-2.fhz and so on where that exists.
    """
    number = 1
    while True:
        suffix = "missed" if number == 1 else f"missed-{number}"
        other = path.with_name(f"{path.stem}.{suffix}{path.suffix}")
        if not os.path.lexists(other):
            return other
        number += 1


def missed_text(path: Path, written: Path, missed: str, advice: str) -> str:
    """The message of a missed promise: what was missed, where the file is, and what may help."""
    return f"{path}: {missed}; the file is {written}" + (f". {advice}" if advice else "")


Configs = EncodeConfig | Mapping[str, EncodeConfig]
"""Settings of all variables, or of each by its name."""


class DatasetReport(Sizes):
    """Figures of a written file of several variables.

    The `bytes` of a variable are those of its own arrays, without shared coordinates and header.
    """

    variables: Annotated[dict[str, EncodeReport], "figures of each variable by name"]


def encode_dataset(
    source: str | Path | Mapping[str, Source],
    path: str | Path,
    config: Configs | None = None,
    *,
    variables: Sequence[str] | None = None,
    open_variable: Callable[[str], Series] | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> DatasetReport:
    """Encode several variables into the container `path`, complete or not at all.

    They are encoded one after the other: no more is held than for the largest one alone. A single
    variable makes a file of several as well; `encode` makes the file of one.

    source: a file, or sources of `encode` by name, such as a dict of arrays or an xarray.Dataset,
        of which those are variables that `fhash info` would list for its file.
    config: the settings of all, or of each by name; the defaults where a name is not in it.
    variables: names of those to encode, in this order. All by default: of a file those that
        `fhash info` says a command for without `--select` and the like.
    open_variable: opens a variable of a file, in place of `open_series(source, var=name)`.
    force: replace a file that exists.

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
        if missed:
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
        dataset: Any = self._source
        if hasattr(dataset, "data_vars"):
            yield labelled_series(dataset, name)  # with all that lies beside it there
        elif isinstance(self._source, Mapping):
            try:
                source = self._source[name]
            except KeyError:
                listed = ", ".join(map(str, self._source))[:400]
                raise InputError(f"no variable {name[:80]!r}; the source has {listed}") from None
            with open_source(source) as series:
                if not isinstance(source, Series | str | Path):
                    series.name = shown_name(name, [each.name for each in series.coords.values()])
                yield series
        else:
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
        if not writer.attributes and series.metadata is not None:
            writer.attributes = json_attributes(series.metadata.attributes)
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
        check_cuda(config.device, torch=config.preset == "published")
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


def encodable(listed: Sequence[Listed], selected: int = 0) -> list[str]:
    """The names of the variables of a file that can be encoded as they are.

    listed: as `list_variables` gives them. selected: number of dimensions along which an index was
        selected for the listing; a variable that needs another one is left out.
    """
    return [
        entry.name
        for entry in listed
        if len(entry.options) == 1 and entry.options[0].count("--select") == selected
    ]


def _all_variables(source: str | Path | Mapping[str, Source]) -> list[str]:
    """The names of all variables of a source that can be encoded as they are."""
    if isinstance(source, str | Path):
        names = encodable(list_variables(source))
    elif hasattr(source, "data_vars"):
        dataset: Any = source
        names = encodable(list_dataset(dataset))
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
) -> DatasetReport:
    """The figures of a written file and of each variable."""
    figures: dict[str, EncodeReport] = {}
    with Dataset(Container.open(path)) as dataset:
        for name, volume in dataset.items():
            took = sum(stage["seconds"] for stage in stages[name])
            told = report(volume, encoded[name].quality, seconds=took)
            figures[name] = {**told, "stages": stages[name]}
        size, split = dataset.container.size, dataset.container.split()
    raw = sum(each["raw_bytes"] for each in figures.values())
    return {
        "path": str(path),
        "bytes": size,
        "split": split,
        "raw_bytes": raw,
        "ratio": raw / size,
        "seconds": seconds,
        "variables": figures,
    }
