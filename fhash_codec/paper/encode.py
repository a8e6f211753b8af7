"""Encoding by the paper profile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.header import brief_history, describe_source, write_series
from fhash_codec.paper.selection import Selection, select
from fhash_codec.paper.storage import write_model, write_tables
from fhash_codec.paper.training.fit import Trained, train_model
from fhash_codec.progress import Progress
from fhash_formats.container import ContainerWriter
from fhash_formats.series import Series


def encode_paper(
    writer: ContainerWriter,
    series: Series,
    config: EncodeConfig,
    mask: npt.ArrayLike | None,
    path: Path,
    progress: Progress,
) -> tuple[dict[str, Any], Path | None]:
    """Train the published model and write it; the header without its quality, and the checkpoint to be removed."""
    selected = select(series, config, progress, mask)
    trained = train_model(selected.coreset, selected.architecture, config, path, progress)
    architecture, coreset = selected.architecture, selected.coreset
    loss = None
    write_series(writer, series, selected.scanned, coreset.key_frames)
    if config.tables == "transform":
        from fhash_codec.paper.tables.step import write_coded

        # A promise counts every step; what is between key frames this search does not see.
        psnr = config.psnr if len(coreset.key_frames) == series.shape[0] else None
        loss = write_coded(
            writer,
            architecture,
            coreset,
            trained.fine,
            trained.tables,
            trained.layers,
            psnr,
            progress,
        )
    else:
        write_tables(writer, architecture, coreset, trained.fine, trained.tables, config.tables)
    write_model(writer, architecture, coreset, trained.layers)
    header = _header(series, selected, trained, config)
    if loss is not None:
        header["required_features"] = ["transform"]
        header["model"]["tables_loss_db"] = round(loss, 4)
    return header, trained.checkpoint


def _header(
    series: Series, selected: Selection, trained: Trained, config: EncodeConfig
) -> dict[str, Any]:
    """The container's header (FORMAT.md), its quality still to be measured."""
    architecture, coreset, value_range = (
        selected.architecture,
        selected.coreset,
        selected.scanned.value_range,
    )
    seconds = trained.history[-1]["seconds"] if trained.history else 0.0
    return {
        **describe_source(series, value_range, config),
        "background": coreset.background,
        "feature_bounding_box": [list(span) for span in coreset.box],
        "features": [str(feature) for feature in selected.features],
        "coreset_fraction": coreset.fraction,
        "model": {
            "profile": config.profile,
            "fold": config.fold,
            "embedding_size": architecture.embedding_size,
            "hidden_layers": architecture.hidden_layers,
            "width": architecture.width,
            "tables": config.tables,
            "levels": [list(level) for level in architecture.levels],
            "parameters": architecture.parameters,
        },
        "config": config.to_dict(),
        "training": {
            "seconds": seconds if config.timings else None,
            "epochs": trained.epochs,
            "device": trained.device,
            **(
                {"restarts": trained.restarts, "learning_rate": trained.learning_rate}
                if trained.restarts
                else {}
            ),
        },
        "history": brief_history(trained.history, timings=config.timings),
    }
