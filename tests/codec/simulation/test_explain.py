"""Explanations: what is computed and why, what is not, and counts with a zero for it."""

from __future__ import annotations

from fhash_codec.simulation.effects.catalogue import EFFECTS
from fhash_codec.simulation.explain import counts, reasons
from fhash_codec.simulation.simulate import simulate

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
