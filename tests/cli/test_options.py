"""Options that commands share, and their types."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

import fhash_codec
from fhash_cli.commands.encode import command as encode
from fhash_cli.main import COMMANDS, program
from fhash_cli.options import (
    GROUPS,
    BaseCommand,
    DurationType,
    IntervalsType,
    SliceType,
    parse_slice,
    written,
)
from fhash_codec.config import EncodeConfig

WHOLE = (None, None)
LATTICE = np.arange(4 * 5 * 6).reshape(4, 5, 6)


@pytest.mark.parametrize(
    "text", ["0", "4", "-1", "-3", "2:5", ":", "::2", "1::3", ":-2", "-4:-1", " 1 : 4 "]
)
def test_slice_means_what_it_means_in_python(text: str) -> None:
    numbers = list(range(7))
    picked = eval(f"numbers[{text}]")
    assert numbers[parse_slice(text)] == (picked if isinstance(picked, list) else [picked])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is empty"),
        ("a", "a is no number"),
        ("1.5", "1.5 is between two"),
        ("1:2:3:4", "more than three parts"),
        ("::0", "the step 0, and steps go upwards"),
        ("::-1", "the step -1, and steps go upwards"),
        ("1,2", "1,2 is no number"),
    ],
)
def test_slice_of_another_form_says_why_and_the_form(text: str, reason: str) -> None:
    with pytest.raises(click.BadParameter, match="half-open range A:B") as refused:
        SliceType().convert(text, None, None)
    assert reason in refused.value.message


@pytest.mark.parametrize(
    "text", ["1,2,3", "0,-1", "2", "1:3", "1:3,2", ":,:,-2:", "...,3", "1,...,2:4", "...", "-2:,1:"]
)
def test_a_region_of_indices_is_that_of_numpy_with_every_axis_kept(text: str) -> None:
    spans = IntervalsType(int).convert(text, None, None)
    picked = LATTICE[tuple(slice(*span) for span in spans)]
    assert picked.ndim == 3
    assert picked.ravel().tolist() == np.ravel(eval(f"LATTICE[{text}]")).tolist()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.5:1e3, :2 ,-1:", ((0.5, 1000.0), (None, 2.0), (-1.0, None))),
        ("0.5:1", ((0.5, 1.0), WHOLE, WHOLE)),
        ("...,2:2", (WHOLE, WHOLE, (2.0, 2.0))),
    ],
)
def test_a_box_of_positions(text: str, expected: tuple[object, ...]) -> None:
    assert IntervalsType(float).convert(text, None, None) == expected


@pytest.mark.parametrize(
    ("number", "text", "reason"),
    [
        (int, "", "an interval is empty"),
        (int, "1:2,,3:4", "an interval is empty"),
        (int, "1:2,3:4,5:6,7:8", "4 intervals, and a region has 3 axes"),
        (int, "...,1,...", "stands there twice"),
        (int, "::2,:,:", "has a step, which a region has not"),
        (int, "0.5:1,:,:", "0.5 is between two"),
        (int, "a:b,:,:", "a is no number"),
        (int, "1:2:3:4", "more than three parts"),
        (float, "1,2,3", "'1' is one position, and an interval has two ends"),
        (float, "1:2:3", "more than two ends"),
        (float, "3:1,:,:", "'3:1' ends before it begins"),
        (float, "nan:1", "'nan' is no position"),
        (float, "a:1", "'a' is no position"),
    ],
)
def test_intervals_of_another_form_say_why_and_the_form(
    number: type[int] | type[float], text: str, reason: str
) -> None:
    with pytest.raises(click.BadParameter, match="write z0:z1,y0:y1,x0:x1") as refused:
        IntervalsType(number).convert(text, None, None)
    assert reason in refused.value.message


@pytest.mark.parametrize("text", ["5", "-3", "-1", "2:4", ":", "2:", ":-1"])
def test_a_range_is_written_as_it_was_given(text: str) -> None:
    chosen = parse_slice(text)
    assert written(chosen.start, chosen.stop) == text


@pytest.mark.parametrize("text", ["soon", "2d", "-3s", "0s", "48h", ""])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match=r"is no time|allowed: 1s to 24h"):
        DurationType().convert(text, None, None)


Fhash = Callable[..., Result]


def commands() -> Iterator[click.Command]:
    """Every command, with those of the benches."""
    for name in COMMANDS:
        command = program.get_command(click.Context(program), name)
        assert command is not None
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


def test_options_are_few_and_each_is_named_in_a_document() -> None:
    root = Path(__file__).resolve().parents[2]
    text = "".join(path.read_text() for path in [root / "README.md", *root.glob("docs/*.md")])
    words = set(re.findall(r"--[a-z][a-z-]*", text))
    names = []
    for name in COMMANDS:
        command = program.get_command(click.Context(program), name)
        if command is not None and not isinstance(command, click.Group):  # all but the benches
            names += [(*p.opts, *p.secondary_opts) for p in command.params if p.opts[0][0] == "-"]
    assert len(names) <= 250
    assert not {word for each in names for word in each if word.startswith("--")} - words


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


SMALL = ["--effort", "1", "--quiet"]


@pytest.mark.parametrize("field", dataclasses.fields(EncodeConfig), ids=lambda field: field.name)
def test_every_setting_is_an_option_with_its_help_and_default(
    field: dataclasses.Field[object],
) -> None:
    option = next(param for param in encode.params if param.name == field.name)
    assert isinstance(option, click.Option)
    assert option.default == field.default
    assert option.help is not None
    assert option.help.rstrip(".").lower() == field.metadata["help"].lower()
    flag = "--" + (field.metadata["option"] or field.name).replace("_", "-")
    assert flag in option.opts
    if field.metadata["choices"]:
        assert isinstance(option.type, click.Choice)
        assert tuple(option.type.choices) == field.metadata["choices"]


def test_settings_reach_the_encoding_as_a_config() -> None:
    seen: list[EncodeConfig] = []

    from fhash_cli.options import config_options

    @click.command()
    @config_options()
    def probe(config: EncodeConfig) -> None:
        seen.append(config)

    probe.main([], standalone_mode=False)
    probe.main(
        [
            "--feature",
            "all",
            "--feature",
            "isosurface:2",
            "--no-timings",
            "--psnr",
            "40",
            "--effort",
            "2",
        ],
        standalone_mode=False,
    )
    assert seen == [
        EncodeConfig(),
        EncodeConfig(features=("all", "isosurface:2"), timings=False, psnr=40.0, effort=2),
    ]


@pytest.mark.parametrize("flag", ["--psnr", "--learning-rate"])
def test_settings_refuse_nan(flag: str) -> None:
    result = CliRunner().invoke(encode, ["data", "-o", "out.fhz", flag, "nan"])
    assert result.exit_code == 2


def test_an_option_that_counts_once_is_not_repeated(
    refused: Callable[..., str], data: Path, tmp_path: Path
) -> None:
    out = tmp_path / "a.fhz"
    message = refused(2, "encode", data, "-o", out, "--var", "a", "--var", "b")
    assert message.startswith(
        "--var is given more than once; a file RUN.fhz holds one variable, so encode each with a"
        " command of its own"
    )
    for option, value in (("--axes", "t,z,y,x"), ("--t", "0"), ("--endian", "big")):
        assert f"{option} is given more than once; give it once" in refused(
            2, "encode", data, "-o", out, option, value, option, value
        )


def test_select_and_missing(refused: Callable[..., str], data: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.fhz"
    for words, text in (
        (["--select", "member"], "'member' is not NAME=INDEX"),
        (["--select", "a=1", "--select", "a=2"], "--select a is given twice"),
        (["--select", "member=0"], "density has no dimension 'member'; its dimensions are time=3"),
        (["--missing", "none"], "'none' is not a number"),
    ):
        assert text in refused(2, "encode", data, "-o", out, *words)


def test_a_fill_value_that_nobody_declared(
    fhash: Callable[..., Result], refused: Callable[..., str], tmp_path: Path
) -> None:
    values = np.linspace(270, 300, 4 * 5 * 6, dtype=np.float32).reshape(4, 5, 6)
    values[:2, :2] = 1e20
    np.save(tmp_path / "a.npy", values)
    words = ["encode", tmp_path / "a.npy", "-o", tmp_path / "a.fhz", *SMALL]
    message = refused(2, *words)
    assert "'a' has 1e+20 at 20 % of its vertices" in message
    assert "--missing 1e+20" in message
    assert "--keep-extremes" in message
    assert fhash(*words, "--keep-extremes").exit_code == 0
    assert fhash(*words, "--force", "--missing", "1e20").exit_code == 0
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        decoded = volume[0]
    assert np.isnan(decoded[:2, :2]).all()
    np.testing.assert_allclose(decoded[2:], values[2:], atol=1)
    measured = fhash("diff", tmp_path / "a.npy", tmp_path / "a.fhz", "--missing", "1e20", "--json")
    assert measured.exit_code == 0
