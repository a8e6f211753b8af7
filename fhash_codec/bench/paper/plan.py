"""The plan of a bench, and the cells that it asks for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from fhash_codec.bench.paper.data import KINDS, feature_text, simulated
from fhash_codec.bench.paper.latency import VIEWS
from fhash_codec.bench.paper.pictures import SIZE
from fhash_codec.bench.paper.protocols import (
    CANDIDATES,
    ENCODINGS,
    PROTOCOLS,
    RATE,
    RELEASED_EPOCHS,
    encodings_of,
)
from fhash_codec.bench.paper.sets import SETS
from fhash_codec.bench.paper.store import Request
from fhash_codec.devices import choose_device
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
    picture_size: int = SIZE

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
