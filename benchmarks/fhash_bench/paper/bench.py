"""Every encoding in every protocol, cell by cell: `fhash bench paper`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fhash_bench.kept import load, save
from fhash_bench.paper.cells import Cell, Request
from fhash_bench.paper.data import (
    CANDIDATES,
    ENCODINGS,
    KINDS,
    PROTOCOLS,
    RATE,
    RELEASED_EPOCHS,
    SETS,
    Arrangement,
    Data,
    arrangement,
    encodings_of,
    feature_text,
    gather_data,
    simulated,
)
from fhash_bench.paper.measures import (
    DECIBELS,
    PICTURE_SIZE,
    VIEWS,
    PictureProbe,
    Places,
    first_seconds,
    measure_between,
    measure_latency,
    places_of,
    rank,
    train,
)
from fhash_bench.paper.trained import TrainedEncoding, build, missing
from fhash_codec.devices import choose_device, machine, threads_for
from fhash_codec.progress import Progress, silent
from fhash_formats.series import Series

USUAL_KEY_FRAMES = 10
"""Key frames of data that are not the paper's."""


@dataclass(frozen=True, kw_only=True)
class BenchPlan:
    """Cells that are to be measured.

    Attributes:
        scale: full, half, quarter or eighth of the paper's lengths; of the scenes alone.
        data_sets: names of scenes; not used with data of one's own.
        protocols, encodings: names.
        features: kinds, or features as the codec takes them.
        epochs: of every training; the protocol released takes RELEASED_EPOCHS times as many.
        seeds: seeds 1, 2, ... of every cell.
        key_frames: as `fhash encode --key-frames` takes it; None for as many as the paper has.
        device: auto, cpu or cuda.
        latency: whether pictures through the encodings are timed, for the first seed of the
            protocol published.
        views: views of these pictures.
        picture_size: pixels along both sides of the pictures of curves.
    """

    scale: str = "full"
    data_sets: tuple[str, ...] = tuple(SETS)
    protocols: tuple[str, ...] = PROTOCOLS
    encodings: tuple[str, ...] = ENCODINGS
    features: tuple[str, ...] = KINDS
    epochs: int = 60
    seeds: int = 3
    key_frames: str | None = None
    device: str = "auto"
    latency: bool = True
    views: int = VIEWS
    picture_size: int = PICTURE_SIZE

    @classmethod
    def quick(cls, **changes: Any) -> BenchPlan:
        """The plan that takes minutes: an eighth of the lengths, one feature, one seed.

        Key frames and epochs are the paper's, and so are the steps in an epoch.
        """
        settings: dict[str, Any] = {
            "scale": "eighth",
            "features": ("segmentation",),
            "seeds": 1,
            "views": 1,
        }
        return cls(**(settings | changes))


def requests_of(
    plan: BenchPlan, encodings: Sequence[str], source: Series | None, name: str
) -> Iterator[Request]:
    """Yield the cells of a plan: encodings in turns, so that a busy machine treats them alike."""
    names = plan.data_sets if source is None else (name,)
    for data_set in names:
        series = simulated(data_set, plan.scale) if source is None else source
        for feature in plan.features:
            settings = {
                "shape": list(series.shape),
                "source": None if source is None else _identity(source),
                "feature": feature_text(data_set, feature),
                "key_frames": _key_frames(plan, data_set, series),
                "epochs": plan.epochs,
                "learning_rate": RATE,
                "picture_size": plan.picture_size,
                "device": choose_device(plan.device).type,
            }
            for seed in range(1, plan.seeds + 1):
                for protocol in plan.protocols:
                    timed = plan.latency and protocol == "published" and seed == 1
                    own: dict[str, Any] = {"latency": timed and plan.views}
                    if protocol == "best":
                        own["candidates"] = list(CANDIDATES)
                    if protocol == "released":
                        own["epochs"] = plan.epochs * RELEASED_EPOCHS
                    for encoding in encodings_of(protocol, encodings):
                        yield Request(
                            encoding=encoding,
                            protocol=protocol,
                            data_set=data_set,
                            feature=feature,
                            seed=seed,
                            settings=settings | own,
                        )


def _identity(source: Series) -> list[Any]:
    """Return the identity of the user's data: names, and size and time of each file."""
    files = [
        [path.name, path.stat().st_size, path.stat().st_mtime_ns]
        for path in source.files
        if path.is_file()
    ]
    return [source.source, source.name, str(source.dtype), files]


def _key_frames(plan: BenchPlan, data_set: str, series: Series) -> str:
    """Return which steps are key frames: the plan's, or as many as the paper has."""
    if plan.key_frames is not None:
        return plan.key_frames
    known = SETS.get(data_set)
    count = USUAL_KEY_FRAMES if known is None else known.key_frames
    return "all" if count >= series.shape[0] else f"auto:{count}"


ZSTD_LEVEL = 3
"""Level at which stored numbers are compressed."""


@dataclass(frozen=True, kw_only=True)
class PaperBench:
    """The result: cells in the order of the plan, and what was left out."""

    cells: tuple[Cell, ...]
    notes: tuple[str, ...]


def bench_paper(
    plan: BenchPlan,
    folder: Path,
    source: Series | None = None,
    *,
    name: str = "data",
    progress: Progress = silent,
) -> PaperBench:
    """Train every encoding that a plan names, and keep each cell in a folder once it is finished.

    Cells that the folder has are not run again. An interrupt loses the running cell alone.

    Args:
        plan: what is to be measured.
        folder: of the cells; it is made for the first.
        source: the user's own series; None for the scenes of the plan.
        name: name of the user's series.
        progress: called with each step of the work.

    Raises:
        InputError: a name of the plan is unknown, or settings do not fit the data.
    """
    notes = []
    encodings = list(plan.encodings)
    reason = missing() if "tcnn" in encodings else None
    if reason is not None:
        encodings.remove("tcnn")
        notes.append(f"not measured: {reason}")
    requests = list(requests_of(plan, encodings, source, name))
    finished = [load(folder / request.filename, Cell.from_dict) for request in requests]
    device, cells = choose_device(plan.device), []
    held: _Held | None = None
    for number, request in enumerate(requests):
        cell = finished[number]
        if cell is None:
            if held is None or not held.is_of(request):
                held = None  # frees the memory of the last data before the next are read
                held = _Held.of(plan, request, source, progress)

            def told(stage: str, done: int, total: int, note: str) -> None:
                text = f"{request}: {stage} {done}/{total} {note}"  # noqa: B023
                progress("cells", number, len(requests), text.rstrip())  # noqa: B023

            cell = _run(request, held, device, told)
            save(folder / request.filename, cell.to_dict())
        cells.append(cell)
        progress("cells", number + 1, len(requests), str(request))
    return PaperBench(cells=tuple(cells), notes=tuple(notes))


@dataclass(frozen=True, kw_only=True)
class _Held:
    """Data that several cells share.

    Attributes:
        data_set, feature: of these cells.
        data: the samples.
        probe: pictures of the key frames.
        places: of all steps.
    """

    data_set: str
    feature: str
    data: Data
    probe: PictureProbe
    places: list[Places]

    @classmethod
    def of(
        cls, plan: BenchPlan, request: Request, source: Series | None, progress: Progress
    ) -> _Held:
        """Read the data of a cell."""
        series = simulated(request.data_set, plan.scale) if source is None else source
        data = gather_data(
            request.data_set, series, request.feature, request.settings["key_frames"], progress
        )
        span = data.scanned.value_range
        probe = PictureProbe(
            data.frames,
            str(data.features[0]),
            value_range=(span.low, span.high),
            size=plan.picture_size,
        )
        return cls(
            data_set=request.data_set,
            feature=request.feature,
            data=data,
            probe=probe,
            places=places_of(data),
        )

    def is_of(self, request: Request) -> bool:
        """Whether a cell is of these data."""
        return (self.data_set, self.feature) == (request.data_set, request.feature)


def _run(request: Request, held: _Held, device: torch.device, progress: Progress) -> Cell:
    """Train one cell and measure it."""
    data, arranged = held.data, arrangement(request.protocol, request.encoding, held.data)
    epochs = request.settings["epochs"]

    def make(steps: int) -> TrainedEncoding:
        return build(
            request.encoding,
            data,
            arranged,
            steps=steps,
            epochs=epochs,
            seed=request.seed,
            device=device,
        )

    # Vertices without training show nothing.
    pictures = partial(held.probe.measure, masks=None if arranged.whole else data.masks)
    progress("warming up", 0, 1, "")
    warm = make(max(arranged.steps))
    threads_of = max(1, warm.samples_an_epoch // len(warm.parts) // max(arranged.steps))
    with threads_for(threads_of) as threads:
        warm.train_epoch(0)
        del warm
        steps, trial = _best_steps(arranged, make, data, epochs, device, progress)
        encoding = make(steps)
        result = train(encoding, data, epochs, device=device, picture=pictures, progress=progress)
        latency = _latency(request, held, encoding, device, progress)
    samples = encoding.samples_an_epoch * epochs
    return Cell(
        encoding=request.encoding,
        protocol=request.protocol,
        data_set=request.data_set,
        shape=data.series.shape,
        feature=request.feature,
        key_frames=data.key_frames,
        coreset_share=data.coreset.fraction,
        box=(data.coreset.box.z, data.coreset.box.y, data.coreset.box.x),
        seed=request.seed,
        parameters={"tables": encoding.tables, "mlp": encoding.mlp},
        buckets_used=encoding.buckets_used(),
        bytes=_stored_bytes(encoding),
        raw_bytes=data.raw_bytes,
        samples_an_epoch=encoding.samples_an_epoch,
        steps_an_epoch=encoding.steps_an_epoch,
        samples_per_second=samples / max(result.seconds, 1e-9),
        training_seconds=result.seconds,
        curve=result.curve,
        settings={**request.settings, "feature_resolved": str(data.features[0])},
        latency=latency,
        between=measure_between(encoding, held.places),
        machine=machine(device) | {"threads": threads},
        collisions=encoding.collisions,
        trial=tuple(trial),
        engine=arranged.engine,
    )


def _best_steps(
    arranged: Arrangement,
    make: Callable[[int], TrainedEncoding],
    data: Data,
    epochs: int,
    device: torch.device,
    progress: Progress,
) -> tuple[int, list[dict[str, Any]]]:
    """Return the best of the candidates for the steps in an epoch, and `Cell.trial`.

    Each is trained to the end. A single candidate is taken without a training.
    """
    if len(arranged.steps) == 1:
        return arranged.steps[0], []
    trial: list[dict[str, Any]] = []
    best: tuple[tuple[int, float, float], int] | None = None
    for candidate in arranged.steps:
        encoding = make(candidate)
        if any(entry["steps"] == encoding.steps_an_epoch for entry in trial):
            continue
        course = train(encoding, data, epochs, device=device, progress=progress)
        trial.append(
            {
                "steps": encoding.steps_an_epoch,
                "seconds": course.seconds,
                "psnr": course.curve[-1].coreset_psnr,
                "reached": {f"{d:g}": first_seconds(course.curve, d) for d in DECIBELS},
            }
        )
        ranked = rank(course.curve), candidate
        best = ranked if best is None else max(best, ranked)
    assert best is not None
    return best[1], trial


def _latency(
    request: Request,
    held: _Held,
    encoding: TrainedEncoding,
    device: torch.device,
    progress: Progress,
) -> dict[str, Any] | None:
    """Return the times of pictures through an encoding, where the cell asks for them."""
    if not request.settings["latency"]:
        return None
    data, span = held.data, held.data.scanned.value_range
    return measure_latency(
        encoding,
        data.masks,
        str(data.features[0]),
        value_range=(span.low, span.high),
        views=request.settings["latency"],
        device=device.type,
        progress=progress,
    )


def _stored_bytes(encoding: TrainedEncoding) -> int:
    """Return the bytes of the trained numbers, compressed by zstd."""
    from numcodecs.zstd import compress

    return sum(len(compress(np.ascontiguousarray(a), ZSTD_LEVEL)) for a in encoding.arrays())
