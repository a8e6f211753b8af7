"""Every command and every piece of Python of the documentation runs, page by page, as a reader
types it; what a page shows as output is what is printed, but for times and the last digits."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from folders import blocks
from json_schemas import DOCS
from reference_pages import commands

import fhash_codec
from fhash_bench.results import pages
from fhash_cli.main import COMMANDS, program

PAGES = [page for page in pages()[1:] if page.name not in ("gallery.md", "stability.md")]
"""Pages of the site, but those that `fhash demo --gallery` and `make hard` write."""
NOTEBOOKS = sorted(DOCS.rglob("*.ipynb"))
RUN = ("sh", "python")
SHOWN = ("text", "toml", "c", "js", "xml", "json", "fortran", "cmake")
"""Languages of blocks that nobody runs: outputs, files, and code of other languages."""
ELSEWHERE = "console"
"""Language of commands that need another machine or a window; their options are checked."""
ENDLESS = ("serve", "view", "paraview", "completion", "bench", "cost", "selftest")
"""Commands whose examples wait for Ctrl-C, print code, or take minutes."""
LONG = re.compile(r"fhash demo$| --ratio | --feature ")
"""Further examples that take long; those of the README are the same."""
NUMBER = re.compile(r"(?<![\w.])-?\d[\d,]*\.?\d*(?:e-?\d+)?")


def named(path: Path) -> str:
    return path.relative_to(DOCS).as_posix()


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what most pages begin from: demo/vortex.h5, and run.fhz of it."""
    folder = tmp_path_factory.mktemp("demo")
    for line in (
        "fhash demo -o demo/vortex.h5 -q",
        "fhash encode demo/vortex.h5 -o run.fhz --max-error 0.01 -q",
    ):
        (folder / "demo").mkdir(exist_ok=True)
        shell(line, folder)
    return folder


@pytest.fixture
def folder(
    demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Path:
    if "first-hour" not in request.node.name:  # begins from nothing
        shutil.copytree(demo, tmp_path, dirs_exist_ok=True)
    shutil.copytree(DOCS / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shell(text: str, folder: Path) -> str:
    """Output of a block of commands; the first that fails fails the test."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", text],
        cwd=folder,
        env={**os.environ, "PATH": path, "HOME": str(folder), "COLUMNS": "100"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, f"{text}\n{done.stderr[-3000:]}"
    return done.stdout


def run_python(text: str, names: dict[str, object]) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(compile(text, "page", "exec"), names)
    return printed.getvalue()


def alike(shown: str, printed: str) -> bool:
    """Whether two outputs have the same words, and numbers that differ by less than a quarter.

    Times and rates differ as machines do; any number stands for them.
    """
    words = [NUMBER.sub("#", text).split() for text in (shown, printed)]
    figures = [
        [
            float(match[0].replace(",", ""))
            for match in NUMBER.finditer(text)
            if not re.match(r" ?(s|ms|MB/s|min|ns)\b", text[match.end() :])
        ]
        for text in (shown, printed)
    ]
    return words[0] == words[1] and all(
        abs(a - b) <= 0.25 * max(abs(a), abs(b)) for a, b in zip(*figures, strict=True)
    )


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("size  14.3 kB", "size 15 kB", True),
        ("size  14.3 kB", "size  34 kB", False),
        ("took 3 s", "took 30.5 s", True),
        ("a 1", "b 1", False),
    ],
)
def test_outputs_are_compared(shown: str, printed: str, same: bool) -> None:
    assert alike(shown, printed) is same


def test_every_block_has_a_language_that_says_whether_it_runs() -> None:
    known = {*RUN, *SHOWN, ELSEWHERE, "{eval-rst}", "{toctree}", "{include}"}
    found = {(named(page), b.line, b.language) for page in PAGES for b in blocks(page)}
    assert not {row for row in found if row[2] not in known and not row[2].startswith("{")}
    assert sum(row[2] in RUN for row in found) > 4 * sum(row[2] == ELSEWHERE for row in found)


@pytest.mark.docs
@pytest.mark.parametrize("page", PAGES, ids=named)
def test_what_a_page_shows_runs(page: Path, folder: Path) -> None:
    names: dict[str, object] = {"__name__": "__main__"}
    printed = ""
    for block in blocks(page):
        place = f"{named(page)}:{block.line}"
        if block.language == "sh":
            printed = shell(block.text, folder)
        elif block.language == "python":
            printed = run_python("\n" * block.line + block.text, names)
        elif block.language == "text" and printed:
            assert alike(block.text, printed), f"{place}\n{printed}"
            printed = ""
        elif block.language == ELSEWHERE:
            check_options(block.text, place)


def check_options(text: str, place: str) -> None:
    """Fail for a command or an option that fhash does not have."""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line.removeprefix("$ "), comments=True)
        if words[:1] != ["fhash"]:
            continue
        shown = CliRunner().invoke(program, [*words[1:], "--help"])
        assert shown.exit_code == 0, f"{place}: {line}: {shown.output}"


@pytest.mark.docs
def test_examples_of_the_help_run(folder: Path) -> None:
    epilogs = {
        name: (command.epilog or "").splitlines()
        for name, command in commands()
        if name.split()[0] not in ENDLESS
    }
    assert sum(map(len, epilogs.values())) > 20
    for lines in epilogs.values():
        shell("\n".join(line for line in lines if not LONG.search(line)), folder)


def code_of(notebook: Path) -> Iterator[str]:
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            yield "".join(cell["source"])


@pytest.mark.docs
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=named)
def test_a_notebook_runs(notebook: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {}
    for text in code_of(notebook):
        run_python(text, names)


def test_a_notebook_has_its_outputs() -> None:
    assert len(NOTEBOOKS) == 2
    for notebook in NOTEBOOKS:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        code = [cell for cell in cells if cell["cell_type"] == "code"]
        assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
        assert any("image/png" in output.get("data", {}) for c in code for output in c["outputs"])
        assert not any(output["output_type"] == "error" for c in code for output in c["outputs"])


def test_each_public_name_has_an_example_that_runs() -> None:
    page = DOCS / "reference" / "api.md"
    code = "".join(block.text for block in blocks(page) if block.language == "python")
    used = set(re.findall(r"fhash_codec\.(\w+)", code))
    assert set(fhash_codec.__all__) <= used
    documented = re.findall(r"^\.\. auto\w+:: (\w+)", page.read_text(encoding="utf-8"), re.M)
    assert sorted(documented) == sorted(fhash_codec.__all__)


def test_each_command_is_in_an_example_that_runs() -> None:
    text = "".join(b.text for page in PAGES for b in blocks(page) if b.language in RUN)
    unseen = {name for name in COMMANDS if not re.search(rf"\bfhash {name}\b", text)}
    assert unseen <= {"paraview", "serve"}, unseen  # a window, and a server that Ctrl-C ends
