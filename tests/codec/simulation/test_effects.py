"""Effects and their catalogue."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_codec.simulation.bodies import Blob, Front, Shell
from fhash_codec.simulation.effect import Effect, Place, Vector, times
from fhash_codec.simulation.flows import Advection, Buoyancy, Rotation, Turbulence, Vortex
from fhash_codec.simulation.scene import EFFECTS, effect_of
from fhash_codec.simulation.simulate import simulate
from fhash_formats.errors import InputError


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


DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "scenes.md"
NAMED = "advection vortex rotation front fingers diffusion turbulence buoyancy shell blob"


def test_all_effects_are_there_and_off_by_strength() -> None:
    assert set(EFFECTS) == set(NAMED.split())
    for kind, effect in EFFECTS.items():
        assert effect.role in ("flow", "body", "bend", "spread")
        assert not effect_of({"effect": kind}, 1).idle
        assert effect_of({"effect": kind, "strength": 0}, 1).idle == "its strength is 0"


def documented() -> dict[str, dict[str, tuple[str, str, str]]]:
    """Rows of the tables in the document, by effect and setting: default, range, meaning."""
    tables = {}
    for section in DOCUMENT.read_text(encoding="utf-8").split("\n### ")[1:]:
        rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \|$", section, re.M)
        tables[section.split("`")[1]] = {name: (*rest,) for name, *rest in rows}
    return tables


def text_of(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(f"{part:g}" for part in value)
    return value if isinstance(value, str) else f"{value:g}"


def test_the_document_has_every_setting_with_its_default_and_range() -> None:
    expected = {
        kind: {
            setting.name: (
                text_of(setting.default),
                ", ".join(setting.metadata["choices"])
                or f"{setting.metadata['low']:g} to {setting.metadata['high']:g}",
                setting.metadata["help"],
            )
            for setting in dataclasses.fields(effect)
        }
        for kind, effect in EFFECTS.items()
    }
    assert documented() == expected


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
