"""Names of any kind in a source: commands print them on one line, and every format takes them."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from command_line import Fhash

pytestmark = pytest.mark.filterwarnings("default::fhash_formats.errors.FhashWarning")
VALUES = np.arange(2 * 3 * 4 * 5, dtype=np.float32).reshape(2, 3, 4, 5) + 1
QUICK = ["--max-error", "0.01", "--effort", "1", "-q", "--force"]
NAMES = [
    "zeta ",
    " ",
    "a/b",
    "..",
    "a\nb",
    "__x",
    "zarr.json",
    "y" * 300,
    "table_1",
    "\u03be",
    "%d",
]


@pytest.mark.parametrize("name", NAMES, ids=map(ascii, NAMES))
@pytest.mark.parametrize("role", ["dimension", "variable"])
def test_every_output_takes_the_names(tmp_path: Path, fhash: Fhash, name: str, role: str) -> None:
    source, run = tmp_path / "a.zarr", tmp_path / "a.fhz"
    names = ["time", name if role == "dimension" else "z", "y", "x"]
    group = zarr.open_group(source, mode="w", zarr_format=2)
    inner = (
        name if role == "variable" and len(name) < 200 and name not in (" ", "..", "a/b") else "u"
    )
    try:
        made = group.create_array(inner, shape=VALUES.shape, dtype="f4", chunks=VALUES.shape)
    except ValueError:
        pytest.skip("zarr refuses the name")
    made[...] = VALUES
    made.attrs["_ARRAY_DIMENSIONS"] = names
    assert fhash("encode", source, "-o", run, *QUICK).exit_code == 0
    for suffix in ("nc", "zarr", "h5", "npy", "pvd", "vtkhdf"):
        out = tmp_path / f"out.{suffix}"
        result = fhash("decode", run, "-o", out, "-q")
        assert result.exit_code == 0, result.stderr
    for engine, suffix in (("h5netcdf", "nc"), ("zarr", "zarr")):
        more = {"consolidated": False} if suffix == "zarr" else {}
        with xr.open_dataset(tmp_path / f"out.{suffix}", engine=engine, **more) as dataset:
            (found,) = (each for each in dataset.data_vars.values() if each.ndim == 4)
            np.testing.assert_allclose(found, VALUES, atol=0.01)


def test_names_forge_no_line(tmp_path: Path, fhash: Fhash) -> None:
    source, run = tmp_path / "a.h5", tmp_path / "a.fhz"
    evil = "u\nsize  1 B\x1b[2J\u202e"
    with h5py.File(source, "w") as file:
        data = file.create_dataset(evil, data=VALUES)
        data.attrs["units"], data.attrs["a\nb"] = "K\nforged", "x\r\nforged"
        for number, name in enumerate(("t", "z\nforged", "y", "x")):
            data.dims[number].label = name
        file["s\nforged"] = 1.0
        file["gone\nforged"] = h5py.SoftLink("/no\nforged")
    encoded = fhash("encode", source, "-o", run, *QUICK)
    assert encoded.exit_code == 0, encoded.stderr
    for words in (
        ["info", source],
        ["info", source, "--var", evil],
        ["info", run],
        ["info", run, "-v"],
        ["diff", source, run, "-q"],
        ["decode", run, "-q"],
        ["verify", run, "-q"],
        ["info", source, "--var", "no\nforged"],
        ["encode", source, "-o", run, "-v", "--var", "all", *QUICK],
    ):
        result = fhash(*words)
        for text in (result.stdout, result.stderr):
            assert "\x1b" not in text
            assert "\u202e" not in text
            assert "\r" not in text
            for line in text.splitlines():
                assert not line.startswith(("forged", "size  1 B")), (words, line)
