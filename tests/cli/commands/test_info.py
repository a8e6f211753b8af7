"""`fhash info`."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Fhash, Refused

from fhash_cli.commands.info import between_text, listing
from fhash_formats.readers.listing import Listed

GOLDEN = Path(__file__).resolve().parents[2] / "golden"


def added(line: str) -> bool:
    """Whether a line is one that only -v prints: a setting, a level or a layer."""
    return line.startswith("  ") and line.split()[0] not in "tzyx"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "paper-feature",
            ["between steps", "network",
             "table_1 to table_", "bytes,",
             "mlp/weight_1 to mlp/weight_2",
             "relu", "; occupancy, bytes,"],
        ),
        ("paper-transform", ["fhash.transform", "in the tiles of coreset"]),
        ("paper-sparse", ["; 2 at each needed vertex, float16; table_1 to table_"]),
        ("compact-psnr", ["table_1, fhash.transform,", "none: the values"]),
        ("compact-mask", ["in the tiles of table_1"]),
        ("compact-cubic", ["cubic (measured: 1.3 dB better than linear"]),
        (
            "compact-linear",
            ["; whole numbers in the header", "in the tiles of table_1"],
        ),
    ],
)  # fmt: skip
def test_the_card_names_every_part_with_its_place(fhash: Fhash, name: str, said: list[str]) -> None:
    path = GOLDEN / f"{name}.fhz"
    short = fhash("info", path).stdout
    for row in ("config ", "tables ", "MLP ", "occupancy "):
        assert f"\n{row}" in short
    for text in said:
        assert text in short
    report = json.loads(fhash("info", path, "--json").stdout)
    card, parts = report["card"], report["split"]
    assert sum(parts.values()) == report["bytes"] == path.stat().st_size
    listed = [name for name in parts if parts[name]]
    assert re.findall(r"(\w+) [0-9.]+ k?B", short.split("\nsplit ")[1].split("\n")[0]) == listed
    full = fhash("info", path, "-v").stdout
    assert [line.split() for line in short.splitlines() if not added(line)] == [
        line.split() for line in full.splitlines() if not added(line)
    ]
    assert full.count("\n  level ") == len(card["tables"])
    assert full.count("\n  layer ") == len(card["mlp"])
    assert "\n  features  " in full
    assert "\n  level " not in short


def entry(name: str, *readings: str, missing: tuple[float, ...] = ()) -> Listed:
    """A variable whose readings need these options."""
    options = tuple(("--var", name, *each.split()) for each in readings)
    problem = "" if readings else "1 dimensions (2,); 2 to 4 can be read"
    shape = (2, 2) if readings else (2,)
    kinds = (("time", "t"), ("x", "x"))[: len(shape)]
    return Listed(
        name=name,
        shape=shape,
        dtype="float32",
        dimensions=kinds,
        options=options,
        missing=missing,
        problem=problem,
        output=f"{name}.fhz",
    )


def test_one_table_and_one_command_for_all_that_is_read_alike() -> None:
    lines = listing("a b.nc", 3, [entry("u", ""), entry("w"), entry("v", "")]).splitlines()
    assert lines == [
        "a b.nc (3 files; shapes are of the first): 2 variables to encode",
        "",
        "variable  type     dimensions",
        "u         float32  time=2 (t), x=2",
        "v         float32  time=2 (t), x=2",
        "",
        "fhash encode 'a b.nc' -o 'a b.fhz' --var all",
        "",
        "not to be encoded: w (2,): too few dimensions",
    ]


def test_what_differs_between_variables_has_a_column() -> None:
    fills = (1e20, 1.00000002004e20, -9.0)
    good = [entry("u", "--axes t,x", "--axes z,x"), entry("v", "--select m=0", missing=fills)]
    lines = listing("a.nc", 1, good).splitlines()
    assert lines[2:5] == [
        "variable  type     dimensions       missing    needs",
        "u         float32  time=2 (t), x=2             --axes t,x or --axes z,x",
        "v         float32  time=2 (t), x=2  1e+20, -9  --select m=0",
    ]
    assert lines[6:] == ["fhash encode a.nc -o v.fhz --var v --select m=0"]
    assert listing("a.nc", 1, good[:1]).splitlines()[5:] == [
        "fhash encode a.nc -o u.fhz --var u --axes t,x",
        "fhash encode a.nc -o u.fhz --var u --axes z,x",
    ]


def test_a_listing_is_for_one_screen() -> None:
    many = [entry(f"v{n}", "") for n in range(100)] + [entry(f"w{n}") for n in range(100)]
    text = listing("a.nc", 1, many)
    assert text.count("\n") < 36
    assert "and 76 more: v24, v25," in text
    assert "not to be encoded: w0 (2,), w1 (2,)" in text


PAPER = ["--preset=published", "--tables=float16", "--epochs", "1", "--width", "4", "--quiet"]


def test_info_says_what_the_file_holds(fhash: Fhash, run: Path) -> None:
    result = fhash("info", run)
    assert (result.exit_code, result.stderr) == (0, "")
    for text in (
        str(run),
        "density, float32, in kg m-3",
        "3 x 6 x 7 x 8",
        "time 0 to 4",
        "x 10 to 3",
        "interval:4:99",
        "F-Hash",
    ):
        assert text in result.stdout


def test_info_of_the_published_network_says_how_it_was_trained(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    assert fhash("encode", data, "-o", tmp_path / "run.fhz", *PAPER).exit_code == 0
    result = fhash("info", tmp_path / "run.fhz")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "F-Hash, the published network" in result.stdout
    assert "1 epochs" in result.stdout


@pytest.mark.filterwarnings("ignore:training diverged")
def test_info_says_that_a_training_diverged(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    wild = [
        "--preset",
        "published",
        "--tables",
        "float16",
        "--epochs",
        "3",
        "--width",
        "64",
        "--hidden-layers",
        "2",
        "--learning-rate",
        "1",
        "--quiet",
    ]
    assert fhash("encode", data, "-o", tmp_path / "run.fhz", *wild).exit_code == 0
    assert (
        "it diverged, and came to its end at a learning rate of 0."
        in fhash("info", tmp_path / "run.fhz").stdout
    )
    assert (
        json.loads(fhash("info", tmp_path / "run.fhz", "--json").stdout)["training"]["restarts"] > 0
    )


def test_info_of_data_lists_variables_and_their_commands(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    result = fhash("info", data)
    assert (result.exit_code, result.stderr) == (0, "")
    row = ["density", "float32", "time=3", "(t),", "z=6,", "y=7,", "x=8", "kg", "m-3"]
    assert row in [line.split() for line in result.stdout.splitlines()]
    with h5py.File(tmp_path / "flow data.h5", "w") as file:
        file["flow"] = np.ones((16, 12, 12, 3), "f4")
        file["ensemble"] = np.ones((2, 3, 4, 5, 6), "f4")
    listed = json.loads(fhash("info", tmp_path / "flow data.h5", "--json").stdout)
    ensemble, flow = listed["variables"]
    assert ensemble["dimensions"][0] == {"name": "dim0", "length": 2, "axis": "select"}
    assert [variable["problem"] for variable in (ensemble, flow)] == ["", ""]
    commands = ensemble["commands"] + flow["commands"]
    assert len(commands) == 3
    shapes = []
    for number, command in enumerate(commands):
        words = shlex.split(command)[1:]
        words[words.index("-o") + 1] = str(tmp_path / f"{number}.fhz")
        result = fhash(*words, "--effort", "1", "--quiet", "--json")
        assert result.exit_code == 0, result.stderr
        shapes.append(json.loads(result.stdout)["shape"])
    assert shapes == [[3, 4, 5, 6], [16, 12, 12, 3], [1, 16, 12, 12]]


def test_options_for_data_are_refused_for_a_run(refused: Refused, run: Path) -> None:
    refusal = refused(2, "info", run, "--missing", "-9")
    assert "is encoded already; --missing is for data" in refusal
    assert "no variable 'q'; it holds density" in refused(2, "info", run, "--var", "q")
    assert "--raw-values is for data" in refused(2, "info", run, "--raw-values")


def test_data_of_which_nothing_can_be_encoded(fhash: Fhash, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["line"] = np.ones(4)
    told = fhash("info", tmp_path / "a.h5")
    assert (told.exit_code, told.stderr.count("\n")) == (2, 1)
    assert "holds nothing that can be encoded" in told.stderr
    assert "line (4,)" in told.stdout
    result = json.loads(fhash("info", tmp_path / "a.h5", "--json").stdout)
    assert (result["exit_code"], result["variables"][0]["name"]) == (2, "line")


def several(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        for number, name in enumerate(["u", "w"]):
            file[name] = np.arange(4 * 3 * 2 * 5, dtype="f4").reshape(4, 3, 2, 5) * (number + 1)
            file[name].attrs.update({"units": "m/s", "long_name": f"speed {name}"})
        time = file.create_dataset("time", data=np.arange(4) * 6.0)
        time.attrs["units"] = "hours since 2001-02-03"
        time.make_scale("time")
        for name in ("u", "w"):
            file[name].dims[0].attach_scale(time)
        file["line"] = np.ones(4)
    return path


def test_info_of_one_variable_is_detailed(fhash: Fhash, tmp_path: Path) -> None:
    path = several(tmp_path / "a.h5")
    result = fhash("info", path, "--var", "w", "--t", "1:3")
    assert (result.exit_code, result.stderr) == (0, "")
    for text in (
        "w         float32  time=4 (t)",
        "--var w --t 1:3",
        "t, z, y, x  2 x 3 x 2 x 5",
        "time 2001-02-03T06:00 to 2001-02-03T12:00",
        "long_name   speed w",
    ):
        assert text in result.stdout
    assert "speed u" not in result.stdout
    assert "\nu " not in result.stdout
    parsed = json.loads(fhash("info", path, "--var", "w", "--json").stdout)
    assert [variable["name"] for variable in parsed["variables"]] == ["w"]
    assert parsed["series"]["coordinates"][0]["dates"] == ["2001-02-03", "2001-02-03T18:00"]
    whole = json.loads(fhash("info", path, "--json").stdout)
    assert "series" not in whole


def test_the_source_is_named_with_what_is_kept_beside(fhash: Fhash, tmp_path: Path) -> None:
    import xarray as xr

    source = xr.Dataset(
        {"u": (("lev", "lat", "lon"), np.arange(60.0).reshape(3, 4, 5))},
        {"lev": ("lev", np.arange(3.0)), "height": ((), 2.0)},
    )
    source.to_netcdf(tmp_path / "wind.nc", engine="h5netcdf")
    fhash("encode", tmp_path / "wind.nc", "-o", tmp_path / "a.fhz", "--effort", "1")
    printed = fhash("info", tmp_path / "a.fhz").stdout
    assert "wind.nc, SHA-256 " in printed
    assert "(lev, lat, lon); beside it height" in " ".join(printed.split())


@pytest.mark.parametrize(
    ("rule", "gain", "text"),
    [
        ("cubic", 1.84, "cubic (measured: 1.8 dB better than linear over left-out steps)"),
        ("linear", -0.6, "linear (measured: 0.6 dB better than cubic over left-out steps)"),
        ("linear", None, "linear"),
        ("network", None, "network"),
    ],
)
def test_the_rule_between_steps(rule: str, gain: float | None, text: str) -> None:
    assert between_text({"rule": rule, "gain_db": gain}) == text
