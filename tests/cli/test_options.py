"""Options that commands share, and their types."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import click
import h5py
import numpy as np
import pytest
import xarray
from click.testing import CliRunner
from command_line import Fhash, Refused
from reference_pages import commands

import fhash_codec
from fhash_cli.commands.encode import command as encode
from fhash_cli.main import COMMANDS, program
from fhash_cli.options import (
    DURATION,
    GROUPS,
    SLICE,
    BaseCommand,
    IntervalsType,
    parse_slice,
    written,
)
from fhash_cli.selection import region_of_box
from fhash_cli.variables import config_of, configs_of
from fhash_codec.config import EncodeConfig
from fhash_formats.errors import InputError, RegionError
from fhash_formats.series import Coordinate

WHOLE = (None, None)
ALL = tuple(command for _, command in commands())
"""Every command, with those of the benches."""
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
        SLICE.convert(text, None, None)
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
        DURATION.convert(text, None, None)


def sections(fhash: Fhash, command: str) -> dict[str, str]:
    """The help of a command by the headings of its groups."""
    text = fhash(*command.split(), "--help").stdout
    parts = [part.partition(":\n") for part in text.split("\n\n")]
    return {title.strip(): rows for title, _, rows in parts if rows.startswith("  -")}


@pytest.mark.parametrize("command", ALL, ids=lambda command: str(command.name))
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


@pytest.mark.parametrize("command", ALL, ids=lambda command: str(command.name))
def test_help_has_examples_that_are_commands(fhash: Fhash, command: click.Command) -> None:
    lines = (command.epilog or "").splitlines()
    assert any(f"fhash {command.name}" in line.replace("bench ", "") for line in lines)
    for line in lines:
        assert len(line) <= 96
        words = re.search(r"fhash ([^)]*)", line)
        assert words
        assert fhash(*shlex.split(words[1]), "--help").exit_code == 0
    assert "130 interrupted" in command.get_help(click.Context(command))


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


def test_options_are_few() -> None:
    names = []
    for name in COMMANDS:
        command = program.get_command(click.Context(program), name)
        if command is not None and not isinstance(command, click.Group):  # all but the benches
            names += [p.name for p in command.params if isinstance(p, click.Option)]
    assert len(names) <= 256


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
    refused: Refused, words: list[str], option: str
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
    flag = f"--{EncodeConfig.label(field)}"
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


def test_select_and_missing(refused: Refused, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.fhz"
    for words, text in (
        (["--select", "member"], "'member' is not NAME=INDEX"),
        (["--select", "a=1", "--select", "a=2"], "--select a is given twice"),
        (["--select", "member=0"], "density has no dimension 'member'; its dimensions are time=3"),
        (["--missing", "none"], "'none' is not a number"),
    ):
        assert text in refused(2, "encode", data, "-o", out, *words)


def test_a_fill_value_that_nobody_declared(fhash: Fhash, refused: Refused, tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("positions", "box", "expected"),
    [
        ([0.0, 5.0, 1.0, 6.0], (0.5, 2.0), (2, 3)),
        ([0.0, 5.0, 1.0, 6.0], (0.0, 6.0), (0, 4)),
        ([0.0, 5.0, 1.0, 6.0], (0.0, 1.0), None),
        ([0.0, 1.0, 1.0, 2.0], (1.0, 1.0), (1, 3)),
        ([3.0, 2.0, 1.0, 0.0], (1.0, 2.0), (1, 3)),
    ],
)
def test_a_box_never_gives_vertices_outside_it(
    positions: list[float], box: tuple[float, float], expected: tuple[int, int] | None
) -> None:
    coordinate = Coordinate(name="x", values=np.array(positions))
    volume = cast(
        fhash_codec.Volume,
        SimpleNamespace(coords={"x": coordinate, "y": coordinate, "z": coordinate}),
    )
    if expected is None:
        with pytest.raises(RegionError, match=r"neither ascend nor descend.*--roi"):
            region_of_box(volume, [(None, None), (None, None), box])
    else:
        assert region_of_box(volume, [(None, None), (None, None), box])[2] == expected


def test_a_box_outside_by_little_says_by_how_much() -> None:
    coordinate = Coordinate(name="x", values=347921.0 + np.arange(3) / 1000)
    volume = cast(fhash_codec.Volume, SimpleNamespace(coords=dict.fromkeys("zyx", coordinate)))
    with pytest.raises(
        RegionError, match=r"347921:347921\.003; the domain has positions 347921 to 347921\.002"
    ):
        region_of_box(volume, [(347921.0, 347921.003), (None, None), (None, None)])


SHAPE = (3, 6, 7, 8)


def values(scale: float) -> np.ndarray:
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    return (scale * np.sin(0.3 * (x + y) + t) + z).astype(np.float32)


@pytest.fixture(scope="module")
def data_variables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two variables of four axes, one of five, and numbers along one."""
    path = tmp_path_factory.mktemp("several") / "data.h5"
    with h5py.File(path, "w") as file:
        file["u"], file["v"] = values(1), values(2)
        file["members"] = np.stack([values(1)] * 2)
        file["numbers"] = np.arange(3.0)
        file["u"].attrs["units"] = "m s-1"
    return path


@pytest.fixture(scope="module")
def run_variables(data_variables: Path) -> Path:
    path = data_variables.with_name("run.fhz")
    config = fhash_codec.EncodeConfig(effort=1, max_error=0.01)
    fhash_codec.encode_dataset(data_variables, path, config, variables=["u", "v"])
    return path


def test_all_takes_what_can_be_encoded_as_it_is(
    fhash: Fhash, data_variables: Path, tmp_path: Path
) -> None:
    path = tmp_path / "run.fhz"
    words = ["encode", data_variables, "-o", path, "--effort", 1]
    result = fhash(*words, "--var", "all", "--max-error", "u=0.1,v=0.2")
    assert result.exit_code == 0
    assert (
        f"--var all makes no variables of members, numbers; fhash info {data_variables} says why"
        in result.stderr
    )
    rows = [line.split() for line in result.stdout.splitlines() if line[:1] in ("u", "v")]
    assert [row[0] for row in rows] == ["variable", "u", "v"]
    info = json.loads(fhash("info", path, "--json").stdout)
    bounds = {name: each["config"]["max_error"] for name, each in info["variables"].items()}
    assert bounds == {"u": 0.1, "v": 0.2}
    assert info["bytes"] == path.stat().st_size


def test_components_become_variables(fhash: Fhash, data_variables: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    words = ["encode", data_variables, "-o", path, *SMALL, "--components", "dim0", "--json"]
    result = fhash(*words, "--max-error", "members_1=0.5")
    assert list(json.loads(result.stdout)["variables"]) == ["members_0", "members_1"]
    report = json.loads(fhash("info", path, "--json").stdout)["variables"]
    assert report["members_1"]["config"]["max_error"] == 0.5
    assert report["members_0"]["variable"]["name"] == "members"
    difference = ["diff", data_variables, path, "--var", "members", "--select", "dim0=1", "--json"]
    assert json.loads(fhash(*difference).stdout)["max_abs_error"] <= 0.5
    result = fhash(*words, "--var", "all", "--force")
    assert list(json.loads(result.stdout)["variables"]) == [
        *(f"members_{n}" for n in range(2)),
        "u",
        "v",
    ]
    result = fhash(*words, "--var", "u,members", "--force")
    assert list(json.loads(result.stdout)["variables"]) == ["u", "members_0", "members_1"]


def test_decode_and_render_take_one(fhash: Fhash, run_variables: Path, tmp_path: Path) -> None:
    assert fhash("decode", run_variables, "--var", "v", "-o", tmp_path / "v.npy").exit_code == 0
    assert np.abs(np.load(tmp_path / "v.npy") - values(2)).max() <= 0.01
    picture = tmp_path / "v.png"
    words = ["render", run_variables, "--size", "16x16", "-o", picture]
    assert fhash(*words, "--var", "v").exit_code == 0
    assert picture.exists()


def test_diff_compares_one_with_its_data(
    fhash: Fhash, run_variables: Path, data_variables: Path
) -> None:
    for name in "uv":
        words = [
            "diff",
            data_variables,
            run_variables,
            "--var",
            name,
            "--max-error",
            0.01,
            "--json",
        ]
        result = fhash(*words)
        assert result.exit_code == 0
        assert json.loads(result.stdout)["max_abs_error"] <= 0.01
        assert json.loads(result.stdout)["differences"] == []


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
@pytest.mark.parametrize("names", [None, "v, u", "v"])
def test_decode_writes_all_or_those_that_are_named_into_one_output(
    fhash: Fhash, run_variables: Path, tmp_path: Path, suffix: str, names: str | None
) -> None:
    path = tmp_path / f"out{suffix}"
    words = ["decode", run_variables, "-o", path, "--t", "1:", "--json"]
    result = fhash(*words, *([] if names is None else ["--var", names]))
    assert result.exit_code == 0
    told, chosen = json.loads(result.stdout), ["u", "v"] if names != "v" else ["v"]
    parts = told["variables"] if len(chosen) > 1 else {"v": told}
    assert told["paths"] == [str(path)]
    assert sorted(parts) == chosen
    with fhash_codec.open(run_variables) as dataset:
        for name in chosen:
            expected = dataset[name][1:]
            assert parts[name]["shape"] == list(expected.shape)
            assert parts[name]["max"] == expected.max()
            if suffix == ".h5":
                with h5py.File(path) as file:
                    found = np.asarray(file[name])
            else:
                engine = "zarr" if suffix == ".zarr" else "h5netcdf"
                with xarray.open_dataset(path, engine=engine, decode_times=False) as data_variables:
                    found = np.asarray(data_variables[name])
            np.testing.assert_array_equal(found.reshape(expected.shape), expected)


def test_decode_refuses_what_one_output_cannot_hold(
    refused: Refused, run_variables: Path, tmp_path: Path
) -> None:
    path = tmp_path / "out.npy"
    assert "holds one variable, and there are 2" in refused(2, "decode", run_variables, "-o", path)
    surface = ["--isosurface", 1, "-o", tmp_path / "out.ply"]
    assert "several variables, u, v; choose one" in refused(2, "decode", run_variables, *surface)
    message = refused(2, "decode", run_variables, "--var", "u,w", "-o", tmp_path / "out.nc")
    assert "has no variable 'w'; it holds u, v" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["render", "diff", "export"])
def test_a_variable_must_be_named(
    refused: Refused, run_variables: Path, data_variables: Path, tmp_path: Path, command: str
) -> None:
    words = {
        "diff": [data_variables, run_variables],
        "export": [run_variables, "--plain", "-o", tmp_path / "plain.fhz"],
    }
    message = refused(2, command, *words.get(command, [run_variables]))
    assert "holds several variables, u, v; choose one" in message
    if command != "export":
        message = refused(2, command, *words.get(command, [run_variables]), "--var", "w")
        assert "has no variable 'w'; it holds u" in message


BAD = {
    "a name twice": (["--var", "u,u"], "has 'u' where another name"),
    "an empty name": (["--var", "u,"], "has '' where another name"),
    "an unknown variable": (["--var", "u,q"], "no variable 'q'"),
    "one that needs a choice": (["--var", "u,members"], "members"),
    "a promise for no variable": (
        ["--var", "u,v", "--psnr", "q=40"],
        "--psnr names q, which is none of the variables u, v",
    ),
    "a promise by name for one": (["--var", "u", "--psnr", "u=40"], "give the number alone"),
    "a promise twice": (["--var", "u,v", "--psnr", "u=40,u=41"], "for each name once"),
    "a promise that is no number": (["--var", "u,v", "--psnr", "u=a"], "not a valid"),
    "a promise beyond its range": (["--var", "u,v", "--psnr", "u=-1"], "not in the range"),
    "two promises for one": (
        ["--var", "u,v", "--psnr", "u=40", "--max-error", "u=1"],
        "promise one of them",
    ),
    "components of no dimension": (["--components", "dim9"], "no variable has that dimension"),
    "an axis as components": (["--components", "t"], "no variable has that dimension"),
    "a budget": (["--var", "u,v", "--time-budget", "9s"], "are for one variable"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_commands(refused: Refused, data_variables: Path, tmp_path: Path, case: str) -> None:
    words, message = BAD[case]
    output = tmp_path / "run.fhz"
    assert message in refused(2, "encode", data_variables, "-o", output, *SMALL, *words)
    assert list(tmp_path.iterdir()) == []


def settings(**given: object) -> dict[str, object]:
    promises = ("psnr", "psnr_bulk", "max_error", "max_error_rel", "ratio")
    return {**dict.fromkeys(promises), **given}


def test_a_promise_by_name_stands_in_place_of_those_for_all() -> None:
    configs = configs_of(settings(psnr=50.0, max_error={"v": 0.5}, effort=3), ["u", "v"])
    assert [(c.psnr, c.max_error, c.effort) for c in configs.values()] == [
        (50, None, 3),
        (None, 0.5, 3),
    ]
    (config,) = configs_of(settings(psnr={"u": 40.0}, psnr_bulk={"u": 30.0}), ["u"]).values()
    assert (config.psnr, config.psnr_bulk) == (40, 30)
    assert config_of(settings(ratio=8.0)).ratio == 8
    with pytest.raises(InputError, match="number for u"):
        config_of(settings(ratio={"u": 8.0}))
