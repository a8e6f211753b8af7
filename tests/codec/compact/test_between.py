"""Values between two steps: the rule, its choice, and every reader of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference import value_between
from scipy.interpolate import PchipInterpolator

import fhash_codec
from fhash_codec import EncodeConfig
from fhash_codec.appending.parts import Part, encode_part
from fhash_codec.appending.series_plan import plan_parts
from fhash_codec.compact import encode as compact
from fhash_codec.compact.model import values_between
from fhash_codec.compact.sample import choose_between
from fhash_codec.features.selection import select_features
from fhash_codec.progress import silent
from fhash_formats.series import ArraySeries, Coordinate

SHAPE = (5, 6, 7)
TIMES = np.array([0.0, 0.5, 2.0, 2.25, 3.0, 4.5, 5.0, 6.25])
STEPS = (0.25, 0.875, 1.3, 3.5, 5.125, 6.5, 6.9)


def slow(times: np.ndarray = TIMES, dtype: str = "float32") -> np.ndarray:
    """A smooth field at some times, values in -1 .. 2."""
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    values = [np.sin(5 * x + 0.7 * time) * np.cos(4 * y) + z for time in times]
    return np.stack(values).astype(dtype)


def saw(steps: int) -> np.ndarray:
    """Values that rise and fall evenly in time, 0 to 6: cubics round the corners."""
    rise = np.abs(np.arange(steps) % 12 - 6.0)
    return np.asarray(rise[:, None, None, None] + np.zeros(SHAPE))


def of(values: np.ndarray, times: np.ndarray = TIMES) -> ArraySeries:
    return ArraySeries(values, coords={"t": Coordinate(name="time", values=times)})


def gappy() -> np.ndarray:
    values = slow()
    values[np.random.default_rng(0).random(values.shape) < 0.1] = np.nan
    return values


BOUND: dict[str, Any] = {"max_error": 1e-4, "effort": 1, "timings": False, "tile": "3x4x4x4"}
SERIES: dict[str, tuple[Callable[[], ArraySeries], dict[str, Any]]] = {
    "uneven": (lambda: of(slow()), {}),
    "descending": (lambda: of(slow(TIMES[::-1]), TIMES[::-1].copy()), {}),
    "float64": (lambda: of(slow(dtype="float64")), {"max_error": 1e-9}),
    "unordered times": (lambda: of(slow(), TIMES % 3), {}),
    "missing": (lambda: of(gappy()), {}),
    "feature": (lambda: of(slow()), {"features": ("interval:0:1",), "dilation": 0}),
    "missing in a feature": (lambda: of(gappy()), {"features": ("interval:0:1",), "dilation": 0}),
}


@pytest.fixture(scope="module", params=SERIES)
def cubic(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file whose rule is cubic, whatever its choice would be."""
    path = tmp_path_factory.mktemp("between") / "a.fhz"
    series, settings = SERIES[request.param]
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # times that do not ascend
        patch.setattr(compact, "choose_between", lambda *_: {"between": {"rule": "cubic"}})
        fhash_codec.encode(series(), path, EncodeConfig(**(BOUND | settings)))
    return path


def expected(values: np.ndarray, times: np.ndarray, step: float, rule: str) -> np.ndarray:
    """Values (z, y, x) at a step by the readable rule, from those of every step."""
    found = np.empty(values.shape[1:])
    for place in np.ndindex(found.shape):
        alone = values[(slice(None), *place)].tolist()
        found[place] = value_between(alone, times.tolist(), step, rule)
    return found


def test_values_have_the_bits_of_the_readable_rule(cubic: Path) -> None:
    with fhash_codec.open(cubic) as volume:
        values = volume[...]
        for step in STEPS:
            wanted = expected(values, volume.key_times._scaled_keys, step, "cubic")
            found = volume.read(step)
            np.testing.assert_array_equal(found, wanted.astype(found.dtype))
            near = values[int(step) : int(step) + 2]
            assert np.isfinite(found).any()
            with np.errstate(invalid="ignore"):
                assert ((near.min(axis=0) <= found) | np.isnan(found)).all()
                assert ((near.max(axis=0) >= found) | np.isnan(found)).all()
            part = volume.read(step, ((1, 4), (2, 3), (0, 7)))
            np.testing.assert_array_equal(part, found[1:4, 2:3])


def test_points_are_trilinear_in_frames_between_steps(cubic: Path) -> None:
    vertices = [p.ravel() for p in np.indices(SHAPE)]
    with fhash_codec.open(cubic) as volume:
        z, y, x = (p.astype(float) for p in vertices)
        for step in (*STEPS, 2.0, 7.0):
            found = volume.sample(t=step, z=z, y=y, x=x)
            np.testing.assert_array_equal(found, volume.read(step).ravel())


def test_derivatives_by_time_are_those_of_the_cubic(cubic: Path) -> None:
    random, tiny = np.random.default_rng(1), 1e-3
    t = random.uniform(0, 6.9, 400)
    t = np.floor(t) + np.clip(t % 1, 2 * tiny, 1 - 2 * tiny)
    points = [random.uniform(0, n - 1, 400) for n in SHAPE]
    at = dict(zip("zyx", points, strict=True))
    with fhash_codec.open(cubic) as volume:
        _, slopes = volume.sample(t=t, **at, gradient=True)
        before, after = (volume.sample(t=t + side, **at) for side in (-tiny, tiny))
    differences = (after.astype(float) - before) / (2 * tiny)
    finite = np.isfinite(differences)
    assert finite.any()
    np.testing.assert_array_equal(finite, np.isfinite(slopes[:, 0]))
    np.testing.assert_allclose(slopes[finite, 0], differences[finite], atol=2e-3)


@pytest.mark.parametrize("times", [TIMES, np.arange(8.0)])
def test_slopes_at_inner_steps_are_those_of_pchip(times: np.ndarray) -> None:
    values = np.random.default_rng(2).normal(size=(8, 50)).cumsum(axis=0)
    pchip = PchipInterpolator(times, values, axis=0)
    for first in range(1, 6):
        gaps = np.diff(times)[first - 1 : first + 2]
        distances = gaps[0] / gaps[1], gaps[2] / gaps[1]
        frames = list(values[first - 1 : first + 3])
        for share in (0.0, 0.3, 0.75, 1.0):
            found, slopes = values_between(frames, distances, np.array([share]), slopes=True)
            at = times[first] + share * gaps[1]
            np.testing.assert_allclose(found, pchip(at), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(slopes, pchip(at, 1) * gaps[1], rtol=1e-9, atol=1e-12)


numbers = st.floats(allow_nan=False, allow_infinity=False) | st.floats(-10, 10)


@given(
    values=st.lists(numbers | st.just(np.nan), min_size=4, max_size=4),
    inner=st.tuples(numbers, numbers),
    distances=st.tuples(*[st.floats(0, 1e300) | st.just(0.0) | st.just(np.inf)] * 2),
    share=st.floats(0, 1),
)
def test_a_value_lies_between_those_of_its_steps(
    values: list[float],
    inner: tuple[float, float],
    distances: tuple[float, float],
    share: float,
) -> None:
    values[1:3] = inner
    frames = [np.array([value]) for value in values]
    found, slopes = values_between(frames, distances, np.array([share]), slopes=True)
    low, high = sorted(inner)
    assert low - abs(low) * 1e-15 <= found[0] <= high + abs(high) * 1e-15
    assert slopes is not None
    if np.isfinite(high - low):
        assert np.isfinite(slopes[0])


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_few_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    path = tmp_path / "a.fhz"
    assert choice(of(slow()[:steps], TIMES[:steps])) == {}
    monkeypatch.setattr(compact, "choose_between", lambda *_: {"between": {"rule": "cubic"}})
    fhash_codec.encode(of(slow()[:steps], TIMES[:steps]), path, EncodeConfig(**BOUND))
    with fhash_codec.open(path) as volume:
        for step in np.linspace(0, steps - 1, 5):
            wanted = expected(volume[...], TIMES, float(step), "cubic")
            np.testing.assert_array_equal(volume.read(step), wanted.astype(np.float32))
            at = {"t": step, "z": 2.5, "y": 1.0, "x": 3.25}
            value, slopes = volume.sample(**at, gradient=True)
            assert np.isfinite(value)
            assert np.isfinite(slopes).all()


def choice(series: ArraySeries, **settings: Any) -> dict[str, Any]:
    selection = select_features(series, EncodeConfig(**settings), silent)
    return choose_between(series, selection.extent, selection.scanned.value_range)


def test_the_rule_is_the_better_one_over_steps_that_are_left_out() -> None:
    smooth = choice(of(slow(np.arange(40) / 4), np.arange(40) / 4))["between"]
    assert smooth["rule"] == "cubic"
    assert smooth["gain_db"] > 3
    rough = choice(of(saw(40), np.arange(40.0)))["between"]
    assert rough["rule"] == "linear"
    assert rough["gain_db"] < 0


def test_where_nothing_can_be_measured_there_is_no_rule() -> None:
    assert choice(of(np.rint(100 * slow()).astype(np.int16))) == {}
    even = np.arange(8.0)[:, None, None, None] + np.zeros(SHAPE)
    assert choice(of(even, np.arange(8.0))) == {}
    labels = of(np.rint(slow()))
    labels.source_dtype = np.dtype(np.int8)
    assert choice(labels) == {}


def test_the_choice_looks_at_the_feature_alone() -> None:
    values = 9 * saw(40) - 99
    values[:, 2:, 2:, 2:] = slow(np.arange(40) / 4)[:, 2:, 2:, 2:] + 2
    series = of(values, np.arange(40) / 4)
    assert choice(series)["between"]["rule"] == "linear"
    own = choice(series, features=("interval:0:9",), dilation=0)["between"]
    assert own["rule"] == "cubic"


def test_threads_change_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []
    for threads in ("1", "3"):
        monkeypatch.setenv("FHASH_THREADS", threads)
        path = tmp_path / f"{threads}.fhz"
        fhash_codec.encode(of(slow()), path, EncodeConfig(**BOUND))
        written.append(path.read_bytes())
    assert written[0] == written[1]


def rule_of(path: Path) -> Any:
    with fhash_codec.open(path) as volume:
        return volume.info["model"]["between"]


def test_files_that_grow_keep_the_rule(tmp_path: Path) -> None:
    path, times = tmp_path / "a.fhz", np.arange(40) / 4
    fhash_codec.encode(of(slow(times), times), path, EncodeConfig(**BOUND))
    told = rule_of(path)
    assert told["rule"] == "cubic"
    later = times[-1] + 1 + np.arange(6.0)
    fhash_codec.append(of(saw(6).astype(np.float32), later), path, keep=39)
    assert rule_of(path) == told
    fhash_codec.export_plain(path, tmp_path / "plain.fhz")
    assert rule_of(tmp_path / "plain.fhz") == told
    with fhash_codec.open(path) as volume, fhash_codec.open(tmp_path / "plain.fhz") as plain:
        np.testing.assert_allclose(plain.read(38.4), volume.read(38.4), atol=1e-6)


def test_parts_share_the_rule_of_the_plan(tmp_path: Path) -> None:
    series, config = of(slow()), EncodeConfig(**BOUND)
    plan = plan_parts(series, tmp_path / "a.plan", config)
    parts = [tmp_path / f"{number}.fhz" for number in (1, 2)]
    for number, path in enumerate(parts, start=1):
        encode_part(series, path, None, Part(number=number, of=2), plan=plan)
    fhash_codec.merge(parts, tmp_path / "whole.fhz")
    fhash_codec.encode(series, tmp_path / "once.fhz", config)
    assert (tmp_path / "whole.fhz").read_bytes() == (tmp_path / "once.fhz").read_bytes()
    assert rule_of(tmp_path / "whole.fhz")["gain_db"] is not None
