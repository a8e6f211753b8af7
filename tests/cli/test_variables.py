"""Several variables in one file, by every command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray
from click.testing import Result

import fhash_codec
from fhash_cli.variables import config_of, configs_of
from fhash_formats.errors import InputError

Fhash = Callable[..., Result]
SMALL = ["--effort", "1", "--quiet"]
SHAPE = (3, 6, 7, 8)


def values(scale: float) -> np.ndarray:
    t, z, y, x = np.meshgrid(*map(np.arange, SHAPE), indexing="ij", sparse=True)
    return (scale * np.sin(0.3 * (x + y) + t) + z).astype(np.float32)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two variables of four axes, one of five, and numbers along one."""
    path = tmp_path_factory.mktemp("several") / "data.h5"
    with h5py.File(path, "w") as file:
        file["u"], file["v"] = values(1), values(2)
        file["members"] = np.stack([values(1)] * 2)
        file["numbers"] = np.arange(3.0)
        file["u"].attrs["units"] = "m s-1"
    return path


@pytest.fixture(scope="module")
def run(data: Path) -> Path:
    path = data.with_name("run.fhz")
    config = fhash_codec.EncodeConfig(effort=1, max_error=0.01)
    fhash_codec.encode_dataset(data, path, config, variables=["u", "v"])
    return path


def test_all_takes_what_can_be_encoded_as_it_is(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    words = ["encode", data, "-o", path, "--effort", 1]
    result = fhash(*words, "--var", "all", "--max-error", "u=0.1,v=0.2")
    assert result.exit_code == 0
    assert (
        f"--var all makes no variables of members, numbers; fhash info {data} says why"
        in result.stderr
    )
    rows = [line.split() for line in result.stdout.splitlines() if line[:1] in ("u", "v")]
    assert [row[0] for row in rows] == ["variable", "u", "v"]
    info = json.loads(fhash("info", path, "--json").stdout)
    bounds = {name: each["config"]["max_error"] for name, each in info["variables"].items()}
    assert bounds == {"u": 0.1, "v": 0.2}
    assert info["bytes"] == path.stat().st_size


def test_components_become_variables(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.fhz"
    words = ["encode", data, "-o", path, *SMALL, "--components", "dim0", "--json"]
    result = fhash(*words, "--max-error", "members_1=0.5")
    assert list(json.loads(result.stdout)["variables"]) == ["members_0", "members_1"]
    report = json.loads(fhash("info", path, "--json").stdout)["variables"]
    assert report["members_1"]["config"]["max_error"] == 0.5
    assert report["members_0"]["variable"]["name"] == "members"
    difference = ["diff", data, path, "--var", "members", "--select", "dim0=1", "--json"]
    assert json.loads(fhash(*difference).stdout)["max_abs_error"] <= 0.5
    result = fhash(*words, "--var", "all", "--force")
    assert list(json.loads(result.stdout)["variables"]) == [
        *(f"members_{n}" for n in range(2)),
        "u",
        "v",
    ]
    result = fhash(*words, "--var", "u,members", "--force")
    assert list(json.loads(result.stdout)["variables"]) == ["u", "members_0", "members_1"]


def test_decode_and_render_take_one(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    assert fhash("decode", run, "--var", "v", "-o", tmp_path / "v.npy").exit_code == 0
    assert np.abs(np.load(tmp_path / "v.npy") - values(2)).max() <= 0.01
    picture = tmp_path / "v.png"
    words = ["render", run, "--size", "16x16", "-o", picture]
    assert fhash(*words, "--var", "v").exit_code == 0
    assert picture.exists()


def test_diff_compares_one_with_its_data(fhash: Fhash, run: Path, data: Path) -> None:
    for name in "uv":
        words = ["diff", data, run, "--var", name, "--max-error", 0.01, "--json"]
        result = fhash(*words)
        assert result.exit_code == 0
        assert json.loads(result.stdout)["max_abs_error"] <= 0.01
        assert json.loads(result.stdout)["differences"] == []


@pytest.mark.parametrize("suffix", [".h5", ".nc", ".zarr"])
@pytest.mark.parametrize("names", [None, "v, u", "v"])
def test_decode_writes_all_or_those_that_are_named_into_one_output(
    fhash: Fhash, run: Path, tmp_path: Path, suffix: str, names: str | None
) -> None:
    path = tmp_path / f"out{suffix}"
    words = ["decode", run, "-o", path, "--t", "1:", "--json"]
    result = fhash(*words, *([] if names is None else ["--var", names]))
    assert result.exit_code == 0
    told, chosen = json.loads(result.stdout), ["u", "v"] if names != "v" else ["v"]
    parts = told["variables"] if len(chosen) > 1 else {"v": told}
    assert told["paths"] == [str(path)]
    assert sorted(parts) == chosen
    with fhash_codec.open(run) as dataset:
        for name in chosen:
            expected = dataset[name][1:]
            assert parts[name]["shape"] == list(expected.shape)
            assert parts[name]["max"] == expected.max()
            if suffix == ".h5":
                with h5py.File(path) as file:
                    found = np.asarray(file[name])
            else:
                engine = "zarr" if suffix == ".zarr" else "h5netcdf"
                with xarray.open_dataset(path, engine=engine, decode_times=False) as data:
                    found = np.asarray(data[name])
            np.testing.assert_array_equal(found.reshape(expected.shape), expected)


def test_decode_refuses_what_one_output_cannot_hold(
    refused: Callable[..., str], run: Path, tmp_path: Path
) -> None:
    path = tmp_path / "out.npy"
    assert "holds one variable, and there are 2" in refused(2, "decode", run, "-o", path)
    surface = ["--isosurface", 1, "-o", tmp_path / "out.ply"]
    assert "several variables, u, v; choose one" in refused(2, "decode", run, *surface)
    message = refused(2, "decode", run, "--var", "u,w", "-o", tmp_path / "out.nc")
    assert "has no variable 'w'; it holds u, v" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["render", "diff", "export"])
def test_a_variable_must_be_named(
    refused: Callable[..., str], run: Path, data: Path, tmp_path: Path, command: str
) -> None:
    words = {"diff": [data, run], "export": [run, "--plain", "-o", tmp_path / "plain.fhz"]}
    message = refused(2, command, *words.get(command, [run]))
    assert "holds several variables, u, v; choose one" in message
    if command != "export":
        message = refused(2, command, *words.get(command, [run]), "--var", "w")
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
def test_bad_commands(refused: Callable[..., str], data: Path, tmp_path: Path, case: str) -> None:
    words, message = BAD[case]
    output = tmp_path / "run.fhz"
    assert message in refused(2, "encode", data, "-o", output, *SMALL, *words)
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
