"""The rooms of the house: which may import which, how large a file and a function may be, and
that the tests mirror the modules. `docs/architecture.md` draws the same order."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "fhash_formats": ROOT / "formats" / "fhash_formats",
    "fhash_codec": ROOT / "fhash_codec",
    "fhash_cli": ROOT / "cli" / "fhash_cli",
}
TESTS = {"fhash_formats": "formats", "fhash_codec": "codec", "fhash_cli": "cli"}

LAYERS: dict[str, tuple[tuple[str, ...], ...]] = {
    "fhash_formats": (
        ("errors",),
        ("support",),
        ("source_metadata",),
        ("native", "series"),
        ("transform",),
        ("container",),
        ("readers",),
        ("writers",),
    ),
    "fhash_formats.transform": (
        ("apart", "array_axes", "values"),
        ("entropy",),
        ("axes", "head"),
        ("tile",),
        ("chunk", "parts", "stream"),
        ("numcodecs_codec", "zarr_codec", "zarr_parts"),
    ),
    "fhash_codec": (
        ("config", "container_name", "lean_header", "native", "progress", "stage_clock"),
        ("measure", "training"),
        ("coreset",),
        ("indexing", "provenance"),
        ("header",),
        ("model_parts",),
        ("compact",),
        ("paper",),
        ("volume_model",),
        ("array_like", "card", "sampling", "times", "value_type"),
        ("volume",),
        ("dataset", "feature_volume", "promises", "report"),
        ("zarr_view",),
        ("rendering",),
        ("simulation",),
        ("comparison", "demo", "isosurface"),
        ("shared_volumes",),
        ("lazy_array",),
        ("appending",),
        ("encoding",),
        ("dataset_encoding", "plain", "xarray_backend"),
        ("zarr_chunks",),
        ("selftest",),
        ("bench",),
        ("cost",),
    ),
    "fhash_codec.appending": (
        ("figures", "series_plan"),
        ("layers", "parts"),
        ("growing", "planning"),
        ("resuming",),
        ("append", "merging", "writer"),
        ("cluster",),
    ),
    "fhash_codec.rendering": (
        ("scene",),
        ("camera", "colour"),
        ("task",),
        ("native", "picture", "stream"),
        ("march",),
        ("renderer",),
        ("animation",),
    ),
    "fhash_cli": (
        ("durations", "frame_statistics", "intervals", "progress_bar"),
        ("base_command", "conversion", "options", "output", "scene_types", "selection"),
        ("animation_options", "card_rows", "gallery", "peer_options"),
        ("decoding", "scene_options", "simulating"),
        ("source_listing", "variables"),
        ("commands",),
        ("main",),
    ),
}
"""Rooms from the ground up. A module imports rooms of lower layers only, wherever in it the import
stands; rooms of one layer do not know each other."""

MAX_LINES = 400
MAX_FUNCTION_LINES = 70
LONG_ON_PURPOSE = {
    "formats/fhash_formats/transform/entropy/coder_portable.py": "twin of coder.cpp",
    "formats/fhash_formats/transform/entropy/labels_portable.py": "twin of labels.cpp",
    "formats/fhash_formats/transform/entropy/mask_portable.py": "twin of mask.cpp",
    "formats/fhash_formats/transform/entropy/predict_portable.py": "twin of predict.cpp",
}
"""Portable twins: one loop that numba compiles and that a reader holds against the C++."""

WITHOUT_MIRROR: dict[str, str] = {
    "fhash_codec.compact.attempt": "records of the stages: compact/test_stages.py",
    "fhash_codec.compact.choices.head_network_portable": "twin: choices/test_head_network.py",
    "fhash_codec.rendering.picture.plan": "a record: picture/test_planning.py, test_explain.py",
    "fhash_codec.selftest.checks.properties": "a list of checks: selftest/test_runner.py",
    "fhash_formats.transform.entropy.coder_portable": "held against the C++: test_coder.py",
    "fhash_formats.transform.entropy.magnitudes_portable": "held against the C++: test_coder.py",
    "fhash_formats.transform.entropy.signs_portable": "held against the C++: test_coder.py",
    "fhash_formats.transform.entropy.labels_portable": "held against the C++: test_labels.py",
    "fhash_formats.transform.entropy.mask_portable": "held against the C++: test_mask.py",
    "fhash_formats.transform.entropy.predict_portable": "held against the C++: test_predict.py",
    "fhash_formats.transform.entropy.trellis_portable": "held against the C++: test_trellis.py",
    "fhash_formats.transform.entropy.rows_portable": "of mask and label twins: test_mask.py",
}
"""Modules without a test file of their own, and where their behaviour is tested instead."""


def modules(package: str) -> list[Path]:
    return sorted(PACKAGES[package].rglob("*.py"))


def dotted(package: str, path: Path) -> str:
    parts = [package, *path.relative_to(PACKAGES[package]).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path) -> Iterator[str]:
    """Every name that a file imports, with its module, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room(scope: str, name: str) -> str | None:
    """The room of a dotted name inside a scope; None outside it."""
    return name[len(scope) + 1 :].split(".")[0] if name.startswith(f"{scope}.") else None


@pytest.mark.parametrize("scope", LAYERS)
def test_rooms_know_only_what_stands_below_them(scope: str) -> None:
    rank = {name: number for number, layer in enumerate(LAYERS[scope]) for name in layer}
    package = scope.split(".")[0]
    seen, wrong = set(), []
    for path in modules(package):
        here = dotted(package, path)
        own = room(scope, here)
        if own is None:
            continue
        seen.add(own)
        assert own in rank, f"{scope}.{own} has no layer in LAYERS"
        for name in imported(path):
            other = room(scope, name)
            if other in rank and other != own and rank[other] >= rank[own]:
                wrong.append(f"{here} imports {name}")
    assert seen == set(rank)
    assert not wrong, "\n".join(sorted(wrong))


def test_modules_import_each_other_in_no_circle() -> None:
    names = {dotted(package, path): path for package in PACKAGES for path in modules(package)}
    arrows = {
        name: {
            other
            for imports in imported(path)
            for other in (imports, imports.rpartition(".")[0])
            if other in names and other != name and names[other].name != "__init__.py"
        }
        for name, path in names.items()
    }
    finished: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join([*trail[trail.index(name) :], name])
        if name not in finished:
            for other in sorted(arrows[name]):
                visit(other, (*trail, name))
            finished.add(name)

    for name in sorted(arrows):
        visit(name, ())


def test_files_and_functions_stay_short() -> None:
    long = []
    for package in PACKAGES:
        for path in modules(package):
            place = path.relative_to(ROOT).as_posix()
            text = path.read_text(encoding="utf-8")
            if place in LONG_ON_PURPOSE:
                continue
            if text.count("\n") > MAX_LINES:
                long.append(f"{place}: {text.count(chr(10))} lines")
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef):
                    lines = (node.end_lineno or node.lineno) - node.lineno + 1
                    if lines > MAX_FUNCTION_LINES:
                        long.append(f"{place}:{node.lineno}: {node.name} has {lines} lines")
    assert not long, "\n".join(long)


def test_tests_mirror_the_modules() -> None:
    missing = set()
    for package, folder in TESTS.items():
        for path in modules(package):
            inside = path.relative_to(PACKAGES[package])
            test = ROOT / "tests" / folder / inside.parent / f"test_{inside.name}"
            if path.name != "__init__.py" and not test.exists():
                missing.add(dotted(package, path))
    unknown = sorted(missing - WITHOUT_MIRROR.keys())
    assert not unknown, "no test file, and no reason in WITHOUT_MIRROR:\n" + "\n".join(unknown)
    assert not WITHOUT_MIRROR.keys() - missing, "these have a test file now"
