"""Cases of the catalogue hold what their names say, and are chosen by name and group."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from math import prod
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fhash_codec
from fhash_codec.config import EncodeConfig
from fhash_codec.encoding import encode
from fhash_codec.paper.model import sample_points
from fhash_codec.paper.network import ArrayTable, Network
from fhash_codec.rendering.cameras import Rays
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.march_task import Frame, Surface, Table, Task
from fhash_codec.rendering.scenes import Camera
from fhash_codec.selftest import field_cases, network_cases, ray_cases, value_cases
from fhash_codec.selftest.case import Case, Check, Run
from fhash_codec.selftest.field_cases import (
    COMPACT,
    EXACT,
    MORE,
    PUBLISHED,
    QUICK,
    lattice,
    noise,
    of_all,
    series,
    waves,
)
from fhash_codec.selftest.field_cases import (
    SHAPE as SHAPE_CASES,
)
from fhash_codec.selftest.network_cases import (
    Oracle,
    constant_tables,
    devices,
    diverged,
    ends_of_half_precision,
    kinks,
    large_tables,
    recovered,
)
from fhash_codec.selftest.ray_cases import (
    blocks,
    closed_form,
    key_times,
    reference_picture,
    scene,
    scenes,
)
from fhash_codec.selftest.run import cases, choose_cases, run_case
from fhash_formats.errors import InputError

CASES = {case.name: case for case in cases()}
GROUPS = {"values", "shapes", "fronts", "features", "times", "networks", "rays"}


@cache
def values_of(name: str) -> np.ndarray:
    """All frames of a case, (t, z, y, x)."""
    return np.stack(list(CASES[name].make().frames()))


def coordinate(name: str, axis: str) -> np.ndarray:
    return np.asarray(CASES[name].make().coords[axis].values)


def in_feature(name: str) -> np.ndarray:
    """The vertices (t, z, y, x) in the interval of a case."""
    (config, *_) = CASES[name].settings.values()
    (feature,) = config.features
    low, high = map(float, feature.removeprefix("interval:").split(":"))
    return (values_of(name) >= low) & (values_of(name) <= high)


def test_every_case_has_a_name_a_reason_and_a_series_that_comes_again() -> None:
    assert len(CASES) == len(cases())
    assert {case.group for case in cases()} == GROUPS
    for case in cases():
        assert case.name == case.name.lower().replace(" ", "-")
        assert case.about
        assert case.settings
        for name in case.settings.keys() & case.more.keys():
            assert case.settings[name] == case.more[name], (case.name, name)
        first, second = case.make(), case.make()
        assert first.shape == second.shape
        assert first.read(0).tobytes() == second.read(0).tobytes()


def test_cases_are_chosen_by_name_and_group() -> None:
    assert [case.name for case in choose_cases(names=["spike"])] == ["spike"]
    assert {case.group for case in choose_cases(groups=["times"])} == {"times"}
    assert choose_cases() == tuple(case for case in cases() if case.quick)
    assert choose_cases(everything=True) == cases()
    with pytest.raises(InputError, match="unknown case 'spikey'; did you mean 'spike'"):
        choose_cases(names=["spikey"])
    with pytest.raises(InputError, match="unknown group 'time'; did you mean 'times'"):
        choose_cases(groups=["time"])


def steps(values: np.ndarray, axis: int) -> np.ndarray:
    return np.diff(values.astype(float), axis=axis)


def alone(chosen: np.ndarray, axes: range) -> bool:
    """Whether vertices are chosen, and no two neighbours along any of some axes."""
    moved = [np.moveaxis(chosen, axis, 0) for axis in axes]
    return bool(chosen.any()) and not any((each[1:] & each[:-1]).any() for each in moved)


def crossed(values: np.ndarray) -> float:
    """Share of the vertices that change their side of a front from one step to the next."""
    return float(((values[1:] > 0) != (values[:-1] > 0)).mean())


def ends(values: np.ndarray) -> tuple[int, int]:
    return np.iinfo(values.dtype).min, np.iinfo(values.dtype).max


TINY = np.finfo("float32").smallest_normal, np.finfo("float64").smallest_normal
LAWS: list[tuple[str, Callable[[np.ndarray], Any]]] = [
    ("checkerboard", lambda v: all((abs(steps(v, axis)) == 1).all() for axis in range(4))),
    ("checkerboard-uint8", lambda v: all((abs(steps(v, axis)) == 1).all() for axis in range(4))),
    ("flicker", lambda v: (v[1:] * v[:-1] < 0).all()),
    ("spike", lambda v: np.count_nonzero(v) == 1),
    ("spikes", lambda v: alone(v != 0, range(1, 4))),
    ("step-on-vertex", lambda v: set(v.ravel().tolist()) == {0.0, 0.5, 1.0}),
    ("step-between", lambda v: set(v.ravel().tolist()) == {0.0, 1.0}),
    ("creeping-front", lambda v: crossed(v) <= 1e-3),
    ("slow-front", lambda v: 0 < crossed(v) <= 0.15),
    ("fast-front", lambda v: 0 < crossed(v) <= 1.0),
    ("nearly-constant-float32", lambda v: np.unique(v).size == 2),
    ("range-float32", lambda v: np.abs(v).min() < 2e-38 and np.abs(v).max() > 9e37),
    ("range-overflows", lambda v: np.isinf(v.max() - v.min())),
    ("denormals-float32", lambda v: 0 < v.max() < TINY[0]),
    ("denormals-float64", lambda v: 0 < v.max() < TINY[1]),
    ("signed-zero", lambda v: np.signbit(v[v == 0]).any()),
    ("isolated-missing", lambda v: np.count_nonzero(~np.isfinite(v)) == 6),
    ("missing-frames", lambda v: np.isfinite(v).any(axis=(1, 2, 3)).tolist()[1:3]),
    ("missing-checkerboard", lambda v: np.isinf(v).mean() == 0.5),
    ("one-finite-value", lambda v: np.isfinite(v).sum() == 1),
    ("nothing-finite", lambda v: not np.isfinite(v).any()),
    ("beyond-float64", lambda v: np.unique(v).size > np.unique(v * 1.0).size),
    ("declared-range", lambda v: np.isnan(v[0, :, 0, 0]).all()),
    ("declared-range", lambda v: np.nanmin(v) < 0.25 and np.nanmax(v) > 0.5),
    ("surfaces-on-vertices", lambda v: set(v.ravel().tolist()) == set(map(float, range(8)))),
    ("surfaces-on-vertices", lambda v: (v[0, -1] == 6.0).all()),
    *[(name, lambda v: np.unique(v).size == 1) for name in CASES if name.startswith("constant-")],
    *[(f"all-of-{kind}", lambda v: (v.min(), v.max()) == ends(v)) for kind in value_cases.INTEGERS],
]


@pytest.mark.parametrize(("name", "holds"), LAWS)
def test_values_are_as_their_name_says(name: str, holds: Callable[[np.ndarray], Any]) -> None:
    with np.errstate(over="ignore"):
        assert holds(values_of(name))


@pytest.mark.parametrize("kind", value_cases.INTEGERS)
def test_integers_are_of_the_type_of_their_name(kind: str) -> None:
    assert CASES[f"all-of-{kind}"].make().read(0).dtype == kind


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("one-vertex", [1, 1, 1, 1]),
        ("whole-box", [2, 2, 2, 2]),
        ("opposite-corners", [8, 8, 8, 16]),
        ("empty-key-frames", [0, 0, 630, 0]),
        ("one-key-frame-filled", [0, 0, 0, 99]),
        ("nothing-selected", [0, 0, 0, 0]),
        ("everything", [990] * 4),
        ("open-interval", [990] * 4),
    ],
)
def test_a_feature_has_the_stated_number_of_vertices(name: str, counts: list[int]) -> None:
    assert in_feature(name).sum(axis=(1, 2, 3)).tolist() == counts


def test_features_lie_where_their_names_say() -> None:
    for case in field_cases.FEATURE_CASES:
        configs = [*case.settings.values(), *case.more.values()]
        assert len({(config.features, config.dilation) for config in configs}) == 1, case.name
    surface = np.ones(SHAPE_CASES, dtype=bool)
    surface[:, 1:-1, 1:-1, 1:-1] = False
    np.testing.assert_array_equal(in_feature("at-every-border"), surface)
    assert alone(in_feature("every-second-vertex"), range(4))
    _, _, y, _ = lattice()
    assert (in_feature("beside-missing") & (np.abs(y - 5) == 1)).any()
    assert np.isnan(values_of("beside-missing"))[y == 5].all()


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("one-voxel", (1, 1, 1, 1)),
        ("one-frame", (1, 9, 10, 11)),
        ("one-along-y", (4, 9, 1, 11)),
        ("twos", (2, 2, 2, 2)),
        ("primes", (5, 7, 11, 13)),
    ],
)
def test_a_case_has_the_shape_of_its_name(name: str, shape: tuple[int, ...]) -> None:
    assert CASES[name].make().shape == shape


def test_shapes_are_long_thin_and_small_and_tiles_do_not_divide_them() -> None:
    for axis, name in enumerate(("long-t", "long-z", "long-y", "long-x")):
        lengths = list(CASES[name].make().shape)
        assert lengths.pop(axis) >= 200 * max(lengths)
    for axis, name in enumerate(("thin-z", "thin-y", "thin-x"), 1):
        assert CASES[name].make().shape[axis] == 1
    assert CASES["thin-all"].make().shape[1:] == (1, 1, 1)
    assert max(prod(case.make().shape) for case in field_cases.SHAPE_CASES) <= 10_000
    rays = max(prod(case.make().shape) for case in ray_cases.RAY_CASES)
    assert rays <= prod(ray_cases.SHAPE)
    odd = CASES["odd-tiles"]
    tile = [int(n) for n in odd.settings["tiles"].tile.split("x")]
    rest = [length % n for length, n in zip(odd.make().shape, tile, strict=True)]
    assert rest == [1, 1, 0, 4]


def is_uneven(times: np.ndarray) -> bool:
    return bool(np.diff(times).max() >= 1e5 * np.diff(times).min() > 0)


@pytest.mark.parametrize(
    ("name", "axes", "holds"),
    [
        ("descending-positions", "zyx", lambda at: (np.diff(at) < 0).all()),
        ("tiny-positions", "zyx", lambda at: np.ptp(at) < 1e-10),
        ("huge-positions", "zyx", lambda at: np.ptp(at) > 1e300),
        ("far-positions", "zyx", lambda at: np.ptp(at) < 1000 * np.spacing(at[0])),
        ("uneven-positions", "zyx", lambda at: (at[1:] == 2 * at[:-1]).all()),
        ("uneven", "t", is_uneven),
        ("tiny", "t", lambda at: (np.diff(at) < 2e-12).all()),
        ("denormal", "t", lambda at: (np.diff(at) == 5e-324).all()),
        ("huge-and-fine", "t", lambda at: (np.nextafter(at[:-1], np.inf) == at[1:]).all()),
        ("descending", "t", lambda at: (np.diff(at) < 0).all()),
        ("negative", "t", lambda at: (at < 0).all()),
        ("both-ends", "t", lambda at: not np.isfinite(at[-1] * 2 - at[0] * 2)),
        ("repeated", "t", lambda at: (np.diff(at) == 0).sum() == 1),
        ("not-a-time", "t", lambda at: (~np.isfinite(at)).sum() == 2),
        ("one-time", "t", lambda at: at.tolist() == [1e5]),
    ],
)
def test_coordinates_are_as_their_name_says(
    name: str, axes: str, holds: Callable[[np.ndarray], Any]
) -> None:
    with np.errstate(over="ignore"):
        assert all(holds(coordinate(name, axis)) for axis in axes)


@pytest.mark.parametrize(
    ("name", "field", "sizes"),
    [
        ("folds", "fold", {2, 3, 4, 5, 6, 7, 8}),
        ("layers", "hidden_layers", {0, 1, 2}),
        ("embeddings", "embedding_size", {1, 2, 3, 4, 5, 6, 7, 8}),
        ("widths", "width", {1, 2, 63, 64, 65, 128}),
        ("wild-rates", "hidden_layers", {0, 1, 2}),
        ("wild-rates", "learning_rate", {1.0}),
    ],
)
def test_every_size_of_a_network_is_tried(name: str, field: str, sizes: set[float]) -> None:
    configs = [*CASES[name].settings.values(), *CASES[name].more.values()]
    assert {getattr(config, field) for config in configs} == sizes
    if name == "wild-rates":
        tried = {(config.hidden_layers, config.schedule) for config in configs}
        assert len(tried) == 2 * len({config.hidden_layers for config in configs})
    else:
        assert len(configs) == len(sizes)


def test_networks_are_trained_on_the_cpu() -> None:
    for case in network_cases.NETWORK_CASES:
        for config in (*case.settings.values(), *case.more.values()):
            assert (config.preset, config.device) == ("published", "cpu")


@pytest.mark.parametrize("view", ray_cases.AXES)
def test_the_camera_along_an_axis_aims_at_vertices(view: str) -> None:
    grid = Grid(counts=ray_cases.SHAPE[:0:-1], origin=np.zeros(3), spacing=np.ones(3))
    camera = Camera.from_dict(ray_cases._grid_camera(view))
    eyes, directions = Rays.of(camera, grid, (9, 9)).pixels()
    along = int(np.argmax(np.abs(directions[4, 4])))
    across = [axis for axis in range(3) if axis != along]
    np.testing.assert_allclose(eyes[..., across], np.rint(eyes[..., across]), atol=1e-12)
    np.testing.assert_allclose(directions[..., across], 0.0, atol=1e-12)


def test_fields_and_series_are_made_as_asked() -> None:
    for shape in (SHAPE_CASES, (2, 2, 2, 2), (1, 1, 1, 5)):
        assert waves(shape).shape == shape
        assert (waves(shape).min(), waves(shape).max()) == (0.0, 1.0)
    assert waves((1, 1, 1, 1)).tolist() == [[[[0.0]]]]
    for axis, index in enumerate(lattice((2, 3, 4, 5))):
        assert index.shape == (2, 3, 4, 5)
        np.testing.assert_array_equal(np.diff(index, axis=axis), 1.0)
    np.testing.assert_array_equal(noise(), noise())
    assert not np.array_equal(noise(), noise(seed=1))
    given = series(waves((2, 3, 1, 1)), times=[5.0, 7.0], units="K", z=np.array([1.0, 2.0, 4.0]))
    assert given.units == "K"
    assert [given.coords[axis].values.tolist() for axis in "tzx"] == [
        [5.0, 7.0],
        [1.0, 2.0, 4.0],
        [0.0],
    ]


def test_the_settings_cover_both_models_promises_and_tables() -> None:
    configs = [*QUICK.values(), *MORE.values()]
    assert not QUICK.keys() & MORE.keys()
    assert {config.preset for config in configs} == {"default", "published"}
    assert {config.tables for config in configs if config.published} >= {
        "float32",
        "uint8",
        "transform",
    }
    compact = [config for config in configs if not config.published]
    assert any(config.psnr is not None for config in compact)
    assert any(config.max_error_rel is not None for config in compact)
    assert any(config.max_error == 0 for config in compact)
    changed = of_all({**COMPACT, **EXACT, **PUBLISHED}, dilation=3)
    assert changed.keys() == {*COMPACT, *EXACT, *PUBLISHED}
    assert {config.dilation for config in changed.values()} == {3}
    assert changed["psnr"].psnr == COMPACT["psnr"].psnr


def test_guises_keep_the_values_in_another_order() -> None:
    values = waves(value_cases.GUISE_SHAPE)
    for factor in value_cases.POWERS:
        single = values.astype(np.float32)
        np.testing.assert_array_equal(single * np.float32(factor) / np.float32(factor), single)
    guises = dict(value_cases._guises(values))
    assert len(guises) == 8
    np.testing.assert_array_equal(guises.pop("negated"), -values)
    for name, guise in guises.items():
        np.testing.assert_array_equal(np.sort(guise, axis=None), np.sort(values, axis=None))
        assert guise.shape != values.shape or not np.array_equal(guise, values), name


Broken = Callable[[Run, Check], set[str]]
ALONE = (constant_tables, ends_of_half_precision, kinks, large_tables)
"""Checks that make networks of their own and do not look at the run."""


@pytest.mark.parametrize("check", ALONE)
def test_sound_networks_keep_every_property(broken: Broken, check: Check) -> None:
    assert broken(None, check) == set()


def shifted(value: float, slope: float) -> Callable[..., object]:
    """`sample_points` with an error in values and slopes."""
    sample_points = network_cases.sample_points

    def sample(*given: object, gradient: bool = False) -> object:
        if not gradient:
            return sample_points(*given) + np.float32(value)
        values, slopes = sample_points(*given, gradient=True)
        return values + np.float32(value), slopes + np.float32(slope)

    return sample


@pytest.mark.parametrize(
    ("check", "value", "slope", "properties"),
    [
        (constant_tables, 1e-6, 0.0, {"constant tables"}),
        (constant_tables, 0.0, 1e-6, {"constant tables, slopes"}),
        (kinks, 0.0, 1e-6, {"derivatives about kinks"}),
        (kinks, 1e-5, 0.0, {"derivatives about kinks, differences"}),
        (large_tables, 1e-3, 0.0, {"large tables"}),
    ],
)
def test_wrong_values_and_slopes_are_seen(
    broken: Broken,
    monkeypatch: pytest.MonkeyPatch,
    check: Check,
    value: float,
    slope: float,
    properties: set[str],
) -> None:
    monkeypatch.setattr(network_cases, "sample_points", shifted(value, slope))
    assert broken(None, check) >= properties


def test_a_number_type_that_accepts_too_much_is_seen(
    broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Careless:
        @classmethod
        def of(cls, table: np.ndarray, kind: str) -> Careless:
            return cls()

        def stored(self, table: np.ndarray) -> np.ndarray:
            return np.minimum(table, 65_000)

    monkeypatch.setattr(network_cases, "NumberType", Careless)
    assert broken(None, ends_of_half_precision) == {"too large for float16", "largest of float16"}


def trained(run: Run, **training: object) -> Run:
    """The run as if its header said this of the training."""
    volume = SimpleNamespace(container=SimpleNamespace(header={"training": training}))
    return replace(run, volume=volume)


def test_a_training_that_does_not_tell_its_restarts_is_seen(
    compact_run: Run, broken: Broken, spoiled: Callable[..., Run]
) -> None:
    rate = compact_run.config.learning_rate
    true = compact_run.decoded
    mean = np.full_like(true, compact_run.values.mean())
    told = trained(compact_run, learning_rate=rate / 16, restarts=2)
    assert broken(spoiled(told, true), recovered) == set()
    assert broken(spoiled(told, mean), recovered) == {"better than a constant"}
    untold = trained(compact_run, learning_rate=rate / 16)
    assert broken(spoiled(untold, true), recovered) == {"rate and restarts told"}
    assert broken(told, diverged) == set()
    assert broken(untold, diverged) == {"divergence not found"}


def test_a_device_that_trains_another_network_is_seen(
    paper_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The CPU stands for another device, another seed for what it gets wrong."""
    encode, seeds = network_cases.encode, iter((paper_run.config.seed, 1))

    def other(source: object, path: object, config: object, **rest: object) -> object:
        assert config.device == "cuda"
        return encode(source, path, replace(config, device="cpu", seed=next(seeds)), **rest)

    monkeypatch.setattr(network_cases, "choose_device", lambda name: name)
    monkeypatch.setattr(network_cases, "encode", other)
    assert [finding.holds for finding in devices(paper_run)] == [True]
    assert [finding.holds for finding in devices(paper_run)] == [False]


@pytest.fixture(scope="module")
def layers() -> Case:
    """A network of one hidden layer, hardly trained."""
    case = next(case for case in network_cases.NETWORK_CASES if case.name == "layers")
    config = replace(case.settings["hidden-layers-1"], epochs=5)
    return replace(case, settings={"hidden-layers-1": config})


def broken_of(case: Case) -> set[str]:
    result = run_case(case, checks=())
    assert not result.errors
    return {finding.name for finding in result.findings if not finding.holds}


def small_network() -> Network:
    """One level of 2 x 2 x 2 x 3 corners with the value t + 10 z + 100 y + 1000 x.

    A ReLU lets values above 500 through; the readout doubles them and adds 0.25.
    """
    t, z, y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in (2, 2, 2, 3)), indexing="ij")
    table = ArrayTable((t + 10 * z + 100 * y + 1000 * x)[..., None])
    first = (np.ones((1, 1), np.float32), np.array([-500.0], np.float32))
    last = (np.full((1, 1), 2.0, np.float32), np.array([0.25], np.float32))
    return Network(
        levels=((2, 2, 2, 3),),
        embedding_size=1,
        tables=[table],
        layers=(first, last),
        box_size=(3, 3, 3),
        key_frames=5,
    )


@pytest.mark.parametrize(
    ("point", "table_value"),
    [
        ((0, 0, 0, 0), 0.0),
        ((4, 2, 2, 2), 2111.0),
        ((2, 0, 0, 1), 1000.5),
        ((1, 1, 0.5, 1.75), 0.25 + 5 + 25 + 1750),
    ],
)
def test_the_oracle_is_the_definition(point: tuple[float, ...], table_value: float) -> None:
    answer = Oracle(small_network()).at(point)
    assert answer.value == pytest.approx(2 * max(0.0, table_value - 500) + 0.25, rel=1e-14)
    assert answer.active == (table_value > 500,)
    sampled = sample_points(small_network(), *point)
    assert abs(float(sampled[0]) - answer.value) <= answer.rounding
    assert answer.rounding < 1e-2


def test_a_sound_network_keeps_the_bounds(layers: Case) -> None:
    assert broken_of(layers) == set()


def test_an_error_beyond_the_bound_of_rounding_is_seen(
    layers: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        network_cases,
        "sample_points",
        lambda *given, **more: sample_points(*given, **more) + np.float32(1e-3),
    )
    case = replace(layers, checks=(network_cases.agrees,))
    assert broken_of(case) == {"float64 oracle", "float64 oracle, error"}


def turned(sample: Callable[..., object]) -> Callable[..., object]:
    """`sample_points` with the derivatives by other coordinates."""

    def other(*given: object, gradient: bool) -> object:
        values, slopes = sample(*given, gradient=gradient)
        return values, slopes[:, ::-1]

    return other


def test_wrong_gradients_are_seen(layers: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_cases, "sample_points", turned(sample_points))
    case = replace(layers, checks=(network_cases.gradients,))
    assert broken_of(case) == {"gradient = differences"}


FOG = {"opacity": [[0.0, 0.02], [1.0, 0.5]]}
SMALL = scene(size=[6, 5], transfer_function=FOG)
EVEN = scene(size=[2, 2], transfer_function={"opacity": [[0.0, 0.5]]}, march={"step": 0.1})


@contextmanager
def opened(run: Run, path: Path, values: np.ndarray) -> Iterator[Run]:
    """A run of other values; few, since the oracle takes its time."""
    source = series(values.astype(np.float32))
    encode(source, path, EncodeConfig(max_error_rel=1e-3, effort=1))
    with fhash_codec.open(path) as volume:
        yield replace(run, series=source, values=values, path=path, volume=volume)


@pytest.fixture(scope="module")
def waves_run(compact_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with opened(
        compact_run, tmp_path_factory.mktemp("waves") / "a.fhz", waves((2, 4, 5, 6))
    ) as run:
        yield run


@pytest.fixture(scope="module")
def even_run(compact_run: Run, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with opened(
        compact_run, tmp_path_factory.mktemp("even") / "a.fhz", np.ones((1, 2, 3, 3))
    ) as run:
        yield run


@pytest.mark.parametrize("check", [scenes({"small": SMALL}), blocks, key_times])
def test_easy_scenes_keep_every_property(waves_run: Run, broken: Broken, check: Check) -> None:
    assert broken(waves_run, check) == set()


def test_an_even_volume_has_its_closed_form(even_run: Run, broken: Broken) -> None:
    assert broken(even_run, closed_form({"even": EVEN}, 1.0)) == set()


def test_a_longer_path_breaks_the_closed_form(
    even_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ray_cases._path
    monkeypatch.setattr(ray_cases, "_path", lambda plan: 2 * path(plan))
    assert broken(even_run, closed_form({"even": EVEN}, 1.0)) == {"closed form"}


def test_a_picture_that_differs_from_the_oracle_is_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = ray_cases.reference_picture
    monkeypatch.setattr(ray_cases, "reference_picture", lambda *given: reference(*given) + 2e-3)
    assert broken(waves_run, scenes({"small": SMALL})) == {"float64 picture"}


def test_an_empty_picture_proves_nothing(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_cases, "reference_picture", lambda *given: np.zeros((5, 6, 4)))
    assert "empty pictures" in broken(waves_run, scenes({"small": SMALL}))


def test_a_part_that_is_drawn_too_bright_is_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    march = ray_cases.march

    def brighter(frame: object, task: object) -> object:
        marched = march(frame, task)
        return replace(marched, rgba=marched.rgba * np.float32(1 + 1e-4 * (frame.first[0] > 0)))

    monkeypatch.setattr(ray_cases, "march", brighter)
    assert broken(waves_run, blocks) == {"blocks = whole"}


def test_pictures_that_depend_on_the_name_of_the_step_are_seen(
    waves_run: Run, broken: Broken, monkeypatch: pytest.MonkeyPatch
) -> None:
    render = ray_cases.Renderer.render

    def other(renderer: object, given: object) -> object:
        image = render(renderer, given)
        return image if given.time is None else replace(image, rgba=image.rgba + np.float32(1e-6))

    monkeypatch.setattr(ray_cases.Renderer, "render", other)
    assert broken(waves_run, key_times) == {"picture at a key time"}


SHAPE = (5, 4, 4)


def task_of(**more: object) -> Task:
    """Four parallel rays from above, through a volume of `SHAPE`."""
    grid = Grid(counts=SHAPE[::-1], origin=np.zeros(3), spacing=np.ones(3))
    camera = Camera(view="xy", projection="parallel", parallel_scale=1.0)
    return Task(rays=Rays.of(camera, grid, (2, 2)), step=0.3, threshold=0.0, **more)


@pytest.mark.parametrize("extinction", [1e-6, 0.3, 50.0])
def test_a_constant_slab_has_its_closed_form(extinction: float) -> None:
    table = Table(
        low=0.0,
        high=1.0,
        colours=np.tile(np.float32([1.0, 0.5, 0.0]), (3, 1)),
        extinctions=np.full(3, extinction),
    )
    frame = Frame(values=np.full(SHAPE, 0.5, np.float32), first=(0, 0, 0))
    opacity = -np.expm1(-4 * extinction)
    np.testing.assert_allclose(
        reference_picture(frame, task_of(table=table)),
        np.broadcast_to(opacity * np.array([1, 0.5, 0, 1]), (2, 2, 4)),
        rtol=1e-9,
    )


def test_surfaces_are_drawn_over_those_behind_them() -> None:
    ramp = np.broadcast_to(np.arange(5, dtype=np.float32)[:, None, None], SHAPE)
    surfaces = tuple(
        Surface(value=value, colour=np.array(colour), opacity=0.5)
        for value, colour in ((1.0, (0, 1, 0)), (4.0, (1, 0, 0)))
    )
    picture = reference_picture(
        Frame(values=ramp, first=(0, 0, 0)), task_of(table=None, surfaces=surfaces)
    )
    # Seen from above, the surface at 4 lies on the face where the rays enter, and the one at 1
    # behind it, exactly on vertices.
    np.testing.assert_allclose(
        picture, np.broadcast_to([0.5, 0.25, 0.0, 0.75], (2, 2, 4)), rtol=1e-12
    )


def test_nothing_is_seen_where_a_vertex_with_a_weight_has_no_value() -> None:
    values = np.full(SHAPE, 0.5, np.float32)
    values[2] = np.nan
    table = Table(
        low=0.0, high=1.0, colours=np.ones((2, 3), np.float32), extinctions=np.full(2, 0.1)
    )
    picture = reference_picture(Frame(values=values, first=(0, 0, 0)), task_of(table=table))
    # Samples lie at 0.15, 0.45, ..., 3.75; one of length 0.1 lies at 3.95. Those from 1 to 3 lie
    # beside the layer without values.
    lengths = 0.3 * np.count_nonzero(np.abs(np.arange(0.15, 3.9, 0.3) - 2) >= 1) + 0.1
    np.testing.assert_allclose(picture[..., 3], -np.expm1(-0.1 * lengths), rtol=1e-6)
