"""Settings: the round trip, and a clear error for each value that is not allowed."""

import json

import numpy as np
import pytest

from fhash_codec.config import EncodeConfig
from fhash_formats.errors import InputError


@pytest.mark.parametrize(
    "config",
    [
        EncodeConfig(),
        EncodeConfig(
            features=("interval:0:1", "isosurface:3"), max_error=0.5, effort=3, tile="4x8x8x8"
        ),
        EncodeConfig(profile="paper", key_frames="0,4,9", psnr=45.0, epochs=0, learning_rate=1e-3),
    ],
    ids=["default", "changed", "paper"],
)
def test_from_dict_of_to_dict_is_the_same_even_through_json(config) -> None:
    assert EncodeConfig.from_dict(config.to_dict()) == config
    assert EncodeConfig.from_dict(json.loads(json.dumps(config.to_dict()))) == config


def test_an_unknown_name_is_refused_and_the_nearest_is_offered() -> None:
    with pytest.raises(InputError, match=r"'learning_rat'.*'learning_rate'"):
        EncodeConfig.from_dict({"learning_rat": 0.1})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"engine": "warp"}, "engine is 'warp'; allowed: auto, fused, native, slab"),
        (
            {"profile": "paper", "max_error": 1.0},
            "max-error belongs to --profile compact; the profile is paper",
        ),
        ({"profile": "paper", "max_error_rel": 0.1}, "max-error-rel belongs to --profile compact"),
        ({"profile": "paper", "ratio": 9.0}, "ratio belongs to --profile compact"),
        ({"profile": "paper", "effort": 1}, "effort belongs to --profile compact"),
        ({"profile": "paper", "tile": "whole"}, "tile belongs to --profile compact"),
        ({"key_frames": [0, 2]}, "key-frames belongs to --profile paper; the profile is compact"),
        *(
            ({name: value}, f"{name.replace('_', '-')} belongs to --profile paper")
            for name, value in {
                "fold": 3,
                "embedding_size": 1,
                "hidden_layers": 3,
                "width": 8,
                "epochs": 1,
                "learning_rate": 0.1,
                "schedule": "constant",
                "batch": 64,
                "tables": "uint8",
                "engine": "slab",
            }.items()
        ),
        (
            {"psnr": 40.0, "max_error": 1.0, "ratio": 3.0},
            "psnr and max-error and ratio are given; promise one of them",
        ),
        ({"psnr_bulk": 40.0, "max_error": 1.0}, "psnr-bulk and max-error are given; promise one"),
        ({"psnr_bulk": 401.0}, "psnr-bulk is 401"),
        ({"effort": 2.5}, "effort is 2.5; a whole number"),
        ({"fold": 1}, "fold is 1; allowed: 2 to 64"),
        ({"fold": 2.5}, "fold is 2.5; a whole number"),
        ({"epochs": True}, "epochs is True"),
        ({"epochs": "many"}, "epochs is many"),
        ({"learning_rate": float("nan")}, "learning-rate is nan"),
        ({"psnr": -1.0}, "psnr is -1"),
        ({"features": ()}, "feature is empty"),
        ({"dilation": -1}, "dilation is -1"),
        ({"without": ("heads",)}, "without names 'heads'; did you mean 'head'"),
        (
            {"profile": "paper", "without": "head"},
            "without names 'head', a stage of --profile compact",
        ),
    ],
)
def test_a_value_that_is_not_allowed_is_named_with_what_is(values, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        EncodeConfig.from_dict(values)
    assert "\n" not in str(caught.value)


def test_settings_may_be_given_as_python_values() -> None:
    assert EncodeConfig(features="all").features == ("all",)
    assert EncodeConfig(profile="paper", key_frames=[0, 3]).key_frames == "0,3"
    with pytest.raises(InputError, match="mask="):
        EncodeConfig(features=(np.ones(3, bool),))
