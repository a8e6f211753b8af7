"""Values on the command line: their forms, and an option for every setting of an encoding."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner, Result

import fhash_codec
from fhash_cli.commands.encode import command as encode
from fhash_cli.options import RealRange
from fhash_codec.config import EncodeConfig

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


@pytest.mark.parametrize("text", ["nan", "NaN", "-1", "0.05", "3601", "-inf", "inf"])
def test_numbers_are_within_their_limits(text: str) -> None:
    assert RealRange(0.1, 3600).convert("12", None, None) == 12
    with pytest.raises(click.BadParameter):
        RealRange(0.1, 3600).convert(text, None, None)


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
