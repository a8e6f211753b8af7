"""Work of an encoding by the profile paper, by a real one of two epochs.

All but the training takes the same time in both; of the training, steps of the second epoch are
timed, since the first ones also make room in memory.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.features.bricks import BRICK_BITS
from fhash_formats.errors import FhashWarning, QualityError
from fhash_formats.series import Series

__all__ = ["PaperProbe", "probe_paper"]

EPOCHS = 2
"""Epochs of the probe."""
ONCE = ("opening", "engine", "other")
"""Stages that take the same time for a part of a series, and begin a process at that."""


@dataclass(frozen=True, kw_only=True)
class PaperProbe:
    """An encoding of two epochs, of a series or a part of it.

    Attributes:
        stages: seconds of each stage but the training, for the whole series.
        step: seconds of a training step.
        curve: seconds of a measurement after an epoch.
        samples: samples of the coreset, of the whole series.
        bricks: bricks that hold them, at most.
        bytes: of the file for the whole series.
    """

    stages: Mapping[str, float]
    step: float
    curve: float
    samples: int
    bricks: int
    bytes: int

    def stage_seconds(self, config: EncodeConfig) -> dict[str, float]:
        """Return the predicted seconds of each stage, for settings that differ in epochs alone."""
        # torch takes seconds to import, and only a training needs it.
        from fhash_codec.paper.train import HISTORY_POINTS, usual_batches, usual_epochs

        batches = usual_batches(self.samples, self.bricks, config.batch)
        epochs = config.epochs or usual_epochs(batches)
        points = len(range(0, epochs, -(-epochs // HISTORY_POINTS)))
        return {
            **self.stages,
            "training": epochs * batches * self.step,
            "curve": points * self.curve,
        }


def probe_paper(part: Series, share: float, config: EncodeConfig) -> PaperProbe:
    """Encode a part of a series for two epochs, with batches of the size for the whole.

    share: share of the series that the part is.

    Raises MissingDependencyError without torch.
    """
    report = _encoded(part, replace(config, epochs=EPOCHS, psnr=None, psnr_bulk=None, timings=True))
    stages = {entry["stage"]: entry["seconds"] for entry in report["stages"]}
    training, curve = stages.pop("training", 0.0), stages.pop("curve", 0.0)
    vertices = prod(hi - lo for lo, hi in report["feature_bounding_box"]) * len(
        report["key_frames"]
    )
    domain = prod(part.shape[1:]) * len(report["key_frames"])
    samples = max(1, round(report["coreset_fraction"] * domain / share))
    first, last = (point["seconds"] for point in (report["curve"][0], report["curve"][-1]))
    from fhash_codec.paper.train import usual_batches

    bricks = max(1, round(vertices / share) >> sum(BRICK_BITS))
    batches_here = usual_batches(
        round(samples * share), max(1, round(bricks * share)), config.batch
    )
    batches = usual_batches(samples, bricks, config.batch)
    second = min(max(last - first - curve / EPOCHS, 0.0), training)
    # A step takes as long as it has samples.
    larger = (samples / batches) / (samples * share / batches_here)
    return PaperProbe(
        stages={
            name: seconds if name in ONCE else seconds / share for name, seconds in stages.items()
        },
        step=second / batches_here * larger,
        curve=curve / EPOCHS,
        samples=samples,
        bricks=bricks,
        bytes=round(report["bytes"] / share),
    )


def _encoded(part: Series, config: EncodeConfig) -> dict[str, Any]:
    """The report of an encoding into a file that is thrown away."""
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        try:
            return encode(part, Path(folder) / "part.fhz", config)
        except QualityError as error:
            return error.figures
