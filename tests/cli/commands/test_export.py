"""`fhash export --plain`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

import fhash_codec

Fhash = Callable[..., Result]
GOLDEN = Path(__file__).resolve().parents[2] / "golden" / "compact-mask.fhz"


def test_a_plain_file_is_written_and_described(fhash: Fhash, tmp_path: Path) -> None:
    plain = tmp_path / "plain.fhz"
    result = fhash("export", GOLDEN, "-o", plain, "--plain")
    assert result.exit_code == 0, result.output
    assert "arrays" in result.stdout
    report = json.loads(fhash("export", GOLDEN, "-o", plain, "--plain", "--force", "--json").stdout)
    with fhash_codec.open(plain) as volume:
        assert report == {
            "path": str(plain),
            "bytes": plain.stat().st_size,
            "source_bytes": GOLDEN.stat().st_size,
            "arrays": len(volume.container.arrays),
            "values": report["values"],
        }
    info = fhash("info", plain)
    assert info.exit_code == 0, info.output
    assert "parts/0.tables.level_1 to parts/0.tables.level_" in info.stdout
    assert "parts/0.occupancy.bits, bytes," in info.stdout
    assert fhash("verify", plain).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((GOLDEN, "-o", "{}/plain.fhz"), "--plain"),
        ((GOLDEN, "-o", "{}/taken.fhz", "--plain"), "exists"),
        (("{}/absent.fhz", "-o", "{}/plain.fhz", "--plain"), "no such file"),
        ((GOLDEN, "-o", "{}/plain.vti", "--plain"), "ends in .fhz"),
        ((GOLDEN, "-o", "{}/nowhere/plain.fhz", "--plain"), "nowhere"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(
    fhash: Fhash, tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    (tmp_path / "taken.fhz").write_bytes(b"mine")
    result = fhash("export", *(str(word).replace("{}", str(tmp_path)) for word in arguments))
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert (tmp_path / "taken.fhz").read_bytes() == b"mine"
    assert [file.name for file in tmp_path.iterdir()] == ["taken.fhz"]
