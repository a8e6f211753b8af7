"""Pictures that this machine draws for a page in a browser (`fhash view --live`)."""

from __future__ import annotations

import io
import json
import threading
from dataclasses import replace
from http import HTTPStatus
from pathlib import Path
from urllib.parse import parse_qsl

from fhash_codec.rendering.cameras import usual_size
from fhash_codec.rendering.grid import Grid
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import USUAL_EFFECTS, Camera, Scene
from fhash_codec.views.server import Answer
from fhash_codec.volume import Volume
from fhash_formats.errors import InputError, suggestion
from fhash_formats.support.files import file_name

PAGE = Path(__file__).with_name("live.html")
"""The page."""
CAMERA = ("azimuth", "elevation", "zoom")
"""Names in a query that are fields of the camera."""
NUMBERS = ("step", *CAMERA, "width", "height", "coarse", "page", "number")
"""Names in a query. Each value is a finite number."""
MAX_PIXELS = 2048
"""Pixels along a side of a picture, at most: twice what the page asks for."""
PICTURES = 1000
"""Pictures of a session, about: the start of a GPU pays for so many."""
COMPRESSION = 1
"""Level of zlib. A picture of 1024 x 1024 pixels takes 45 ms on one core, and 130 ms at the usual
level 6 for a sixth fewer bytes."""
MOVING_EFFECTS = replace(USUAL_EFFECTS, axes=False, colour_bar=False, time_label=False)
"""Effects of a coarse picture: texts would be too large in it, and take longer than its rays."""


class _OvertakenError(Exception):
    """A request whose page has sent a newer one."""


class Live:
    """A page and the pictures that it asks for, as a `server.Answering` view.

    `picture?step=3&azimuth=30&elevation=10&zoom=2&width=800&height=800` is a PNG; what is left out
    is as in the default picture of `fhash render`, and `coarse=1` leaves out all texts. A request
    is answered with 204 and not drawn if its `page` has sent a larger `number` meanwhile. A header
    `Fhash-Picture` has, as JSON, `view`: left, top, width and height of the part that shows the
    volume, and the first column of the colour bar; `ms` of drawing; `device`; `samples`.
    """

    def __init__(self, volume: Volume) -> None:
        """Plan the default picture; raises what planning raises.

        volume: an open container that nobody else reads until `close`.
        """
        self._renderer = Renderer(volume, pictures=PICTURES)
        size = usual_size(Camera(), Grid.of_volume(volume))
        scene = Scene(effects=USUAL_EFFECTS, size=size)
        self._scene = self._renderer.plan(scene).scene
        facts = {"name": file_name(volume.path), "size": size, "last": volume.shape[0] - 1}
        text = json.dumps({**facts, "step": self._scene.step or 0}).replace("<", "\\u003c")
        self._page = PAGE.read_text("utf-8").replace("FACTS", text).encode()
        self._drawing = threading.Lock()
        self._newest = 0.0, 0.0  # page and number of the last request

    def close(self) -> None:
        """Wait for the picture that is drawn, and draw no other; then the volume may be closed."""
        self._drawing.acquire()

    def answer(self, key: str, query: str) -> Answer:
        """The page, or a picture; a line where there is none."""
        status, line = HTTPStatus.NOT_FOUND, "there are / and /picture"
        try:
            if key == "":
                return HTTPStatus.OK, {"Content-Type": "text/html; charset=utf-8"}, self._page
            if key == "picture":
                return self._picture(_numbers(query))
        except _OvertakenError:
            return HTTPStatus.NO_CONTENT, {}, b""
        except InputError as error:
            status, line = HTTPStatus.BAD_REQUEST, " ".join(str(error).split())
        return status, {"Content-Type": "text/plain; charset=utf-8"}, f"{line}\n".encode()

    def _picture(self, asked: dict[str, float]) -> Answer:
        """Draw a picture, unless its page asks for another one before its turn comes."""
        from PIL import Image as Pictures

        file = io.BytesIO()
        page, number = asked.get("page", 0.0), asked.get("number", 0.0)
        scene = self._scene_of(asked)
        if self._newest[0] != page or self._newest[1] < number:
            self._newest = page, number

        def check(stage: str = "marching", done: int = 0, total: int = 1, _: str = "") -> None:
            # Decoding is not interrupted, for the next picture needs the frame.
            if stage == "marching" and self._newest[0] == page and self._newest[1] > number:
                raise _OvertakenError

        with self._drawing:
            check()
            plan = self._renderer.plan(scene)
            image = self._renderer.render(plan=plan, progress=check)
        Pictures.fromarray(image.to_uint8()).save(file, "PNG", compress_level=COMPRESSION)
        bar = plan.layout.bar  # whose frame and name begin a bit before its colours
        view = *plan.layout.view, scene.size[0] if bar is None else bar.box[0] - 4
        told = {"view": view, "device": plan.device, "samples": image.counters["samples"]}
        told["ms"] = round(1000 * image.seconds)
        headers = {"Content-Type": "image/png", "Fhash-Picture": json.dumps(told)}
        return HTTPStatus.OK, headers, file.getvalue()

    def _scene_of(self, asked: dict[str, float]) -> Scene:
        """The scene of a query; raises InputError for numbers that are not allowed."""
        width, height = self._scene.size
        size = int(asked.get("width", width)), int(asked.get("height", height))
        if max(size) > MAX_PIXELS:  # a scene knows the least
            raise InputError(f"size is {size[0]:.6g} x {size[1]:.6g}; allowed: 1 to {MAX_PIXELS}")
        return replace(
            self._scene,
            camera=Camera.from_dict({name: asked[name] for name in CAMERA if name in asked}),
            size=size,
            step=asked.get("step", self._scene.step),
            effects=MOVING_EFFECTS if asked.get("coarse") else USUAL_EFFECTS,
        )


def _numbers(query: str) -> dict[str, float]:
    """The numbers of a query by name; raises InputError for anything else."""
    numbers: dict[str, float] = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in NUMBERS:
            raise InputError(f"unknown {name[:40]!r}; {suggestion(name, NUMBERS)}")
        try:
            numbers[name] = float(text)
            int(numbers[name])  # refuses infinity and NaN
        except (ValueError, OverflowError) as error:
            raise InputError(f"{name} is {text[:40]!r}; a finite number is needed") from error
    return numbers
