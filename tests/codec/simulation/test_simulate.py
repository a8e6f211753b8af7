"""Simulation of a scene, its terms and its explanation."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fhash_codec.simulation import simulate as module
from fhash_codec.simulation.effects import (
    Advection,
    Blob,
    Buoyancy,
    Effect,
    Front,
    Place,
    Rotation,
    Shell,
    Turbulence,
    Vector,
    Vortex,
    times,
)
from fhash_codec.simulation.scene import (
    EFFECTS,
    MAX_EFFECTS,
    PRESETS,
    SimulatedScene,
    effect_of,
    scene_of,
)
from fhash_codec.simulation.simulate import (
    MAX_SEED,
    Simulation,
    counts,
    reasons,
    simulate,
    terms_of,
)
from fhash_formats.errors import InputError, MissingInputError, RegionError

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


def test_products_leave_out_parts_that_are_zero() -> None:
    z, y, x = (np.full((1, 1, 1), value, dtype=np.float32) for value in (1, np.nan, 3))
    assert times((z, y, x), (2, 0, 5)).item() == 17
    assert times((z, y, x), (0, 0, 0)).item() == 0


def test_an_effect_without_a_term_cannot_be_made() -> None:
    with pytest.raises(TypeError, match="abstract"):
        Effect()  # type: ignore[abstract]


PLACE = (np.float32([[[0.5]]]), np.float32([[[0.25]]]), np.float32([[[0.75]]]))


def test_a_parcel_came_from_upwind() -> None:
    effect = Advection(strength=2.0, direction=(0, 3, 4))
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = flow.carry(PLACE, 1.0, 1.25)
    assert z is PLACE[0]
    assert y.item() == pytest.approx(0.25 - 0.5 * 0.6)
    assert x.item() == pytest.approx(0.75 - 0.5 * 0.8)
    assert flow.rigid
    assert flow.exact


@pytest.mark.parametrize(
    ("axis", "here", "before"),
    [
        ("z", (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),  # y was x
        ("x", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),  # z was y
        ("y", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),  # x was z
    ],
)
def test_a_quarter_turn_brings_x_to_y_to_z_to_x(
    axis: str, here: tuple[float, ...], before: tuple[float, ...]
) -> None:
    effect = Rotation(strength=math.pi / 2, axis=axis, centre=(0, 0, 0))
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = (np.full((1, 1, 1), part, dtype=np.float32) for part in here)
    came = [part.item() for part in flow.carry((z, y, x), 2.0, 3.0)]
    np.testing.assert_allclose(came, before, atol=1e-6)


RADIUS = 0.2


def speed(distance: float) -> float:
    """Speed along y of a parcel beside the middle, from where it came a moment ago."""
    effect = Vortex(strength=3.0, radius=RADIUS, centre=(0, 0, 0))
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    zero = np.zeros((1, 1, 1), dtype=np.float32)
    _, y, _ = flow.carry((zero, zero, zero + np.float32(distance)), 0.0, 1e-3)
    return float(-y.item() / 1e-3)


def test_the_largest_speed_is_the_strength_at_the_radius() -> None:
    assert speed(RADIUS) == pytest.approx(3.0, rel=1e-3)
    assert speed(0.9 * RADIUS) < speed(RADIUS) > speed(1.1 * RADIUS)


def test_the_distance_to_the_axis_stays_and_what_is_even_along_it_is_computed_once() -> None:
    flow = Vortex(strength=8.0).term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = np.ix_(*(np.linspace(0, 1, 5, dtype=np.float32),) * 3)
    _, v, u = flow.carry((z, y, x), 0.0, 1.0)
    assert v.shape == u.shape == (1, 5, 5)
    before = np.hypot(y - 0.5, x - 0.5)
    np.testing.assert_allclose(np.hypot(v - 0.5, u - 0.5), before, atol=1e-5)
    assert not flow.rigid


FINE: Vector = (1e-4, 1e-4, 1e-4)


def carried(place: np.ndarray, spacing: Vector = FINE, seed: int = 0, **settings: float) -> Place:
    flow = Turbulence(**settings).term(np.random.default_rng(seed), spacing)
    z, y, x = (part.astype(np.float32)[:, None, None] for part in place.T)
    return flow.carry((z, y, x), 0.0, 0.5)


def test_volumes_stay() -> None:
    """A small cube and its image have the same volume, by differences in float32."""
    edge, corner = 2e-3, np.array([0.3, 0.6, 0.1])
    corners = corner + np.concatenate([np.zeros((1, 3)), np.eye(3) * edge, -np.eye(3) * edge])
    came = np.stack(
        [part[:, 0, 0] for part in carried(corners, strength=0.1, scale=0.5, octaves=2)]
    )
    jacobian = (came[:, 1:4] - came[:, 4:7]) / (2 * edge)
    assert np.linalg.det(jacobian.astype(np.float64)) == pytest.approx(1.0, abs=2e-3)


EFFECT = Buoyancy(strength=2.0, radius=0.25, centre=(0.5, 0.5, 0.5))


def carry(places: np.ndarray, stop: float, effect: Buoyancy = EFFECT) -> np.ndarray:
    flow = effect.term(np.random.default_rng(0), (0.1, 0.1, 0.1))
    z, y, x = (part.astype(np.float32)[:, None, None] for part in places.T)
    return np.stack([part[:, 0, 0] for part in flow.carry((z, y, x), 0.0, stop)], axis=-1)


def test_it_falls_upwards_first_and_then_keeps_its_speed() -> None:
    assert EFFECT.height(0.0) == 0
    assert EFFECT.height(0.01) == pytest.approx(2.0 * 0.01**2 / 2, rel=1e-2)
    assert EFFECT.height(9.0) - EFFECT.height(8.0) == pytest.approx(math.sqrt(2.0 * 0.25), rel=1e-3)
    assert Buoyancy(strength=-2.0).height(1.0) == -Buoyancy(strength=2.0).height(1.0)
    assert math.isfinite(Buoyancy(strength=1e3, radius=1e-3).height(1e6))


@pytest.mark.parametrize("place", [(0.55, 0.5, 0.7), (0.45, 0.65, 0.6), (0.7, 0.4, 0.45)])
def test_volumes_stay_buoyancy(place: tuple[float, float, float]) -> None:
    edge = 2e-3
    corners = np.array(place) + np.concatenate([np.eye(3) * edge, -np.eye(3) * edge])
    came = carry(corners, 0.3)
    jacobian = ((came[:3] - came[3:]) / (2 * edge)).astype(np.float64)
    assert np.linalg.det(jacobian) == pytest.approx(1.0, abs=5e-3)


SPACING = (0.02, 0.02, 0.02)


def amount(blob: Blob, widening: float) -> float:
    """The integral of the value over all space."""
    radius = np.linspace(0, 3, 20001, dtype=np.float32)[None, None]
    body = blob.term(np.random.default_rng(0), SPACING)
    values = body.value(radius - np.float32(blob.radius), widening, 1.0)
    return float((values * 4 * np.pi * radius.astype(np.float64) ** 2).sum() * 3 / 20000)


@pytest.mark.parametrize("widening", [1e-4, 1e-2, 0.05])
def test_the_amount_stays_as_it_spreads(widening: float) -> None:
    blob = Blob(radius=0.5, edge=0.05)
    assert amount(blob, widening) == pytest.approx(amount(blob, 0.0), rel=5e-3)


LINE = np.linspace(0, 1, 101, dtype=np.float32)[None, None]
ZERO = np.zeros((1, 1, 1), dtype=np.float32)


def values(front: Front, time: float, widening: float = 0.0) -> np.ndarray:
    body = front.term(np.random.default_rng(0), (0.01, 0.01, 0.01))
    surface = body.surface((ZERO, ZERO, LINE), time)
    return body.value(surface.distance, widening, time).ravel()


def test_it_moves_at_its_speed_and_leaves_its_value_behind() -> None:
    front = Front(strength=-3.0, start=0.2, speed=0.5, width=0.01)
    early, late = values(front, 0.0), values(front, 1.0)
    assert early[20] == pytest.approx(-1.5)
    assert late[70] == pytest.approx(-1.5, abs=1e-4)
    assert (late[0], late[-1]) == (-3.0, 0.0)


def test_a_depth_makes_a_sheet_that_keeps_its_amount_as_it_spreads() -> None:
    front = Front(start=0.6, speed=0.0, depth=0.2, width=0.01)
    sharp, wide = values(front, 0.0), values(front, 0.0, 0.005)
    assert sharp[50] == pytest.approx(1.0, abs=1e-6)
    assert (sharp[30], sharp[70]) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert wide.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    assert wide.max() < 0.99


def test_the_radius_grows_as_time_to_the_two_fifths() -> None:
    shell = Shell(radius=0.4, age=0.1)
    assert shell.grown(1.0) == pytest.approx(0.4)
    ratio = (0.5 + 0.1) / (0.2 + 0.1)
    assert shell.grown(0.5) / shell.grown(0.2) == pytest.approx(ratio**0.4)


def test_it_is_densest_at_its_edge_and_weakens() -> None:
    shell = Shell(strength=2.0, radius=0.4, thickness=0.05, centre=(0, 0, 0))
    body = shell.term(np.random.default_rng(0), (0.01, 0.01, 0.01))
    radius = np.linspace(0, 0.6, 601, dtype=np.float32)[None, None]
    zero = np.zeros((1, 1, 1), dtype=np.float32)
    profile = body.value(body.surface((zero, zero, radius), 1.0).distance, 0.0, 1.0).ravel()
    assert profile.argmax() == pytest.approx(385, abs=12)
    assert profile[350] / profile[300] == pytest.approx(np.exp(1), rel=0.02)
    assert profile[-1] == 0
    assert shell.level(0.0) > shell.level(1.0) == 2.0
    assert Shell(weakening=0, strength=2.0).level(0.0) == 2.0


DIFFUSIVITY = 4e-3


def test_a_front_becomes_an_error_function_of_width_sqrt_4dt() -> None:
    scene = {
        "shape": (1, 1, 512),
        "effects": [
            {"effect": "front", "start": 0.5, "speed": 0, "width": 0},
            {"effect": "diffusion", "strength": DIFFUSIVITY},
        ],
    }
    series = simulate(scene)
    x, time = series.coords["x"].values, series.coords["t"].values
    for step in (8, 15):
        width = math.sqrt(4 * DIFFUSIVITY * time[step])
        expected = [math.erfc((place - 0.5) / width) / 2 for place in x]
        np.testing.assert_allclose(series.read(step).ravel(), expected, atol=2e-3)


def test_a_medium_that_is_drawn_out_mixes_sooner() -> None:
    """The share of the contrast that diffusion takes is larger in a vortex than at rest."""
    sheet = {"effect": "front", "start": 0.55, "speed": 0, "depth": 0.1, "direction": (0, 1, 0)}
    vortex = {"effect": "vortex", "strength": 1.0}
    diffusion = {"effect": "diffusion", "strength": 1e-4}

    def contrast(*effects: dict[str, object]) -> float:
        frame = simulate({"effects": effects}, (2, 1, 128, 128)).read(1)
        return float(frame[:, 40:88, 40:88].std())

    at_rest = 1 - contrast(sheet, diffusion) / contrast(sheet)
    wound = 1 - contrast(sheet, vortex, diffusion) / contrast(sheet, vortex)
    assert wound > 2 * at_rest > 0


NAMED = "advection vortex rotation front fingers diffusion turbulence buoyancy shell blob"


def test_all_effects_are_there_and_off_by_strength() -> None:
    assert set(EFFECTS) == set(NAMED.split())
    for kind, effect in EFFECTS.items():
        assert effect.role in ("flow", "body", "bend", "spread")
        assert not effect_of({"effect": kind}, 1).idle
        assert effect_of({"effect": kind, "strength": 0}, 1).idle == "its strength is 0"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"effect": "vortx"}, "effect 3 is 'vortx'; did you mean 'vortex'"),
        ({"effect": "vortex", "speed": 1}, "effect 3, vortex: unknown setting 'speed'"),
        ({"effect": "vortex", "strength": "fast"}, "strength is 'fast'; a number from -1000"),
        ({"effect": "vortex", "strength": 1001}, "strength is 1001; allowed: -1000 to 1000"),
        ({"effect": "vortex", "axis": "w"}, "axis is 'w'; allowed: z, y, x"),
        ({"effect": "vortex", "centre": [0, 1]}, "a list of 3"),
        ({"effect": "blob", "strength": float("nan")}, "strength is nan"),
        ({"strength": 1}, 'effect 3 has no name; write effect = "NAME"'),
        (7, "effect 3 is 7; a table of settings is needed"),
        ({"effect": ["a"]}, "effect 3 has no name"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(table: Any, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as error:
        effect_of(table, 3)
    assert "\n" not in str(error.value)


TOML = """
name = "smoke"
shape = [4, 5, 6]
[[effects]]
effect = "vortex"
strength = 2
"""


def test_toml_json_and_tables_are_the_same_scene(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(TOML)
    scene = scene_of(tmp_path / "s.toml")
    assert (scene.shape, scene.effects) == ((4, 5, 6), (Vortex(strength=2.0),))
    (tmp_path / "s.JSON").write_text(json.dumps(scene.to_dict()))
    assert scene_of(str(tmp_path / "s.JSON")) == scene == scene_of(scene.to_dict())
    assert scene_of(scene) is scene


@pytest.mark.parametrize("name", ["vortex", "front", "flame", "bubble", "shell"])
def test_presets_survive_a_round_through_their_tables(name: str) -> None:
    scene = scene_of(name)
    assert SimulatedScene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[effects]]\neffect = 'shel'", "effect 1 is 'shel'; did you mean 'shell'"),
        ("efects = []", "unknown setting 'efects'"),
        ("shape = [4, 5]", "shape is [4, 5]; a list of 3"),
        ("shape = [4, 0, 5]", "shape is 0; allowed: 1 to 16384"),
        ("steps = 2.5", "steps is 2.5; a whole number"),
        ("duration = 0", "duration is 0; allowed"),
        ("name = ' '", "name is empty"),
        ("effects = 3", "effects is 3; a list of tables"),
        ("effects = [1]", "effect 1 is 1; a table"),
        ("splits = 65", "splits is 65; allowed: 1 to 64"),
        ("a = ", "not a scene"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)) as error:
        scene_of(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_no_text_or_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="no such file"):
        scene_of(tmp_path / "none.toml")
    (tmp_path / "s.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="holds no text"):
        scene_of(tmp_path / "s.json")
    (tmp_path / "t.json").write_text("[1]")
    with pytest.raises(InputError, match="a table of settings is needed"):
        scene_of(tmp_path / "t.json")


def test_an_unknown_preset_names_the_nearest_or_all_and_the_suffixes() -> None:
    with pytest.raises(InputError, match=r"did you mean 'flame'\?; a file ends in .toml or .json"):
        scene_of("flames")
    with pytest.raises(InputError, match="known: vortex, front, flame, bubble, shell"):
        scene_of("zzz")


def test_the_number_of_effects_is_limited() -> None:
    table = {"effect": "rotation"}
    assert len(scene_of({"effects": [table] * MAX_EFFECTS}).effects) == MAX_EFFECTS
    with pytest.raises(InputError, match="65 effects; allowed: 64"):
        scene_of({"effects": [table] * (MAX_EFFECTS + 1)})


def test_a_scene_without_a_paper_shape_says_which_have_one() -> None:
    with pytest.raises(InputError, match="flame, bubble, shell do"):
        scene_of("vortex").as_in_paper()


PAPER = {
    "flame": (54, 172, 200, 136),
    "bubble": (256, 128, 128, 241),
    "shell": (216, 216, 216, 136),
}
"""Vertices along z, y and x, and steps, of Table 2."""


@pytest.mark.parametrize("name", PAPER)
def test_paper_shapes_are_those_of_the_paper(name: str) -> None:
    scene = simulate(name).scene
    large = scene.as_in_paper()
    assert (*large.shape, large.steps) == PAPER[name]
    # Both shapes have the same proportions as the box, so that cells are cubes, about.
    for shape in (scene.shape, large.shape):
        cells = [length / count for length, count in zip(scene.size, shape, strict=True)]
        assert max(cells) < 1.05 * min(cells)


@pytest.mark.parametrize("name", PRESETS)
def test_something_happens_and_the_seed_changes_it(name: str) -> None:
    shape = (4, 12, 16, 14)
    first, again, other = (simulate(name, shape, seed) for seed in (0, 0, 1))
    for step in range(3):
        assert not np.array_equal(first.read(step), first.read(step + 1))
    np.testing.assert_array_equal(first.read(3), again.read(3))
    assert not np.array_equal(first.read(3), other.read(3))
