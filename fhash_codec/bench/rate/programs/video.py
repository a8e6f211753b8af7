"""Video codecs, by an ffmpeg that has their encoders: HEVC, AV1 and VVC.

The values are quantised to grey of 10 or 12 bits, in a picture with even lengths of at least
LEAST, whose colours are constant. The planes of all steps are one film. Only bytes of the bare
stream count. A video codec has no bound, so it is searched for a PSNR alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fhash_codec.bench.rate.layouts import Values
from fhash_codec.bench.rate.programs.program import ProgramVariant, called
from fhash_codec.bench.rate.programs.raw_files import read_raw, write_raw
from fhash_formats.errors import InputError

__all__ = ["ENCODERS", "Encoder", "Video", "video_variants"]

LEAST = 64
"""Vertices of a picture along each axis; shorter ones are filled up with their last value."""
MULTIPLE = 8
"""Lengths of a picture are multiples of it."""
QUIET = ("-v", "error", "-nostdin", "-y")
"""Options of every call: nothing but errors is said, and nothing asked."""
LISTING_SECONDS = 60.0
"""Seconds in which a program must list its encoders."""


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """An encoder of ffmpeg.

    Attributes:
        name: in ffmpeg.
        stream: format of the bare stream.
        bits: of a grey value, each tried.
        quality: options; {0} stands for the quantiser.
        most: coarsest quantiser; 0 is the finest.
        slope: quantisers for each dB.
    """

    name: str
    stream: str
    bits: tuple[int, ...]
    quality: tuple[str, ...]
    most: int
    slope: float = 1.0


ENCODERS = {
    "hevc": (
        Encoder(
            name="libx265",
            stream="hevc",
            bits=(10, 12),
            quality=(
                *("-preset", "slow", "-tune", "psnr"),
                *("-x265-params", "qp={0}:keyint=-1:log-level=none"),
            ),
            most=51,
        ),
    ),
    "av1": (
        Encoder(
            name="libaom-av1",
            stream="obu",
            bits=(10, 12),
            quality=("-cpu-used", "4", "-crf", "{0}", "-b:v", "0", "-g", "9999"),
            most=63,
            slope=1.4,
        ),
        Encoder(
            name="libsvtav1",
            stream="obu",
            bits=(10,),
            quality=("-preset", "4", "-crf", "{0}", "-g", "9999"),
            most=63,
            slope=1.4,
        ),
    ),
    "vvc": (
        Encoder(
            name="libvvenc",
            stream="vvc",
            bits=(10,),
            quality=("-preset", "medium", "-qp", "{0}", "-g", "9999"),
            most=63,
        ),
    ),
}
"""Encoders of each video codec. All that a program has are tried."""
VIDEO_NAMES = {"hevc": "HEVC", "av1": "AV1", "vvc": "VVC"}
"""Names of the codecs."""
FINEST = 70.0
"""Level in dB of the finest quantiser."""


@dataclass(frozen=True, kw_only=True)
class Video:
    """An encoder of the ffmpeg at a path, with so many bits."""

    path: str
    encoder: Encoder
    bits: int

    def encode(self, part: Values, file: Path, scale: tuple[float, float], level: float) -> None:
        """Write an array (planes, y, x) as a film; see `Program`."""
        low, data_range = scale
        top = 2**self.bits - 1
        grey = np.rint((part.astype(np.float64) - low) * (top / data_range)).clip(0, top)
        height, width = (_filled(n) for n in part.shape[1:])
        missing = [(0, 0), (0, height - part.shape[1]), (0, width - part.shape[2])]
        pictures = np.pad(grey.astype("<u2"), missing, mode="edge").reshape(len(part), -1)
        colours = np.full((len(part), height * width // 2), 2 ** (self.bits - 1), "<u2")
        raw = file.with_suffix(".raw")
        write_raw(np.concatenate([pictures, colours], axis=1), raw)
        quantiser = round((FINEST - level) * self.encoder.slope)
        quantiser = min(max(quantiser, 0), self.encoder.most)
        source = ("-pix_fmt", self._pixels, "-s", f"{width}x{height}", "-r", "25", "-i", raw)
        quality = [option.format(quantiser) for option in self.encoder.quality]
        target = ("-threads", "1", "-f", self.encoder.stream, file)
        coder = ("-c:v", self.encoder.name, *quality)
        called([self.path, *QUIET, "-f", "rawvideo", *source, *coder, *target])
        raw.unlink()

    def decode(self, file: Path, shape: tuple[int, ...], scale: tuple[float, float]) -> Values:
        """An array (planes, y, x) from its film; see `Program`."""
        low, data_range = scale
        raw = file.with_suffix(".out")
        target = ("-f", "rawvideo", "-pix_fmt", self._pixels, "-fps_mode", "passthrough", raw)
        called([self.path, *QUIET, "-f", self.encoder.stream, "-i", file, *target])
        height, width = (_filled(n) for n in shape[1:])
        size = height * width
        films = read_raw(raw, "<u2", (shape[0], size + size // 2))
        raw.unlink()
        grey = films[:, :size].reshape(shape[0], height, width)[:, : shape[1], : shape[2]]
        return np.asarray(grey * (data_range / (2**self.bits - 1)) + low)

    @property
    def _pixels(self) -> str:
        """ffmpeg's name of the number type."""
        return f"yuv420p{self.bits}le"


def video_variants(name: str, path: str) -> tuple[ProgramVariant, ...]:
    """The films of a video codec, for each encoder that an ffmpeg has.

    Raises InputError where it has none, or is no ffmpeg.
    """
    listed = called([path, "-v", "error", "-encoders"], LISTING_SECONDS)
    there = {
        words[1] for words in map(str.split, listed.decode("utf-8", "replace").splitlines())
        if len(words) > 1
    }  # fmt: skip
    encoders = [encoder for encoder in ENCODERS[name] if encoder.name in there]
    if not encoders:
        wanted = " or ".join(encoder.name for encoder in ENCODERS[name])
        raise InputError(f"peer {name}: {path} has no encoder {wanted}")
    return tuple(
        ProgramVariant(
            peer=VIDEO_NAMES[name],
            mode=f"{encoder.name} {bits} bit",
            layout=layout,
            goals=("psnr",),
            program=Video(path=path, encoder=encoder, bits=bits),
            step=1.0 / encoder.slope,
        )
        for encoder in encoders
        for bits in encoder.bits
        for layout in ("turned", "folded")
    )


def _filled(length: int) -> int:
    """Length of a picture that holds an axis."""
    return max(LEAST, math.ceil(length / MULTIPLE) * MULTIPLE)
