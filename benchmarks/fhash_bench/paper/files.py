"""Files at a quality (the honest Table 5), kept in the folder of the cells."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import fhash_codec
from fhash_bench.kept import load, of_fields, save, settings_id
from fhash_bench.paper.cells import CELL_VERSION, Cell
from fhash_bench.paper.printed import (
    ENCODINGS,
    FEATURES,
    QUOTED,
    SETS,
    TABLE_5,
    PaperTable,
    Value,
    notes_of,
)
from fhash_bench.rate.rate import bench_rate
from fhash_codec.config import EncodeConfig
from fhash_codec.progress import Progress, silent
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import MissingDependencyError, QualityError
from fhash_formats.series import Series

TARGET = 45.0
"""PSNR in dB over all steps that a file must have (paper, Table 5)."""
PEERS = ("SZ3", "SPERR", "ZFP")
"""Codecs that the files are compared with, as HDF5 filters."""
EPOCHS = (20, 40, 80)
"""Epochs of F-Hash that are tried until a file has the quality; its bytes hardly depend on them."""
NUMBER_TYPES = ("float32", "float16")
"""Number types of F-Hash's stored tables."""
EFFORT = 3
"""Effort of the default preset: a larger one makes smaller files in several times the time."""
PAPER = {"preset": "published", "key_frames": "all"}
"""Settings of the published F-Hash; every step is a key frame, since every step is asked for."""


@dataclass(frozen=True, kw_only=True)
class FileResult:
    """A file at a quality, or the best that a codec came to.

    Attributes:
        data_set, feature: as of a cell.
        codec: its name, with its setting.
        kind: paper, with tables of a number type; coded, with tables that the transform codes;
            default or peer.
        whole: whether the file holds the whole domain; else the coreset of the feature alone.
        bytes: on disk.
        raw_bytes: the values of all steps in the source's number type.
        psnr: dB over all steps of what the file holds; None where nothing differs.
        reached: whether that is the quality asked for.
        seconds: of encoding, training and measuring included; None where only the bytes are known.
    """

    data_set: str
    feature: str
    codec: str
    kind: str
    whole: bool
    bytes: int
    raw_bytes: int
    psnr: float | None
    reached: bool
    seconds: float | None

    @property
    def ratio(self) -> float:
        """Raw bytes of all steps / bytes of the file."""
        return self.raw_bytes / self.bytes

    def to_dict(self) -> dict[str, Any]:
        """JSON values by field name."""
        return asdict(self)


def measure_files(
    data_set: str,
    series: Series,
    feature: str,
    *,
    kind: str = "",
    target: float = TARGET,
    number_types: Sequence[str] = NUMBER_TYPES,
    progress: Progress = silent,
) -> tuple[list[FileResult], list[str]]:
    """Encode a series by F-Hash as published, by the default preset and by the installed peers.

    Args:
        data_set: name, as of a cell.
        series: all steps, held in memory.
        feature: as `fhash encode --feature` takes it.
        kind: name of the feature, as of a cell; the feature itself if empty.
        target: PSNR in dB over all steps.
        number_types: of F-Hash's tables, beside coded ones; each is a training of its own.
        progress: is told about each file.

    Returns:
        The files, and a line for each codec that could not be measured.
    """
    made = _Files(data_set, series, feature, kind or feature, target)
    refused: list[str] = []
    works: dict[str, Callable[[], list[FileResult]]] = {
        **{
            f"F-Hash, {name} tables": lambda name=name: [made.trained(name)]  # type: ignore[misc]
            for name in number_types
        },
        "F-Hash, coded tables": lambda: [made.coded()],
        "default": lambda: [made.default()],
        ", ".join(PEERS): made.peers,
    }
    results = []
    for number, (name, work) in enumerate(works.items()):

        def told(stage: str, done: int, total: int, note: str) -> None:
            text = f"{data_set}, {name}: {stage} {done}/{total} {note}"  # noqa: B023
            progress("files", number, len(works), text.rstrip())  # noqa: B023

        progress("files", number, len(works), f"{data_set}, {name}")
        made.progress = told
        try:
            results += work()
        except MissingDependencyError as error:
            refused.append(f"{name} not measured: {error}")
    progress("files", len(works), len(works), "")
    return results, [*refused, *made.refused]


class _Files:
    """Files of one series, each measured and then removed."""

    def __init__(
        self, data_set: str, series: Series, feature: str, kind: str, target: float
    ) -> None:
        self.data_set, self.series, self.feature, self.kind = data_set, series, feature, kind
        self.target = target
        self.refused: list[str] = []
        self.progress: Progress = silent

    def trained(self, tables: str) -> FileResult:
        """F-Hash with tables of a number type, trained until it has the quality."""
        for epochs in EPOCHS:
            settings = {**PAPER, "tables": tables, "epochs": epochs}
            result = self._encoded(f"F-Hash, {tables}, {epochs} epochs", "paper", settings)
            if result.reached:
                break
        return result

    def coded(self) -> FileResult:
        """F-Hash with tables that the transform codes down to the quality."""
        settings = {**PAPER, "tables": "transform", "psnr": self.target}
        return self._encoded("F-Hash, tables coded by the transform", "coded", settings)

    def default(self) -> FileResult:
        """The default preset on the feature."""
        settings = {"psnr": self.target, "effort": EFFORT}
        return self._encoded(f"default preset, effort {EFFORT}", "default", settings)

    def peers(self) -> list[FileResult]:
        """Codecs of the whole domain: the peers, and the default preset."""
        bench = bench_rate(
            self.series,
            {"effort": EFFORT},
            targets=(self.target,),
            bounds=(),
            names=PEERS,
            presets=("default",),
            speed=False,
            price_tiles=False,
            progress=self.progress,
        )
        self.refused += [f"{name} not measured: {why}" for name, why in bench.refused.items()]
        return [
            FileResult(
                data_set=self.data_set,
                feature=self.kind,
                codec=point.setting if point.codec in PEERS else f"default preset, effort {EFFORT}",
                kind="peer" if point.codec in PEERS else "default",
                whole=True,
                bytes=point.bytes,
                raw_bytes=bench.raw_bytes,
                psnr=point.psnr,
                reached=point.reached,
                seconds=None,
            )
            for point in bench.points
        ]

    def _encoded(self, codec: str, kind: str, settings: Mapping[str, Any]) -> FileResult:
        """Encode the feature once and read the figures of the file."""
        config = EncodeConfig.from_dict({**settings, "features": (self.feature,)})
        with tempfile.TemporaryDirectory(prefix="fhash-bench-") as folder:
            path, begun = Path(folder, "file.fhz"), time.perf_counter()
            try:
                fhash_codec.encode(self.series, path, config, progress=self.progress)
            except QualityError as error:  # its quality is in the result
                path = Path(error.figures["path"])
            seconds = time.perf_counter() - begun
            with open_volume(path) as volume:
                info = volume.info
        psnr = info["quality"]["psnr"]
        return FileResult(
            data_set=self.data_set,
            feature=self.kind,
            codec=codec,
            kind=kind,
            whole=False,
            bytes=info["bytes"],
            raw_bytes=info["raw_bytes"],
            psnr=psnr,
            reached=psnr is None or psnr >= self.target,
            seconds=seconds,
        )


def files_table(results: Sequence[FileResult], refused: Sequence[str] = ()) -> PaperTable:
    """The files by data set, smallest first, and the ratios that the paper prints, quoted."""
    rows: list[tuple[Value, ...]] = []
    for data_set, feature in dict.fromkeys((each.data_set, each.feature) for each in results):
        here = [each for each in results if (each.data_set, each.feature) == (data_set, feature)]
        for each in sorted(here, key=lambda each: (not each.reached, each.bytes)):
            rows.append(
                (
                    data_set, feature, each.codec, "domain" if each.whole else "feature",
                    each.bytes, each.ratio, "exact" if each.psnr is None else each.psnr,
                    "yes" if each.reached else "no", each.seconds,
                )
            )  # fmt: skip
        place = FEATURES.index(feature) if feature in FEATURES else 0
        for name, printed in TABLE_5.get(data_set, {}).items():
            codec = f"{ENCODINGS.get(name, name)} on {SETS[data_set]} (paper, {QUOTED})"
            ratio = printed[min(place, len(printed) - 1)]
            rows.append((data_set, feature, codec, None, None, ratio, None, None, None))
    return PaperTable(
        name="table-5-files",
        title=f"Table 5, files: bytes at {TARGET:g} dB or more over all steps",
        columns=("data set", "feature", "codec", "holds", "bytes", "ratio", "dB", "reached",
                 "encode s"),
        rows=tuple(rows),
        notes=(
            "the ratio is that of the raw values of all steps of the whole domain; peers are"
            " stored chunks alone, without the structure of a file",
            "dB are over what a file holds: 45 dB over a feature, all of whose vertices are hard,"
            " are more than over a domain that is mostly background",
            *refused,
            *notes_of(5),
        ),
    )  # fmt: skip


MAX_BYTES = 1 << 29
"""Bytes of the largest series that files are made of: its F-Hash trains on all steps, and the peers
hold it in memory."""


def files_of(
    cells: Sequence[Cell],
    series_of: Callable[[str], Series],
    folder: Path,
    *,
    number_types: Sequence[str] = NUMBER_TYPES,
    progress: Progress = silent,
) -> tuple[list[FileResult], list[str]]:
    """Measure the files of every data set and feature of some cells.

    What the folder has is not measured again.

    Args:
        cells: of the bench.
        series_of: name of a data set -> all of its steps.
        folder: of the cells, one file is added for each data set and feature.
        number_types: of F-Hash's tables, as for `measure_files`.
        progress: is told about each file.

    Returns:
        The files, and a line for what could not be measured.
    """
    results: list[FileResult] = []
    refused: list[str] = []
    for data_set, kind in dict.fromkeys((cell.data_set, cell.feature) for cell in cells):
        cell = next(each for each in cells if (each.data_set, each.feature) == (data_set, kind))
        if cell.raw_bytes > MAX_BYTES:
            refused.append(
                f"no files of {data_set}: it has {cell.raw_bytes / 1e9:.2g} GB, at most"
                f" {MAX_BYTES / 1e9:.2g} GB are encoded; take a smaller scale"
            )
            continue
        feature = cell.settings.get("feature_resolved", kind)
        path = folder / _filename(cell, feature, number_types)
        kept = load(path, _results_of)
        if kept is None:
            found, missing = measure_files(
                data_set,
                series_of(data_set),
                feature,
                kind=kind,
                number_types=number_types,
                progress=progress,
            )
            save(path, {"files": [each.to_dict() for each in found], "refused": list(missing)})
            kept = found, missing
        results += kept[0]
        refused += kept[1]
    return results, list(dict.fromkeys(refused))


def _filename(cell: Cell, feature: str, number_types: Sequence[str]) -> str:
    """The name of the file of results; other data or settings have another name."""
    settings: dict[str, Any] = {
        "shape": list(cell.shape),
        "source": cell.settings.get("source"),
        "feature": feature,
        "target": TARGET,
        "epochs": list(EPOCHS),
        "effort": EFFORT,
        "peers": list(PEERS),
        "number_types": list(number_types),
    }
    words = re.sub(r"[^A-Za-z0-9.-]+", "-", f"{cell.data_set}_{cell.feature}")
    return f"files_{words[:100]}_{settings_id(settings, CELL_VERSION)}.json"


def _results_of(values: Mapping[str, Any]) -> tuple[list[FileResult], list[str]]:
    """Results that were kept; raises ValueError where a codec was missing then."""
    if values["refused"]:
        raise ValueError("a codec was missing")
    return [of_fields(FileResult, each) for each in values["files"]], []
