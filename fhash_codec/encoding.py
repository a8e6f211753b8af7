"""Encoding: a series in, a container out, whose quality is measured on the file as it decodes."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.compact.coded_table import DecodedTiles
from fhash_codec.compact.encode import encode_compact
from fhash_codec.comparison import measure, ssim_budget
from fhash_codec.config import EncodeConfig
from fhash_codec.container_name import check_name
from fhash_codec.coreset.selection import Source, mask_files, open_source
from fhash_codec.header import brief_quality
from fhash_codec.paper.encode import encode_paper
from fhash_codec.progress import Progress, silent
from fhash_codec.promises import missed_promise, remarks
from fhash_codec.report import report
from fhash_codec.stage_clock import recording, skip, stage
from fhash_codec.training.devices import choose_device, need_torch
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import FhashWarning, InputError, QualityError
from fhash_formats.series import Series
from fhash_formats.support.atomic import check_output

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
) -> dict[str, Any]:
    """Encode a series into the container `path`, complete or not at all.

    source: a file (opened by `fhash_formats.open_series`), a Series, or an array (t, z, y, x) or
        (z, y, x), labelled or not.
    config: the settings; the defaults if None.
    mask: booleans (t, z, y, x) or (z, y, x), one more feature. It is the only feature if the
        settings name none.
    force: replace a file that exists.
    predicted: seconds, bytes and psnr that were predicted, for the header; see `fhash info`.
    client: of a dask cluster (`dask.distributed.Client`), on whose workers the series is coded.
        The file is that of this function without `client` and with `timings=False`, byte for byte.
        The source is a file that all workers see, or an array of dask, labelled or not; the
        promise is a bound of the error. See docs/scale.md.

    Returns the figures of the written file (see `report`), and as "stages" what took the time (see
    `stage_clock.Stage`). In the profile paper Ctrl-C during the
    training saves a checkpoint beside `path` and raises InterruptedEncodingError; the same call
    then continues from the checkpoint to the same result. In the profile compact nothing is kept:
    KeyboardInterrupt passes through, and the same call starts again.

    Raises InputError for a source or settings that cannot be encoded, or for a promise that is seen
    to be out of reach, and MissingDependencyError for the profile paper without torch. Raises
    QualityError, with the figures of the file in the error, if the file
    misses what the settings promise. It is written nevertheless: as `path` where that is free; an
    older file stays as it is, and the new one is written beside it (`missed_path`). Warns
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
            if encoded.missed is not None and os.path.lexists(path):
                writer.divert(missed_path(path))
            written = writer.path
            progress("writing", 0, 1, "")
            with stage("writing", "header, and the file takes its name"):
                writer.commit(_with_prediction(encoded.header, predicted, config, begun))
            progress("writing", 1, 1, "")
        encoded.remove_checkpoint()
    with open_volume(written) as volume:
        seconds = time.perf_counter() - begun
        figures = report(volume, encoded.quality, seconds=seconds, files=series.files)
    figures["stages"] = clock.to_list()
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
) -> dict[str, Any]:
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
    checkpoint, advice = None, ""
    if config.profile == "compact":
        header = encode_compact(writer, series, config, mask, progress, measured.complete)
    else:
        header, checkpoint, advice = encode_paper(writer, series, config, mask, path, progress)
        header = measured.complete(header)
    figures = measured.figures(header)
    return EncodedVariable(
        header=header,
        quality=measured.quality,
        ratio=figures["ratio"],
        checkpoint=checkpoint,
        missed=missed_promise(config, figures),
        advice=advice,
    )


@contextmanager
def _opened(source: Source, path: Path, force: bool, config: EncodeConfig) -> Iterator[Series]:
    """The series of a source; raises what can be told at once, and not after the planning."""
    with ExitStack() as stack:
        with stage("opening", "paths, libraries and the source"):
            check_name(path)
            check_output(path, force)
            if config.profile == "paper":
                need_torch("profile paper")
                choose_device(config.device)
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
            vertices = ssim_budget(self._config)
            self.quality = measure(self._series, volume, self._progress, ssim_budget=vertices)
        low, high = header["value_range"]
        steps = header["domain"]["shape"][0]
        quality = brief_quality(self._writer, self.quality, high - low, steps)
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
    name = "tables/level_1"
    for number, (index, values) in enumerate(decoded.items()):
        if number % DECODED_AGAIN == 0:
            read = container.arrays[name].decode_chunk(index)
            if not np.array_equal(read, values, equal_nan=values.dtype.kind == "f"):
                raise RuntimeError(f"tile {index} decodes to other values than its encoder found")
    container.take_decoded(name, decoded)


def missed_path(path: Path) -> Path:
    """The name of a file that misses its promise, beside an older file `path` that stays.

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
    where = "the file is written" if written == path else f"it is kept, the new file is {written}"
    return f"{path}: {missed}; {where}" + (f". {advice}" if advice else "")
