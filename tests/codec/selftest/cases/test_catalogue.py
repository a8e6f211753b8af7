"""Every case has a unique name and says what is hard; cases are chosen by name and group."""

from __future__ import annotations

import pytest

from fhash_codec.selftest.cases.catalogue import cases, choose_cases
from fhash_formats.errors import InputError

GROUPS = {"values", "shapes", "fronts", "features", "times", "networks", "rays"}


def test_names_are_unique_and_every_case_says_what_is_hard() -> None:
    assert len({case.name for case in cases()}) == len(cases())
    assert {case.group for case in cases()} == GROUPS
    for case in cases():
        assert case.name == case.name.lower().replace(" ", "-")
        assert case.about
        assert case.settings


def test_settings_of_the_long_set_do_not_replace_others_under_the_same_name() -> None:
    for case in cases():
        for name in case.settings.keys() & case.more.keys():
            assert case.settings[name] == case.more[name], (case.name, name)


def test_a_series_is_the_same_on_every_call() -> None:
    for case in cases():
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
