"""Every command's JSON is what its schema says, key by key and in both directions."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command_line import Fhash
from json_schemas import DOCS, RESULTS, check, example, faults, parsed

import fhash_codec
from fhash_cli.main import COMMANDS
from fhash_codec.config import EncodeConfig
from fhash_codec.cost.results import CostReport
from fhash_codec.measure.metrics import BetweenQuality
from fhash_codec.records import Record
from fhash_codec.rendering.scenes import Scene
from fhash_codec.rendering.timeline import Animation
from fhash_codec.selftest.case import Finding
from fhash_codec.selftest.run import CaseResult, Summary
from fhash_codec.simulation.scene import PRESETS, SimulatedScene
from fhash_codec.views.server import Server

WITHOUT_JSON = {"completion", "hdf5-plugin-path", "paraview"}
"""Commands whose output is no result."""


def test_every_command_has_a_schema() -> None:
    assert {name.split()[0] for name in RESULTS} - {"errors"} == set(COMMANDS) - WITHOUT_JSON


@pytest.mark.parametrize(
    ("name", "record", "values", "good"),
    [
        ("EncodeConfig", EncodeConfig, EncodeConfig().to_dict(), True),
        ("EncodeConfig", EncodeConfig, {"effort": 9, "psnr": None}, True),
        ("EncodeConfig", EncodeConfig, {"effort": 10}, False),
        ("EncodeConfig", EncodeConfig, {"preset": "compact"}, False),
        ("render --scene", Scene, {"effects": {"shading": True, "clip": {"x": [False, 2]}}}, True),
        ("render --scene", Scene, {"effects": {"shading": False}, "time": 1}, True),
        ("render --scene", Scene, {"effects": {"isosurfaces": [{"opacity": 1}]}}, False),
        ("render --scene", Scene, {"camera": {"zoom": 0}}, False),
        ("render --scene", Scene, {"size": [1]}, False),
        ("render --scene", Scene, {"sise": [1, 1]}, False),
        *(("demo --scene", SimulatedScene, PRESETS[name], True) for name in PRESETS),
        ("demo --scene", SimulatedScene, {"effects": [{"effect": "blobs"}]}, False),
        ("demo --scene", SimulatedScene, {"effects": [{"radius": 1}]}, False),
        ("render --animate FILE", Animation, {"keys": [{"at": 0, "camera": {}}]}, True),
        ("render --animate FILE", Animation, {"fps": 0}, False),
    ],
)
def test_settings_are_taken_as_their_schema_says(
    name: str, record: type[Record], values: dict[str, Any], good: bool
) -> None:
    assert (not faults(name, json.loads(json.dumps(values)))) is good
    with nullcontext() if good else pytest.raises(fhash_codec.InputError):
        record.from_dict(values)


def test_serve(fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Server, "serve_forever", lambda self: None)
    check("serve", parsed(fhash("serve", run, "--port", 0, "--json")))
    check("view", parsed(fhash("view", run, "--port", 0, "--no-browser", "--json")))


def test_view(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    check("view --static", parsed(fhash("view", run, "--static", tmp_path / "page", "--json")))


@pytest.mark.filterwarnings("default::fhash_formats.errors.FhashWarning")
def test_encode_diff_and_info(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.fhz"
    outputs: dict[str, list[Any]] = {"encode": [], "diff": [], "info": [], "info DATA": []}
    with h5py.File(data) as file:
        smallest = file["density"][...].min()
    for settings in (
        ["--effort", "2", "--timings"],
        ["--effort", "2", "--missing", repr(float(smallest))],
        *(
            [
                "--preset=published",
                "--tables=float16",
                "--epochs=1",
                "--timings",
                "--width=4",
                "--key-frames=0,2",
            ],
        ),
    ):
        words = ["encode", data, "-o", path, "--force", *settings]
        outputs["encode"].append(parsed(fhash(*words, "--json", "-q")))
        outputs["encode"].append(parsed(fhash(*words, "--json", "-q", "-v")))
        outputs["diff"].append(parsed(fhash("diff", data, path, "--json", "-q")))
        outputs["info"].append(parsed(fhash("info", path, "--json")))
    other = tmp_path / "b.fhz"  # of a source with attributes and coordinates of its own
    for words in (["decode", path, "-o", tmp_path / "a.nc"], ["encode", tmp_path / "a.nc"]):
        more = [] if words[0] == "decode" else ["-o", other, "--effort", "1"]
        parsed(fhash(*words, *more, "--json", "-q"))
    outputs["info"].append(parsed(fhash("info", other, "--json")))
    partly = tmp_path / "partly.h5"
    with h5py.File(partly, "w") as file, h5py.File(data) as whole:
        shape = whole["density"].shape
        file.create_dataset("density", shape, "f4", chunks=(1, *shape[1:]))[1:] = whole["density"][
            1:
        ]
    parsed(fhash("encode", partly, "-o", other, "--effort", "1", "--force", "--json", "-q"))
    outputs["info"].append(parsed(fhash("info", other, "--json")))
    outputs["info DATA"].append(parsed(fhash("info", partly, "--var", "density", "--json")))
    detailed = ["--var", "density", "--t", "1:", "--missing", "-9"]
    words = ["encode", data, "-o", path, "--force", "--effort", "2", "--time-budget", "10m"]
    outputs["encode"].append(parsed(fhash(*words, "--json", "-q")))
    words[-4:] = ["--preset", "published", "--psnr", "20"]
    outputs["encode"].append(parsed(fhash(*words, "--json", "-q")))
    outputs["info"].append(parsed(fhash("info", path, "--json")))
    outputs["info DATA"].append(parsed(fhash("info", data, *detailed, "--json")))
    with h5py.File(partly, "w") as file, h5py.File(data) as whole:
        file["u"] = np.stack(2 * [whole["density"][...]])
    words = ["encode", partly, "-o", path, "--components", "dim0", "--effort", "1", "--force"]
    check("encode --var u,v", parsed(fhash(*words, "--json", "-q")))
    check("info of several variables", parsed(fhash("info", path, "--json")))
    outputs["info"].append(parsed(fhash("info", path, "--var", "u_1", "--json")))
    part = ["--max-error", "0.1", "--tile", "2x6x7x8", "--effort", "1", "--part", "1/2"]
    parsed(fhash("encode", data, "-o", path, "--force", *part, "--json", "-q"))
    outputs["info"].append(parsed(fhash("info", path, "--json")))
    for command, results in outputs.items():
        check(command, *results)
    for report in (*outputs["encode"], *outputs["info"]):
        assert sum(report["split"].values()) == report["bytes"]


def test_demo(fhash: Fhash, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = fhash_codec.encode

    def encode_fast(*words: Any, **options: Any) -> dict[str, Any]:
        *files, config = words
        return encode(*files, replace(config, effort=2, timings=True), **options)

    monkeypatch.setattr(fhash_codec, "encode", encode_fast)
    words = ("demo", "--shape", "8,10,12", "--steps", "5", "--explain", "--json", "-q", "-o")
    demo = parsed(fhash(*words, tmp_path))
    assert demo["curve"] == []  # nothing is trained here
    demo["curve"] = [{"epoch": 1, "seconds": None, "psnr": 40.0}]
    assert demo["quality"]["between"] is None  # every step is a key frame
    demo["quality"]["between"] = vars(example(BetweenQuality))
    check("demo", demo)
    check("demo -o FILE", parsed(fhash(*words, tmp_path / "run.npy")))
    monkeypatch.setattr("fhash_codec.gallery.PICTURES", ())
    monkeypatch.setattr("fhash_codec.gallery.GALLERY_SERIES", {})
    gallery = fhash("demo", "--gallery", tmp_path / "gallery", "--json", "-q")
    check("demo --gallery", parsed(gallery))


def test_verify_and_decode(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    check("verify", parsed(fhash("verify", run, "--json", "-q")))
    several = tmp_path / "several.fhz"
    config = fhash_codec.EncodeConfig(max_error=0.1, effort=1)
    arrays = {"u": np.zeros((2, 3, 4, 5)), "v": np.ones((2, 3, 4, 5))}
    fhash_codec.encode_dataset(arrays, several, config)
    one, both = (parsed(fhash("decode", path, "--json", "-q")) for path in (run, several))
    check("decode", one)
    check("decode --var u,v", both)
    assert both["variables"]["u"].keys() == one.keys() - {"paths"}
    plain = run.parent / "plain.fhz"
    words = ["export", run, "-o", plain, "--plain", "--force", "--json", "-q"]
    check("export", parsed(fhash(*words)))


def test_append(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run.fhz"
    words = ("--max-error", "0.1", "--tile", "1x6x7x8", "--effort", "1", "-q")
    assert fhash("encode", data, "-o", run, *words, "--t", "0:2").exit_code == 0
    check("append", parsed(fhash("append", run, data, "--t", "2:3", "--json", "-q")))


def test_plan(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ("--max-error", "0.1", "--effort", "1", "-q", "--json")
    check("plan", parsed(fhash("plan", data, "-o", tmp_path / "a.plan", *words)))


def test_merge(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    words = ("--max-error", "0.1", "--tile", "2x6x7x8", "--effort", "1", "-q", "--json")
    parts = [tmp_path / f"{number}.fhz" for number in (1, 2)]
    for number, part in enumerate(parts, start=1):
        encoded = parsed(fhash("encode", data, "-o", part, *words, "--part", f"{number}/2"))
        assert encoded["path"] == str(part)
    check("merge", parsed(fhash("merge", *parts, "-o", tmp_path / "a.fhz", "--json", "-q")))


def test_pack_and_unpack(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    run, store = tmp_path / "run.fhz", tmp_path / "run.zarr"
    assert fhash("encode", data, "-o", run, "--max-error", "0.1", "--effort", "1").exit_code == 0
    check("unpack", parsed(fhash("unpack", run, "-o", store, "--json", "-q")))
    words = ["pack", store, "-o", run, "--force", "--json", "-q"]
    check("pack", parsed(fhash(*words)))


def test_render(fhash: Fhash, run: Path, tmp_path: Path) -> None:
    words = ["render", run, "--size", "16x16", "--json", "-q", "-o", tmp_path / "a.png"]
    check("render", parsed(fhash(*words, "--explain")))
    check("render --animate", parsed(fhash(*words, "--animate", "steps")))
    words += ["--force", "--evolution", "0:2", "--track", "own"]
    check("render --evolution", parsed(fhash(*words)))


def test_selftest(fhash: Fhash, monkeypatch: pytest.MonkeyPatch) -> None:
    findings = tuple(
        Finding(name="a", worst=worst, limit=1.0, unit="dB", under="psnr")
        for worst in (0.5, float("nan"))
    )
    result = CaseResult(name="a", group="b", about="c", under=("psnr",), findings=findings)
    monkeypatch.setattr(
        "fhash_codec.selftest.run.run_cases", lambda *_, **__: Summary(results=[result])
    )
    check("selftest", parsed(fhash("selftest", "--json", "-q"), code=1))


def test_cost() -> None:
    result = example(CostReport)
    check("cost", json.loads(json.dumps({"paths": ["a"], **result.to_dict()})))


ERRORS = (
    ("usage", 2, ["info", "--json"]),
    ("usage", 2, ["info", "x", "--jsno", "--json"]),
    ("usage", 2, ["nonsense", "--json"]),
    ("missing-input", 2, ["info", "gone.fhz", "--json"]),
    ("missing-input", 2, ["encode", "gone.h5", "-o", "a.fhz", "--json"]),
    ("missing-input", 2, ["diff", "gone.h5", "RUN", "--json"]),
    ("missing-input", 2, ["bench", "rate", "gone.h5", "--json"]),
    ("region", 2, ["decode", "RUN", "--t", "99", "--json"]),
    ("input", 2, ["render", "RUN", "--t", "99", "-o", "a.png", "--json"]),
    ("output-exists", 2, ["decode", "RUN", "-o", "there.npy", "--json"]),
    ("input", 2, ["decode", "RUN", "-o", "a.docx", "--json"]),
    ("input", 2, ["selftest", "--case", "gone", "--json"]),
    ("damaged", 4, ["verify", "there.npy", "--json"]),
)


@pytest.mark.parametrize(("kind", "code", "words"), ERRORS, ids=str)
def test_an_error_is_an_object_too(
    fhash: Fhash,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    code: int,
    words: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.npy").write_bytes(b"there")
    result = fhash(*(run if word == "RUN" else word for word in words))
    error = parsed(result, code)
    check("errors", error)
    assert (error["kind"], error["exit_code"]) == (kind, code)
    assert result.stderr == f"fhash: error: {error['error']}\n"
    assert f"| `{kind}` | {code} |" in (DOCS / "json.md").read_text()


def test_a_missed_gate_is_beside_the_figures(fhash: Fhash, data: Path, run: Path) -> None:
    words = ["diff", data, run, "--max-error", "0", "-q"]
    report = parsed(fhash(*words, "--json"), code=3)
    assert (report["kind"], report["exit_code"]) == ("quality", 3)
    assert report["max_abs_error"] > 0
    assert report["error"]
    assert fhash(*words).exit_code == 3


def test_without_json_stdout_stays_empty(fhash: Fhash) -> None:
    assert fhash("info", "gone.fhz").stdout == ""
    assert fhash("info", "--", "--json").stdout == ""
