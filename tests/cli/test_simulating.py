"""Options of scenes, and series that are written frame by frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import Result

from fhash_cli.simulating import (
    SceneOptions,
    ShapeType,
    describe,
    is_data_file,
    refuse_scene_options,
    simulation_rows,
)
from fhash_codec.simulation.simulate import Simulation, simulate
from fhash_formats import open_series
from fhash_formats.errors import InputError

Fhash = Callable[..., Result]
SMALL = ("--shape", "6,7,8", "--steps", "3", "-q")
SUFFIXES = ("h5", "nc", "zarr", "npy", "raw", "vtkhdf", "pvd")


def options(**settings: Any) -> SceneOptions:
    return SceneOptions(
        **{
            "scene": "front",
            "shape": None,
            "steps": None,
            "paper_shape": False,
            "seed": 0,
            **settings,
        }
    )


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ("54,172,200", {"z": 54, "y": 172, "x": 200}),
        (" 1, 2 ,3", {"z": 1, "y": 2, "x": 3}),
        ("x=64,y=63,z=62", {"x": 64, "y": 63, "z": 62}),
        ("z=4,x=6,y=5,t=7", {"z": 4, "x": 6, "y": 5, "t": 7}),
    ],
)
def test_shapes_are_z_y_x_or_named(text: str, shape: dict[str, int]) -> None:
    assert ShapeType().convert(text, None, None) == shape


@pytest.mark.parametrize(
    "text", ["", "5", "5,6", "5,6,7,8", "5,6,-7", "5x6x7", "x=5,y=6", "a=1", "\uff15,6,7"]
)
def test_other_shapes_are_refused(text: str) -> None:
    with pytest.raises(click.BadParameter, match="is not Z,Y,X such as"):
        ShapeType().convert(text, None, None)


def test_options_change_the_scene() -> None:
    assert options().open().shape == (16, 32, 48, 48)
    named = {"z": 4, "y": 5, "x": 6, "t": 7}
    assert options(shape=named).open().shape == (7, 4, 5, 6)
    assert options(steps=1, seed=9).open().seed == 9
    assert options(scene="flame", paper_shape=True).open().shape == (136, 54, 172, 200)


@pytest.mark.parametrize(
    "settings",
    [
        {"shape": {"z": 4, "y": 5, "x": 6, "t": 7}, "steps": 3},
        {"paper_shape": True, "steps": 3, "scene": "flame"},
    ],
)
def test_options_that_exclude_each_other_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(click.UsageError, match="exclude"):
        options(**settings).open()


def test_names_of_files_and_folders() -> None:
    assert all(is_data_file(Path(f"a/run.{suffix}")) for suffix in (*SUFFIXES, "NC4", "hdf5"))
    assert not any(is_data_file(Path(name)) for name in ("demo", "a.b/demo", "run.fhz"))
    assert options(scene="a/wake.v2.toml").name == "wake.v2"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_holds_the_simulated_values(fhash: Fhash, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run.{suffix}"
    result = fhash("demo", "--scene", "bubble", *SMALL, "--seed", "4", "-o", path, "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    report = json.loads(result.stdout)
    assert str(path) in report["paths"]
    assert (report["shape"], report["seed"]) == ([3, 6, 7, 8], 4)
    expected = simulate("bubble", (3, 6, 7, 8), 4)
    shape = "x=8,y=7,z=6,t=3"
    raw = ("run.raw", "--shape", shape, "--dtype", "float32") if suffix == "raw" else ()
    if raw:
        values = np.fromfile(path, dtype="<f4").reshape(expected.shape)
        frames = list(values)
    else:
        with open_series(path) as series:
            assert series.name == expected.name or suffix == "npy"
            frames = [series.read(step) for step in range(3)]
    for step, frame in enumerate(frames):
        np.testing.assert_array_equal(frame, expected.read(step))


def test_a_file_of_a_scene_is_simulated_and_never_replaced(
    fhash: Fhash, refused: Callable[..., str], tmp_path: Path
) -> None:
    scene = tmp_path / "wake.json"
    scene.write_text(json.dumps({"name": "dye", "effects": [{"effect": "blob"}]}))
    result = fhash("demo", "--scene", scene, *SMALL, "-o", tmp_path / "wake.npy", "--explain")
    assert result.exit_code == 0, result.stderr
    assert "1 blob" in result.stdout
    assert "never made, cost nothing" in result.stdout
    assert np.load(tmp_path / "wake.npy").shape == (3, 6, 7, 8)
    (tmp_path / "same.npy").symlink_to(scene)
    message = refused(2, "demo", "--scene", scene, *SMALL, "-o", tmp_path / "same.npy", "--force")
    assert "is the input itself" in message
    scene.write_text('{"effects": [{"effect": "blub"}]}')
    message = refused(2, "demo", "--scene", scene, "-o", tmp_path / "other.npy")
    assert message.startswith(f"{scene}: effect 1 is 'blub'; did you mean 'blob'")


def test_an_output_that_exists_is_kept_without_force(
    fhash: Fhash, refused: Callable[..., str], tmp_path: Path
) -> None:
    path = tmp_path / "run.npy"
    path.write_text("mine")
    assert "--force" in refused(2, "demo", *SMALL, "-o", path)
    assert fhash("demo", *SMALL, "-o", path, "--force").exit_code == 0
    assert np.load(path).shape == (3, 6, 7, 8)


def test_a_full_disk_is_refused_before_any_work(
    refused: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=10**9))
    monkeypatch.setattr(Simulation, "read", None)
    words = ("demo", "--scene", "shell", "--paper-shape", "-q", "-o", tmp_path / "run.h5")
    assert "up to 5.48 GB are needed" in refused(1, *words)


@pytest.mark.parametrize("suffix", ["npy", "h5", "zarr"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupt_leaves_nothing(
    fhash: Fhash,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    suffix: str,
    error: type[BaseException],
) -> None:
    read = Simulation.read

    def broken(self: Simulation, step: int) -> Any:
        if step == 2:
            raise error
        return read(self, step)

    monkeypatch.setattr(Simulation, "read", broken)
    result = fhash("demo", *SMALL, "-o", tmp_path / f"run.{suffix}")
    assert result.exit_code == (130 if error is KeyboardInterrupt else 1)
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_one_frame_is_read_before_the_next_is_computed(
    fhash: Fhash, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames come one by one: none is computed before the one before it is on its way to disk."""
    steps: list[int] = []
    read = Simulation.read
    monkeypatch.setattr(
        Simulation, "read", lambda self, step: steps.append(step) or read(self, step)
    )
    assert fhash("demo", *SMALL, "-o", tmp_path / "run.npy").exit_code == 0
    assert steps == [0, 1, 2]


def test_a_line_says_what_is_simulated_and_how_large_it_is() -> None:
    chosen = options(scene="shell", paper_shape=True)
    text = describe(chosen, chosen.open())
    assert text.startswith("simulating 'shell', a shell of a supernova")
    assert text.endswith("136 x 216 x 216 x 216 values, 5.48 GB")


def test_rows_explain_only_where_asked() -> None:
    simulation = simulate("front", (2, 4, 4, 4))
    simulation.read(1)
    assert len(simulation_rows(simulation, 1.0, False)) == 1
    rows = [(name.strip(), text) for name, text in simulation_rows(simulation, 1.0, True)]
    assert ("shell", "125 places") in rows
    assert any(name == "0 places" and "vortex" in text for name, text in rows)


def test_scene_options_are_refused_where_none_is_simulated() -> None:
    refuse_scene_options(options(), "--gallery")
    with pytest.raises(InputError, match="--paper-shape is for a scene; leave it out"):
        refuse_scene_options(options(paper_shape=True), "--gallery")
