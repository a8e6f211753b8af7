"""The card of a file as `fhash info` prints it, short and with every part."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

GOLDEN = Path(__file__).resolve().parents[1] / "golden"


def added(line: str) -> bool:
    """Whether a line is one that only -v prints: a setting, a level or a layer."""
    return line.startswith("  ") and line.split()[0] not in "tzyx"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "paper-feature",
            ["parts/0.tables.level_1 to parts/0.tables.level_", "bytes,",
             "parts/0.mlp.weight_1 to parts/0.mlp.weight_2",
             "relu", "parts/0.occupancy.bits, bytes,"],
        ),
        ("paper-transform", ["fhash.transform", "parts/0.occupancy.mask, fhash.transform,"]),
        ("paper-sparse", ["; 2 at each needed vertex, float16; parts/0.tables.level_1 to parts/"]),
        ("compact-psnr", ["density, fhash.transform,", "none: the values"]),
        ("compact-mask", ["in the tiles of density"]),
        (
            "compact-cross",
            ["; packed in the codec of density", "in the tiles of density"],
        ),
    ],
)  # fmt: skip
def test_the_card_names_every_part_with_its_place(
    fhash: Callable[..., Result], name: str, said: list[str]
) -> None:
    path = GOLDEN / f"{name}.fhz"
    short = fhash("info", path).stdout
    for row in ("config ", "tables ", "MLP ", "occupancy "):
        assert f"\n{row}" in short
    for text in said:
        assert text in short
    card = json.loads(fhash("info", path, "--json").stdout)["card"]
    full = fhash("info", path, "-v").stdout
    assert [line.split() for line in short.splitlines() if not added(line)] == [
        line.split() for line in full.splitlines() if not added(line)
    ]
    assert full.count("\n  level ") == len(card["tables"])
    assert full.count("\n  layer ") == len(card["mlp"])
    assert "\n  learning_rate  " in full
    assert "\n  level " not in short


def test_bytes_of_the_parts_are_those_of_the_arrays(fhash: Callable[..., Result]) -> None:
    info = json.loads(fhash("info", GOLDEN / "paper-transform.fhz", "--json").stdout)
    card, arrays = info["card"], info["arrays"]
    parts = [*card["tables"], *card["mlp"], card["occupancy"]]
    stored = sum(
        array["bytes"]
        for name, array in arrays.items()
        if name.startswith(("parts/0.tables.", "parts/0.mlp.", "parts/0.occupancy."))
    )
    assert sum(part["bytes"] for part in parts) == stored
    assert 0 < card["config"]["bytes"] < info["bytes"]
