"""`fhash serve`."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

import fhash_codec

Fhash = Callable[..., Result]
MAIN = [sys.executable, "-m", "fhash_cli.main", "serve"]


def opened(url: str) -> bytes:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=30) as answer:
        return bytes(answer.read())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_server_answers_until_it_is_stopped(run: Path, number: int) -> None:
    words = [*MAIN, str(run), "--port", "0", "--json"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        assert told["path"] == str(run)
        assert told["arrays"] == ["density"]
        assert told["url"].startswith("http://127.0.0.1:")
        root = json.loads(opened(f"{told['url']}zarr.json"))
        assert "density" in root["consolidated_metadata"]["metadata"]
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "fhash: stopped\n")


def test_the_text_says_how_to_open_it(
    fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fhash_codec.zarr_view.server import Server

    monkeypatch.setattr(Server, "serve_forever", lambda self: None)
    result = fhash("serve", run, "--port", 0)
    assert result.exit_code == 0, result.output
    assert "density at http://127.0.0.1:" in result.stdout
    assert 'xarray.open_zarr("http://127.0.0.1:' in result.stdout
    assert result.stderr == ""
    result = fhash("serve", run, "--port", 0, "--host", "0.0.0.0")
    assert result.exit_code == 0, result.output
    assert "warning: every machine" in result.stderr


def test_the_file_is_released(fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fhash_codec.zarr_view.server import Server

    views = []
    monkeypatch.setattr(Server, "serve_forever", lambda self: views.append(self.view))
    fhash("serve", run, "--port", 0)
    (view,) = views
    with pytest.raises(fhash_codec.InputError, match="closed"):
        view.get(next(view.listing("density/c/")))


def test_what_is_wrong_is_told_in_one_line(
    refused: Callable[..., str], run: Path, tmp_path: Path
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = refused(2, "serve", run, "--port", port)
        assert f"127.0.0.1:{port} cannot be served" in line
        assert "give another --port" in line
    assert "no such file" in refused(2, "serve", tmp_path / "nope.fhz")
    assert "is not known" in refused(2, "serve", run, "--host", "no such host")
    (tmp_path / "text.fhz").write_text("no container")
    refused(4, "serve", tmp_path / "text.fhz")
