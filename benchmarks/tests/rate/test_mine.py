"""`fhash bench mine`: each measure beside a second way, and the command with one peer."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Fhash, Refused

from fhash_bench.rate.mine import (
    MEASURES,
    OWN,
    MineBench,
    Shown,
    Wish,
    bench_mine,
    extrema_errors,
    fidelity,
    isosurface_distances,
    power_spectrum,
    worst_octave,
)
from fhash_bench.rate.mine_page import figures, page
from fhash_formats.errors import InputError, MissingDependencyError
from fhash_formats.series import ArraySeries

Field = Callable[..., np.ndarray]
Z, Y, X = np.meshgrid(*(np.arange(24.0) for _ in range(3)), indexing="ij")
SETTINGS = {"effort": 1, "tile": "4x8x16x16"}
ALONG = np.arange(64) * np.ones((8, 8, 1))


def test_gradient_error_of_a_wave_on_a_ramp() -> None:
    number = 2 * np.pi / 8
    judged = fidelity(2 * X[None], (2 * X + 0.1 * np.sin(number * X))[None], 20.0)
    # The central difference of sin(k x) is sin(k) cos(k x).
    wave = 0.1 * np.sin(number) * np.cos(number * np.arange(1, 23))
    assert judged.gradient_error == pytest.approx(np.sqrt(np.mean(wave**2)) / 2)


@pytest.mark.parametrize("normal", [(0, 0, 1), (2, 1, 2), (1, 1, 0), (-1, 3, 2)])
def test_isosurfaces_of_shifted_planes_lie_half_a_vertex_apart(normal: tuple[int, ...]) -> None:
    height = (normal[0] * Z + normal[1] * Y + normal[2] * X) / np.linalg.norm(normal)
    value = float(height.mean()) + 0.2
    distances = isosurface_distances(height, height - 0.5, value)
    # At its rim, a plane may have no crossing within a vertex.
    assert np.median(distances) == pytest.approx(0.5)
    assert distances.mean() == pytest.approx(0.5, abs=0.01)
    assert isosurface_distances(height, height, value).max() < 1e-6


def test_isosurfaces_of_spheres_and_of_nothing() -> None:
    radius = np.sqrt((Z - 11) ** 2 + (Y - 11.5) ** 2 + (X - 12) ** 2)
    distances = isosurface_distances(radius, radius - 1.5, 8.0)
    assert distances.mean() == pytest.approx(1.5, abs=0.05)
    assert isosurface_distances(radius, 0 * radius, 8.0).size == 0
    far = isosurface_distances(X, np.where(X > 18, 20.0, 0.0), 4.3)
    assert far.mean() == pytest.approx(18 + 4.3 / 20 - 4.3)


def test_spectrum_of_a_scaled_band() -> None:
    waves = [np.cos(2 * np.pi * number * ALONG / 64) for number in (2, 5, 20)]
    ratio, octave = worst_octave(sum(waves), waves[0] + 1.2 * waves[1] + waves[2])
    assert (ratio, octave) == (pytest.approx(1.44, rel=1e-3), 4)
    quiet = worst_octave(sum(waves), waves[0] + waves[1] + 0.5 * waves[2])
    assert quiet == (pytest.approx(0.25, rel=0.02), 16)  # the window spreads the wave at 5
    assert worst_octave(0 * ALONG, ALONG) == (None, None)


def test_power_is_that_of_the_windowed_frame() -> None:
    frame = np.random.default_rng(0).normal(size=(8, 12, 16))
    windows = [np.hanning(n + 2)[1:-1] for n in frame.shape]
    windowed = np.einsum("zyx,z,y,x->zyx", frame - frame.mean(), *windows)
    power = frame.size * np.sum(windowed**2) - np.sum(windowed) ** 2  # Parseval
    # The shell of wave number 0 holds nothing but the mean.
    assert power_spectrum(frame).sum() == pytest.approx(power)


def test_errors_of_extrema() -> None:
    frames = np.zeros((2, 3, 9, 9))
    frames[:, 1, 2, 2], frames[:, 1, 2, 6], frames[:, 0, 0, 0] = 5, 5, -3
    decoded = frames.copy()
    decoded[1, 1, 2, 7], decoded[1, 0, 0, 0] = 7, -2.5
    # Of the two maxima, the one at x = 6 is closer.
    assert extrema_errors(frames, decoded) == (2, 0.5, 0.5)


@pytest.fixture(scope="module")
def found(field: Field) -> tuple[MineBench, Shown]:
    """A wave with some values missing, beside ZFP, cropped."""
    values = field((4, 16, 40, 48))
    values[:, 0, 5, :9] = np.nan
    return bench_mine(
        ArraySeries(values), Wish(psnr=45.0, settings=SETTINGS, names=["ZFP"], budget=1e-3)
    )


def test_a_peer_has_equal_psnr_or_equal_bytes(found: tuple[MineBench, Shown]) -> None:
    result, shown = found
    assert "z 3:13, y 7:33, x 8:39" in result.measured
    own, zfp = result.of("psnr").values()
    assert (own.codec, own.psnr) == (OWN, pytest.approx(45.5, abs=0.5))
    assert 0 <= zfp.psnr - own.psnr < 0.1  # though its own tolerances are 6 dB apart
    assert (own.seams, zfp.seams) == pytest.approx((1, 1), abs=0.4)
    same, zfp = result.of("bytes").values()
    assert replace(same, goal="psnr") == own
    assert 1 <= zfp.bytes / own.bytes < 1.03
    assert shown.planes.keys() == shown.spectra.keys() == {"source", OWN, "ZFP"}


def test_losses_are_marked(found: tuple[MineBench, Shown]) -> None:
    result, shown = found
    own, zfp = result.of("psnr").values()
    better = replace(zfp, bytes=own.bytes // 2, place_error=0.0)
    worse = replace(own, place_error=1.0, spectrum_ratio=0.5)
    result = replace(result, rows=(worse, replace(better, spectrum_ratio=1.6), *result.rows[2:]))
    cells = {row[0]: row[-1] for row in figures(result, "psnr")}
    assert cells[MEASURES["bytes"]] == "loss: 2x, ZFP"
    assert cells[MEASURES["place_error"]] == "loss: infinite ratio, ZFP"
    assert cells[MEASURES["spectrum_ratio"]] == "loss: 1.25x, ZFP"
    assert cells[MEASURES["psnr"]] == ""
    text = page(result, shown)
    assert text.count('class="loss"') >= 3
    assert "http" not in text
    assert text.count("src=") == text.count('src="data:image/png;base64,') == 1


def test_missing_peers_are_named_and_others_are_measured(
    monkeypatch: pytest.MonkeyPatch, field: Field, tthresh: str
) -> None:
    series = ArraySeries(field())
    with monkeypatch.context() as old:
        old.delattr("hdf5plugin.Sperr")
        result, _ = bench_mine(series, Wish(settings={"effort": 1}, names=["SPERR", "ZFP"]))
        assert list(result.of("psnr")) == [OWN, "ZFP"]
        assert "fhash[bench]" in result.refused["SPERR PSNR, a chunk per frame"]
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fhash\[bench\]'"):
        bench_mine(series)
    result, _ = bench_mine(series, Wish(settings={"effort": 1}, named={"tthresh": tthresh}))
    assert list(result.of("psnr")) == [OWN, "TTHRESH"]
    assert "fhash[bench]" in result.refused["SPERR, SZ3, ZFP"]
    with pytest.raises(InputError, match="is constant"):
        bench_mine(ArraySeries(np.ones((2, 4, 4, 4))), Wish(names=(), named={"tthresh": tthresh}))


def test_the_command_writes_a_page(
    fhash: Fhash, refused: Refused, data: Path, tmp_path: Path
) -> None:
    words = ("bench", "mine", data, "--peer", "SZ3", "--effort", "1", "-q")
    where = tmp_path / "a.html"
    kept = json.loads(fhash(*words, "-o", where, "--json").stdout)
    assert {"rows", "verdicts", "machine", "isovalue"} <= kept.keys()
    assert {row["codec"] for row in kept["rows"]} == {OWN, "SZ3"}
    assert kept["path"] == str(where)
    assert where.read_text().startswith("<!DOCTYPE html>")
    assert "exists; use --force" in refused(2, *words, "-o", where)
    assert "Blosc has no quality" in refused(
        2, *words, "--peer", "Blosc", "-o", tmp_path / "b.html"
    )
    text = fhash(*words, "-o", where, "--force").stdout
    assert text.splitlines()[0].split()[:3] == ["at", "equal", "PSNR"]
    assert "fhash at equal PSNR: best in" in text
