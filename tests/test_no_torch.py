"""The package where torch is not installed: all but CUDA works."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fhash_codec

BLOCK = "import sys\nsys.modules['torch'] = None\n"
"""Module that Python runs at its start: `import torch` then fails as if it were not installed."""
SCRIPT = """
import json, sys
from click.testing import CliRunner
from fhash_cli.main import program
from fhash_codec.compact import trials

trials.least_gain = lambda task: -1e6  # an MLP is trained, whether it pays or not
for line in sys.stdin:
    result = CliRunner().invoke(program, json.loads(line))
    print(json.dumps([result.exit_code, result.stdout, result.stderr]))
assert sys.modules["torch"] is None
"""
NEEDS = "needs torch: pip install 'fhash[torch]'"


def run(commands: list[list[str]], folder: Path) -> list[tuple[int, str, str]]:
    """The exit code, stdout and stderr of each command, in one process without torch."""
    site = folder / "site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(BLOCK)
    places = os.pathsep.join([str(site), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input="\n".join(json.dumps(command) for command in commands),
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": places},
        cwd=folder,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [tuple(json.loads(line)) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("plain")
    t, z, y, x = np.meshgrid(*map(np.arange, (6, 8, 32, 32)), indexing="ij")
    front = x + 0.6 * y - 2 * t + 4 * np.sin(z / 5 + t / 4) - 26
    np.save(folder / "data.npy", (1 / (1 + np.exp(-2 * front))).astype(np.float32))
    commands = {
        "encode": "encode data.npy -o run.fhz --json",
        "paper": "encode data.npy -o network.fhz --preset=published --tables=dense --epochs=2",
        "decode": "decode run.fhz --t 1 -o step.npy",
        "render": "render run.fhz -o step.png --size 64x64",
        "stream": "render network.fhz -o stream.png --size 16x16 --march stream",
        "info": "info run.fhz --json",
        "verify": "verify run.fhz",
        "diff": "diff data.npy run.fhz --min-psnr 50",
        "bench rate": "bench rate data.npy --target 40 --peer none --no-speed --effort 1 --json",
        "bench render": "bench render run.fhz --part accelerations --turns 1 --size 16 --json",
        "selftest": "selftest --case constant-float32 --case devices --processes 1",
        "published on cuda": "encode data.npy -o c.fhz --preset published --device cuda",
        "picture on cuda": "render network.fhz -o cuda.png --device cuda",
        "bench train": "bench train data.npy",
        "compact on cuda": "encode data.npy -o cuda.fhz --device cuda",
    }
    done = run([command.split() for command in commands.values()], folder)
    return {"folder": folder, **dict(zip(commands, done, strict=True))}


@pytest.mark.parametrize(
    "command",
    ["encode", "paper", "decode", "render", "stream", "info", "verify", "diff", "bench rate",
     "bench render", "selftest"],
)  # fmt: skip
def test_ordinary_commands_need_no_torch(results: dict[str, Any], command: str) -> None:
    code, _, errors = results[command]
    assert code == 0, errors


def test_the_default_encode_trains_a_head(results: dict[str, Any]) -> None:
    with fhash_codec.open(results["folder"] / "run.fhz") as volume:
        assert volume.container.header["training"]["steps"] > 0


@pytest.mark.parametrize(
    ("command", "what"),
    [("published on cuda", "device 'cuda'"), ("bench train", "bench train")],
)
def test_what_needs_torch_says_so_in_one_line(
    results: dict[str, Any], command: str, what: str
) -> None:
    code, _, errors = results[command]
    assert code == 2
    assert errors == f"fhash: error: {what} {NEEDS}\n"
    assert "Traceback" not in errors


@pytest.mark.parametrize("command", ["compact on cuda", "picture on cuda"])
def test_what_needs_a_device_alone_says_so(results: dict[str, Any], command: str) -> None:
    code, _, errors = results[command]
    assert code == 2
    assert "there is no CUDA device here; use --device cpu" in errors
    assert "torch" not in errors


def test_a_benchmark_trains_the_network_and_names_no_torch(results: dict[str, Any]) -> None:
    report = json.loads(results["bench rate"][1])
    assert {point["codec"] for point in report["points"]} == {"fhash default", "fhash published"}
    assert "torch" not in report["machine"]
