"""Terms: made for named effects alone, and independent of those that are not computed."""

from __future__ import annotations

from typing import Any

import pytest

from fhash_codec.simulation.effects.catalogue import EFFECTS
from fhash_codec.simulation.scene import SimulatedScene
from fhash_codec.simulation.terms import spacing_of, terms_of

BLOB = {"effect": "blob"}


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


@pytest.mark.parametrize("kind", EFFECTS)
def test_an_effect_that_is_not_named_or_has_no_strength_is_never_made(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    assert made(monkeypatch, BLOB) == ["blob"]
    assert made(monkeypatch, BLOB, {"effect": kind, "strength": 0}) == ["blob"]


@pytest.mark.parametrize("kind", EFFECTS)
def test_a_named_effect_is_made_once(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    assert made(monkeypatch, BLOB, {"effect": kind}) == ["blob", kind]


def test_without_a_body_nothing_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    effects = [{"effect": kind} for kind, effect in EFFECTS.items() if effect.role != "body"]
    assert made(monkeypatch, *effects) == []
    terms = terms_of(SimulatedScene(effects=tuple(effects)), 0)  # type: ignore[arg-type]
    assert len(terms.idle) == len(effects)
    assert "no body" in terms.idle[0]


def test_roles_and_sums() -> None:
    effects = (BLOB, {"effect": "diffusion"}, {"effect": "diffusion", "strength": 0.5})
    terms = terms_of(SimulatedScene(effects=effects), 0)  # type: ignore[arg-type]
    assert terms.diffusivity == pytest.approx(0.501)
    assert terms.spreads == [1, 2]
    assert not terms.stretched
    assert terms.exact


@pytest.mark.parametrize(
    ("kind", "sheared", "exact"),
    [("rotation", False, True), ("vortex", True, True), ("turbulence", True, False)],
)
def test_flows_say_whether_they_shear_and_are_exact(kind: str, sheared: bool, exact: bool) -> None:
    one = SimulatedScene(effects=(BLOB, {"effect": kind}))  # type: ignore[arg-type]
    two = SimulatedScene(effects=(BLOB, {"effect": kind}, {"effect": "advection"}))  # type: ignore[arg-type]
    assert (terms_of(one, 0).sheared, terms_of(one, 0).exact) == (sheared, exact)
    assert not terms_of(two, 0).exact


def test_the_spacing_of_one_vertex_is_zero() -> None:
    scene = SimulatedScene(shape=(1, 4, 10), size=(1.0, 2.0, 5.0))
    assert spacing_of(scene) == (0.0, 0.5, 0.5)
