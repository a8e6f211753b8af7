"""Shared settings cover both profiles, every kind of promise and every type of tables."""

from __future__ import annotations

from fhash_codec.selftest.cases.settings import COMPACT, EXACT, MORE, PAPER, QUICK, of_all


def test_the_settings_cover_profiles_promises_and_tables() -> None:
    configs = [*QUICK.values(), *MORE.values()]
    assert {config.profile for config in configs} == {"compact", "paper"}
    assert {config.tables for config in configs if config.profile == "paper"} >= {
        "float32",
        "uint8",
        "transform",
    }
    compact = [config for config in configs if config.profile == "compact"]
    assert any(config.psnr is not None for config in compact)
    assert any(config.max_error_rel is not None for config in compact)
    assert any(config.max_error == 0 for config in compact)
    assert not QUICK.keys() & MORE.keys()


def test_a_change_is_made_in_all_settings() -> None:
    changed = of_all({**COMPACT, **EXACT, **PAPER}, dilation=3)
    assert changed.keys() == {*COMPACT, *EXACT, *PAPER}
    assert {config.dilation for config in changed.values()} == {3}
    assert changed["psnr"].psnr == COMPACT["psnr"].psnr
