"""The page of `fhash view`: for a server, copied for other servers, and in notebooks."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from fhash_codec.boxes import Box
from fhash_codec.rendering.colours import named_map
from fhash_formats.container import Container
from fhash_formats.errors import InputError, MissingDependencyError, MissingInputError, OutputError
from fhash_formats.support.files import check_output, replacing_all

FOLDER = Path(__file__).with_name("page")
"""Files of the page, of which those in KINDS are given."""
PRIORS = ("prior.bin", "mask_prior.bin", "fast_prior.bin")
"""Files that the decoder fetches when it needs them: numbers 0 to 2 of native/priors.hpp."""
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".wasm": "application/wasm",
    ".bin": "application/octet-stream",
}
"""Media types of the page's files by suffix, and of containers: that of .bin."""
INDEX = "index.html"
PIECE = 1 << 20
"""Bytes that are read from a container at a time."""
MOST_EMBEDDED = 256 << 20
"""Bytes of the largest container that a notebook holds."""
THUMBNAIL = 160
"""Pixels of the longer side of the picture of a volume in a notebook, about."""


def _files() -> dict[str, Path]:
    """The page's files by name."""
    return {path.name: path for path in FOLDER.iterdir() if path.suffix in KINDS}


def _index(names: Sequence[str]) -> bytes:
    """The page with the names of the containers beside it."""
    listed = json.dumps([{"name": name, "url": quote(name)} for name in names])
    text = (FOLDER / INDEX).read_text("utf-8")
    return text.replace('id="files">[]', 'id="files">' + listed.replace("<", "\\u003c")).encode()


class Page:
    """The page and containers as a `server.View`; a container that changes is given as it is.

    Attributes:
        runs: path of each container by the name that it is given under.
        hint: what a client is told that asks for an unknown key.
    """

    hint = "no such file; open {url} in a browser"

    def __init__(self, runs: Sequence[str | Path]) -> None:
        """Look at containers; raises what opening raises, and InputError for what is remote."""
        self._files = _files()
        self.runs: dict[str, Path] = {}
        for run in runs:
            path = Path(run)
            if "://" in str(run):
                raise InputError(
                    f"{run}: only files of this machine are given; the page opens a URL by Open"
                )
            Container.open(path).close()
            name, number = path.name, 2
            while name in self.runs or name in self._files:
                name, number = f"{number}-{path.name}", number + 1
            self.runs[name] = path.resolve()
        self._index = _index([*self.runs])

    def _path(self, key: str) -> Path | None:
        return self.runs.get(key, self._files.get(key))

    def tag_of(self, key: str) -> str:
        """Text that differs where the bytes of a key may."""
        path = self._path(key)
        if key in ("", INDEX) or path is None:
            return hashlib.sha256(self._index).hexdigest()
        status = path.stat()
        return f"{path}/{status.st_mtime_ns}/{status.st_size}"

    def size(self, key: str) -> int | None:
        """The number of bytes of a key; None where there is no such key."""
        if key in ("", INDEX):
            return len(self._index)
        path = self._path(key)
        return path.stat().st_size if path is not None and path.is_file() else None

    def kind(self, key: str) -> str:
        """The media type of a key."""
        return KINDS[".bin" if key in self.runs else Path(key or INDEX).suffix]

    def pieces(self, key: str, first: int, end: int) -> Iterator[bytes]:
        """Yield the bytes of a key that there is, from `first` to before `end`."""
        path = self._path(key)
        if key in ("", INDEX) or path is None:
            yield self._index[first:end]
            return
        with path.open("rb") as file:
            file.seek(first)
            while first < end and (piece := file.read(min(PIECE, end - first))):
                first += len(piece)
                yield piece

    def write(self, folder: str | Path, *, force: bool = False) -> list[Path]:
        """Write page and containers for any web server; the paths, the page itself last.

        A container that lies in the folder already stays. All files are written completely, or none
        is. Raises OutputExistsError unless `force`, OutputError for what cannot be written.
        """
        folder = Path(folder)
        copies = {
            name: path
            for name, path in {**self._files, **self.runs}.items()
            if name != INDEX and (folder / name).resolve() != path
        }
        outputs = [*(folder / name for name in copies), folder / INDEX]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made: {error.strerror or error}") from error
        for output in outputs:
            check_output(output, force)
        with replacing_all(outputs, force=force) as temporaries:
            for temporary, path in zip(temporaries[:-1], copies.values(), strict=True):
                shutil.copyfile(path, temporary)
            temporaries[-1].write_bytes(self._index)
        return outputs


def embedded() -> tuple[str, dict[str, Any]]:
    """The page in one text, for a frame without an address, and what it is sent beside a container.

    The text asks its parent by `{fhashReady: true}`, which answers `{fhash: {name, bytes, wasm,
    priors, script}}`: arrays of bytes, and the address of the worker's text.
    """
    text = (FOLDER / INDEX).read_text("utf-8")
    modules = {
        path.name: path.read_text("utf-8").replace('from "./', 'from "fhash/')
        for path in sorted(FOLDER.glob("*.js"))
        if path.name != "worker.js"
    }
    addresses = {
        f"fhash/{name}": "data:text/javascript;base64," + base64.b64encode(each.encode()).decode()
        for name, each in modules.items()
    }
    style = (FOLDER / "style.css").read_text("utf-8")
    text = text.replace('<link rel="stylesheet" href="style.css">', f"<style>{style}</style>")
    text = text.replace(
        '<script type="module" src="app.js"></script>',
        f'<script type="importmap">{json.dumps({"imports": addresses})}</script>'
        '<script type="module">import "fhash/app.js";</script>',
    )
    sent = {
        "wasm": (FOLDER / "fhash.wasm").read_bytes(),
        "priors": [(FOLDER / name).read_bytes() for name in PRIORS],
        "script": (FOLDER / "worker.js").read_text("utf-8"),
    }
    return text, sent


WIDGET = """
function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.style.cssText = `width: 100%; height: ${model.get("height")}px; border: 0`;
  const script = URL.createObjectURL(new Blob([model.get("script")], { type: "text/javascript" }));
  const bytes = (one) => new Uint8Array(one.buffer, one.byteOffset, one.byteLength).slice().buffer;
  const answer = ({ data, source }) => {
    if (source !== frame.contentWindow || !data?.fhashReady) return;
    const [name, priors] = [model.get("name"), model.get("priors").map(bytes)];
    const given = { name, priors, script, bytes: bytes(model.get("bytes")) };
    frame.contentWindow.postMessage({ fhash: { ...given, wasm: bytes(model.get("wasm")) } }, "*");
  };
  addEventListener("message", answer);
  frame.srcdoc = model.get("page");
  el.append(frame);
  return () => { removeEventListener("message", answer); URL.revokeObjectURL(script); };
}
export default { render };
"""
"""The part of the widget in the browser: the page in a frame, which is sent the container."""


def widget(path: str | Path, height: int) -> Any:
    """A widget that shows a container in a notebook, `height` pixels high.

    The file's bytes go through the kernel. Raises MissingDependencyError without anywidget, and
    InputError for a file that is remote or larger than MOST_EMBEDDED.
    """
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise MissingDependencyError(
            "view needs anywidget; pip install 'fhash[notebook]'"
        ) from error
    path = Path(path)
    if not path.is_file():
        raise MissingInputError(
            f"{path}: no file of this machine; fhash view shows it in a browser"
        )
    if path.stat().st_size > MOST_EMBEDDED:
        raise InputError(
            f"{path}: larger than {MOST_EMBEDDED >> 20} MiB; use `fhash view`, which reads parts"
        )
    page, sent = embedded()
    values = {"page": page, **sent, "name": path.name, "bytes": path.read_bytes(), "height": height}
    traits = {name: traitlets.Any(value).tag(sync=True) for name, value in values.items()}
    return type("View", (anywidget.AnyWidget,), {"_esm": WIDGET, **traits})()


def html_of(volume: Any) -> str:
    """A table about an open `Volume` and a picture of its middle slice, for notebooks.

    The slice is of a coarse level of detail, so that little is decoded.
    """
    attributes = volume.container.header["variable"].get("attributes", {})
    quality: Mapping[str, Any] = volume.container.header["quality"]
    rows = {
        "variable": f"{volume.name} [{volume.units}]" if volume.units else volume.name,
        "meaning": attributes.get("long_name", attributes.get("standard_name", "")),
        "t, z, y, x": ", ".join(map(str, volume.shape)),
        "type": str(volume.dtype),
        "range": f"{volume.value_range.low:g} to {volume.value_range.high:g}",
        "largest error": ""
        if quality.get("max_abs_error") is None
        else f"{quality['max_abs_error']:g}",
        "PSNR": "" if quality.get("psnr") is None else f"{quality['psnr']:.2f} dB",
        "file": str(volume.path),
    }
    cells = "".join(
        f"<tr><th style='text-align:left'>{name}</th><td>{html.escape(str(text))}</td></tr>"
        for name, text in rows.items()
        if text
    )
    picture = base64.b64encode(_slice(volume)).decode()
    image = f"<img alt='middle slice' src='data:image/png;base64,{picture}'>"
    return (
        f"<div style='display:flex;gap:1em;align-items:center'>{image}<table>{cells}</table></div>"
    )


def _slice(volume: Any) -> bytes:
    """A PNG of the slice through the middle of z, or of the first axis of one vertex, at step 0."""
    from PIL import Image

    lod = 0
    while max(volume.shape[1:]) >> lod > THUMBNAIL and lod < 10:
        lod += 1
    axis = volume.shape[1:].index(min(volume.shape[1:]))
    middle = volume.shape[1 + axis] // 2 >> lod << lod
    region = [(0, n) for n in volume.shape[1:]]
    region[axis] = (middle, middle + 1)
    values = np.asarray(volume.read_lod(0, lod, Box.of(region)), dtype=np.float64).squeeze(axis)
    low, high = volume.value_range.low, volume.value_range.high
    share = (values - low) / ((high - low) or 1.0)
    colours = np.concatenate([named_map("viridis")(share), ~np.isnan(values)[..., None]], axis=-1)
    rows, columns = (volume.coords["zyx"[n]].values for n in range(3) if n != axis)
    colours = colours[::-1] if rows[-1] >= rows[0] else colours  # the lowest position below
    colours = colours if columns[-1] >= columns[0] else colours[:, ::-1]
    image = Image.fromarray(np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8))
    factor = max(THUMBNAIL // max(image.size), 1)
    image = image.resize((image.width * factor, image.height * factor), Image.Resampling.NEAREST)
    file = io.BytesIO()
    image.save(file, format="PNG")
    return file.getvalue()
