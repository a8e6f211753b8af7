"""House rules that no module can hold alone: packages, what loads what, and documents that name
what exists. `test_rooms.py` holds the order of the rooms."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from click.testing import CliRunner
from folders import blocks

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "fhash_formats": ROOT / "formats" / "fhash_formats",
    "fhash_codec": ROOT / "fhash_codec",
    "fhash_cli": ROOT / "cli" / "fhash_cli",
    "fhash_bench": ROOT / "benchmarks" / "fhash_bench",
}
ALLOWED = {
    "fhash_formats": {"fhash_formats"},
    "fhash_codec": {"fhash_codec", "fhash_formats"},
    "fhash_cli": {"fhash_cli", "fhash_codec", "fhash_formats"},
    "fhash_bench": {"fhash_bench", "fhash_cli", "fhash_codec", "fhash_formats"},
}
TORCH_FILES = {
    "fhash_codec": re.compile(
        r"paper/engines/fused/.+\.py|devices\.py"
        r"|rendering/torch_arrays\.py"
    ),
    "fhash_bench": re.compile(r"(engines|train|paper/(bench|encodings|measures|trained))\.py"),
}
"""Modules that train or evaluate tensors, march through them, or start training."""
SLOW = ("torch", "xarray", "zarr", "h5py", "matplotlib", "pandas", "scipy", "asyncio")


def modules(package: str) -> list[Path]:
    return sorted(PACKAGES[package].rglob("*.py"))


@cache
def imports(path: Path) -> list[str]:
    """Every module that a file imports, wherever in it."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.append(node.module or "")
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_dependencies_point_one_way(package: str) -> None:
    files = modules(package)
    assert files
    for path in files:
        own = {name.split(".")[0] for name in imports(path)}
        wrong = {name for name in own if name.startswith("fhash")} - ALLOWED[package]
        assert not wrong, f"{path} imports {wrong}"
        assert not own & {"cli", "formats", "benchmarks", "fhash"}, f"{path} imports a source root"


def test_torch_stays_where_tensors_are_trained() -> None:
    for package in PACKAGES:
        for path in modules(package):
            if any(name.split(".")[0] in ("torch", "triton") for name in imports(path)):
                inside = path.relative_to(PACKAGES[package]).as_posix()
                assert package in TORCH_FILES, f"{path} imports torch"
                assert TORCH_FILES[package].fullmatch(inside), f"{path} imports torch"


@pytest.mark.parametrize("folder", ["cli", "formats", "benchmarks"])
def test_source_roots_are_no_packages(folder: str) -> None:
    assert not (ROOT / folder / "__init__.py").exists()


def test_every_package_folder_is_installed_and_typed() -> None:
    projects = (ROOT / "pyproject.toml", ROOT / "benchmarks" / "pyproject.toml")
    listed = {
        name
        for project in projects
        for name in tomllib.loads(project.read_text())["tool"]["setuptools"]["packages"]
    }
    found = {
        ".".join([package, *path.parent.relative_to(PACKAGES[package]).parts])
        for package in PACKAGES
        for path in modules(package)
    }
    assert listed == found
    assert all((folder / "py.typed").exists() for folder in PACKAGES.values())


def test_version_is_the_same_everywhere() -> None:
    import fhash_codec

    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert declared == importlib.metadata.version("fhash") == fhash_codec.__version__
    benchmarks = tomllib.loads((ROOT / "benchmarks" / "pyproject.toml").read_text())["project"]
    assert benchmarks["version"] == declared
    assert f"fhash=={declared}" in benchmarks["dependencies"]
    assert f"## [{declared}]" in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {declared}\n" in (ROOT / "CITATION.cff").read_text()


def test_packages_of_conda_and_spack_need_what_pip_installs() -> None:
    """Version and requirements in `recipes/` are those of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = {f"python{project['requires-python']}", *project["dependencies"]}
    conda = (ROOT / "recipes/conda/recipe.yaml").read_text()
    run = conda.split("\n  run:\n")[1].split("\n\n")[0]
    assert {line.strip("- ").replace(" ", "") for line in run.splitlines()} == required
    spack = (ROOT / "recipes/spack/package.py").read_text()
    needed = re.findall(r'depends_on\("(?:py-)?([a-z0-9]+)@([0-9.]+):"', spack)
    assert {f"{name}>={version}" for name, version in needed} - {"setuptools>=77"} == required
    assert f'version: "{project["version"]}"' in conda
    assert f'version("{project["version"]}")' in spack


@pytest.mark.parametrize(
    "statement",
    [
        "import fhash_codec",
        "import fhash_formats",
        "import fhash_codec.volume",
        "import fhash_cli.main",
        "from fhash_cli.main import program; program(['--help'])",
        "from fhash_cli.main import program; program(['encode', '--help'])",
        "from fhash_cli.main import program; program(['render', 'x'])",
        "import os; os.environ.update("
        "_FHASH_COMPLETE='bash_complete', COMP_WORDS='fhash enc', COMP_CWORD='1');"
        "from fhash_cli.main import program; program(prog_name='fhash')",
    ],
)
def test_nothing_slow_is_loaded_before_it_is_needed(statement: str) -> None:
    code = (
        f"import sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\n"
        f"print([m for m in {SLOW} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_constraints_pin_every_requirement_and_name_no_place() -> None:
    lines = [
        line
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if not line.startswith("#")
    ]
    assert all(re.fullmatch(r"[a-z0-9._-]+==[0-9][0-9a-z.]*", line) for line in lines), (
        "only name==version, without path, URL or local build"
    )
    pinned = {re.sub(r"[-_.]+", "-", line.split("==")[0]) for line in lines}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    benchmarks = tomllib.loads((ROOT / "benchmarks" / "pyproject.toml").read_text())["project"]
    required = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
        *benchmarks["dependencies"],
    ]
    names = {
        re.sub(r"[-_.]+", "-", re.match(r"[A-Za-z0-9._-]+", line)[0].lower()) for line in required
    } - {"fhash", "fhash-bench"}  # type: ignore[index]
    assert names <= pinned


@pytest.mark.parametrize("document", ["docs/architecture.md", "CONTRIBUTING.md", "README.md"])
def test_documents_name_paths_that_exist(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    places = [ROOT, *PACKAGES.values(), PACKAGES["fhash_formats"] / "transform"]
    places += [PACKAGES["fhash_codec"] / "rendering", ROOT / "formats", ROOT / "cli"]
    paths = re.findall(
        r"`((?:[a-z_]+/)+(?:[a-z_]+\.[a-z]+)?|(?:[a-z_]+/)*[a-z_]+\.(?:py|cpp))`", text
    )
    missing = [path for path in paths if not any((place / path).exists() for place in places)]
    assert not missing


def readme_commands() -> list[str]:
    lines = [
        line.strip().removeprefix("$ ")
        for block in blocks(ROOT / "README.md")
        for line in block.text.replace("\\\n", " ").splitlines()
    ]
    return [line for line in lines if line.startswith("fhash ")]


def test_readme_shows_commands() -> None:
    assert readme_commands()


@pytest.mark.parametrize("line", readme_commands())
def test_readme_commands_exist(line: str) -> None:
    from fhash_cli.main import program

    words = shlex.split(line.split("|")[0].split(">")[0], comments=True)[1:]
    result = CliRunner().invoke(program, [*words, "--help"])
    assert result.exit_code == 0, result.stderr


SECURITY = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
LIMITS = re.findall(
    r"^\| (.+) \| ([0-9^]+)(?: (\w+))? \| `(.+)[.:](\w+)` \|$", SECURITY, re.MULTILINE
)
UNITS = {"KiB": 2**10, "MiB": 2**20, "GiB": 2**30}


@pytest.mark.parametrize("row", LIMITS, ids=lambda row: row[0])
def test_limits_of_the_document_are_those_of_the_program(row: tuple[str, ...]) -> None:
    _, number, unit, module, name = row
    base, _, power = number.partition("^")
    limit = int(base) ** int(power or 1) * UNITS.get(unit, 1)
    if not module.startswith("native/"):
        assert getattr(importlib.import_module(module), name) == limit
        return
    source = (ROOT / "formats" / "fhash_formats" / module).read_text(encoding="utf-8")
    first, shift = re.findall(rf"\b{name} = (\d+) << (\d+);", source)[0]
    assert int(first) << int(shift) == limit


def test_every_limit_is_looked_at() -> None:
    assert len(LIMITS) == SECURITY.count("` |\n") > 12
