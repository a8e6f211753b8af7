"""Video codecs: grey values there and back, by a stand-in and by an ffmpeg that is there."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fhash_codec.bench.rate.programs.video import ENCODERS, variants
from fhash_formats.errors import InputError

Field = Callable[..., np.ndarray]


def psnr(values: np.ndarray, decoded: np.ndarray) -> float:
    """dB over the range of the values."""
    return float(20 * np.log10(np.ptp(values) / np.sqrt(np.mean((decoded - values) ** 2.0))))


@pytest.mark.parametrize("shape", [(4, 6, 20, 24), (1, 3, 65, 72), (2, 1, 1, 9)])
def test_a_finer_level_is_better(
    ffmpeg: str, field: Field, tmp_path: Path, shape: tuple[int, ...]
) -> None:
    values = field(shape)
    data_range = float(np.ptp(values))
    found = variants("hevc", ffmpeg)
    assert {variant.program.bits for variant in found} == {10, 12}
    for variant in found:
        assert variant.goals == ("psnr",)
        reached = []
        for level in (30.0, 50.0, 90.0):
            coded = variant.encode(values, data_range, level, tmp_path)
            decoded = variant.decode(coded)
            assert decoded.shape == values.shape
            reached.append(psnr(values, decoded))
        assert reached == sorted(reached)
        # The finest is the quantisation alone.
        assert reached[-1] == pytest.approx(6.02 * variant.program.bits + 10.8, abs=2)


def test_an_encoder_that_is_not_there_is_named(ffmpeg: str) -> None:
    with pytest.raises(InputError, match="has no encoder libvvenc"):
        variants("vvc", ffmpeg)
    with pytest.raises(InputError, match="has no encoder libaom-av1 or libsvtav1"):
        variants("av1", ffmpeg)


def real() -> str | None:
    """Path of an ffmpeg, of imageio's or of the machine."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        return shutil.which("ffmpeg")


@pytest.mark.parametrize("name", ENCODERS)
def test_an_ffmpeg_codes_what_it_is_given(field: Field, tmp_path: Path, name: str) -> None:
    path = real()
    if path is None:
        pytest.skip("there is no ffmpeg")
    try:
        found = variants(name, path)
    except InputError as error:
        pytest.skip(str(error))
    values = field()
    for variant in found:
        coded = variant.encode(values, float(np.ptp(values)), 50.0, tmp_path)
        assert coded.bytes < values.nbytes / 2
        assert psnr(values, variant.decode(coded)) > 30
