"""The header of a compact file describes its table."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planned import plan_task, waves
from rarely import rarely

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.compact import attempt as access
from fhash_codec.compact import encode, planner
from fhash_codec.compact.encode import (
    SIZE_PASSES,
    ByteWindow,
    CodedTable,
    _Aim,
    _code_all,
    _head_holds,
    code_series,
    code_to_size,
)
from fhash_codec.compact.goal import Goal
from fhash_codec.compact.head_training import Budget, Pair, train_head
from fhash_codec.compact.plan import CodingPlan, first_settings
from fhash_codec.compact.planner import block_of, column_of, sheet_of
from fhash_codec.compact.tiles import Coding, Outcome, recoded
from fhash_codec.compact.transform import usual_transform
from fhash_codec.compact.trials import plan_by_prices
from fhash_codec.config import ACCESS
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.errors import FhashWarning
from fhash_formats.series import ArraySeries
from fhash_formats.support.threads import at_most
from fhash_formats.transform.head import NeighbourHead
from fhash_formats.transform.tile_format import TileSettings

Field = Callable[..., npt.NDArray[Any]]


Series = npt.NDArray[Any]
Field_encode = Callable[..., Series]


def with_holes(values: Series) -> Series:
    """Set NaN at a tenth of the vertices and a corner of every step, and infinity at one step."""
    values[np.random.default_rng(1).random(values.shape) < 0.1] = np.nan
    values[:, :4, :5, :6] = np.nan
    values[2] = np.inf
    return values


SERIES: dict[str, Callable[[Field_encode], Series]] = {
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


@pytest.mark.parametrize("psnr", [50.0, *rarely(30.0, 75.0)])
@pytest.mark.parametrize("name", SERIES)
def test_a_promised_psnr_is_kept(
    tmp_path: Path, field: Field_encode, name: str, psnr: float
) -> None:
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


def bulk_psnr(source: Series, back: Series) -> float:
    """The PSNR in the range of the middle 98 % of the values."""
    low, high = np.percentile(source.astype(np.float64), [1, 99])
    inside = (source >= low) & (source <= high)
    errors = (back.astype(np.float64) - source)[inside]
    return float(20 * np.log10((high - low) / np.sqrt(np.mean(errors**2))))


def spiked(field: Field_encode, factor: float) -> Series:
    """Return a field with a small hot ball, whose values are `factor` times as far."""
    source = field((5, 16, 20, 24))
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in source.shape), indexing="ij")
    ball = np.exp(-((z - 8) ** 2 + (y - 9) ** 2 + (x - 10 - t) ** 2) / 2.0)
    return (source + 300 * factor * ball).astype(np.float32)


@pytest.mark.parametrize("effort", [1, 2])
def test_the_default_keeps_the_bulk_beside_a_hot_spot(
    tmp_path: Path, field: Field_encode, effort: int
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
    tmp_path: Path, field: Field_encode, effort: int
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


@pytest.mark.parametrize("name", ["labels", "shell", "noise", "thin", "plateau"])
def test_the_default_behaves_on_every_kind_of_data(
    tmp_path: Path, field: Field_encode, name: str
) -> None:
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
@pytest.mark.parametrize("share", [0.001, *rarely(0.05)])
def test_a_strict_bound_is_kept_for_every_type(
    tmp_path: Path, field: Field_encode, dtype: str, share: float
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
def test_a_strict_bound_is_kept_for_every_series(
    tmp_path: Path, field: Field_encode, name: str
) -> None:
    source = SERIES[name](field)
    finite = source[np.isfinite(source)]
    bound = 0.01 * (float(finite.max()) - float(finite.min()))
    fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=1, max_error=bound))
    back = decoded(tmp_path / "a.fhz")
    np.testing.assert_array_equal(np.isnan(back), ~np.isfinite(source))
    assert max_error(source, back) <= bound


@pytest.mark.parametrize("ratio", [8.0, 20.0])
@pytest.mark.parametrize("kind", ["large", "small", "whole numbers", "missing"])
def test_a_ratio_is_met_within_a_twentieth(
    tmp_path: Path, field: Field_encode, ratio: float, kind: str
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


def test_a_ratio_that_cannot_be_is_refused(tmp_path: Path, field: Field_encode) -> None:
    with pytest.raises(InputError, match=r"leaves 0 bytes for the file, and all but the values"):
        fhash_codec.encode(field(), tmp_path / "a.fhz", EncodeConfig(effort=1, ratio=1e5))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-160, 5.0])
@pytest.mark.parametrize("promise", [{}, {"ratio": 3.0}, {"max_error_rel": 0.1}], ids=str)
@pytest.mark.parametrize("effort", [5, *rarely(2)])
def test_a_constant_series_is_exact_with_every_effort_and_promise(
    tmp_path: Path, value: float, promise: dict[str, float], effort: int
) -> None:
    source = np.full((4, 9, 10, 11), value)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the file is .* times smaller", FhashWarning)
        fhash_codec.encode(source, tmp_path / "a.fhz", EncodeConfig(effort=effort, **promise))
    assert np.array_equal(decoded(tmp_path / "a.fhz"), source)


@pytest.mark.parametrize("effort", [1, 2])
def test_a_psnr_out_of_reach_is_told_before_anything_is_written(
    tmp_path: Path, field: Field_encode, effort: int
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


@pytest.mark.parametrize(
    "config",
    [{"effort": 1}, {"effort": 3, "max_error_rel": 0.01}, {"effort": 1, "tile": "2x4x6x8"}],
    ids=str,
)
def test_the_same_input_gives_the_same_bytes_with_any_number_of_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: Field_encode, config: dict[str, Any]
) -> None:
    paths = []
    for number, threads in enumerate((1, 2, 2)):
        monkeypatch.setenv("FHASH_THREADS", str(threads))
        paths.append(tmp_path / f"{number}.fhz")
        source = with_holes(field((4, 7, 12, 14)))
        fhash_codec.encode(source, paths[-1], EncodeConfig(timings=False, **config))
    assert len({path.read_bytes() for path in paths}) == 1


@pytest.mark.parametrize("tile", ["", "4x4", "4x4x4x0", "4x4x4x-1", "axbxcxd", "4,4,4,4"])
def test_other_tiles_are_refused(tmp_path: Path, field: Field_encode, tile: str) -> None:
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
    monkeypatch.setattr("fhash_codec.compact.tiles.MAX_BYTES_IN_MEMORY", 1000)
    t, z, y, x = np.meshgrid(*(np.linspace(0, 3, n) for n in (9, 6, 20, 17)), indexing="ij")
    values = (np.sin(2 * x + t) * np.cos(y * z)).astype(np.float32)
    figures = fhash_codec.encode(
        values, tmp_path / "a.fhz", EncodeConfig(psnr=40.0, effort=effort, tile="4x6x10x17")
    )
    assert figures["psnr"] >= 40
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        assert volume.chunks == (4, 6, 10, 17)
        assert psnr_of(values, volume[...]) >= 40 - 1e-3


def outcome(psnr: float, size: int) -> Outcome:
    """Return an outcome of a PSNR over a range of 1."""
    return Outcome(size=size, squares=10 ** (-psnr / 10), count=1, max_error=1.0)


def moving_sphere() -> npt.NDArray[Any]:
    """A sphere (4, 24, 32, 32) of sharp edge, which a transform smears and a head mends."""
    t, z, y, x = np.indices((4, 24, 32, 32))
    far = np.sqrt((z - 12) ** 2 + (y - 16) ** 2 + (x - 10 - 3 * t) ** 2)
    return np.tanh(9 - far).astype(np.float32)


def test_a_head_holds_where_it_gains_in_all_tiles() -> None:
    """One that was trained on the tiles saves more than it takes; one for noise does not."""
    series = ArraySeries(moving_sphere())
    config = EncodeConfig(psnr=38.0, effort=2, tile="2x24x32x32", without=("transform",))
    aim = _Aim(psnr=38.0, data_range=2.0)
    with ThreadPoolExecutor(2) as workers:
        selection = select_features(series, config, silent)
        table = code_series(series, selection, config, silent)
        blocks, settings = table.plan.blocks, table.plan.settings

        def code_all(plan: CodingPlan) -> CodedTable:
            return _code_all(replace(plan, sample=None), workers, silent)

        def with_mlp(head: NeighbourHead) -> CodedTable:
            plan = replace(table.plan, settings=replace(settings, head=head), plain=table.plan)
            return code_all(plan)

        assert _head_holds(table, aim, code_all)  # it has none
        pairs = []
        for index, stream in zip(blocks.indices(), table.streams, strict=True):
            tile = blocks.read(index)
            pairs.append(Pair(recoded(tile, stream, settings).decoded, tile.values, None))
        assert _head_holds(with_mlp(trained(pairs, settings)), aim, code_all)
        noise = np.random.default_rng(0).normal(size=(2, 24, 32, 32)).astype(np.float32)
        head = trained([Pair(noise, -noise, None)], settings)
        assert not _head_holds(with_mlp(head), aim, code_all)


def trained(pairs: list[Pair], settings: TileSettings) -> NeighbourHead:
    """A small head for some tiles."""
    low, high = settings.low, settings.high
    found = train_head(pairs, low, high, (4, 4), Budget(updates=300, samples=60_000))
    assert found is not None
    return found.head


Law = Callable[[float], float]
WINDOW = ByteWindow(9524.0, 10000.0)


def coder(law: Law, dtype: str = "float32") -> tuple[CodedTable, Callable[..., CodedTable], list]:
    """Return a table to begin with, the function that makes others, and the steps it was given."""
    steps: list[float] = []
    blocks: Any = SimpleNamespace(dtype=np.dtype(dtype))

    def code_all(plan: CodingPlan) -> CodedTable:
        step = plan.settings.step
        steps.append(step)
        error = 0.0 if step < 1e-3 else step / 2
        outcome = Outcome(size=round(law(step)), squares=error, count=1, max_error=error)
        return CodedTable(plan=plan, streams=[], outcome=outcome)

    settings = TileSettings(
        transform=usual_transform((1, 4, 4, 4)), step=0.05, center=0.0, low=0.0, high=10.0
    )
    plan = CodingPlan(
        blocks=blocks, settings=settings, coding=Coding(), goal=Goal(size=1.0, data_range=10.0)
    )
    return code_all(plan), code_all, steps


LAWS: dict[str, Law] = {
    "usual": lambda step: 300 * step**-1.2 + 20,
    "steep": lambda step: 20000 * math.exp(-step * 40),
    "flat": lambda step: 8000 * step**-0.1,
    "wavy": lambda step: 300 * step**-1.2 * (1 + 0.2 * math.sin(9 * math.log(step))),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_size_is_found(name: str) -> None:
    table, code_all, steps = coder(LAWS[name])
    assert WINDOW.holds(code_to_size(table, WINDOW, code_all))
    assert len(steps) <= SIZE_PASSES + 1


def test_where_no_step_fits_the_best_table_below_is_taken() -> None:
    table, code_all, _ = coder(lambda step: 12000.0 if step < 0.02 else 7000 - step)
    assert code_to_size(table, WINDOW, code_all).outcome.size in (6999, 7000)
    table, code_all, _ = coder(lambda step: 12000.0 - step)
    assert code_to_size(table, WINDOW, code_all).outcome.size < 12000


@pytest.mark.parametrize(
    ("options", "keys"),
    [
        ({"effort": 2}, {"price", "tried"}),
        ({"effort": 2, "preset": "fast"}, {"price", "tried"}),
        ({"effort": 2, "tile": "whole"}, set()),
    ],
)
def test_a_header_says_what_the_tiles_cost(
    options: dict[str, Any],
    keys: set[str],
    tmp_path: Path,
    field: Field,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(access, "FAST_ENOUGH", 1 << 10)
    shape = (4, 8, 12, 16)
    fhash_codec.encode(field(shape), tmp_path / "a.fhz", EncodeConfig(**options, timings=True))
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        record = volume.info["model"].get("tiling", {})
        assert record.keys() - {"coder"} == keys
        assert record.get("coder", "fast") == "fast"
    if "price" in record:
        assert 1 <= record["price"] <= access.PRICES[ACCESS[options.get("preset", "default")]]
        assert record["tried"] >= 1


Lengths = tuple[int, int, int, int]
SHAPES = [(12, 25, 125, 125), (600, 1, 24, 24), (1, 300, 300, 300), (2000, 4, 5, 6), (3, 3, 3, 3)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("part_of", [column_of, sheet_of, block_of])
def test_parts_lie_in_their_series(
    part_of: Callable[[Lengths, int], Lengths], shape: Lengths
) -> None:
    part = part_of(shape, 1 << 16)
    assert all(1 <= n <= length for n, length in zip(part, shape, strict=True))
    assert math.prod(part) <= 2 << 16
    assert part == shape or math.prod(part) > 1 << 12


def moving(kind: str) -> Series:
    """Return 20 x 8 x 48 x 48 values: 'separable' of one mode, or a 'front' that moves."""
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (20, 8, 48, 48)), indexing="ij")
    if kind == "front":
        return np.where(x + 0.3 * np.sin(9 * y) + 0.2 * z < 0.2 + t, 1, 0).astype(np.float32)
    rough = np.random.default_rng(0).normal(size=(4, 48))
    pairs = zip((t, z, y, x), rough, strict=True)
    modes = [np.interp(axis, np.linspace(0, 1, 48), row) for axis, row in pairs]
    noise = np.random.default_rng(1).normal(size=t.shape)
    return (math.prod(modes) + 1e-3 * noise).astype(np.float32)


def planned(values: Series, workers: ThreadPoolExecutor) -> access.Attempt:
    task = plan_task(values, workers)
    return plan_by_prices(task, first_settings(task, task.blocks.retile((20, 8, 24, 24))))


def test_prices_find_the_transform_of_each_kind() -> None:
    """A single mode needs one own vector along a long axis; a front needs haar in the plane."""
    with ThreadPoolExecutor(2) as workers:
        separable = planned(moving("separable"), workers).settings.transform
        front = planned(moving("front"), workers).settings.transform
    assert [separable.axes[axis].kind for axis in (0, 2, 3)] == ["klt"] * 3
    assert [axis.kind for axis in front.axes[2:]] == ["haar"] * 2


@pytest.mark.parametrize("kind", ["separable", "front"])
def test_a_plan_does_not_depend_on_the_threads(kind: str) -> None:
    plans = []
    for threads in (1, 2, 8):
        with at_most(threads), ThreadPoolExecutor(threads) as workers:
            plans.append(planned(moving(kind), workers).settings)
    assert plans[0] == plans[1] == plans[2]


@pytest.mark.parametrize("psnr", [50.0, 60.0])
def test_one_or_two_codings_come_near_the_promise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, psnr: float
) -> None:
    coded = []
    code_all = encode._code_all
    monkeypatch.setattr(encode, "_code_all", lambda *a, **k: coded.append(1) or code_all(*a, **k))
    values = waves((12, 12, 60, 60))
    figures = fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(psnr=psnr))
    assert len(coded) <= 2
    assert psnr <= psnr_of(values, decoded(tmp_path / "a.fhz")) < psnr + 0.15
    assert figures["psnr"] == pytest.approx(psnr_of(values, decoded(tmp_path / "a.fhz")), 1e-6)


def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a series of a million vertices a large one."""
    for module in (access, planner):
        monkeypatch.setattr(module, "MAX_WHOLE_VERTICES", 1 << 19)
    monkeypatch.setattr(access, "MAX_VERTICES", 1 << 18)
    monkeypatch.setattr(planner, "WINDOW_VERTICES", 1 << 19)
    monkeypatch.setattr(planner, "LEAST_EDGE", 16)


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_large_series_has_long_tiles_where_steps_are_alike(
    monkeypatch: pytest.MonkeyPatch, *, in_memory: bool
) -> None:
    """Few steps alone would look at the still noise anew."""
    small_limits(monkeypatch)
    if not in_memory:
        monkeypatch.setattr("fhash_codec.compact.tiles.MAX_BYTES_IN_MEMORY", 1)
    shape = (64, 32, 32, 32)
    still = np.random.default_rng(5).normal(size=shape[1:])
    moving = 0.02 * np.random.default_rng(6).normal(size=shape)
    with ThreadPoolExecutor(2) as workers:
        task = plan_task((still + moving).astype(np.float32), workers, psnr=25.0)
        attempt = plan_by_prices(task, first_settings(task, task.blocks.retile((8, 32, 32, 32))))
    assert attempt.tiling is not None
    assert attempt.tiling.tile[0] > 16
    assert np.prod(attempt.tiling.tile) <= 1 << 18


def test_faster_wishes_have_faster_regions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "FAST_ENOUGH", 1 << 10)
    works = []
    for preset in ("fast", "default", "small"):
        with ThreadPoolExecutor(2) as workers:
            task = plan_task(waves((8, 16, 48, 48)), workers, psnr=40.0, preset=preset)
            attempt = plan_by_prices(task, first_settings(task, task.blocks))
        assert attempt.tiling is not None
        assert attempt.tiling.price is not None
        assert attempt.tiling.price <= access.PRICES[ACCESS[preset]]
        works.append(access.region_vertices(task.blocks.shape, attempt.tiling.tile))
    assert works == sorted(works)


@pytest.mark.parametrize("around", ["noise", "the same waves"])
def test_vertices_that_do_not_count_are_filled_where_that_pays(tmp_path: Path, around: str) -> None:
    values = waves((8, 16, 56, 56))
    mask = np.zeros(values.shape, bool)
    mask[:, 3:11, 8:40, 5:45] = True
    if around == "noise":
        noise = np.random.default_rng(0).normal(size=values.shape)
        values = np.where(mask, values, noise).astype(np.float32)
    sizes = {}
    for without in ((), ("filling",)):
        path = tmp_path / "a.fhz"
        config = EncodeConfig(psnr=50.0, effort=4, dilation=0, without=without)
        sizes[without] = fhash_codec.encode(values, path, config, mask=mask, force=True)["bytes"]
        with fhash_codec.open(path) as volume:
            error = (volume[...] - values)[mask].astype(np.float64)
        data_range = float(np.ptp(values))
        assert 20 * np.log10(data_range / np.sqrt(np.mean(error**2))) >= 50.0
    assert sizes[()] <= 1.02 * sizes["filling",]
