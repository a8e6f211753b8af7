"""`fhash pack`, `unpack`, `export`, `serve` and `view`."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import zarr
from command_line import Fhash, Refused

import fhash_codec
from fhash_formats.transform.zarr_codec import TransformCodec


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store of two variables that are coded, and one that is not."""
    values = np.arange(3 * 6 * 7 * 8, dtype=np.float32).reshape(3, 6, 7, 8)
    group = zarr.open_group(tmp_path / "run.zarr", mode="w")
    for name in ("u", "v"):
        array = group.create_array(
            name, shape=values.shape, chunks=(2, 6, 4, 8), dtype="f4", fill_value=0,
            serializer=TransformCodec(max_error=0.5), dimension_names=["time", "z", "y", "x"],
        )  # fmt: skip
        array[...] = values
    group.create_array("w", data=values, dimension_names=["time", "z", "y", "x"])
    return tmp_path / "run.zarr"


def test_variables_are_packed(fhash: Fhash, store: Path) -> None:
    run = store.with_suffix(".fhz")
    result = fhash("pack", store, "-o", run, "--var", "u,v")
    assert result.exit_code == 0, result.stderr
    assert "u          3 x 6 x 7 x 8 in 4 tiles of 2 x 6 x 4 x 8; error within 0.5" in result.stdout
    assert fhash("verify", run).exit_code == 0
    assert "command" not in fhash("info", run, "--var", "u").stdout
    with fhash_codec.open(run, variable="v") as volume:
        array = zarr.open_group(store, mode="r")["v"]
        assert np.array_equal(volume[...], array[...])


def test_what_cannot_be_packed_is_refused(refused: Refused, fhash: Fhash, store: Path) -> None:
    run = store.with_suffix(".fhz")
    assert "w is not coded by fhash.transform" in refused(2, "pack", store, "-o", run)
    assert "coded by bytes, zstd" in refused(2, "pack", store, "-o", run, "--var", "w")
    assert "a name twice" in refused(2, "pack", store, "-o", run, "--var", "u,u")
    (store / "u" / "c" / "1" / "0" / "1" / "0").unlink()
    assert "--absent fill" in refused(2, "pack", store, "-o", run, "--var", "u")
    words = ("pack", store, "-o", run, "--var", "u", "--absent", "fill", "-q")
    result = fhash(*words)
    assert result.exit_code == 0, result.stderr
    assert "1 not in the store" in result.stdout
    assert "--force" in refused(2, *words)


def test_a_container_is_unpacked_and_packed_again(fhash: Fhash, data: Path, tmp_path: Path) -> None:
    run, store, again = (tmp_path / name for name in ("run.fhz", "run.zarr", "again.fhz"))
    words = ("--max-error", "0.1", "--tile", "2x6x7x8", "--effort", "1", "-q")
    assert fhash("encode", data, "-o", run, *words).exit_code == 0
    result = fhash("unpack", run, "-o", store)
    assert result.exit_code == 0, result.stderr
    assert "2 chunks" in result.stdout
    assert fhash("pack", store, "-o", again).exit_code == 0
    with fhash_codec.open(run) as volume, fhash_codec.open(again) as other:
        array = zarr.open_group(store, mode="r")[volume.name]
        assert np.array_equal(array[...], volume[...])
        assert np.array_equal(other[...], volume[...])


def test_a_feature_is_refused_with_the_way_out(refused: Refused, run: Path, tmp_path: Path) -> None:
    told = refused(2, "unpack", run, "-o", tmp_path / "run.zarr")
    assert "a part of its domain" in told
    assert "fhash decode" in told


GOLDEN = Path(__file__).resolve().parents[2] / "golden" / "compact-mask.fhz"


def test_a_plain_file_is_written_and_described(fhash: Fhash, tmp_path: Path) -> None:
    plain = tmp_path / "plain.fhz"
    result = fhash("export", GOLDEN, "-o", plain, "--plain")
    assert result.exit_code == 0, result.output
    assert "arrays" in result.stdout
    report = json.loads(fhash("export", GOLDEN, "-o", plain, "--plain", "--force", "--json").stdout)
    with fhash_codec.open(plain) as volume:
        assert report == {
            "path": str(plain),
            "bytes": plain.stat().st_size,
            "source_bytes": GOLDEN.stat().st_size,
            "arrays": len(volume.container.arrays),
            "values": report["values"],
        }
    info = fhash("info", plain)
    assert info.exit_code == 0, info.output
    assert "table_1 to table_" in info.stdout
    assert "; occupancy, bytes," in info.stdout
    assert fhash("verify", plain).exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((GOLDEN, "-o", "{}/plain.fhz"), "--plain"),
        ((GOLDEN, "-o", "{}/taken.fhz", "--plain"), "exists"),
        (("{}/absent.fhz", "-o", "{}/plain.fhz", "--plain"), "no such file"),
        ((GOLDEN, "-o", "{}/plain.vti", "--plain"), "ends in .fhz"),
        ((GOLDEN, "-o", "{}/nowhere/plain.fhz", "--plain"), "nowhere"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(
    fhash: Fhash, tmp_path: Path, arguments: tuple[object, ...], message: str
) -> None:
    (tmp_path / "taken.fhz").write_bytes(b"mine")
    result = fhash("export", *(str(word).replace("{}", str(tmp_path)) for word in arguments))
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert (tmp_path / "taken.fhz").read_bytes() == b"mine"
    assert [file.name for file in tmp_path.iterdir()] == ["taken.fhz"]


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


def test_the_page_is_served_until_it_is_stopped(run: Path) -> None:
    words = [*MAIN[:-1], "view", str(run), "--port", "0", "--no-browser", "--json"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        assert told["files"] == [run.name]
        assert opened(told["url"] + run.name) == run.read_bytes()
        assert b"fhash view" in opened(told["url"])
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "fhash: stopped\n")


def test_live_pictures_are_served_until_it_is_stopped(run: Path) -> None:
    words = [*MAIN[:-1], "view", str(run), "--live", "--port", "0", "--no-browser", "--json"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        assert told["files"] == [run.name]
        assert run.name.encode() in opened(told["url"])
        picture = opened(told["url"] + "picture?width=64&height=48&azimuth=20")
        assert picture[:8] == b"\x89PNG\r\n\x1a\n"
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "fhash: stopped\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--live", "--static", "site"], "--live shows one RUN.fhz, without --static and --force"),
        (["--live", "--force"], "--live shows one RUN.fhz"),
        (["another.fhz", "--live"], "--live shows one RUN.fhz"),
        (["--var", "u"], "give --live too"),
        (["--var", "density"], "give --live too"),
        (["--live", "--var", "u"], "no variable 'u'"),
    ],
)
def test_options_that_exclude_each_other(
    refused: Refused, run: Path, words: list[str], message: str
) -> None:
    assert message in refused(2, "view", run, *words)


def test_what_cannot_be_viewed_is_told_in_one_line(refused: Refused, tmp_path: Path) -> None:
    other = tmp_path / "other.fhz"
    other.write_bytes(b"no container")
    refused(4, "view", other)
    refused(4, "view", other, "--live")
    refused(2, "view", tmp_path / "none.fhz", "--live")
    refused(2, "view", tmp_path / "none.fhz")
    refused(2, "view", "https://example.org/run.fhz")


def test_the_text_says_how_to_open_it(
    fhash: Fhash, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fhash_codec.views.server import Server

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
    from fhash_codec.views.server import Server

    views = []
    monkeypatch.setattr(Server, "serve_forever", lambda self: views.append(self.view))
    fhash("serve", run, "--port", 0)
    (view,) = views
    with pytest.raises(fhash_codec.InputError, match="closed"):
        view.get(next(view.listing("density/c/")))


def test_what_is_wrong_is_told_in_one_line_serve(
    refused: Refused, run: Path, tmp_path: Path
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
