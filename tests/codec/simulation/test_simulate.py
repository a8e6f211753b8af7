"""Simulation of a scene, its terms and its explanation."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fhash_codec.simulation import simulate as module
from fhash_codec.simulation.scene import EFFECTS, SimulatedScene, scene_of
from fhash_codec.simulation.simulate import (
    MAX_SEED,
    Simulation,
    counts,
    reasons,
    simulate,
    terms_of,
)
from fhash_formats.errors import InputError, RegionError

BLOB = {"effect": "blob", "radius": 0.2, "edge": 0.05}
KINDS = tuple(EFFECTS)
SHAPE = (4, 6, 9, 8)


@st.composite
def tables(draw: st.DrawFn) -> dict[str, Any]:
    """An effect with any settings that are allowed, the limits among them."""
    kind = draw(st.sampled_from(KINDS))
    table: dict[str, Any] = {"effect": kind}
    for setting in dataclasses.fields(EFFECTS[kind]):
        limits = setting.metadata
        if draw(st.booleans()):
            continue
        if limits["choices"]:
            table[setting.name] = draw(st.sampled_from(limits["choices"]))
            continue
        low, high = limits["low"], limits["high"]
        if setting.name in ("octaves", "waves"):
            table[setting.name] = draw(st.integers(int(low), min(int(high), 8)))
            continue
        number = st.sampled_from([low, high]) | st.floats(low, high)
        parts = len(setting.default) if isinstance(setting.default, tuple) else 0
        table[setting.name] = draw(st.tuples(*[number] * parts)) if parts else draw(number)
    return table


@settings(max_examples=60)
@given(
    effects=st.lists(tables(), max_size=4),
    shape=st.tuples(*[st.integers(1, 7)] * 3),
    size=st.tuples(*[st.sampled_from([1e-2, 1.0, 1e3])] * 3),
    steps=st.integers(1, 4),
    duration=st.sampled_from([1e-3, 1.0, 1e3]),
    splits=st.sampled_from([1, 3]),
    seed=st.integers(0, MAX_SEED),
)
def test_values_are_finite_and_within_the_bounds_of_the_bodies(
    effects: list[dict[str, Any]], seed: int, **scene: Any
) -> None:
    series = simulate({"effects": effects, "background": 0.5, **scene}, seed=seed)
    low, high = series.bounds
    slack = 1e-5 * max(abs(low), abs(high))
    for frame in series.frames():
        assert frame.dtype == np.float32
        assert frame.shape == series.shape[1:]
        assert np.isfinite(frame).all()
        assert frame.min() >= low - slack
        assert frame.max() <= high + slack


def test_it_is_a_series_with_coordinates_in_si_units() -> None:
    series = simulate("flame", SHAPE)
    assert (series.shape, series.dtype, series.name) == (SHAPE, np.float32, "mixture_fraction")
    assert [series.coords[axis].attributes["units"] for axis in "tzyx"] == ["s", "m", "m", "m"]
    assert series.coords["t"].values[[0, -1]].tolist() == [0.0, 1.0]
    np.testing.assert_allclose(series.coords["x"].values[[0, -1]], [1 / 16, 15 / 16])
    with pytest.raises(RegionError):
        series.read(4)


@pytest.mark.parametrize("kind", KINDS)
def test_an_effect_of_strength_0_changes_no_bit_and_is_not_computed(kind: str) -> None:
    """It stands first and twice, so that it would shift random numbers and the order of flows."""
    others = [
        BLOB | {"jitter": 0.1},
        {"effect": "fingers"},
        {"effect": "turbulence"},
        {"effect": "diffusion"},
    ]
    nothing = {"effect": kind, "strength": 0}
    with_it = simulate({"effects": [nothing, *others, nothing]}, SHAPE, 5)
    without = simulate({"effects": others}, SHAPE, 5)
    for step in range(SHAPE[0]):
        np.testing.assert_array_equal(with_it.read(step), without.read(step))
    assert set(with_it.counters.evaluations) == {1, 2, 3, 4}


def test_threads_and_order_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCK_VERTICES", 64)
    frames = {}
    for threads in ("1", "5"):
        monkeypatch.setenv("FHASH_THREADS", threads)
        series = simulate("shell", SHAPE)
        order = range(4) if threads == "1" else (3, 1, 0, 2)
        frames[threads] = {step: series.read(step) for step in order}
        assert series.counters.frames == 4
    for step in range(4):
        np.testing.assert_array_equal(frames["1"][step], frames["5"][step])


@pytest.mark.parametrize("name", ["vortex", "front", "bubble"])
def test_blocks_leave_no_seams(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = simulate(name, (3, 10, 12, 11)).read(2)
    monkeypatch.setattr(module, "BLOCK_VERTICES", 30)
    np.testing.assert_allclose(simulate(name, (3, 10, 12, 11)).read(2), whole, atol=2e-5)


def test_flows_in_turn_come_near_the_exact_motion_with_more_splits() -> None:
    """A blob is blown along while it turns: the exact place follows from the velocities."""
    effects = [
        {"effect": "blob", "centre": (0.5, 0.3, 0.5), "radius": 0.12},
        {"effect": "rotation", "strength": 2.0},
        {"effect": "advection", "strength": 0.3, "direction": (0, 0, 1)},
    ]
    scene = {"effects": effects, "shape": (1, 64, 64), "steps": 2}
    turn = 2.0
    # d(p)/dt = w i p + v has the solution p0 e^iwt + v (e^iwt - 1) / iw, with p = x + iy.
    phase = np.exp(1j * turn)
    place = -0.2j * phase + 0.3 * (phase - 1) / (1j * turn)
    errors = []
    for splits in (1, 4, 32):
        frame = simulate({**scene, "splits": splits}).read(1)[0].astype(float)
        y, x = np.meshgrid(*[(np.arange(64) + 0.5) / 64 - 0.5] * 2, indexing="ij")
        middle = ((x + 1j * y) * frame).sum() / frame.sum()
        errors.append(abs(middle - place))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.02


@pytest.mark.parametrize(
    ("effect", "kept"),
    [
        ({"effect": "diffusion", "strength": 1e-3}, 0.005),
        ({"effect": "turbulence", "strength": 0.05}, 0.01),
        ({"effect": "rotation", "strength": 1}, 0.005),
    ],
)
def test_the_amount_of_a_blob_stays(effect: dict[str, Any], kept: float) -> None:
    blob = {"effect": "blob", "centre": (0.4, 0.5, 0.45), "radius": 0.15, "edge": 0.05}
    series = simulate({"effects": [blob, effect]}, (3, 32, 32, 32))
    amounts = [float(frame.mean(dtype=np.float64)) for frame in series.frames()]
    np.testing.assert_allclose(amounts, amounts[0], rtol=kept)


def test_counters_say_what_was_computed() -> None:
    effects = [BLOB, {"effect": "rotation"}, {"effect": "vortex"}, {"effect": "diffusion"}]
    series = simulate({"effects": effects, "splits": 3}, (2, 4, 4, 4))
    assert series.counters.evaluations == {}
    series.read(0)
    assert (series.counters.parts, series.counters.evaluations) == (0, {0: 125})
    series.read(1)
    counters = series.counters
    assert (counters.frames, counters.vertices, counters.places) == (2, 128, 250)
    # Both flows turn about z, so that one layer is enough.
    assert (counters.parts, counters.evaluations) == (3, {0: 250, 1: 75, 2: 75, 3: 64})
    assert counters.stretches == 128


def test_nothing_to_show_is_the_background_and_costs_nothing() -> None:
    series = simulate({"background": 2.5, "effects": [{"effect": "turbulence"}]}, SHAPE)
    assert (series.read(3) == 2.5).all()
    assert series.counters.places == 0
    assert series.bounds == (2.5, 2.5)


@pytest.mark.parametrize("seed", [-1, 2**32, 0.5])
def test_a_seed_outside_its_range_is_refused(seed: Any) -> None:
    with pytest.raises(InputError, match="seed is"):
        Simulation(scene_of("front"), seed)


def test_a_frame_that_no_memory_holds_is_refused() -> None:
    with pytest.raises(InputError, match="a frame may have 2147483648"):
        simulate("front", (1, 16384, 16384, 9))
    assert simulate("front", (1, 16384, 16384, 8)).shape[1] == 16384


def made(monkeypatch: pytest.MonkeyPatch, *effects: dict[str, Any]) -> list[str]:
    """Kinds of the effects whose terms are made, in order."""
    kinds: list[str] = []
    for kind, effect in EFFECTS.items():
        own = effect.term  # type: ignore[attr-defined]

        def term(self: Any, *words: Any, own: Any = own, kind: str = kind) -> Any:
            kinds.append(kind)
            return own(self, *words)

        monkeypatch.setattr(effect, "term", term)
    terms_of(SimulatedScene(effects=effects), 0)  # type: ignore[arg-type]
    return kinds


EFFECTS_HERE = [
    {"effect": "blob"},
    {"effect": "vortex", "strength": 0},
    {"effect": "turbulence"},
    {"effect": "front", "direction": (0, 0, 0)},
    {"effect": "diffusion"},
]


def test_every_named_effect_has_its_line_and_the_others_one() -> None:
    lines = dict(reasons(simulate({"effects": EFFECTS_HERE, "background": 2, "units": "K"})))
    assert lines["effects"] == "5 effects named, one line each"
    assert lines["1 blob"].startswith("computed: adds its value")
    assert lines["2 vortex"] == "not computed: its strength is 0"
    assert "waves from 0.3 m down" in lines["3 turbulence"]
    assert lines["4 front"] == "not computed: its direction is 0"
    assert lines["5 diffusion"].startswith("computed: widens")
    others = set(EFFECTS) - {"blob", "vortex", "turbulence", "front", "diffusion"}
    assert all(kind in lines["not named"] for kind in others)
    assert "4 parts" in lines["time"]
    assert "draw them out" in lines["surfaces"]
    assert lines["background"] == "2 K"


def test_other_reasons() -> None:
    alone = dict(reasons(simulate({"effects": [{"effect": "vortex"}]})))
    assert alone["1 vortex"] == "not computed: the scene has no body, so nothing shows it"
    assert "the background everywhere" in alone["surfaces"]
    still = dict(reasons(simulate({"effects": [{"effect": "shell"}]})))
    assert "nothing is carried" in still["time"]
    assert "the same everywhere" in still["surfaces"]
    one = dict(reasons(simulate({"effects": [{"effect": "shell"}, {"effect": "rotation"}]})))
    assert "is one part" in one["time"]
    bent = dict(reasons(simulate({"effects": [{"effect": "shell"}, {"effect": "fingers"}]})))
    assert "fingers bend them" in bent["surfaces"]


def test_counts_have_every_kind_and_zero_for_those_that_are_not_computed() -> None:
    series = simulate({"effects": EFFECTS_HERE}, (2, 4, 4, 4))
    before = counts(series)["effects"]
    assert set(before) == set(EFFECTS)
    assert all(values["places"] == 0 for values in before.values())
    series.read(1)
    after = counts(series)
    computed = {kind for kind, values in after["effects"].items() if values["places"]}
    assert computed == {"blob", "turbulence", "diffusion"}
    assert {kind for kind, values in after["effects"].items() if values["made"]} == computed
    assert (after["frames"], after["vertices"], after["parts"]) == (1, 64, 4)
