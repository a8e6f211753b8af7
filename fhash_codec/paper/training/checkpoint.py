"""Checkpoints: interrupted trainings on disk, beside their output.

A checkpoint is named after the data and the settings, so that only the same command continues it,
on the same device or another one: a state is the same arrays on all of them. On another device the
training goes on with another rounding.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_codec.coreset.bricks import Coreset
from fhash_codec.paper.training.train import TrainingProgress
from fhash_formats.errors import InputError
from fhash_formats.support.atomic import replacing
from fhash_formats.support.leftovers import clear

MAX_NAME_BYTES = 250
"""Bytes of a checkpoint's file name, with those that a temporary name adds; systems allow 255."""
PARTIAL_BYTES = 24
"""Bytes that a temporary name adds while the checkpoint is written."""
UNRELATED = ("device", "engine", "psnr", "tables", "timings", "train_on_seconds", "without")
"""Settings that do not change the course of a training, but at most its rounding and its end.

Engines go on from each other's state.
"""


def checkpoint_path(output: Path, coreset: Coreset, config: EncodeConfig) -> Path:
    """Return the path of a training's checkpoint.

    It is `OUTPUT.<digest of coreset and settings>.checkpoint`, beside the output.
    """
    settings = {name: value for name, value in config.to_dict().items() if name not in UNRELATED}
    settings |= {
        "fold": config.model_fold,
        "embedding_size": config.model_embedding_size,
        "width": config.model_width,
    }
    digest = hashlib.sha256(
        json.dumps(
            [version("fhash"), settings, coreset.box, coreset.key_frames], sort_keys=True
        ).encode()
    )
    for array in (coreset.values, coreset.bricks, coreset.mask_bits):
        digest.update(array.data)
    end = f".{digest.hexdigest()[:12]}.checkpoint"
    # A long name may lose its end: the digest tells checkpoints apart.
    room = MAX_NAME_BYTES - len(end) - PARTIAL_BYTES
    start = output.name.encode()[:room].decode(errors="ignore")
    return output.with_name(start + end)


def save_checkpoint(
    path: Path, state: Mapping[str, npt.NDArray[Any]], reached: TrainingProgress
) -> None:
    """Write a checkpoint; the old one stays until the new one is complete.

    Args:
        path: the checkpoint.
        state: state of the engine.
        reached: how far the training has come.
    """
    text = np.frombuffer(json.dumps(asdict(reached)).encode(), dtype=np.uint8)
    with replacing(path, force=True) as temporary, temporary.open("wb") as file:
        np.savez(file, course=text, **state)  # type: ignore[arg-type]


def load_checkpoint(path: Path) -> tuple[dict[str, npt.NDArray[Any]], TrainingProgress] | None:
    """Read a checkpoint: the state of the engine, and how far the training had come.

    Returns None where there is no checkpoint. Raises InputError for one that cannot be read.
    Temporary files of a training that was killed while it saved are deleted here, since this
    training may never save.
    """
    clear([path])
    if not path.exists():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            state = {name: file[name] for name in file.files}
        return state, TrainingProgress(**json.loads(state.pop("course").tobytes()))
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"checkpoint {path} cannot be read; delete it to train from the start"
        ) from error
