"""Films of pictures: MP4 by the ffmpeg that imageio-ffmpeg brings, GIF by pillow."""

from __future__ import annotations

import importlib
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fhash_formats.errors import InputError, MissingDependencyError, OutputError
from fhash_formats.support.atomic import replacing

__all__ = ["FILMS", "check_film", "film"]

Pixels = npt.NDArray[np.uint8]

FILMS = (".mp4", ".gif")
"""Suffixes of films."""
QUALITY = 18
"""Constant rate factor of x264: nearly without visible loss."""


def check_film(suffix: str) -> str | None:
    """Find the program that writes MP4; None for a GIF.

    Raises MissingDependencyError where it is not installed.
    """
    if suffix != ".mp4":
        return None
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise MissingDependencyError(
            "an MP4 needs imageio-ffmpeg: pip install 'fhash[video]'; a GIF needs nothing more"
        ) from error


def film(
    path: Path, frames: Iterator[Pixels], size: tuple[int, int], rate: float, *, force: bool = False
) -> None:
    """Write a film, complete or not at all.

    An MP4 is H.264 with 4:2:0 colours, as browsers play it; an odd side gets its last row or column
    twice. A GIF has 256 colours to a picture and repeats for ever; its pictures last whole
    hundredths of a second, at least two.

    Args:
        path: NAME.mp4 or NAME.gif.
        frames: pictures (H, W, 3), at least one.
        size: W, H of the frames.
        rate: pictures per second.
        force: whether to replace a file.

    Raises InputError for another kind of file, OutputError for what cannot be written,
    MissingDependencyError without the package for MP4.
    """
    suffix = path.suffix.lower()
    if suffix not in FILMS:
        raise InputError(f"{path}: a film is written as {' or '.join(FILMS)}; use such a name")
    ffmpeg = check_film(suffix)
    with replacing(path, force=force) as temporary:
        if ffmpeg is None:
            _write_gif(temporary, frames, rate)
        else:
            _write_mp4(ffmpeg, path, temporary, frames, size, rate)


def _write_gif(path: Path, frames: Iterator[Pixels], rate: float) -> None:
    from PIL import Image as Pictures

    pictures = (
        Pictures.fromarray(frame).quantize(256, dither=Pictures.Dither.NONE) for frame in frames
    )
    first = next(pictures)
    hundredths = max(2, round(100 / rate))
    with path.open("xb") as file:
        first.save(
            file,
            format="GIF",
            save_all=True,
            append_images=pictures,
            duration=10 * hundredths,
            loop=0,
        )


def _write_mp4(
    ffmpeg: str,
    path: Path,
    temporary: Path,
    frames: Iterator[Pixels],
    size: tuple[int, int],
    rate: float,
) -> None:
    wide, high = (side + side % 2 for side in size)
    # The format is named, since the temporary file has another suffix. `faststart` puts the index
    # first, so that a film plays before all of it is loaded.
    words = (
        f"-y -loglevel error -f rawvideo -pix_fmt rgb24 -s {wide}x{high} -r {rate:.6g} -i - "
        f"-an -c:v libx264 -pix_fmt yuv420p -crf {QUALITY} -movflags +faststart -f mp4"
    )
    with tempfile.TemporaryFile() as log:
        with subprocess.Popen(
            [ffmpeg, *words.split(), str(temporary)], stdin=subprocess.PIPE, stdout=log, stderr=log
        ) as process:
            assert process.stdin is not None
            try:
                for frame in frames:
                    padding = ((0, high - frame.shape[0]), (0, wide - frame.shape[1]), (0, 0))
                    process.stdin.write(np.pad(frame, padding, mode="edge").tobytes())
                process.stdin.close()
            except BrokenPipeError:  # ffmpeg says why in its log
                pass
            except BaseException:
                process.kill()
                raise
        if process.returncode != 0:
            log.seek(0)
            reason = (
                " ".join(log.read(2000).decode(errors="replace").split())
                or f"it ended with {process.returncode}"
            )
            raise OutputError(f"{path}: ffmpeg failed: {reason[:200]}; take .gif, or numbered .png")
