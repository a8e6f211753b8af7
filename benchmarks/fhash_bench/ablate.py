"""Ablations: a series is encoded with one setting varied at a time, and the files are measured."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from fhash_bench.kept import save
from fhash_codec.config import PUBLISHED, EncodeConfig
from fhash_codec.cost.report import require_matplotlib
from fhash_codec.devices import machine
from fhash_codec.encoding import encode
from fhash_codec.features.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.simulation.simulate import simulate
from fhash_codec.volume import open as open_volume
from fhash_formats.errors import FhashWarning, InputError, QualityError, suggestion
from fhash_formats.series import ArraySeries, Series


@dataclass(frozen=True, kw_only=True)
class Axis:
    """Settings that vary together.

    Attributes:
        name: name on the command line.
        preset: of the base.
        varied: settings of each model; the names are fields of `EncodeConfig`, and what is not
            named has its default.
        reference: number of the one in `varied` that the others are compared with: the default.
        common: settings of all models of the axis.
        why: what the axis is to show, one line.
    """

    name: str
    preset: str
    varied: tuple[dict[str, Any], ...]
    why: str
    reference: int = 0
    common: tuple[tuple[str, Any], ...] = ()


def _one(field: str, *values: Any) -> tuple[dict[str, Any], ...]:
    """Settings of one field."""
    return tuple({field: value} for value in values)


def _grid(first: str, ones: Sequence[Any], second: str, others: Sequence[Any]) -> Any:
    """Settings of two fields, each value of one with each of the other."""
    return tuple({first: one, second: other} for one in ones for other in others)


AXES = (
    Axis(
        name="encoding",
        preset="published",
        varied=_grid("fold", (2, 4, 6), "embedding_size", (1, 2, 4, 8)),
        reference=1,
        why="ratio of resolution between levels, and numbers at a grid corner (paper, Table 1)",
    ),
    Axis(
        name="network",
        preset="published",
        varied=_grid("hidden_layers", (1, 2), "width", (16, 32, 64, 128)),
        reference=6,
        why="layers and neurons of the MLP (paper, Ablation Study)",
    ),
    Axis(
        name="key-frames",
        preset="published",
        varied=_one("key_frames", "all", "every:2", "every:4", "auto:10"),
        why="steps that are trained; quality is measured on all steps",
    ),
    Axis(
        name="dilation",
        preset="published",
        varied=_one("dilation", 0, 1, 2, 4),
        reference=1,
        why="vertices by which the feature grows",
    ),
    Axis(
        name="samples",
        preset="published",
        varied=_one("samples", "all", "keys", "published"),
        common=(("key_frames", "every:4"),),
        why="steps between key frames, and vertices of one neighbour alone, with every 4th step",
    ),
    Axis(
        name="brick",
        preset="published",
        varied=_one("brick", "auto", "4x4x4", "4x4x8", "4x8x8", "8x8x8", "8x8x16", "16x16x16"),
        why="vertices that are trained together",
    ),
    Axis(
        name="batch",
        preset="published",
        varied=_one("batch", 0, 1 << 12, 1 << 14, 1 << 16, 1 << 18, 1 << 21),
        why="samples of a training step; 0 is the product's own choice, 2^21 the paper's",
    ),
    Axis(
        name="schedule",
        preset="published",
        varied=_one("schedule", "cosine", "constant"),
        why="course of the learning rate; constant is the paper's",
    ),
    Axis(
        name="tables",
        preset="published",
        varied=(
            *_one("tables", "float32", "float16", "uint8", "sparse", "dense"),
            {"tables": "transform", "fold": 2, "embedding_size": 2, "width": 64},
            {"tables": "transform"},
        ),
        reference=1,
        why="storage of the tables: float16 is sparse here, of needed vertices alone;"
        " transform alone has a smaller model, made for coding",
    ),
    Axis(
        name="effort",
        preset="default",
        varied=_one("effort", 1, 2, 3, 4, 5, 7, 9),
        reference=4,
        why="trials and training of the default preset",
    ),
    Axis(
        name="tile",
        preset="default",
        varied=_one("tile", "auto", "whole", "4x16x16x16", "4x32x32x32", "16x16x16x16"),
        why="vertices that are decoded together",
    ),
    Axis(
        name="stages",
        preset="default",
        varied=(*_one("without", (), ("tiles",), ("transform",)), {"train": "none"}),
        why="stages of the encoding, each left out",
    ),
    Axis(
        name="stages-of-bound",
        preset="default",
        varied=(
            *_one("without", (), ("tiles",), ("transform",), ("predictor",)),
            {"train": "none"},
        ),
        why="the same for a strict bound of 1 % of the range, whatever is promised otherwise",
        common=(("psnr", None), ("max_error", None), ("max_error_rel", 0.01)),
    ),
)
"""All axes, in the order in which they are measured."""


def axes_named(names: Sequence[str]) -> tuple[Axis, ...]:
    """Return the axes of some names, in the order of AXES; all of them for no names.

    Raises InputError for an unknown name.
    """
    known = [axis.name for axis in AXES]
    for name in names:
        if name not in known:
            raise InputError(f"unknown axis '{name}'; {suggestion(name, known)}")
    return tuple(axis for axis in AXES if not names or axis.name in names)


POINTS = 1 << 17
"""Points of a measurement."""
TURNS = 3
"""Measurements of which the best counts; the first one reads the tables from the file."""
BETWEEN = 0.37
"""Place between two steps, as a share of their distance."""


def points_per_second(path: Path) -> float:
    """Return how many points `Volume.sample` evaluates in a second of processors.

    The points lie beside vertices of the coreset that are drawn at random, in their order in the
    volume, at one time between two steps.

    Args:
        path: a file with a coreset.
    """
    random = np.random.default_rng(0)
    with open_volume(path) as volume:
        steps = volume.shape[0]
        step, vertices = next(
            (step, vertices)
            for step in (*range(steps // 2, steps), *range(steps // 2))
            if len(vertices := np.argwhere(volume.occupancy(step)))
        )
        drawn = vertices[np.sort(random.integers(len(vertices), size=POINTS))]
        last = np.array(volume.shape[1:]) - 1
        z, y, x = np.minimum(drawn + random.random(drawn.shape), last).T
        spent = []
        for _ in range(TURNS):
            begun = time.process_time()
            volume.sample(t=min(step + BETWEEN, steps - 1), z=z, y=y, x=x)
            spent.append(time.process_time() - begun)
    return POINTS / min(spent)


@dataclass(frozen=True, kw_only=True)
class Run:
    """Figures of one encoding; those of a quality are of the file as it decodes, over all steps.

    Attributes:
        axis: name of the axis.
        settings: what is varied.
        reference: whether the axis's others are compared with it.
        seed: seed of the random choices.
        seconds: time of the whole encoding.
        training_seconds: time of the training; None but for the published network.
        epochs: epochs of the training, 0 without one.
        bytes: size of the file.
        parameters: numbers of the model.
        points_per_second: points that are evaluated in a second of processors.
        psnr: dB in the coreset; None where the error is 0.
        psnr_domain: dB over all finite vertices.
        max_abs_error: largest error in the coreset, in data units.
        curve: {epoch, seconds, psnr} of the training.
    """

    axis: str
    settings: dict[str, Any]
    reference: bool
    seed: int
    seconds: float
    training_seconds: float | None
    epochs: int
    bytes: int
    parameters: int
    points_per_second: float
    psnr: float | None
    psnr_domain: float | None
    max_abs_error: float | None
    curve: tuple[dict[str, Any], ...] = ()

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Run:
        """The record that `asdict` gave. Raises InputError for other values."""
        try:
            settings = {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in values["settings"].items()
            }
            return cls(**{**values, "settings": settings, "curve": tuple(values["curve"])})
        except (AttributeError, KeyError, TypeError) as error:
            raise InputError(f"not a run of bench ablate: {error}") from error


@dataclass(frozen=True, kw_only=True)
class Row:
    """One variation over all seeds: medians, and the spread of the PSNR.

    Attributes:
        axis, settings: as in `Run`.
        seconds, training_seconds, bytes, parameters, points_per_second, psnr, psnr_domain,
            max_abs_error: medians.
        psnr_spread: largest less smallest PSNR of the seeds; None for one seed.
        seconds_ratio, bytes_ratio: over those of the axis's reference.
        psnr_gain: dB over the axis's reference.
    """

    axis: str
    settings: dict[str, Any]
    seconds: float
    training_seconds: float | None
    bytes: int
    parameters: int
    points_per_second: float
    psnr: float | None
    psnr_domain: float | None
    max_abs_error: float | None
    psnr_spread: float | None
    seconds_ratio: float | None
    bytes_ratio: float | None
    psnr_gain: float | None


@dataclass(frozen=True, kw_only=True)
class AblateBench:
    """Figures of all axes.

    Attributes:
        series: name of the series. shape: (t, z, y, x). features: what was encoded.
        common: settings of all encodings of a preset.
        runs: all encodings.
        left_out: a line for each variation that was not measured, with the reason.
        machine: what the encodings ran on.
    """

    series: str
    shape: tuple[int, ...]
    features: tuple[str, ...]
    common: dict[str, dict[str, Any]]
    runs: tuple[Run, ...]
    left_out: tuple[str, ...]
    machine: dict[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> list[Row]:
        """The variations in their order, each beside the reference of its axis."""
        groups: dict[tuple[str, str], list[Run]] = {}
        for run in self.runs:
            groups.setdefault((run.axis, str(run.settings)), []).append(run)
        references = {axis: runs for (axis, _), runs in groups.items() if runs[0].reference}
        return [_row(runs, references.get(axis)) for (axis, _), runs in groups.items()]

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "series": self.series,
            "shape": list(self.shape),
            "features": list(self.features),
            "common": self.common,
            "rows": [asdict(row) for row in self.rows],
            "runs": [asdict(run) for run in self.runs],
            "left_out": list(self.left_out),
            "machine": self.machine,
        }


def _row(runs: list[Run], reference: list[Run] | None) -> Row:
    """The row of a variation's runs, beside those of the reference if it was measured."""
    psnrs = [run.psnr for run in runs]
    known = [value for value in psnrs if value is not None]
    psnr, seconds = _median(psnrs), median(run.seconds for run in runs)
    size = median(run.bytes for run in runs)
    seconds_ratio = bytes_ratio = psnr_gain = None
    if reference is not None:
        seconds_ratio = seconds / median(run.seconds for run in reference)
        bytes_ratio = size / median(run.bytes for run in reference)
        expected = _median([run.psnr for run in reference])
        psnr_gain = None if psnr is None or expected is None else psnr - expected
    return Row(
        axis=runs[0].axis,
        settings=runs[0].settings,
        seconds=seconds,
        training_seconds=_median([run.training_seconds for run in runs]),
        bytes=round(size),
        parameters=round(median(run.parameters for run in runs)),
        points_per_second=median(run.points_per_second for run in runs),
        psnr=psnr,
        psnr_domain=_median([run.psnr_domain for run in runs]),
        max_abs_error=_median([run.max_abs_error for run in runs]),
        psnr_spread=max(known) - min(known) if len(known) > 1 else None,
        seconds_ratio=seconds_ratio,
        bytes_ratio=bytes_ratio,
        psnr_gain=psnr_gain,
    )


def _median(values: list[float | None]) -> float | None:
    """The median of some numbers; None if one of them is unknown."""
    known = [value for value in values if value is not None]
    return median(known) if known and len(known) == len(values) else None


EPOCHS = 10
"""Epochs of every training, unless others are asked for."""
MADE = "bubble"
"""Scene of the made series: the paper's ablations are of its Argon Bubble."""
TAKEN = ("bytes", "parameters", "points_per_second", "psnr", "psnr_domain", "max_abs_error")
"""Figures of an encoding that a run has under the same name."""


def bench_ablate(
    source: Source | None = None,
    settings: dict[str, Any] | None = None,
    *,
    names: Sequence[str] = (),
    epochs: int = EPOCHS,
    seeds: int = 1,
    folder: Path | None = None,
    progress: Progress = silent,
) -> AblateBench:
    """Encode a series once for each variation of each axis and seed, and measure the files.

    Args:
        source: the series; None for a made one, with a feature.
        settings: features, promise and device of all encodings, by the names of `EncodeConfig`.
        names: axes to measure; all of them if empty.
        epochs: epochs of each training.
        seeds: number of seeds, from 0.
        folder: where finished encodings are kept; None to keep none.
        progress: called with each step of the work.

    Raises:
        InputError: an axis is unknown, or the series or the settings cannot be encoded at all.
    """
    settings = {name: value for name, value in (settings or {}).items() if value is not None}
    axes = axes_named(names)
    if source is None:
        made = simulate(MADE)
        # In memory, since a scene is computed anew whenever it is read.
        frames = np.stack([made.read(step) for step in range(made.shape[0])])
        source = ArraySeries(frames, name=MADE, coords=made.coords)
        if settings.get("features", ("all",)) == ("all",):
            settings["features"] = (made.scene.feature,)
    promise: dict[str, Any] = {
        name: settings.pop(name) for name in ("psnr", "max_error") if name in settings
    }
    common: dict[str, dict[str, Any]] = {
        # Tables of numbers have no default promise, which would end a training where it is kept.
        PUBLISHED: {"tables": "float16", **settings, "preset": PUBLISHED, "epochs": epochs},
        "default": {**settings, **promise, "preset": "default"},
    }
    with open_source(source) as series, tempfile.TemporaryDirectory() as scratch:
        work = _Work(series, common, Path(scratch), folder, progress)
        work.measure(axes, seeds)
    return AblateBench(
        series=f"{series.source} {series.name}".strip(),
        shape=tuple(series.shape),
        features=tuple(settings.get("features", ("all",))),
        common={axis.preset: common[axis.preset] for axis in axes},
        runs=tuple(work.runs),
        left_out=tuple(work.left_out),
        machine=machine(),
    )


class _Work:
    """The encodings of one call.

    Attributes:
        runs: those that are finished.
        left_out: a line for each that could not be made.
    """

    def __init__(
        self,
        series: Series,
        common: dict[str, dict[str, Any]],
        scratch: Path,
        folder: Path | None,
        progress: Progress,
    ) -> None:
        self.runs: list[Run] = []
        self.left_out: list[str] = []
        self._series, self._common = series, common
        self._scratch, self._folder, self._progress = scratch, folder, progress
        self._digest = "" if folder is None else _digest(series)

    def measure(self, axes: Sequence[Axis], seeds: int) -> None:
        """Encode every variation with every seed."""
        tasks = [
            (axis, varied, seed) for axis in axes for varied in axis.varied for seed in range(seeds)
        ]
        for number, (axis, varied, seed) in enumerate(tasks):
            self._progress("encoding", number, len(tasks), f"{axis.name}: {as_options(varied)}")
            self._one(axis, varied, seed)
        self._progress("encoding", len(tasks), len(tasks), "")

    def _one(self, axis: Axis, varied: dict[str, Any], seed: int) -> None:
        """Encode one variation, unless it is finished already."""
        settings = {**self._common[axis.preset], **dict(axis.common), **varied, "seed": seed}
        config = EncodeConfig.from_dict(settings)
        kept = None if self._folder is None else self._folder / self._name(axis, varied, config)
        if kept is not None and kept.exists():
            self.runs.append(_read(kept))
            return
        try:
            figures = _encoded(self._series, self._scratch / "run.fhz", config)
        except InputError as error:
            self.left_out.append(f"{axis.name}: {as_options(varied)}: {error}")
            return
        run = _run(axis, varied, seed, figures)
        if kept is not None:
            save(kept, asdict(run))
        self.runs.append(run)

    def _name(self, axis: Axis, varied: dict[str, Any], config: EncodeConfig) -> str:
        """The name of a kept run, which all that its figures depend on is part of."""
        identity = json.dumps([self._digest, config.to_dict()], sort_keys=True)
        digest = hashlib.sha256(identity.encode()).hexdigest()[:10]
        words = re.sub(r"[^a-z0-9]+", "-", as_options(varied).lower()).strip("-")
        return f"{axis.name}-{words}-{digest}.json"


def _digest(series: Series) -> str:
    """A digest of the values of a series: a file may change under its name."""
    digest = hashlib.sha256(f"{series.shape} {series.dtype}".encode())
    for step in range(series.shape[0]):
        digest.update(series.read(step).tobytes())
    return digest.hexdigest()


def as_options(settings: dict[str, Any]) -> str:
    """Settings as options of the command line; an empty one as nothing left out."""
    texts = {
        name: (",".join(value) or "nothing") if isinstance(value, list | tuple) else value
        for name, value in settings.items()
    }
    return " ".join(f"--{name.replace('_', '-')} {text}" for name, text in texts.items())


def _encoded(series: Series, path: Path, config: EncodeConfig) -> dict[str, Any]:
    """Encode a series; the figures of the file, also where it misses a promise."""
    with warnings.catch_warnings():
        # What a variation does badly is what the table is to show.
        warnings.simplefilter("ignore", FhashWarning)
        try:
            figures = encode(series, path, replace(config, timings=True), force=True)
        except QualityError as error:
            figures = error.figures
        finally:
            for left in path.parent.glob("*.checkpoint"):
                left.unlink()
    return {**figures, "points_per_second": points_per_second(path)}


def _read(path: Path) -> Run:
    """Read a run that was kept. Raises InputError for another file."""
    try:
        return Run.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}; delete it to measure again") from error


def _run(axis: Axis, varied: dict[str, Any], seed: int, figures: dict[str, Any]) -> Run:
    """The figures of one encoding."""
    curve = figures["curve"] or []
    return Run(
        axis=axis.name,
        settings=varied,
        reference=varied == axis.varied[axis.reference],
        seed=seed,
        seconds=figures["seconds"],
        training_seconds=curve[-1].get("seconds") if axis.preset == PUBLISHED and curve else None,
        epochs=figures["epochs"],
        curve=tuple(curve) if axis.preset == PUBLISHED else (),
        **{
            field.name: figures[field.name]
            for field in dataclasses.fields(Run)
            if field.name in TAKEN
        },
    )


COLUMNS = 3
"""Panels side by side."""
COLOURS = ("#4a86c0", "#d1604b", "#2f9e6e", "#e0a030", "#b07aa1", "#3b3f46", "#57b8c4", "#9c8b5a")
"""Colours of the models of a panel, told apart by colour-blind readers with their line styles."""
STYLES = ("-", "--", ":", "-.")
"""Line styles, for more models than colours."""


def plot(result: AblateBench, path: Path) -> None:
    """Draw a result as a PNG at `path`.

    An axis of the preset published shows PSNR over the epochs of each training; one of the
    default bytes against seconds: its models keep the same promise.
    """
    figure_module = require_matplotlib()
    axes = list(dict.fromkeys(run.axis for run in result.runs))
    lines = -(-len(axes) // COLUMNS)
    columns = min(COLUMNS, len(axes))
    size = (1 + 5.2 * columns, 0.6 + 4.2 * lines)
    figure = figure_module.Figure(figsize=size, layout="constrained", dpi=120)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel, name in zip(panels, axes, strict=False):
        runs = [run for run in result.runs if run.axis == name and run.seed == 0]
        if any(run.curve for run in runs):
            _curves(panel, runs)
        else:
            _points(panel, [row for row in result.rows if row.axis == name])
        panel.set_title(name, fontsize=10)
        panel.grid(True, color="#e3e4e8", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.legend(frameon=False, fontsize=6, ncols=2)
    for panel in panels[len(axes) :]:
        panel.set_visible(False)
    figure.suptitle(f"{Path(result.series).name}, {' x '.join(map(str, result.shape))}")
    figure.savefig(path, format="png")


def _curves(panel: Any, runs: list[Run]) -> None:
    """PSNR over epochs, on the bricks that the training watches; a line for each model."""
    for number, run in enumerate(runs):
        points = [point for point in run.curve if point["psnr"] is not None]
        panel.plot(
            [point["epoch"] for point in points],
            [point["psnr"] for point in points],
            color=COLOURS[number % len(COLOURS)],
            linestyle=STYLES[number // len(COLOURS) % len(STYLES)],
            linewidth=2.4 if run.reference else 1.3,
            label=as_options(run.settings),
        )
    panel.set_xlabel("epochs")
    panel.set_ylabel("PSNR on some bricks of the key frames, dB")


def _points(panel: Any, rows: list[Row]) -> None:
    """Bytes against seconds, a point for each variation, whose legend tells its PSNR."""
    for number, row in enumerate(rows):
        quality = "exact" if row.psnr is None else f"{row.psnr:.1f} dB"
        panel.plot(
            [row.seconds],
            [row.bytes],
            "o",
            color=COLOURS[number % len(COLOURS)],
            label=f"{as_options(row.settings)}: {quality}",
        )
    panel.set_xscale("log")
    panel.set_xlabel("seconds of the encoding")
    panel.set_ylabel("bytes of the file")
