"""Pictures of `fhash view --live`: those of the renderer, dropped requests, guards, the page."""

from __future__ import annotations

import io
import json
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_server import Answer, Ask, asking, raw

import fhash_codec
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import USUAL_EFFECTS, Camera, Effects, Scene
from fhash_codec.views.live import PAGE, Live
from fhash_codec.views.page import Page
from fhash_codec.views.server import Server
from fhash_formats.errors import DamagedFileError

SMALL = "width=200&height=160"


@contextmanager
def serving(path: Path, news: Callable[[str], None] = print) -> Iterator[tuple[Live, Server]]:
    """A view and its server, in a thread of its own."""
    with fhash_codec.open(path) as volume:
        live = Live(volume)
        with Server(live, news=news) as server:
            thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
            thread.start()
            try:
                yield live, server
            finally:
                server.shutdown()
                thread.join()
                live.close()


@pytest.fixture
def ask(whole: Path) -> Iterator[Ask]:
    with serving(whole) as (_, server):
        yield asking(server)


def pixels(answer: Answer) -> np.ndarray:
    status, headers, body = answer
    assert (status, headers["Content-Type"]) == (200, "image/png"), body[:200]
    return np.asarray(Image.open(io.BytesIO(body)))


def told(answer: Answer) -> dict[str, Any]:
    return json.loads(answer[1]["Fhash-Picture"])


def test_the_first_picture_is_the_default_one(ask: Ask, whole: Path) -> None:
    with fhash_codec.open(whole) as volume:
        assert np.array_equal(pixels(ask("/picture")), Renderer(volume).render().to_uint8())


@pytest.mark.parametrize("coarse", [False, True])
def test_pictures_are_those_of_the_renderer(ask: Ask, whole: Path, coarse: bool) -> None:
    some = Effects(shading=USUAL_EFFECTS.shading, box=True)
    scene = Scene(
        camera=Camera(azimuth=30, elevation=-12.5, zoom=1.5),
        size=(200, 160),
        step=2.25,
        effects=some if coarse else USUAL_EFFECTS,
    )
    query = f"step=2.25&azimuth=30&elevation=-12.5&zoom=1.5&{SMALL}&coarse={int(coarse)}"
    answer = ask(f"/picture?{query}")
    with fhash_codec.open(whole) as volume:
        renderer = Renderer(volume)
        plan = renderer.plan(scene)
        image = renderer.render(plan=plan)
    assert np.array_equal(pixels(answer), image.to_uint8())
    assert told(answer)["samples"] == image.counters["samples"] > 0
    assert told(answer)["device"] == "cpu"
    *view, bar = told(answer)["view"]
    assert tuple(view) == plan.layout.view
    assert view[0] + view[2] <= bar <= 200
    assert (bar == 200) is coarse
    other = ask(f"/picture?{query.replace('azimuth=30', 'azimuth=31')}")
    assert not np.array_equal(pixels(other), image.to_uint8())


def test_a_map_is_proposed_in_its_shape(tmp_path: Path) -> None:
    values = np.linspace(0, 1, 40 * 20, dtype=np.float32).reshape(1, 1, 20, 40)
    fhash_codec.encode(values, tmp_path / "a<b>.fhz", fhash_codec.EncodeConfig(effort=1, psnr=30.0))
    with serving(tmp_path / "a<b>.fhz") as (_, server):
        text = asking(server)("/")[2].decode()
        size = pixels(asking(server)("/picture")).shape[1::-1]
    facts = re.search(r'<script id="facts" type="application/json">([^<]*)</script>', text)
    assert facts is not None
    assert size[0] == 1024 > size[1]
    assert json.loads(facts[1]) == {"name": "a<b>.fhz", "size": list(size), "last": 0, "step": 0}


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("steps=1", "unknown 'steps'; did you mean 'step'?"),
        ("step", "step is ''; a finite number"),
        ("step=1=2", "step is '1=2'"),
        ("zoom=nan", "zoom is 'nan'; a finite number"),
        ("zoom=1e999", "zoom is '1e999'"),
        ("zoom=0", "zoom is 0; allowed"),
        ("elevation=91", "elevation is 91; allowed: -90 to 90"),
        ("step=4", "step 4 is outside the series, which has steps 0 to 3"),
        ("step=-1", "step is -1"),
        ("width=0", "size is 0; allowed"),
        ("height=-5", "size is -5; allowed"),
        ("width=2049", "size is 2049 x 1024; allowed: 1 to 2048"),
        ("width=1e300", "allowed: 1 to 2048"),
        ("number=x%0Ay", "number is 'x\\ny'"),
        ("%ff=1", "unknown"),
    ],
)
def test_wrong_queries_are_refused_with_a_line(whole: Path, query: str, words: str) -> None:
    news: list[str] = []
    with serving(whole, news.append) as (_, server):
        ask = asking(server)
        status, headers, body = ask(f"/picture?{query}")
        assert status == 400, body[:200]
        assert words in body.decode()
        assert (body.count(b"\n"), body[-1:]) == (1, b"\n")
        assert headers["Content-Type"] == "text/plain; charset=utf-8"
        assert pixels(ask(f"/picture?{SMALL}&coarse=1")).shape == (160, 200, 3)
    assert not news


def test_overtaken_requests_are_not_drawn(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[float] = []
    render = Renderer.render

    def counted(self: Renderer, *, plan: Any, **more: Any) -> Any:
        drawn.append(plan.scene.camera.azimuth)
        return render(self, plan=plan, **more)

    monkeypatch.setattr(Renderer, "render", counted)
    with serving(whole) as (live, server):
        answers: dict[str, int] = {}

        def request(page: int, number: int) -> None:
            query = f"{SMALL}&page={page}&number={number}&azimuth={number}"
            answers[f"{page}.{number}"] = asking(server)(f"/picture?{query}")[0]

        threads = []
        with live._drawing:  # as if a long picture were drawn
            for page, number in ((1, 5), (2, 4), (2, 6), (2, 3)):
                threads.append(threading.Thread(target=request, args=(page, number)))
                threads[-1].start()
                newest = (page, max(number, 6)) if number == 3 else (page, number)
                while live._newest != newest:
                    time.sleep(0.005)
            time.sleep(0.1)  # the last one changes nothing that could be waited for
        for thread in threads:
            thread.join()
        assert answers == {"1.5": 200, "2.4": 204, "2.6": 200, "2.3": 204}
        assert sorted(drawn) == [5, 6]
        status, headers, body = asking(server)(f"/picture?{SMALL}&page=2&number=1")
        assert (status, body) == (204, b"")
        assert "Content-Length" not in headers


def test_a_picture_that_is_overtaken_while_it_is_decoded_is_not_marched(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marched, frame, march = list[float](), Renderer._frame, Renderer._march_frame
    with fhash_codec.open(whole) as volume:
        live = Live(volume)

        def overtaking(self: Renderer, *given: Any) -> Any:
            live._newest = 7.0, 2.0
            return frame(self, *given)

        def counted(self: Renderer, plan: Any, *given: Any) -> Any:
            marched.append(plan.step)
            return march(self, plan, *given)

        monkeypatch.setattr(Renderer, "_frame", overtaking)
        monkeypatch.setattr(Renderer, "_march_frame", counted)
        assert live.answer("picture", f"{SMALL}&page=7&number=1&step=1")[0] == 204
        assert (1.0, 0) in live._renderer._frames  # decoded, and kept
        live._newest = 0.0, 0.0
        assert live.answer("picture", f"{SMALL}&page=7&number=2&step=2")[0] == 200
        live._newest = 0.0, 0.0
        assert live.answer("picture", f"{SMALL}&page=8&number=1&step=3")[0] == 200
    assert marched == [2.0, 3.0]  # the second is the newest, the third is another page's


def test_guards_are_those_of_the_server(whole: Path) -> None:
    with serving(whole) as (_, server):
        check_guards(asking(server))
        head = f"HEAD /picture?{SMALL} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        status, headers, rest = raw(server, head.encode())
        assert (status, headers["Content-Type"], rest) == (b"HTTP/1.1 200 OK", "image/png", b"")


def check_guards(ask: Ask) -> None:
    for path in ("/", f"/picture?{SMALL}"):
        status, headers, body = ask(path)
        assert status == 200
        assert headers["Content-Security-Policy"] == "frame-ancestors 'none'"
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert headers["Cache-Control"] == "no-store"
        status, head, nothing = ask(path, "HEAD")
        assert (status, nothing) == (200, b"")
        assert head["Content-Length"] == headers["Content-Length"] == str(len(body))
        status, _, line = ask(path, Host="evil.example")
        assert (status, line[:8]) == (421, b"this is ")
        assert ask(path, "POST")[0] == 405
        origin = ask(path, Origin="https://example.org")[1]
        assert "Access-Control-Allow-Origin" not in origin
    for path in ("/index.html", "/whole.fhz", "/picture/", "/../etc/passwd", "/live.htm"):
        assert ask(path)[::2] == (404, b"there are / and /picture\n")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (DamagedFileError("a tile is\ndamaged"), "a tile is damaged"),
        (KeyError("x"), "unexpected KeyError: 'x'"),
    ],
)
def test_a_failure_is_one_of_one_answer(
    whole: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, line: str
) -> None:
    news: list[str] = []
    with serving(whole, news.append) as (live, server):
        with monkeypatch.context() as patched:
            patched.setattr(live._renderer, "plan", lambda scene: (_ for _ in ()).throw(error))
            status, headers, body = asking(server)(f"/picture?{SMALL}")
        assert (status, body.decode()) == (500, f"{line}\n")
        assert headers["Cache-Control"] == "no-store"
        assert news == [f"picture: {line}"]
        assert asking(server)(f"/picture?{SMALL}")[0] == 200


def test_the_page_is_no_file_of_the_other_page(whole: Path) -> None:
    assert Page([whole]).size(PAGE.name) is None
    text = PAGE.read_text()
    assert text.count("FACTS") == 1
    assert not re.findall(r"(?:src|href)=\"(?!data:)|https?://|import\b", text)


BROWSER = """
const url = process.argv[1], html = await (await fetch(url)).text(), log = [];
const made = {}, real = fetch, sleep = (ms) => new Promise((done) => setTimeout(done, ms));
const element = () => ({ offsetHeight: 40, getContext: () => context, setPointerCapture() {} });
const context = { fillRect: (...at) => log.push({ cleared: at }),
  drawImage: (picture, ...at) => log.push({ drawn: [picture.width, picture.height], at }) };
globalThis.document = { getElementById: (id) => (made[id] ??= element()) };
document.getElementById("facts").textContent = /id="facts"[^>]*>([^<]*)</.exec(html)[1];
Object.assign(globalThis, { innerWidth: 300, innerHeight: 340 });
globalThis.fetch = async (path) => {
  log.push({ asked: Object.fromEntries(new URL(path, url).searchParams) });
  const answer = await real(url + path);
  if (path.includes("number=5")) await sleep(400); // longer than the page waits at rest
  log.push({ status: answer.status, view: JSON.parse(answer.headers.get("Fhash-Picture"))?.view });
  return answer;
};
globalThis.createImageBitmap = async (blob) => {
  const bytes = new DataView(await blob.arrayBuffer());
  return { width: bytes.getUint32(16), height: bytes.getUint32(20) };
};
(0, eval)(/<script>([^]*)<\\/script>/.exec(html)[1]);
const drawn = async (count) => {
  while (log.filter((each) => each.drawn).length < count) await sleep(5);
};
await drawn(1);
for (let n = 0; n < 5; n++) made.canvas.onpointermove({ buttons: 1, movementX: 10, movementY: 4 });
made.canvas.onpointermove({ buttons: 0, movementX: 99, movementY: 99 });
await drawn(4);
await sleep(400);
globalThis.onkeydown({ key: "+" });
await drawn(6);
const status = made.status.textContent, hidden = made.time.hidden;
console.log(JSON.stringify({ log, status, title: document.title, hidden }));
"""
"""The page in node with what it needs of a browser; prints its requests and what it draws."""


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node")
def test_the_page_asks_for_coarse_pictures_while_it_moves_and_a_full_one_at_rest(
    whole: Path,
) -> None:
    with serving(whole) as (_, server):
        words = ["node", "--input-type=module", "-e", BROWSER, server.url]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    asked = [each["asked"] for each in found["log"] if "asked" in each]
    # Of five movements only the first and the last are drawn, one after the other.
    assert [each["coarse"] for each in asked] == ["0", "1", "1", "0", "1", "0"]
    assert [each["number"] for each in asked] == [*"123456"]
    assert len({each["page"] for each in asked}) == 1
    assert (asked[0]["width"], asked[0]["height"]) == ("300", "300")
    assert [float(each["azimuth"]) for each in asked] == pytest.approx([0, -6, -30, -30, -30, -30])
    assert float(asked[3]["elevation"]) == pytest.approx(12)
    assert [each["zoom"] for each in asked] == [*"1111", "1.15", "1.15"]
    # None is asked for before the one before it has come.
    order = [each.get("status", "asked") for each in found["log"] if {"asked", "status"} & {*each}]
    assert order == ["asked", 200] * 6
    left, top, width, height, bar = next(each["view"] for each in found["log"] if "view" in each)
    drawn = [each for each in found["log"] if "drawn" in each]
    assert [each["at"] for each in drawn[:2]] == [[0, 0], [left, top, width, height]]
    assert drawn[0]["drawn"] == [300, 300]
    assert drawn[1]["drawn"] == [-(-width // 4), -(-height // 4)]
    assert next(each["cleared"] for each in found["log"] if "cleared" in each)[2] == bar
    assert re.fullmatch(r"300 x 300, \d+ ms \(drawing \d+\), cpu, [\d,]+ samples", found["status"])
    assert (found["title"], found["hidden"]) == ("whole.fhz - fhash view", False)
