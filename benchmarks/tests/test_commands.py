"""Commands of `fhash bench`: options, tables, JSON, and refusals in one line."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import click
import numpy as np
import pytest
from command_line import Fhash, Refused

from fhash_bench.commands.rate import PEER, Peer, filters_of, opened, programs_of
from fhash_bench.main import command
from fhash_bench.pictures import vtk
from fhash_bench.rate import generated as made
from fhash_bench.rate.measuring import PEERS
from fhash_codec.progress import silent
from fhash_formats.series import Series


def test_every_benchmark_is_named_in_the_help(fhash: Fhash) -> None:
    result = fhash("bench", "--help")
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.stdout.splitlines() if line.startswith("  ")]
    assert set(command.commands) <= set(listed)
    assert {"train", "rate", "render"} <= set(command.commands)


RATE = ["--preset", "published", "--epochs", "1", "--width", "4", "-q"]


def test_bench_rate_prints_one_json_object(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench",
        "rate",
        data,
        *["--target", "40", "--bound", "0.02", "--peer", "SZ3", "--peer", "Blosc"],
        *RATE,
        "--json",
    )
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    asked = {(point["codec"], point["goal"], point["asked"]) for point in report["points"]}
    assert asked == {
        (codec, *goal)
        for codec in ("SZ3", "Blosc", "fhash published")
        for goal in (("psnr", 40.0), ("bound", 0.02))
    }
    assert [row["peer"] for row in report["best_peers"]] == ["SZ3", "SZ3"]
    assert len(report["speeds"]) == 3
    assert report["shape"] == [3, 6, 7, 8]
    assert {"cores", "device"} <= set(report["machine"])


def test_bench_rate_prints_tables(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench",
        "rate",
        data,
        *["--t", ":2", "--target", "40", "--bound", "0.05", "--peer", "SZ3"],
        *RATE,
    )
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert lines[0].split("  ")[0] == "bytes"
    assert lines[0].endswith("best / fhash published")
    assert [line.split("  ")[0] for line in lines[1:3]] == ["40 dB", "within 5 %"]
    assert any(line.startswith("speed") for line in lines)
    assert any(line.startswith("6 x 7 x 8 of a step") for line in lines)
    assert any("float32 2 x 6 x 7 x 8" in line for line in lines)


def test_bench_rate_measures_size_alone_and_no_preset(fhash: Fhash, data: Path) -> None:
    result = fhash(
        "bench",
        "rate",
        data,
        *["--target", "40", "--peer", "ZFP", "--preset", "none", "--no-speed", "-q", "--json"],
    )
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert [point["codec"] for point in report["points"]] == ["ZFP"]
    assert report["speeds"] == report["access"] == report["tiles"] == []


def test_bench_rate_draws(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    picture = tmp_path / "rate.png"
    words = [
        "bench",
        "rate",
        data,
        *["--target", "40", "--peer", "SZ3", "--preset", "none", "--no-speed", "-q", "--plot"],
        picture,
    ]
    assert fhash(*words).exit_code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = fhash(*words)
    assert again.exit_code == 2
    assert "exists; use --force" in again.stderr


def test_bench_rate_refuses_what_is_unknown(
    refused: Refused, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "'zip' is no peer; allowed: SZ3, SPERR" in refused(
        2, "bench", "rate", data, "--peer", "zip"
    )
    assert "'tiny' is no preset; allowed: " in refused(2, "bench", "rate", data, "--preset", "tiny")
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    assert "fhash[bench]" in refused(2, "bench", "rate", data, "--target", "40")


def test_bench_rate_prices_tiles_and_takes_generated_series(fhash: Fhash) -> None:
    words = ("bench", "rate", "generated:long", "--target", "35", "--peer", "none", "--effort", "1")
    result = fhash(*words, "--preset", "default", "--no-speed", "-q", "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    (price,) = report["tiles"]
    assert price["steps"] == 600
    assert price["price"] == price["bytes"] / price["one_tile_bytes"]
    assert price["bytes"] == report["points"][0]["bytes"]
    assert "is no generated series" in fhash("bench", "rate", "generated:no").stderr
    assert "--var is for DATA" in fhash("bench", "rate", "generated:long", "--var", "a").stderr


def test_made_series_make_a_table(fhash: Fhash) -> None:
    result = fhash("bench", "labels", "--kind", "tiny grid", "--effort", "1", "-q")
    assert (result.exit_code, result.stderr) == (0, "")
    header, row, *_ = result.stdout.splitlines()
    assert header.startswith("labels")
    assert row.startswith("tiny grid  int16 200 x 6 x 7 x 8")


def test_data_are_measured_by_the_options_of_a_series(fhash: Fhash, tmp_path: Path) -> None:
    path = tmp_path / "labels.npy"
    np.save(path, (np.indices((4, 3, 16, 20))[2] // 5).astype("u1"))
    result = fhash("bench", "labels", path, "--t", ":2", "--effort", "1", "-q")
    assert result.exit_code == 0, result.stderr
    assert "uint8 2 x 3 x 16 x 20" in result.stdout


def test_an_unknown_kind_is_refused(refused: Refused) -> None:
    assert "kind is 'foo'; allowed: " in refused(2, "bench", "labels", "--kind", "foo")


def test_bench_table_prints_a_table_and_goes_on(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "table", data, "--target", "40", "--bound", "0.05", "--peer", "SZ3"]
    words += ["--effort", "1", "--preset", "fast", "-o", tmp_path / "cells", "-q"]
    first = fhash(*words)
    assert (first.exit_code, first.stderr) == (0, "")
    header, *rows = first.stdout.split("\n\n")[0].splitlines()
    assert header.split()[:4] == ["series", "quality", "codec", "bytes"]
    assert [word in row for row, word in zip(rows, ["40 dB", "40 dB", "5 %", "5 %"], strict=True)]
    assert [("fhash 1 fast" in row, "SZ3" in row) for row in rows] == 2 * [
        (True, False),
        (False, True),
    ]
    assert "start-up of fhash" in first.stdout
    assert len(list((tmp_path / "cells").iterdir())) == 5
    again = json.loads(fhash(*words, "--json").stdout)
    assert again["measured"] == 0
    assert [cell["codec"] for cell in again["cells"]] == 2 * ["fhash 1 fast", "SZ3"]


def test_bench_table_needs_data(refused: Refused, data: Path) -> None:
    assert "Missing DATA; or give --generated" in refused(2, "bench", "table")
    assert "is no program that can be run" in refused(
        2, "bench", "table", data, "--peer", "tthresh=/nowhere/tthresh"
    )
    assert "and as NAME=PATH tthresh, qoz" in refused(2, "bench", "table", data, "--peer", "zip=a")
    assert "is no peer" in refused(2, "bench", "table", data, "--peer", "tthresh")


def test_filters_are_all_unless_some_are_named() -> None:
    program = Peer(name="vvc", path="/usr/bin/ffmpeg")
    assert filters_of([], PEERS) == filters_of([program], PEERS) == list(PEERS)
    assert filters_of([Peer(name="SZ3"), program, Peer(name="SZ3")], PEERS) == ["SZ3"]
    assert filters_of([Peer(name="none"), program], PEERS) == []
    assert programs_of([Peer(name="SZ3"), program]) == {"vvc": "/usr/bin/ffmpeg"}


def test_a_peer_is_a_name_or_a_program() -> None:
    kind = PEER
    assert kind.convert("SZ3", None, None) == Peer(name="SZ3")
    assert kind.convert("tthresh=a=b", None, None) == Peer(name="tthresh", path="a=b")
    assert kind.convert(Peer(name="none"), None, None) == Peer(name="none")
    for wrong in ("SZ3=/bin/true", "tthresh", "", "=x"):
        with pytest.raises(click.BadParameter, match="is no peer; allowed: SZ3"):
            kind.convert(wrong, None, None)


def test_a_generated_series_has_no_options() -> None:
    with opened("generated:long", None, silent) as series:
        assert series.shape == (600, 6, 10, 14)


QUICK = ["--size", "16", "--turns", "1", "-q"]


@pytest.mark.vtk
def test_prints_tables(fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vtk, "FINE_SIZE", 16)
    monkeypatch.setattr(vtk, "EXPLAINED_SIZE", 16)
    result = fhash(
        "bench", "render", run, *QUICK, *["--part", "accelerations", "--part", "exactness"]
    )
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert [line.split("  ")[0] for line in lines if "PSNR" in line][:2] == [
        "acceleration",
        "VTK on software OpenGL",
    ]
    assert any(line.startswith("early termination  ") for line in lines)
    assert any("medians of 1" in line for line in lines)


def test_prints_one_json_object_of_a_scene(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text("step = 1.5\n")
    result = fhash(
        "bench", "render", run, *QUICK, "--part", "accelerations", "--scene", scene, "--json"
    )
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert report["step"] == 1.5
    assert [entry["name"] for entry in report["accelerations"]][:2] == [
        "skipping",
        "early termination",
    ]
    assert report["curves"] == []


def test_draws(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    picture = tmp_path / "bench.png"
    words = ["bench", "render", run, *QUICK, "--part", "curves", "--plot", picture]
    assert fhash(*words).exit_code == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--part", "speed"], "allowed: effects"),
        (["--size", "3"], "16"),
        (["--scene", "none.json"], "no such scene"),
        (["--plot", "none/a.png"], "does not exist"),
    ],
)
def test_refuses_in_one_line(words: list[str], part: str, refused: Refused, run: Path) -> None:
    assert part in refused(2, "bench", "render", run, "-q", *words)


def test_a_wrong_ospray_is_refused_before_anything_is_measured(fhash: Fhash, run: Path) -> None:
    for words, message in (
        (["--part", "shell", "--ospray", "no_such_module"], "no OSPRay there"),
        (["--part", "orbit", "--ospray", "no_such_module"], "the part 'shell'"),
    ):
        result = fhash("bench", "render", run, *QUICK, *words)
        assert result.exit_code == 2
        assert message in result.stderr
        assert result.stderr.count("\n") == 1


@pytest.fixture
def data_bench_ablate(tmp_path: Path) -> Path:
    path = tmp_path / "waves.npy"
    np.save(path, np.sin(np.indices((3, 6, 8, 10))[3] * 0.3).astype("f4"))
    return path


@pytest.mark.torch
def test_a_table_has_a_row_for_each_variation(
    fhash: Fhash, data_bench_ablate: Path, tmp_path: Path
) -> None:
    arguments = ("bench", "ablate", data_bench_ablate, "--axis", "samples", "--epochs", "1", "-q")
    result = fhash(*arguments, "-o", tmp_path / "runs", "--plot", tmp_path / "p.png")
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert lines[0].startswith("samples: ")
    assert [line.split()[1] for line in lines[2:5]] == ["all", "keys", "published"]
    assert "--samples all *" in lines[2]
    assert (tmp_path / "p.png").stat().st_size > 1000
    kept = list((tmp_path / "runs").iterdir())
    assert len(kept) == 3
    again = fhash(*arguments, "-o", tmp_path / "runs", "--json")
    assert [row["settings"]["samples"] for row in json.loads(again.stdout)["rows"]] == [
        "all",
        "keys",
        "published",
    ]


@pytest.mark.torch
def test_unsuitable_options_are_refused(
    refused: Refused, data_bench_ablate: Path, tmp_path: Path
) -> None:
    assert "unknown axis 'tiles'" in refused(
        2, "bench", "ablate", data_bench_ablate, "--axis", "tiles"
    )
    assert "--var is for DATA" in refused(2, "bench", "ablate", "--var", "a")
    missing = tmp_path / "no" / "where"
    assert "give a folder that exists" in refused(
        2, "bench", "ablate", data_bench_ablate, "--axis", "samples", "-o", missing
    )


WORDS = ("bench", "train", "--seconds", "0.1", "--width", "4", "--hidden-layers", "1", "-q")


@pytest.fixture
def steady(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clocks that advance by 10 ms whenever they are read."""
    from fhash_bench import engines as clock
    from fhash_bench import train as bench

    ticks = count()
    read = lambda: next(ticks) / 100  # noqa: E731
    monkeypatch.setattr(clock, "time", SimpleNamespace(perf_counter=read, process_time=read))
    monkeypatch.setattr(bench, "INFER_SECONDS", 0.03)


@pytest.mark.torch
@pytest.mark.usefixtures("steady")
def test_it_measures_each_engine(fhash: Fhash, data: Path) -> None:
    result = fhash(*WORDS, data, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    (series,) = report["series"]
    assert {entry["engine"] for entry in series["engines"]} == {"native"}
    assert {"cores", "device"} <= set(report["machine"])


@pytest.mark.torch
@pytest.mark.usefixtures("steady")
def test_it_prints_a_row_for_each_engine_and_draws_curves(
    fhash: Fhash, data: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "curves.png"
    words = (*WORDS, data, "--engines", "native", "--bricks-per-step", "1", "--plot", picture)
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    facts, header, *rows = result.stdout.splitlines()
    assert facts.startswith("all: ")
    assert "1 bricks a step" in facts
    assert header.split()[:2] == ["engine", "threads"]
    assert "CPU s to 50 dB" in header
    engines = [row.split()[0] for row in rows if row]
    assert list(dict.fromkeys(engines))[:1] == ["native"]
    assert any(row.startswith("points, M per CPU s: rays ") for row in rows)
    assert any("times as fast as the whole box" in row for row in rows)
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = fhash(*words)
    assert again.exit_code != 0
    assert "--force" in again.stderr


@pytest.mark.torch
@pytest.mark.usefixtures("steady")
def test_a_series_is_made_where_none_is_given(
    fhash: Fhash, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = {key: replace(it, shape=(2, 8, 16, 16)) for key, it in made.MADE.items()}
    monkeypatch.setattr(made, "MADE", small)
    words = (*WORDS, "--engines", "native", "--json")
    result = fhash(*words)
    assert (result.exit_code, result.stderr) == (0, "")
    features = [entry["features"] for entry in json.loads(result.stdout)["series"]]
    assert features == [["interval:0.25:2"], ["all"]]
    argon = json.loads(fhash(*words, "generated:argon").stdout)["series"]
    assert [entry["features"] for entry in argon] == [["all"]]
    refused = fhash(*words, "--var", "velocity")
    assert refused.exit_code == 2
    assert refused.stderr == "fhash: error: --var is for DATA that are read; name them\n"


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--engines", "fast"), "'fast' is no engine"),
        (("--bricks-per-step", "64,x"), "'x' is no number of bricks"),
        (("--bricks-per-step", "0"), "'0' is no number of bricks"),
    ],
)
def test_unsuitable_options_are_refused_bench_train(
    fhash: Fhash, option: tuple[str, str], message: str
) -> None:
    refused = fhash(*WORDS, *option)
    assert refused.exit_code == 2
    assert message in refused.stderr


FEW = [
    "--quick", "--epochs", "1", "--no-latency", "--no-files", "-q", "--feature", "interval:6:99",
]  # fmt: skip
"""Options that make a training a matter of milliseconds."""


@pytest.fixture(autouse=True)
def no_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fhash_bench.paper.report.plot_convergence", lambda *_: [])


def test_parameters_are_printed_to_the_unit(fhash: Fhash, tmp_path: Path) -> None:
    result = fhash("bench", "paper", "--parameters", "-o", tmp_path / "none")
    assert (result.exit_code, result.stderr) == (0, "")
    for number in ("125,829,120", "141,557,760", "80,945,280", "112,857,968"):
        assert number in result.stdout
    assert not (tmp_path / "none").exists()


@pytest.mark.torch
def test_cells_of_own_data_are_resumed(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ["bench", "paper", data, *FEW, "--protocol", "equal", "-o", tmp_path / "cells"]
    words += ["--encoding", "hash", "--encoding", "tcnn"]
    first = fhash(*words)
    assert first.exit_code == 0, first.stderr
    assert "Claims of the paper" in first.stdout
    assert "not measured: tcnn: " in first.stdout
    (path,) = (tmp_path / "cells").glob("*.json")
    before = path.stat().st_mtime_ns
    cell = json.loads(path.read_text())
    assert (cell["data_set"], cell["encoding"]) == ("tiny.h5", "hash")
    assert fhash(*words).stdout == first.stdout
    assert path.stat().st_mtime_ns == before


@pytest.mark.torch
def test_files_are_asked_for_by_data_set(
    fhash: Fhash, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def measure(
        name: str, series: Series, feature: str, **_: object
    ) -> tuple[list[object], list[str]]:
        asked.append((name, len(series.shape), feature))
        return [], ["SZ3 not measured"]

    monkeypatch.setattr("fhash_bench.paper.files.measure_files", measure)
    words = [word for word in FEW if word != "--no-files"]
    words += ["--encoding", "fhash", "--protocol", "equal", "-o", str(tmp_path / "cells")]
    result = fhash("bench", "paper", data, *words)
    assert result.exit_code == 0, result.stderr
    assert asked == [("tiny.h5", 4, "interval:6:99")]
    assert "SZ3 not measured" in result.stdout


@pytest.mark.torch
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--protocol", "fair"], "'fair' is no protocol; allowed: published, released,"),
        (["--encoding", "mhe"], "'mhe' is no encoding; allowed: dense,"),
        (["--data-set", "argon"], "'argon' is no data set; allowed: flame,"),
        (["--var", "x"], "--var is for DATA"),
        (["--feature", "blob", "--quick"], "feature 'blob' is not known"),
    ],
)
def test_unsuitable_words_are_refused(
    refused: Refused, words: list[str], line: str, tmp_path: Path
) -> None:
    assert line in refused(2, "bench", "paper", "-q", "-o", tmp_path / "none", *words)
