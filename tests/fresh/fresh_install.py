"""Commands in a fresh install, see conftest.py."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def run(site: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python with the packages of `site` alone, and without any program on its path."""
    environment = {"PYTHONPATH": str(site), "PATH": "", "HOME": str(folder)}
    environment |= {name: os.environ[name] for name in ("LANG", "TMPDIR") if name in os.environ}
    return subprocess.run(
        [sys.executable, "-S", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def fhash(site: Path, folder: Path, *arguments: str) -> str:
    result = run(site, folder, "-m", "fhash_cli.main", *arguments)
    assert result.returncode == 0, f"fhash {' '.join(arguments)}: {result.stderr}"
    return result.stdout
