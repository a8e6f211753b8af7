"""The rooms of the house: which may import which, and how large a file and a function may be.
`docs/architecture.md` draws the same order."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "fhash_formats": ROOT / "formats" / "fhash_formats",
    "fhash_codec": ROOT / "fhash_codec",
    "fhash_cli": ROOT / "cli" / "fhash_cli",
    "fhash_bench": ROOT / "benchmarks" / "fhash_bench",
}

LAYERS: dict[str, tuple[tuple[str, ...], ...]] = {
    "fhash_formats": (
        ("errors",),
        ("support",),
        ("native", "series"),
        ("transform",),
        ("container", "hdf5"),
        ("readers",),
        ("writers",),
    ),
    "fhash_formats.transform": (
        ("head", "values"),
        ("predict", "spec"),
        ("tile_format",),
        ("tile",),
        ("stream",),
        ("numcodecs_codec", "zarr_codec"),
    ),
    "fhash_formats.container": (
        ("record", "zip_file"),
        ("array", "header", "remote"),
        ("source_entry", "stored"),
        ("hierarchy",),
        ("reader",),
        ("writer",),
        ("growing",),
    ),
    "fhash_codec": (
        ("cuda", "native", "paraview_reader", "progress", "records"),
        ("boxes", "config", "devices", "measure"),
        ("features",),
        ("file_info",),
        ("header",),
        ("compact",),
        ("paper",),
        ("volume_model", "times"),
        ("volume",),
        ("dataset", "comparison"),
        ("rendering",),
        ("simulation", "isosurface"),
        ("gallery",),
        ("appending",),
        ("encoding",),
        ("plain", "views", "xarray_backend"),
        ("selftest",),
        ("cost",),
    ),
    "fhash_codec.appending": (("growing", "series_plan"), ("parts", "writer"), ("cluster",)),
    "fhash_codec.rendering": (
        ("scenes", "grid"),
        ("cameras", "colours"),
        ("transfer_function", "view"),
        ("march_task",),
        ("bricks", "torch_arrays"),
        ("light", "tiled_frame"),
        ("layout", "network_device"),
        ("march_device",),
        ("march", "network_frame"),
        ("stream_fields",),
        ("image", "plan", "stream_march"),
        ("renderer",),
        ("timeline", "tracking"),
        ("film",),
    ),
    "fhash_cli": (
        ("options", "output"),
        ("selection",),
        ("variables",),
        ("commands",),
        ("main",),
    ),
    "fhash_bench": (
        ("engines", "kept", "labels", "pictures"),
        ("ablate", "rate"),
        ("paper", "train"),
        ("commands",),
        ("main", "results"),
    ),
}
"""Rooms from the ground up. A module imports rooms of lower layers only, wherever in it the import
stands; rooms of one layer do not know each other."""

MAX_LINES = 800
MAX_FUNCTION_LINES = 70
MAX_PARAMETERS = 7
"""Most parameters of a function; one that needs more takes a record, but a command's options."""
MANY_PARAMETERS = {
    "fhash_codec/appending/writer.py": {"__init__"},
    "fhash_codec/encoding.py": {"encode"},
    "fhash_codec/views/pack.py": {"pack"},
    "fhash_codec/xarray_backend.py": {"open_dataset"},
    "formats/fhash_formats/container/writer.py": {"add_array"},
    "benchmarks/fhash_bench/paper/measures.py": {"measure_latency"},
    "benchmarks/fhash_bench/rate/rate.py": {"bench_rate"},
    "benchmarks/fhash_bench/rate/table.py": {"bench_table"},
}
"""Functions with more all the same: interfaces whose callers write keywords. No name is added."""


UPWARDS = {"fhash_codec.volume": "fhash_codec.views.page."}
"""Modules that stand above the one that names them, and that it loads when it is asked to: methods
of an object, for notebooks, that show it. No name is added."""


def modules(package: str) -> list[Path]:
    return sorted(PACKAGES[package].rglob("*.py"))


def dotted(package: str, path: Path) -> str:
    parts = [package, *path.relative_to(PACKAGES[package]).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def imported(path: Path) -> list[str]:
    """Every name that a file imports, with its module, also inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


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
            upwards = name.startswith(UPWARDS.get(here, "-"))
            if other in rank and other != own and rank[other] >= rank[own] and not upwards:
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
            if text.count("\n") > MAX_LINES:
                long.append(f"{place}: {text.count(chr(10))} lines")
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef):
                    lines = (node.end_lineno or node.lineno) - node.lineno + 1
                    if lines > MAX_FUNCTION_LINES:
                        long.append(f"{place}:{node.lineno}: {node.name} has {lines} lines")
                    parameters = {each.arg for each in (*node.args.args, *node.args.kwonlyargs)}
                    many = len(parameters - {"self", "cls"}) > MAX_PARAMETERS
                    is_command = any("click" in ast.unparse(x) for x in node.decorator_list)
                    if many and not is_command and node.name not in MANY_PARAMETERS.get(place, ()):
                        long.append(f"{place}:{node.lineno}: {node.name} takes {len(parameters)}")
    assert not long, "\n".join(long)
