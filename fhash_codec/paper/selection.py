"""The coreset that the paper profile trains on, and the architecture it trains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.bricks import Coreset, build_coreset, parse_brick
from fhash_codec.coreset.features import Feature
from fhash_codec.coreset.scan import Scan
from fhash_codec.coreset.selection import resolve_selection
from fhash_codec.paper.architecture import Architecture
from fhash_codec.progress import Progress
from fhash_codec.stage_clock import stage
from fhash_formats.series import Series


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Training samples that the settings select from a series, and the model to fit to them.

    Attributes:
        scanned: value range and missing values of the series.
        features: the features of interest.
        coreset: the samples at the key frames.
        architecture: the sizes of the model.
    """

    scanned: Scan
    features: tuple[Feature, ...]
    coreset: Coreset
    architecture: Architecture


def select(
    series: Series, config: EncodeConfig, progress: Progress, mask: npt.ArrayLike | None = None
) -> Selection:
    """Find the features of a series at its key frames and gather the coreset for training.

    Args:
        series: the series.
        config: the settings.
        progress: called with each step of the work.
        mask: booleans (t, z, y, x) or (z, y, x), one more feature. It replaces 'all' where the
            settings name no other feature.

    Raises:
        InputError: the settings do not fit the series, or they select nothing.
    """
    brick = parse_brick(config.brick)
    scanned, key_frames, features = resolve_selection(series, config, progress, mask)
    with stage("coreset", "samples at the key frames, for the training"):
        coreset = build_coreset(
            series,
            scanned,
            key_frames,
            features,
            config.dilation,
            progress,
            fringe=config.fringe == "trained",
            brick=brick,
        )
    architecture = Architecture.for_box(
        coreset.box.shape,
        len(key_frames),
        fold=config.model_fold,
        embedding_size=config.model_embedding_size,
        hidden_layers=config.hidden_layers,
        width=config.model_width,
    )
    return Selection(scanned=scanned, features=features, coreset=coreset, architecture=architecture)
