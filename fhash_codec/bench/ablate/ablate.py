"""`fhash bench ablate`: encodes a series with one setting varied at a time, and measures the files.

Each variation is a whole encoding by `fhash_codec.encode`, so that its figures are those that a
user gets. With a folder, each finished encoding leaves a JSON file there, and the same call goes on
where an earlier one ended.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fhash_codec.bench.ablate.axes import Axis, axes_named
from fhash_codec.bench.ablate.points import points_per_second
from fhash_codec.bench.ablate.results import AblateBench, Run
from fhash_codec.bench.machine import machine
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.features.selection import Source, open_source
from fhash_codec.progress import Progress, silent
from fhash_codec.simulation.simulate import simulate
from fhash_formats.errors import FhashWarning, InputError, QualityError
from fhash_formats.series import ArraySeries, Series
from fhash_formats.support.files import replacing

__all__ = ["EPOCHS", "MADE", "bench_ablate"]

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
        "paper": {**settings, "profile": "paper", "epochs": epochs},
        "compact": {**settings, **promise, "profile": "compact"},
    }
    with open_source(source) as series, tempfile.TemporaryDirectory() as scratch:
        work = _Work(series, common, Path(scratch), folder, progress)
        work.measure(axes, seeds)
    return AblateBench(
        series=f"{series.source} {series.name}".strip(),
        shape=tuple(series.shape),
        features=tuple(settings.get("features", ("all",))),
        common={axis.profile: common[axis.profile] for axis in axes},
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
            self._progress("encoding", number, len(tasks), f"{axis.name}: {told(varied)}")
            self._one(axis, varied, seed)
        self._progress("encoding", len(tasks), len(tasks), "")

    def _one(self, axis: Axis, varied: dict[str, Any], seed: int) -> None:
        """Encode one variation, unless it is finished already."""
        settings = {**self._common[axis.profile], **dict(axis.common), **varied, "seed": seed}
        config = EncodeConfig.from_dict(settings)
        kept = None if self._folder is None else self._folder / self._name(axis, varied, config)
        if kept is not None and kept.exists():
            self.runs.append(_read(kept))
            return
        try:
            figures = _encoded(self._series, self._scratch / "run.fhz", config)
        except InputError as error:
            self.left_out.append(f"{axis.name}: {told(varied)}: {error}")
            return
        run = _run(axis, varied, seed, figures)
        if kept is not None:
            with replacing(kept, force=False) as temporary:
                temporary.write_text(json.dumps(asdict(run), indent=1) + "\n", encoding="utf-8")
        self.runs.append(run)

    def _name(self, axis: Axis, varied: dict[str, Any], config: EncodeConfig) -> str:
        """The name of a kept run, which all that its figures depend on is part of."""
        identity = json.dumps([self._digest, config.to_dict()], sort_keys=True)
        digest = hashlib.sha256(identity.encode()).hexdigest()[:10]
        words = re.sub(r"[^a-z0-9]+", "-", told(varied).lower()).strip("-")
        return f"{axis.name}-{words}-{digest}.json"


def _digest(series: Series) -> str:
    """A digest of the values of a series: a file may change under its name."""
    digest = hashlib.sha256(f"{series.shape} {series.dtype}".encode())
    for step in range(series.shape[0]):
        digest.update(series.read(step).tobytes())
    return digest.hexdigest()


def told(settings: dict[str, Any]) -> str:
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
            figures = encode(series, path, config, force=True)
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
        training_seconds=curve[-1].get("seconds") if axis.profile == "paper" and curve else None,
        epochs=figures["epochs"],
        curve=tuple(curve) if axis.profile == "paper" else (),
        **{
            field.name: figures[field.name]
            for field in dataclasses.fields(Run)
            if field.name in TAKEN
        },
    )
