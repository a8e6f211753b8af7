"""`fhash completion`: the code of each shell, and the words that it completes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable

import pytest
from click.testing import Result

Fhash = Callable[..., Result]


@pytest.mark.parametrize(
    ("shell", "words"),
    [
        ("zsh", ("#compdef fhash", "_FHASH_COMPLETE=zsh_complete")),
        ("fish", ("complete --no-files --command fhash", "_FHASH_COMPLETE=fish_complete")),
        ("bash", ("complete -o nosort -F", "_FHASH_COMPLETE=bash_complete")),
    ],
)
def test_code_for_a_shell(fhash: Fhash, shell: str, words: tuple[str, ...]) -> None:
    result = fhash("completion", shell)
    assert result.exit_code == 0
    for word in words:
        assert word in result.stdout


def test_another_shell_is_refused(refused: Callable[..., str]) -> None:
    assert "'csh' is not one of 'bash', 'zsh', 'fish'" in refused(2, "completion", "csh")


@pytest.mark.parametrize(
    ("line", "found"), [("fhash enc", "plain,encode"), ("fhash encode x --ps", "plain,--psnr")]
)
def test_words_are_completed(line: str, found: str) -> None:
    words = {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}
    result = subprocess.run(
        [sys.executable, "-m", "fhash_cli.main"],
        env={**os.environ, **words, "_FHASH_COMPLETE": "bash_complete"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found in result.stdout.splitlines()
