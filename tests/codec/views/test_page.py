"""The page of `fhash view` in Chromium, its server, its copies, and the decoder in WebAssembly."""

from __future__ import annotations

import base64
import gzip
import hashlib
import http.client
import io
import json
import os
import re
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from reference import rounding

import fhash_codec
from fhash_cli.main import program
from fhash_codec import EncodeConfig
from fhash_codec.native import network
from fhash_codec.rendering.colours import COLOUR_MAPS
from fhash_codec.rendering.renderer import Renderer, structure
from fhash_codec.rendering.scenes import SCENE_KEY, Scene, scene_in_png, text_in_png
from fhash_codec.views.page import FOLDER, PRIORS, WIDGET, Page, embedded
from fhash_codec.views.server import Server
from fhash_formats import native
from fhash_formats.errors import InputError, MissingDependencyError, OutputExistsError
from fhash_formats.native import ffi, pointer

ROOT = Path(__file__).resolve().parents[3]
GOLDEN = ROOT / "tests/golden"
WASM = FOLDER / "fhash.wasm"
LONG = os.environ.get("FHASH_VIEW", "")
"""Folder of screenshots and figures of the long version (`make view`)."""
CHROMIUM = shutil.which("chromium")
in_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
ENDS = ("--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
QUIET = ("--disable-quic", "--no-first-run", "--disable-component-update", "--disable-sync")
SOFTWARE = "GPU stall due to ReadPixels"
"""Words of Chromium about its own compositor, where there is no graphics card."""


class Tab:
    """A page in a headless Chromium, driven by the DevTools protocol over a WebSocket."""

    def __init__(self) -> None:
        assert CHROMIUM
        self.profile = tempfile.mkdtemp(prefix="chromium")
        options = [*ENDS, *QUIET, f"--user-data-dir={self.profile}", "--remote-debugging-port=0"]
        options += ["--disable-background-networking", "--hide-scrollbars"]
        self.process = subprocess.Popen(
            [CHROMIUM, "--headless", "--no-sandbox", *options, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = Path(self.profile, "DevToolsActivePort")
        for _ in range(300):
            if port_file.exists() and len(port_file.read_text().split()) == 2:
                break
            time.sleep(0.1)
        port = int(port_file.read_text().split()[0])
        listing = http.client.HTTPConnection("127.0.0.1", port)
        listing.request("GET", "/json")
        tabs = json.loads(listing.getresponse().read())
        listing.close()
        address = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=120)
        self.socket.sendall(
            f"GET {address.split(str(port), 1)[1]} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
        )
        self.file = self.socket.makefile("rb")
        while self.file.readline() != b"\r\n":
            pass
        self.number, self.events = 0, list[Any]()
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def close(self) -> None:
        self.file.close()
        self.socket.close()
        self.process.terminate()
        self.process.wait()
        shutil.rmtree(self.profile, ignore_errors=True)

    def call(self, method: str, **given: Any) -> Any:
        self.number += 1
        data = json.dumps({"id": self.number, "method": method, "params": given}).encode()
        size = len(data)
        head = (
            bytes([0xFE]) + struct.pack(">H", size)
            if size < 65536
            else b"\xff" + struct.pack(">Q", size)
        )
        head = bytes([0x80 | size]) if size < 126 else head
        self.socket.sendall(b"\x81" + head + bytes(4) + data)  # masked by zeros
        while True:
            answer = self._receive()
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def _receive(self) -> Any:
        data, final = b"", 0
        while not final:
            first, size = self.file.read(2)
            if size == 126:
                (size,) = struct.unpack(">H", self.file.read(2))
            elif size == 127:
                (size,) = struct.unpack(">Q", self.file.read(8))
            data, final = data + self.file.read(size), first & 0x80
        return json.loads(data)

    def run(self, code: str) -> Any:
        """The value of an expression of the page; raises AssertionError where it fails."""
        answer = self.call(
            "Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, json.dumps(answer["exceptionDetails"])[:800]
        return answer["result"].get("value")

    def until(self, code: str, seconds: float = 90) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.run(
                f"(() => {{ try {{ return Boolean({code}) }} catch {{ return false }} }})()"
            ):
                return
            time.sleep(0.03)
        raise AssertionError(
            f"{code} did not come true: {self.run('document.body.innerText')[:600]}"
        )

    def go(self, url: str, width: int = 700, height: int = 560) -> None:
        """Load a page in a window of a size."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.call("Page.navigate", url="about:blank")
        self.events.clear()
        self.call("Page.navigate", url=url)

    def drawn(self) -> None:
        """Wait for a picture as it should be."""
        self.until("fhash.app.sharp && !fhash.app.dirty && document.getElementById('busy').hidden")

    def drag(self, start: tuple[int, int], stop: tuple[int, int]) -> None:
        mouse: dict[str, Any] = {"button": "left", "buttons": 1, "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **mouse)
        for n in range(1, 9):
            x, y = (a + (b - a) * n / 8 for a, b in zip(start, stop, strict=True))
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **mouse)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=stop[0], y=stop[1], **mouse)

    def box(self, selector: str) -> list[float]:
        """Left, top, width and height of an element, in pixels."""
        found = f"document.querySelector('{selector}').getBoundingClientRect()"
        return [float(self.run(f"{found}.{name}")) for name in ("x", "y", "width", "height")]

    def shot(self, name: str) -> None:
        """Keep a screenshot of the long version."""
        if LONG:
            Path(LONG).mkdir(parents=True, exist_ok=True)
            data = self.call("Page.captureScreenshot", format="png")["data"]
            Path(LONG, f"{name}.png").write_bytes(base64.b64decode(data))

    def complaints(self) -> list[str]:
        """Messages of the console."""
        self.run("new Promise((done) => setTimeout(done, 50))")
        kinds = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
        told = [
            json.dumps(event["params"])[:600] for event in self.events if event["method"] in kinds
        ]
        return [line for line in told if SOFTWARE not in line]

    def picture(self, scene: dict[str, Any]) -> np.ndarray:
        """The volume by a scene, uint8 (H, W, 3)."""
        self.run(
            f"(async () => {{ const scene = {json.dumps(scene)}; fhash.app.fixedSize = scene.size;"
            "fhash.setScene(scene); fhash.app.tf = null; await fhash.show(); fhash.restyle();"
            "await fhash.show(); })()"
        )
        self.drawn()
        data = self.run("(fhash.surround(), fhash.picture().toDataURL('image/png'))").split(",")[1]
        self.run("fhash.app.fixedSize = null")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    made = Tab()
    yield made
    made.close()


class CountedPage(Page):
    """A page that counts the ranges of its containers."""

    def __init__(self, *runs: str | Path) -> None:
        super().__init__(runs)
        self.requests, self.bytes = 0, 0

    def pieces(self, key: str, first: int, end: int) -> Iterator[bytes]:
        if key in self.runs:
            self.requests, self.bytes = self.requests + 1, self.bytes + end - first
        return super().pieces(key, first, end)


@contextmanager
def serving(page: Page) -> Iterator[str]:
    """The address of a server of a page."""
    with Server(page) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server.url
        finally:
            server.shutdown()
            thread.join()


def figures(**found: Any) -> None:
    """Keep figures of the long version."""
    if LONG:
        Path(LONG).mkdir(parents=True, exist_ok=True)
        with Path(LONG, "figures.jsonl").open("a") as file:
            file.write(json.dumps(found) + "\n")


# ---- the decoder ----


def test_decoder_is_that_of_its_sources() -> None:
    digests = json.loads(WASM.with_suffix(".wasm.json").read_text())
    stale = [
        name
        for name, digest in digests.items()
        if hashlib.sha256((ROOT / name).read_bytes()).hexdigest() != digest
    ]
    assert not stale, f"`make wasm`: {stale} changed"
    folder = ROOT / "formats/fhash_formats/native"
    there = {
        path.relative_to(ROOT).as_posix()
        for kind in ("cpp", "c", "hpp", "h", "inc")
        for path in folder.rglob(f"*.{kind}")
    }
    assert there == {name for name in digests if "/native/" in name}


def test_page_is_small() -> None:
    files = [path for path in FOLDER.iterdir() if path.suffix in (".js", ".css", ".html")]
    packed = len(gzip.compress(b"".join(path.read_bytes() for path in sorted(files)), 9))
    decoder = len(gzip.compress(WASM.read_bytes(), 9))
    assert packed < 60_000
    assert decoder < 200_000
    figures(what="sizes", page_gz=packed, wasm=WASM.stat().st_size, wasm_gz=decoder)


def test_colour_maps_are_those_of_fhash() -> None:
    rows = re.findall(
        r'^  (\w+): "([0-9a-f ]+)",$', (FOLDER / "colours.js").read_text(), re.MULTILINE
    )
    assert {name: tuple(colours.split()) for name, colours in rows} == COLOUR_MAPS


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node")
def test_decoder_gives_the_bits_of_the_library() -> None:
    library = native.library()
    if not hasattr(library, "fhash_open_path"):
        pytest.skip("the library reads no files")
    runs = sorted(GOLDEN.glob("compact-*.fhz"))
    words = ["node", Path(__file__).with_name("decode.mjs"), WASM, FOLDER, *runs]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found, compared = json.loads(done.stdout), 0
    for run in runs:
        for number, step, lod, digest in found[str(run)]:
            values, profile = read_natively(library, run, number, step, lod)
            if profile == "compact":  # a network is no stream: its last bits are the machine's
                assert digest == hashlib.sha256(values.tobytes()).hexdigest(), (
                    run.name,
                    number,
                    step,
                    lod,
                )
                compared += 1
    assert compared > 100


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node")
@pytest.mark.parametrize(("psnr", "width", "scale"), [(50.0, 0, 1.0), (80.0, 32, 1e3)])
def test_a_network_keeps_its_promise_in_every_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, psnr: float, width: int, scale: float
) -> None:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 3, n) for n in (3, 8, 9, 10)), indexing="ij")
    values = scale * (np.sin(2 * x + t) * np.cos(y - 0.3 * t) + 0.1 * z * t)
    run = tmp_path / "run.fhz"
    fhash_codec.encode(values, run, EncodeConfig(preset="published", psnr=psnr, width=width))
    readers: dict[str, np.ndarray] = {}
    with fhash_codec.open(run) as volume:
        most = rounding(volume)
        for path in network.machine_paths():
            monkeypatch.setattr(network, "best_path", lambda _, bit=network.PATHS[path]: bit)
            readers[path] = volume.read_steps(range(3))
    library = native.library()
    readers["libfhash"] = np.stack([read_natively(library, run, 0, t, 0)[0] for t in range(3)])
    words = ["node", Path(__file__).with_name("decode.mjs"), WASM, FOLDER, "--values", run]
    page = subprocess.run(words, capture_output=True, check=True).stdout
    readers["page"] = np.frombuffer(page).reshape(values.shape)
    for name, decoded in readers.items():
        error = np.sqrt(np.mean((decoded - values) ** 2)) / np.ptp(values)
        assert -20 * np.log10(error) >= psnr, name
        assert np.abs(decoded - readers["libfhash"]).max() <= most


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node")
def test_the_page_chooses_the_step_of_render(steady: Path) -> None:
    surface = {"value": 20.0, "opacity": 0.5}
    scene = Scene.from_dict({"step": 0, "effects": {"isosurfaces": [surface]}})
    with fhash_codec.open(steady) as volume:
        plan = Renderer(volume).plan(scene)
        frames = [volume.read_lod(step, 0) for step in (0, 3)]
    job = {
        "frames": [frame.ravel().tolist() for frame in frames],
        "shape": frames[0].shape,
        "points": plan.function.points.tolist(),
        "positions": plan.function.colours.positions.tolist(),
        "surfaces": [surface],
    }
    words = ["node", Path(__file__).with_name("structure.mjs"), FOLDER]
    done = subprocess.run(words, input=json.dumps(job), capture_output=True, text=True, check=True)
    np.testing.assert_allclose(json.loads(done.stdout), [structure(each, plan) for each in frames])


def read_natively(
    library: native.Library, run: Path, number: int, step: float, lod: int
) -> tuple[np.ndarray, str]:
    """A step as float64 with one kind of NaN, by the library of this machine, and the profile."""
    context, file = library.fhash_context_create(0, 1), ffi.new("fhash_file **")
    error = ffi.new("fhash_error *")
    assert not library.fhash_open_path(context, str(run).encode(), file, error), error.text
    headers = json.loads(ffi.string(library.fhash_header(file[0])))["variables"]
    header = list(headers.values() if isinstance(headers, dict) else headers)[number]
    shape = [-(-n // 2**lod) for n in header["domain"]["shape"][1:]]
    values = np.empty(shape)
    read = (file[0], number, step, ffi.NULL, lod, 11, pointer(values), error)
    assert not library.fhash_read(*read), error.text
    library.fhash_close(file[0])
    library.fhash_context_destroy(context)
    return np.where(np.isnan(values), np.nan, values), header["model"]["profile"]


# ---- server, copies, notebooks ----


def ask(url: str, key: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    host = url.split("/")[2]
    connection = http.client.HTTPConnection(host, timeout=20)
    connection.putrequest("GET", f"/{key}", skip_host=True)
    for name, value in {"Host": host, **headers}.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, dict(answer.headers), body


def test_server_gives_page_and_container_alone(whole: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("secret")
    run = shutil.copy(whole, tmp_path / "a b<é>.fhz")
    with serving(Page([run])) as url:
        status, headers, body = ask(url, "")
        assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
        assert b'[{"name": "a b\\u003c\\u00e9>.fhz", "url": "a%20b%3C%C3%A9%3E.fhz"}]' in body
        name = "a%20b%3C%C3%A9%3E.fhz"
        status, headers, body = ask(url, name, Range="bytes=-100")
        assert (status, headers["Content-Type"]) == (206, "application/octet-stream")
        assert body == whole.read_bytes()[-100:]
        assert ask(url, name)[2] == whole.read_bytes()
        assert ask(url, "fhash.wasm")[1]["Content-Type"] == "application/wasm"
        assert ask(url, "app.js")[1]["Content-Type"].startswith("text/javascript")
        assert ask(url, "prior.bin")[2] == (FOLDER / "prior.bin").read_bytes()
        for other in (
            "secret.txt",
            "../secret.txt",
            "..%2Fsecret.txt",
            str(secret),
            "fhash.wasm.json",
            "page/app.js",
        ):
            assert ask(url, other)[0] == 404, other
        assert ask(url, name, Host="example.org")[0] == 421
        tag = ask(url, name)[1]["ETag"]
        os.utime(run, ns=(1, 1))
        assert ask(url, name)[1]["ETag"] != tag


def test_containers_of_one_name_are_told_apart(whole: Path, tmp_path: Path) -> None:
    paths = [tmp_path / folder / "run.fhz" for folder in "ab"]
    for path in paths:
        path.parent.mkdir()
        shutil.copy(whole, path)
    assert [*Page(paths).runs] == ["run.fhz", "2-run.fhz"]
    with pytest.raises(InputError, match="only files of this machine"):
        Page(["https://example.org/run.fhz"])


def test_copy_for_any_server(whole: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    done = runner.invoke(
        program, ["view", str(whole), "--static", str(tmp_path / "site"), "--json"]
    )
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    names = {Path(name).name for name in report["files"]}
    assert names >= {"index.html", "app.js", "fhash.wasm", "whole.fhz", *PRIORS}
    assert (tmp_path / "site/whole.fhz").read_bytes() == whole.read_bytes()
    again = runner.invoke(program, ["view", str(whole), "--static", str(tmp_path / "site")])
    assert again.exit_code == 2
    (tmp_path / "site/app.js").write_text("mine")
    with pytest.raises(OutputExistsError):
        Page([whole]).write(tmp_path / "site")
    assert (tmp_path / "site/app.js").read_text() == "mine"
    Page([whole]).write(tmp_path / "site", force=True)
    assert (tmp_path / "site/app.js").read_text() != "mine"
    own = Page([tmp_path / "site/whole.fhz"]).write(tmp_path / "site", force=True)
    assert tmp_path / "site/whole.fhz" not in own


def test_notebooks_without_anywidget(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "anywidget", None)
    with fhash_codec.open(whole) as volume:
        with pytest.raises(MissingDependencyError, match=r"fhash\[notebook\]"):
            volume.view()
        text = volume._repr_html_()
    assert "density [kg m-3]" in text
    assert "4, 10, 24, 44" in text
    picture = Image.open(io.BytesIO(base64.b64decode(text.split("base64,")[1].split("'")[0])))
    assert picture.size == (44 * 3, 24 * 3)
    pixels = np.asarray(picture)
    assert pixels.shape[2] == 4
    assert len(np.unique(pixels.reshape(-1, 4), axis=0)) > 20


# ---- the page ----


@pytest.fixture(scope="module")
def steady(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A smooth series of six steps whose values are exact but for a bound, in two tiles of time."""
    path = tmp_path_factory.mktemp("page") / "steady.fhz"
    t, z, y, x = np.meshgrid(*map(np.arange, (6, 20, 28, 36)), indexing="ij", sparse=True)
    distance = (z - 9) ** 2 + (y - 13 - t) ** 2 + (x - 17 + t) ** 2
    values = (100 * np.exp(-distance / 90) + 5 * np.sin(x / 3) * np.cos(y / 4)).astype(np.float32)
    fhash_codec.encode(values, path, EncodeConfig(effort=1, max_error=0.02, tile="3x20x28x36"))
    return path


@in_chromium
def test_page_shows_turns_plays_and_edits(tab: Tab, steady: Path) -> None:
    page = CountedPage(steady)
    with serving(page) as url:
        tab.go(url, 1400, 900)
        tab.drawn()
        first = page.requests, page.bytes
        assert page.requests <= 3
        assert tab.run("fhash.app.container.requests") == page.requests
        assert tab.run("fhash.app.container.loaded") == page.bytes
        before = tab.run("fhash.picture().toDataURL()")
        tab.drag((500, 400), (640, 430))
        tab.drawn()
        assert tab.run("fhash.picture().toDataURL()") != before
        assert tab.run("fhash.app.scene.camera.azimuth") < -5
        points = tab.run("fhash.app.tf.points.length")
        box = tab.box("#editor")
        place = int(box[0] + box[2] / 2), int(box[1] + box[3] / 4)
        tab.drag(place, (place[0] + 10, place[1] + 15))
        tab.drawn()
        assert tab.run("fhash.app.tf.points.length") == points + 1
        tab.run("document.getElementById('speed').value = 25; fhash.play(true)")
        tab.until("fhash.app.step === 5")
        tab.run("fhash.play(false)")
        tab.drawn()
        assert page.bytes <= 2 * steady.stat().st_size
        for key in ("d", "v", "v", ".", "+", "2", "ArrowLeft"):
            tab.call(
                "Input.dispatchKeyEvent", type="keyDown", key=key, text=key if len(key) == 1 else ""
            )
        tab.drawn()
        tab.shot("short-1400")
        tab.go(url, 480, 900)
        tab.drawn()
        assert tab.run("document.documentElement.scrollWidth") <= 480
        tab.shot("short-480")
        assert tab.complaints() == []
    figures(
        what="steady", file=steady.stat().st_size, first=first, last=(page.requests, page.bytes)
    )


def decibels(mine: np.ndarray, theirs: np.ndarray, where: np.ndarray) -> float:
    """PSNR of pixels (H, W, 3) where a mask (H, W) is true."""
    error = np.mean((mine.astype(float) - theirs)[where] ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def scenes(low: float, high: float) -> dict[str, tuple[float, dict[str, Any]]]:
    """Scenes by name, each with the PSNR that the page must reach."""
    at = [low + share * (high - low) for share in (0.2, 0.4, 0.5, 1.0)]
    opacity = [[at[0], 0], [at[2], 0.2], [at[3], 0.6]]
    base = {
        "camera": {"azimuth": 20, "elevation": 10},
        "size": [192, 160],
        "step": 0,
        "march": {"lod": 0},
        "effects": {},
    }
    volume = base | {"transfer_function": {"opacity": opacity, "colours": "turbo"}}
    surface = {"isosurfaces": [{"value": at[1], "colour": "#c04020"}]}
    return {
        "volume": (45, volume),
        "time": (45, volume | {"step": 2.5, "background": "#101018"}),
        "shading": (40, volume | {"effects": {"shading": {"light": [1, 0, 1]}}}),
        "clip": (
            45,
            volume | {"effects": {"clip": {"planes": [{"normal": [1, 1, 1], "offset": 40}]}}},
        ),
        "surface": (35, base | {"transfer_function": {"nothing": True}, "effects": surface}),
        "maximum": (
            45,
            volume
            | {
                "effects": {"maximum_intensity": True},
                "camera": {"projection": "parallel", "zoom": 1.4},
            },
        ),
    }


@in_chromium
def test_pictures_are_those_of_render(tab: Tab, steady: Path) -> None:
    with serving(Page([steady])) as url, fhash_codec.open(steady) as volume:
        tab.go(url)
        tab.drawn()
        renderer = Renderer(volume)
        for name, (least, scene) in scenes(volume.value_range.low, volume.value_range.high).items():
            image = renderer.render(Scene.from_dict(scene))
            found = decibels(tab.picture(scene), image.to_uint8(), image.rgba[..., 3] > 0)
            figures(what="psnr", scene=name, dB=round(found, 2))
            assert found >= least, (name, found)
        assert tab.complaints() == []


@in_chromium
def test_scenes_go_in_and_out(tab: Tab, steady: Path, tmp_path: Path) -> None:
    scene = {
        "camera": {"view": "xz", "zoom": 1.2},
        "step": 2,
        "background": "#203040",
        "transfer_function": {
            "opacity": [[0, 0], [90, 0.5]],
            "colours": "plasma_r",
            "density": 2.0,
        },
        "effects": {"box": True, "isosurfaces": [{"value": 50.0}], "shadows": True},
    }
    with serving(Page([steady])) as url:
        tab.go(url)
        tab.drawn()
        tab.run(
            "(async () => { const { drop } = await import('./app.js');"
            f"await drop(new File([{json.dumps(json.dumps(scene))}], 'a.json')); }})()"
        )
        tab.drawn()
        assert "shadows" in tab.run("document.getElementById('message').textContent")
        saved = tab.run("fhash.sceneNow()")
        read = Scene.from_dict(saved)
        assert read == Scene.from_dict(scene)
        data = tab.run(
            "(async () => { const { pictureWithScene } = await import('./files.js');"
            "const blob = await pictureWithScene(fhash.picture(), fhash.sceneNow());"
            "return btoa(String.fromCharCode(...new Uint8Array(await blob.arrayBuffer()))); })()"
        )
        path = tmp_path / "picture.png"
        path.write_bytes(base64.b64decode(data))
        Image.open(path).load()
        assert text_in_png(path, SCENE_KEY) is not None
        assert scene_in_png(path) == read
        tab.run("document.getElementById('link').click()")
        tab.until("location.hash.length > 100")
        link = tab.run("location.href")
        tab.go(link)
        tab.drawn()
        assert Scene.from_dict(tab.run("fhash.sceneNow()")) == read
        assert tab.run("fhash.app.step") == 2
        assert tab.complaints() == []


class Plain(SimpleHTTPRequestHandler):
    """A server that knows no ranges."""

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


@in_chromium
def test_servers_without_ranges_and_dropped_files(tab: Tab, steady: Path, tmp_path: Path) -> None:
    Page([steady]).write(tmp_path / "site")
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Plain, directory=tmp_path / "site")
    ) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            tab.go(f"http://127.0.0.1:{server.server_port}/")
            tab.drawn()
            assert tab.run("fhash.app.container.loaded") == steady.stat().st_size
            before = tab.run("fhash.picture().toDataURL()")
            tab.run(
                "(async () => { const { drop } = await import('./app.js');"
                "const bytes = await (await fetch('steady.fhz')).arrayBuffer();"
                "await drop(new File([bytes], 'dropped.fhz')); })()"
            )
            tab.drawn()
            assert tab.run("document.getElementById('title').textContent") == "dropped.fhz"
            assert tab.run("fhash.app.container.requests") == 0
            assert tab.run("fhash.picture().toDataURL()") == before
            assert tab.complaints() == []
        finally:
            server.shutdown()
            thread.join()


@in_chromium
def test_features_are_layers(tab: Tab, feature: Path) -> None:
    with serving(Page([feature])) as url:
        tab.go(url)
        tab.drawn()
        ends = "[fhash.app.tf.points[0][0], fhash.app.tf.shown[0]]"
        assert tab.run(ends) == pytest.approx([0.6, 0.6])
        tab.run("document.querySelector('#features input').click()")
        tab.drawn()
        assert tab.run("fhash.app.features.length") == 0
        assert tab.run(ends)[1] < 0.6
        assert tab.complaints() == []


@in_chromium
def test_slices_need_no_webgl(tab: Tab, feature: Path) -> None:
    with serving(Page([feature])) as url, fhash_codec.open(feature) as volume:
        tab.go(f"{url}?no-webgl")
        tab.until("fhash.app.frame && fhash.app.frame.lod === 0 && !fhash.app.dirty")
        assert tab.run("document.getElementById('volumeTab').disabled")
        box = tab.box("figure canvas")
        tab.call(
            "Input.dispatchMouseEvent",
            type="mouseMoved",
            x=box[0] + box[2] / 2,
            y=box[1] + box[3] / 2,
        )
        tab.until("document.getElementById('told').textContent")
        told = tab.run("document.getElementById('told').textContent")
        value, x, y, z = re.match(
            r"(\S+)(?: kg m-3)? at lon (\S+), lat (\S+), height (\S+)", told
        ).groups()  # type: ignore[union-attr]
        place = [
            int(np.argmin(np.abs(volume.coords[axis].values - float(at))))
            for axis, at in zip("zyx", (z, y, x), strict=True)
        ]
        assert float(value) == pytest.approx(float(volume.read(0)[*place]), rel=1e-5)
        tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=box[0] + 3, y=box[1] + 3)
        tab.until("document.getElementById('told').textContent.startsWith('no value')")
        corner = "document.querySelector('figure canvas').getContext('2d').getImageData(2, 2, 1, 1)"
        transparent = tab.run(f"{corner}.data[3]")
        assert transparent == 0
        assert tab.complaints() == []


@in_chromium
@pytest.mark.parametrize("kind", ["cut", "noise", "empty", "tile", "gone"])
def test_bad_files_are_one_clear_line(
    tab: Tab, whole: Path, damaged: Path, tmp_path: Path, kind: str
) -> None:
    run = tmp_path / "run.fhz"
    shutil.copy(damaged if kind == "tile" else whole, run)
    page = Page([run])
    data = {"cut": whole.read_bytes()[:-300], "noise": bytes(range(256)) * 40, "empty": b""}.get(
        kind
    )
    if data is not None:
        run.write_bytes(data)
    if kind == "gone":
        run.unlink()
    with serving(page) as url:
        tab.go(url)
        tab.until("!document.getElementById('message').hidden")
        line = tab.run("document.getElementById('message').textContent")
        assert line.startswith("run.fhz: ")
        assert len(line) < 250
        assert "undefined" not in line
        assert "wasm" not in line
        told = tab.complaints()
        assert not told or kind in ("empty", "gone")  # the browser tells of 404 and 416 itself


@in_chromium
def test_page_in_a_notebook(tab: Tab, steady: Path, tmp_path: Path) -> None:
    page, sent = embedded()
    packed: dict[str, Any] = {
        name: base64.b64encode(each).decode()
        for name, each in (("wasm", sent["wasm"]), ("bytes", steady.read_bytes()))
    }
    packed["priors"] = [base64.b64encode(each).decode() for each in sent["priors"]]
    host = tmp_path / "host.html"
    values = {"page": page, "script": sent["script"], "name": "steady.fhz", "height": 500}
    given = json.dumps(values | packed).replace("<", "\\u003c")
    host.write_text(
        "<!DOCTYPE html><link rel=icon href='data:,'><div id=el></div><script type=module>"
        + WIDGET.replace("export default { render };", "")
        + f"""
        const bytes = (text) => Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
        const view = (text) => new DataView(bytes(text).buffer);
        const given = {given};
        const all = {{ ...given, wasm: view(given.wasm), bytes: view(given.bytes) }};
        all.priors = given.priors.map(view);
        render({{ model: {{ get: (name) => all[name] }}, el: document.getElementById("el") }});
        </script>"""
    )
    tab.go(host.as_uri(), 900, 600)
    tab.until("document.querySelector('iframe').contentWindow.fhash.app.sharp")
    assert (
        tab.run(
            "document.querySelector('iframe').contentDocument.getElementById('title').textContent"
        )
        == "steady.fhz"
    )
    assert tab.complaints() == []


# ---- the long version ----


@in_chromium
@pytest.mark.skipif(not LONG, reason="`make view` runs it")
def test_real_and_large_files(tab: Tab, tmp_path: Path) -> None:
    for name, run in (("isabel", isabel(tmp_path)), ("large", large(tmp_path))):
        page = CountedPage(run)
        with serving(page) as url:
            tab.go(url, 1400, 900)
            begin = time.monotonic()
            tab.until("fhash.app.frame")
            shown, first = time.monotonic() - begin, (page.requests, page.bytes)
            tab.drawn()
            tab.shot(f"{name}-1400")
            for n in range(6):
                tab.drag((400 + 20 * n, 400), (480 + 20 * n, 420))
            frames = tab.run("fhash.app.fps")
            last = tab.run("fhash.app.container.variables[0].shape[0] - 1")
            for step in range(last + 1):
                tab.run(f"fhash.go({step})")
            tab.drawn()
            figures(
                what=name,
                bytes=run.stat().st_size,
                first=first,
                last=(page.requests, page.bytes),
                seconds_to_first=round(shown, 2),
                frames=round(frames, 1),
            )
            tab.run("document.getElementById('slicesTab').click()")
            tab.run("new Promise((done) => setTimeout(done, 500))")
            tab.shot(f"{name}-slices")
            tab.go(url, 480, 900)
            tab.drawn()
            tab.shot(f"{name}-480")
            assert tab.complaints() == []
            with fhash_codec.open(run) as volume:
                for each, (_, scene) in scenes(
                    volume.value_range.low, volume.value_range.high
                ).items():
                    scene = scene | {"size": [384, 384]}
                    image = Renderer(volume).render(Scene.from_dict(scene))
                    found = decibels(tab.picture(scene), image.to_uint8(), image.rgba[..., 3] > 0)
                    figures(what="psnr", file=name, scene=each, dB=round(found, 2))
                    assert found >= 35, (name, each, found)


def isabel(folder: Path) -> Path:
    data = Path(os.environ.get("FHASH_DATA", "/work/shared/data"), "isabel.h5")
    if not data.exists():
        pytest.skip(f"{data} is not here")
    path = folder / "isabel.fhz"
    fhash_codec.encode(data, path, EncodeConfig(effort=1, max_error_rel=0.01))
    return path


def large(folder: Path) -> Path:
    """A container of about 50 MB: waves and noise, so that it does not become small."""
    path = folder / "large.fhz"
    rng = np.random.default_rng(1)
    z, y, x = np.meshgrid(
        *3 * [np.linspace(-1, 1, 192, dtype=np.float32)], indexing="ij", sparse=True
    )
    frames = [
        np.exp(-4 * ((x - 0.1 * t) ** 2 + y**2 + (z + 0.05 * t) ** 2))
        + 0.1 * np.sin(9 * x + t) * np.cos(7 * y * z)
        + rng.normal(0, 0.01, (192, 192, 192)).astype(np.float32)
        for t in range(12)
    ]
    config = EncodeConfig(effort=1, max_error=0.001, tile="2x48x96x96")
    fhash_codec.encode(np.stack(frames), path, config)
    return path
