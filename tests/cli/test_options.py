"""Values on the command line: their forms, and an option for every setting of an encoding."""

from __future__ import annotations

import dataclasses

import click
import pytest
from click.testing import CliRunner

from fhash_cli.commands.encode import command as encode
from fhash_cli.options import RealRange
from fhash_codec.config import EncodeConfig


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
