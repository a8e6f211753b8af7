"""Interrupted training on disk: beside the output, named after what is being trained, so that only the same command goes on from it."""

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
from fhash_codec.paper.training.train import Course
from fhash_formats.errors import InputError
from fhash_formats.support.atomic import replacing
from fhash_formats.support.leftovers import clear

# Settings that change neither the model nor the course of its training.
PARTIAL_BYTES = 24  # what a temporary name adds while the checkpoint is written
UNRELATED = ("psnr", "tables", "timings")


def checkpoint_path(output: Path, coreset: Coreset, config: EncodeConfig) -> Path:
    """Where the checkpoint of this training stands: `OUTPUT.<digest of coreset and settings>.checkpoint`."""
    settings = {name: value for name, value in config.to_dict().items() if name not in UNRELATED}
    digest = hashlib.sha256(
        json.dumps(
            [version("fhash"), settings, coreset.box, coreset.key_frames], sort_keys=True
        ).encode()
    )
    for array in (coreset.values, coreset.bricks, coreset.mask_bits):
        digest.update(array.data)
    end = f".{digest.hexdigest()[:12]}.checkpoint"
    # A name may have 255 bytes; what is cut off of a long one does not matter, since the digest tells checkpoints apart.
    start = output.name.encode()[: 250 - len(end) - PARTIAL_BYTES].decode(errors="ignore")
    return output.with_name(start + end)


def save_checkpoint(path: Path, state: Mapping[str, npt.NDArray[Any]], course: Course) -> None:
    """Replace the checkpoint by this state; the old one stays until the new one is complete."""
    text = np.frombuffer(json.dumps(asdict(course)).encode(), dtype=np.uint8)
    with replacing(path, force=True) as temporary, temporary.open("wb") as file:
        np.savez(file, course=text, **state)  # type: ignore[arg-type]


def load_checkpoint(path: Path) -> tuple[dict[str, npt.NDArray[Any]], Course] | None:
    """The state and course saved at `path`, or None where there is none; InputError for one that cannot be read.

    What a training left that was killed while it saved is cleared away, since this one may never save.
    """
    clear([path])
    if not path.exists():
        return None
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            state = {name: file[name] for name in file.files}
        return state, Course(**json.loads(state.pop("course").tobytes()))
    except (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"checkpoint {path} cannot be read; delete it to train from the start"
        ) from error
