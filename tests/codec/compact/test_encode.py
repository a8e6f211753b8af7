"""The compact profile end to end: promises are kept on decoded values, and bytes are repeatable."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.coreset.features import dilate
from fhash_formats.errors import FhashWarning

Series = npt.NDArray[Any]
Field = Callable[..., Series]

FAST = EncodeConfig(effort=1)


def with_holes(values: Series) -> Series:
    """Set NaN at a tenth of the vertices and a corner of every step, and infinity at one step."""
    values[np.random.default_rng(1).random(values.shape) < 0.1] = np.nan
    values[:, :4, :5, :6] = np.nan
    values[2] = np.inf
    return values


SERIES: dict[str, Callable[[Field], Series]] = {
    "float32": lambda field: field(),
    "float64": lambda field: field(dtype=np.float64),
    "int16": lambda field: field(dtype=np.int16),
    "offset": lambda field: field(dtype=np.float64) * 1e-3 + 1e5,
    "tiny": lambda field: field().astype(np.float64) * 1e-200,
    "huge": lambda field: field().astype(np.float64) * 1e200,
    "with NaN": lambda field: with_holes(field()),
    "one step": lambda field: field((1, 9, 12, 20)),
    "flat in z": lambda field: field((5, 1, 12, 20)),
    "flat in y": lambda field: field((5, 9, 1, 20)),
    "flat in x": lambda field: field((5, 9, 12, 1)),
    "a column": lambda field: field((7, 23, 1, 1)),
    "prime": lambda field: field((3, 7, 11, 13)),
    "two values": lambda field: (field() > 0).astype(np.uint8),
}


def decoded(path: Path) -> Series:
    with fhash_codec.open(path) as volume:
        return volume[...]


def psnr_of(source: Series, back: Series) -> float:
    """Return the PSNR in dB over finite values, the range being that of the source."""
    finite = np.isfinite(source) & np.isfinite(back)
    difference = back[finite].astype(np.float64) - source[finite].astype(np.float64)
    values = source[np.isfinite(source)].astype(np.float64)
    scale = float(values.max() - values.min())
    mean = float(((difference / scale) ** 2).mean())
    return math.inf if mean == 0 else -10 * math.log10(mean)


def max_error(source: Series, back: Series) -> float:
    """Return the largest error over finite values."""
    finite = np.isfinite(source)
    return float(np.abs(back[finite].astype(np.float64) - source[finite].astype(np.float64)).max())


@pytest.mark.parametrize("psnr", [30.0, 50.0, 75.0])
@pytest.mark.parametrize("name", SERIES)
def test_a_promised_psnr_is_kept(tmp_path: Path, field: Field, name: str, psnr: float) -> None:
    source = SERIES[name](field)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, psnr=psnr))
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isnan(back), ~np.isfinite(source))
    reached = psnr_of(source, back)
    assert reached >= psnr
    assert figures["psnr"] is None or figures["psnr"] == pytest.approx(reached, abs=1e-3)
    if name in ("float32", "float64"):
        # And not by giving more than was asked for.
        assert reached < psnr + 1


def test_the_default_promise_is_50_db(tmp_path: Path, field: Field) -> None:
    fhash_codec.encode(field(), tmp_path / "a.fhz", FAST)
    assert 50 <= psnr_of(field(), decoded(tmp_path / "a.fhz")) < 51


def bulk_psnr(source: Series, back: Series) -> float:
    """The PSNR in the range of the middle 98 % of the values."""
    low, high = np.percentile(source.astype(np.float64), [1, 99])
    inside = (source >= low) & (source <= high)
    errors = (back.astype(np.float64) - source)[inside]
    return float(20 * np.log10((high - low) / np.sqrt(np.mean(errors**2))))


def spiked(field: Field, factor: float) -> Series:
    """Return a field with a small hot ball, whose values are `factor` times as far."""
    source = field((5, 16, 20, 24))
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in source.shape), indexing="ij")
    ball = np.exp(-((z - 8) ** 2 + (y - 9) ** 2 + (x - 10 - t) ** 2) / 2.0)
    return (source + 300 * factor * ball).astype(np.float32)


@pytest.mark.parametrize("effort", [1, 2])
def test_the_default_keeps_the_bulk_beside_a_hot_spot(
    tmp_path: Path, field: Field, effort: int
) -> None:
    source = spiked(field, 12.0)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=effort))
    back = decoded(tmp_path / "a.fhz")
    assert psnr_of(source, back) >= 50
    # The ends of the bulk are rounded, by 0.1 dB at most; more is not given either.
    assert 39.9 <= bulk_psnr(source, back) < 41
    assert figures["psnr_bulk"] >= 40
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        stored, config = volume.info["quality"]["bulk"], volume.info["config"]
    assert (config["psnr"], config["psnr_bulk"]) == (50.0, 40.0)
    assert stored["range"] == figures["quality"]["bulk"]["range"]
    assert 40 <= stored["psnr"] <= figures["psnr_bulk"]
    again = fhash_codec.diff(source, tmp_path / "a.fhz")
    assert again["psnr_bulk"] == figures["psnr_bulk"]


@pytest.mark.parametrize("effort", [1, 2])
def test_a_bulk_is_promised_alone_or_beside_the_whole(
    tmp_path: Path, field: Field, effort: int
) -> None:
    source = spiked(field, 12.0)
    config = EncodeConfig(effort=effort, psnr_bulk=25.0)
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", config)
    assert 25 <= figures["psnr_bulk"] < 26
    assert figures["psnr"] < 50
    both = EncodeConfig(effort=effort, psnr_bulk=25.0, psnr=52.0)
    figures = fhash_codec.encode(source, tmp_path / "b.fhz", both)
    assert 52 <= figures["psnr"] < 53
    assert figures["psnr_bulk"] >= 25


def test_an_explicit_promise_that_leaves_the_bulk_far_below_is_remarked(
    tmp_path: Path, field: Field
) -> None:
    config = EncodeConfig(effort=1, psnr=45.0)
    with pytest.warns(FhashWarning, match="--psnr-bulk 40 beside --psnr keeps them"):
        fhash_codec.encode(spiked(field, 40.0), tmp_path / "a.fhz", config)
    fhash_codec.encode(field(), tmp_path / "b.fhz", config)  # no warning


@pytest.mark.parametrize("name", ["labels", "shell", "noise", "thin", "plateau"])
def test_the_default_behaves_on_every_kind_of_data(tmp_path: Path, field: Field, name: str) -> None:
    """A bulk that is not the harder promise changes no byte of the values."""
    t, z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (3, 12, 16, 16)), indexing="ij")
    radius = np.sqrt(x**2 + y**2 + z**2)
    source = {
        "labels": np.digitize(radius, [0.4, 0.7, 1.0]).astype(np.int8),
        "shell": np.exp(-(((radius - 0.5 - 0.1 * t) / 0.1) ** 2)).astype(np.float32),
        "noise": np.random.default_rng(0).normal(size=t.shape).astype(np.float32),
        "thin": field((6, 1, 24, 24)),
        "plateau": (radius < 0.15).astype(np.float32),
    }[name]
    tiles = []
    for config in (EncodeConfig(effort=1), EncodeConfig(effort=1, psnr=50.0)):
        fhash_codec.encode(source, tmp_path / "a.fhz", config, force=True)
        with fhash_codec.open(tmp_path / "a.fhz") as volume:
            tiles.append(volume[...])
            assert (volume.info["quality"]["bulk"] is None) == (name == "plateau")
    np.testing.assert_array_equal(*tiles)


@pytest.mark.parametrize(
    "dtype", ["uint8", "int16", "uint16", "int32", "float16", "float32", "float64"]
)
@pytest.mark.parametrize("share", [0.05, 0.001])
def test_a_strict_bound_is_kept_for_every_type(
    tmp_path: Path, field: Field, dtype: str, share: float
) -> None:
    source = (field() / 2 + 100).clip(0, 255).astype(dtype)
    span = float(source.max()) - float(source.min())
    figures = fhash_codec.encode(
        source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=share * span)
    )
    assert max_error(source, decoded(tmp_path / "a.fhz")) <= share * span
    assert figures["max_abs_error"] <= share * span
    fhash_codec.encode(source, tmp_path / "b.fhz", EncodeConfig(effort=1, max_error_rel=share))
    assert max_error(source, decoded(tmp_path / "b.fhz")) <= share * span


@pytest.mark.parametrize("name", SERIES)
def test_a_strict_bound_is_kept_for_every_series(tmp_path: Path, field: Field, name: str) -> None:
    source = SERIES[name](field)
    finite = source[np.isfinite(source)]
    bound = 0.01 * (float(finite.max()) - float(finite.min()))
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=bound))
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isnan(back), ~np.isfinite(source))
    assert max_error(source, back) <= bound


@pytest.mark.parametrize("dtype", ["int16", "float32", "float64"])
def test_a_bound_of_0_is_lossless(tmp_path: Path, field: Field, dtype: str) -> None:
    source = field((2, 3, 5, 7), dtype)
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=0.0))
    np.testing.assert_array_equal(decoded(tmp_path / "a.fhz"), source)


@pytest.mark.parametrize("ratio", [8.0, 20.0])
@pytest.mark.parametrize("kind", ["large", "small", "whole numbers", "missing"])
def test_a_ratio_is_met_within_a_twentieth(
    tmp_path: Path, field: Field, ratio: float, kind: str
) -> None:
    source = field((6, 20, 30, 36) if kind == "large" else (4, 12, 20, 20))
    if kind == "whole numbers":
        source = np.round(source * 50).astype(np.int16)
    elif kind == "missing":
        source[source > 150] = np.nan
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, ratio=ratio))
    assert ratio <= source.nbytes / (tmp_path / "a.fhz").stat().st_size <= 1.05 * ratio
    assert ratio <= figures["ratio"] <= 1.05 * ratio


def test_a_ratio_that_exact_values_exceed_says_so(tmp_path: Path) -> None:
    source = np.zeros((4, 12, 20, 20), np.int16)
    source[:, 4:9, 5:15, 6:16] = 7
    with pytest.warns(FhashWarning, match="3 times were asked for: its values are exact already"):
        figures = fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, ratio=3.0))
    assert figures["ratio"] > 3.15


def test_a_ratio_that_cannot_be_is_refused(tmp_path: Path, field: Field) -> None:
    with pytest.raises(InputError, match=r"leaves 0 bytes for the file, and all but the values"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, ratio=1e5))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [0.0, 0.1, -1e30, 1e305, 255])
def test_a_constant_series_is_exact_and_small(tmp_path: Path, value: float) -> None:
    source = np.full((3, 4, 5, 6), value)
    for name, config in {"psnr": FAST, "bound": EncodeConfig(effort=1, max_error=1e-3)}.items():
        fhash_codec.encode(source, tmp_path / f"{name}.fhz", config)
        assert np.abs(decoded(tmp_path / f"{name}.fhz") - source).max() <= (
            1e-3 if name == "bound" else 0
        )


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-160, 5.0])
@pytest.mark.parametrize("promise", [{}, {"ratio": 3.0}, {"max_error_rel": 0.1}], ids=str)
@pytest.mark.parametrize("effort", [2, 5])
def test_a_constant_series_is_exact_with_every_effort_and_promise(
    tmp_path: Path, value: float, promise: dict[str, float], effort: int
) -> None:
    source = np.full((4, 9, 10, 11), value)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the file is .* times smaller", FhashWarning)
        fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=effort, **promise))
    assert np.array_equal(decoded(tmp_path / "a.fhz"), source)


def test_values_near_the_largest_float_are_kept(tmp_path: Path) -> None:
    source = (2 * np.random.default_rng(0).random((2, 4, 5, 6)) - 1) * 1.7e308
    figures = fhash_codec.encode(source, tmp_path / "a.fhz", FAST)
    np.testing.assert_array_equal(decoded(tmp_path / "a.fhz"), source)
    assert figures["rmse"] == 0


@pytest.mark.parametrize("effort", [1, 2])
def test_a_psnr_out_of_reach_is_told_before_anything_is_written(
    tmp_path: Path, field: Field, effort: int
) -> None:
    stages = []
    with pytest.raises(InputError, match=r"out of reach: 400 dB.*--max-error 0 stores"):
        fhash_codec.encode(
            field(dtype=np.float64),
            tmp_path / "a.fhz",
            EncodeConfig(effort=effort, psnr=400.0),
            progress=lambda stage, *rest: stages.append(stage),
        )
    assert not list(tmp_path.iterdir())
    assert "measuring" not in stages


def test_a_psnr_at_the_level_of_the_noise_is_reached(tmp_path: Path) -> None:
    """Around it the PSNR hardly depends on the step, so that the search takes steps too small."""
    t, z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (6, 12, 24, 24)), indexing="ij")
    noise = np.random.default_rng(0).normal(size=t.shape)
    source = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z + 0.012 * noise).astype(np.float32)
    for psnr in (49.0, 50.0, 51.0):
        config = EncodeConfig(effort=2, psnr=psnr)
        figures = fhash_codec.encode(source, tmp_path / "a.fhz", config, force=True)
        assert figures["psnr"] >= psnr


def test_a_feature_counts_alone(feature: tuple[Series, Path]) -> None:
    source, path = feature
    with fhash_codec.open(path) as volume:
        back = volume[...]
        inside = np.stack([volume.occupancy(t) for t in range(5)])
        assert volume.chunks == (2, 4, 5, 8)
        assert volume.background == pytest.approx(
            source[~inside].astype(np.float64).mean(), rel=1e-5
        )
        assert volume.verify() == len(volume.info["arrays"])
    assert 0.2 < inside.mean() < 0.98
    assert (inside >= (source >= 20) & (source <= 180)).all()
    np.testing.assert_array_equal(np.isfinite(back), inside)
    assert psnr_of(source, back) >= 45


def test_a_feature_of_few_vertices_keeps_the_promise(tmp_path: Path) -> None:
    source = np.zeros((4, 8, 10, 12), np.float32)
    source[1, 3, 4, 5:7] = 1.0
    figures = fhash_codec.encode(
        source, tmp_path / "a.fhz", EncodeConfig(effort=2, psnr=45.0, features=("interval:1:1",))
    )
    back = decoded(tmp_path / "a.fhz")
    assert figures["psnr"] is None or figures["psnr"] >= 45
    np.testing.assert_array_equal(np.isfinite(back[1]), dilate(source[1] == 1, 1))
    assert np.isnan(back[[0, 2, 3]]).all()


def test_a_feature_of_integers_keeps_its_bound(tmp_path: Path, field: Field) -> None:
    source = np.round(field((4, 12, 20, 24)) / 2 + 100).clip(0, 255).astype(np.uint8)
    config = EncodeConfig(max_error=3.0, features=("interval:150:255",), effort=4)
    fhash_codec.encode(source, tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        inside = volume.occupancy(1)
        assert inside[source[1] >= 150].all()
        assert np.abs(volume.read(1)[inside] - source[1][inside].astype(float)).max() <= 3


@pytest.mark.parametrize(
    "config",
    [{"effort": 1}, {"effort": 3, "max_error_rel": 0.01}, {"effort": 1, "tile": "2x4x6x8"}],
    ids=str,
)
def test_the_same_input_gives_the_same_bytes_with_any_number_of_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: Field, config: dict[str, Any]
) -> None:
    paths = []
    for number, threads in enumerate((1, 2, 2)):
        monkeypatch.setenv("FHASH_THREADS", str(threads))
        paths.append(tmp_path / f"{number}.fhz")
        source = with_holes(field((4, 7, 12, 14)))
        fhash_codec.encode(source, paths[-1], EncodeConfig(timings=False, **config))
    assert len({path.read_bytes() for path in paths}) == 1


@pytest.mark.parametrize(
    ("tile", "expected"),
    [("2x4x5x8", (2, 4, 5, 8)), ("99x99x3x99", (5, 9, 3, 20)), ("whole", (5, 9, 12, 20))],
)
def test_tiles_are_those_that_were_asked_for(
    tmp_path: Path, field: Field, tile: str, expected: tuple[int, ...]
) -> None:
    fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, tile=tile))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.chunks == expected
        assert psnr_of(field(), volume[...]) >= 50


@pytest.mark.parametrize("tile", ["", "4x4", "4x4x4x0", "4x4x4x-1", "axbxcxd", "4,4,4,4"])
def test_other_tiles_are_refused(tmp_path: Path, field: Field, tile: str) -> None:
    with pytest.raises(
        InputError, match=r"allowed: auto, whole, or four whole numbers as in 4x32x32x32"
    ):
        fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, tile=tile))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("effort", [1, 2])
def test_a_series_larger_than_memory_is_coded_layer_by_layer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, effort: int
) -> None:
    """One layer of tiles in time is in memory at a time; the promise is the same."""
    monkeypatch.setattr("fhash_codec.compact.tiles.blocks.MAX_BYTES_IN_MEMORY", 1000)
    t, z, y, x = np.meshgrid(*(np.linspace(0, 3, n) for n in (9, 6, 20, 17)), indexing="ij")
    values = (np.sin(2 * x + t) * np.cos(y * z)).astype(np.float32)
    figures = fhash_codec.encode(
        values, tmp_path / "a.fhz", EncodeConfig(psnr=40.0, effort=effort, tile="4x6x10x17")
    )
    assert figures["psnr"] >= 40
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.chunks == (4, 6, 10, 17)
        assert psnr_of(values, volume[...]) >= 40 - 1e-3
