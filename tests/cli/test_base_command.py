"""Options in groups by purpose, and single values that are given twice."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator

import click
import pytest
from click.testing import Result

from fhash_cli.base_command import GROUPS, LAST, OTHERS, BaseCommand, group_of
from fhash_cli.main import COMMANDS

Fhash = Callable[..., Result]


def commands() -> Iterator[click.Command]:
    """Every command, with those of the benches."""
    for name in COMMANDS:
        command = importlib.import_module(f"fhash_cli.commands.{name}").command
        if isinstance(command, click.Group):
            yield from command.commands.values()
        else:
            yield command


def sections(fhash: Fhash, command: str) -> dict[str, str]:
    """The help of a command by the headings of its groups."""
    text = fhash(*command.split(), "--help").stdout
    parts = [part.partition(":\n") for part in text.split("\n\n")]
    return {title.strip(): rows for title, _, rows in parts if rows.startswith("  -")}


@pytest.mark.parametrize("command", tuple(commands()), ids=lambda command: str(command.name))
def test_every_command_is_of_this_kind_and_names_each_option_once(command: click.Command) -> None:
    assert isinstance(command, BaseCommand)
    with click.Context(command) as context:
        formatter = click.HelpFormatter(width=10_000)
        command.format_options(context, formatter)
        lines = [
            line.split()[0].rstrip(",")
            for line in formatter.getvalue().splitlines()
            if line.startswith("  -")
        ]
        options = [
            option for option in command.get_params(context) if isinstance(option, click.Option)
        ]
    assert sorted(lines) == sorted(min(option.opts, key=len) for option in options)


def test_the_help_of_encode_has_the_groups_of_its_options(fhash: Fhash) -> None:
    groups = sections(fhash, "encode")
    order = ["Input", "Quality, one of", "Feature", "Profile compact", "Profile paper"]
    assert [title for title in groups if title in order] == order
    assert tuple(groups)[-2:] == LAST
    for title, option in {
        "Input": "--var", "Quality, one of": "--max-error", "Feature": "--feature",
        "Profile compact": "--effort", "Profile paper": "--epochs", "Output": "-o",
        "Run": "--quiet",
    }.items():  # fmt: skip
        assert f"{option} " in groups[title], option


@pytest.mark.parametrize(
    ("command", "title", "option"),
    [
        ("decode", "Steps and region", "--t "),
        ("decode", "Output", "--isosurface "),
        ("diff", "Quality, gates", "--min-psnr "),
        ("render", "Camera", "--azimuth "),
        ("render", "Animation", "--fps "),
        ("bench rate", "Comparison", "--target "),
    ],
)
def test_options_mean_what_their_command_makes_of_them(
    fhash: Fhash, command: str, title: str, option: str
) -> None:
    assert option in sections(fhash, command)[title]


def test_a_new_option_is_shown_without_being_named_here() -> None:
    assert group_of("encode", click.Option(["--never-heard-of"])) == OTHERS


def test_no_option_is_in_two_groups() -> None:
    names = [name for members in GROUPS.values() for name in members]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["encode", "a", "-o", "b", "-o", "c"], "-o"),
        (["encode", "a", "-o", "b", "--var", "u", "--var", "v"], "--var"),
        (["encode", "a", "-o", "b", "--psnr", "40", "--psnr=50"], "--psnr"),
        (["encode", "a", "-o", "b", "--timings", "--no-timings"], "--timings/--no-timings"),
        (["decode", "a", "--roi", "1", "--roi", "2"], "--roi"),
        (["diff", "a", "b", "--t", "1", "--t", "2"], "--t"),
        (["render", "a", "--zoom", "1", "--zoom", "2"], "--zoom"),
        (["bench", "rate", "a", "--effort", "1", "--effort", "2"], "--effort"),
        (["bench", "render", "a", "--size", "16", "--size", "32"], "--size"),
        (["selftest", "--processes", "1", "--processes", "2"], "--processes"),
        (["demo", "--scene", "front", "--scene", "vortex"], "--scene"),
    ],
    ids=" ".join,
)
def test_a_single_value_that_is_given_twice_is_refused(
    refused: Callable[..., str], words: list[str], option: str
) -> None:
    advice = "a file RUN.fhz holds one variable" if option == "--var" else "give it once"
    assert refused(2, *words).startswith(f"{option} is given more than once; {advice}")


def test_flags_may_be_repeated_and_lists_as_well(fhash: Fhash, run: str) -> None:
    assert fhash("verify", run, "-q", "-q").exit_code == 0
    result = fhash("decode", run, "--time", "0", "--time", "1", "-q", "--json", "--json")
    assert result.exit_code == 0, result.output
