"""The gallery: runs the commands of its pictures and writes a page that shows both."""

from __future__ import annotations

import contextlib
import io
import shlex
from pathlib import Path
from typing import Any

import click

from fhash_cli.options import check_writable
from fhash_cli.output import say
from fhash_codec.gallery import GALLERY_SERIES, PICTURES, Picture
from fhash_formats.errors import InputError

__all__ = ["make_gallery", "page"]


def make_gallery(
    folder: Path, run: dict[str, click.Command], *, force: bool, quiet: bool
) -> dict[str, Any]:
    """Simulate the series, encode and draw them: FOLDER/*.png, FOLDER/series and FOLDER.md.

    run: the commands `encode` and `render` by name. Returns the written files as JSON values.
    Raises InputError for a folder that cannot be, and for files that exist, unless `force`.
    """
    data, text = folder / "series", folder.with_name(f"{folder.name}.md")
    try:
        data.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; give a folder that can be made") from error
    pictures = [folder / f"{picture.name}.png" for picture in PICTURES]
    series = [data / f"{name}.{suffix}" for name in GALLERY_SERIES for suffix in ("h5", "fhz")]
    for path in (*pictures, *series, text):
        check_writable(path, force)
    for name, made in GALLERY_SERIES.items():
        if not quiet:
            say(f"simulating and encoding '{name}'")
        _simulate(data / f"{name}.h5", name)
        paths = str(data / f"{name}.h5"), "-o", str(data / f"{name}.fhz")
        _run(run["encode"], [*paths, *made.options, "--force", "-q"])
    for picture, path in zip(PICTURES, pictures, strict=True):
        if not quiet:
            say(f"drawing '{picture.name}'")
        container = str(data / f"{picture.series}.fhz")
        _run(run["render"], [container, "-o", str(path), *picture.options, "--force", "-q"])
    from fhash_formats.support.files import replacing

    with replacing(text, force=force) as temporary:
        temporary.write_text(page(folder.name), encoding="utf-8")
    return {"page": str(text), "pictures": [str(path) for path in pictures]}


def page(folder: str) -> str:
    """The page of the gallery in Markdown; folder: of the pictures, beside the page."""
    lines = [
        "# Gallery",
        "",
        f"`fhash demo --gallery {folder}` simulates these series, encodes and draws them: the",
        f"pictures into `{folder}`, the series and their files into `{folder}/series`, where the",
        "commands below give the same again.",
    ]
    for picture in PICTURES:
        lines += ["", f"## {picture.title}", "", f"![{picture.title}]({folder}/{picture.name}.png)"]
        lines += ["", "```", *commands(picture), "```"]
    return "\n".join(lines) + "\n"


def commands(picture: Picture) -> list[str]:
    """The two commands of a picture, as they are typed in the folder of the series."""
    name = picture.series
    encode = ["fhash", "encode", f"{name}.h5", "-o", f"{name}.fhz", *GALLERY_SERIES[name].options]
    render = ["fhash", "render", f"{name}.fhz", "-o", f"{picture.name}.png", *picture.options]
    return [shlex.join(encode), shlex.join(render)]


def _simulate(path: Path, name: str) -> None:
    """Write a series of the gallery as HDF5."""
    from fhash_formats import Region, save_region

    series = GALLERY_SERIES[name].make()
    save_region(path, Region.of(series), series.frames(), force=True)


def _run(command: click.Command, words: list[str]) -> None:
    """Run a command without its output."""
    with contextlib.redirect_stdout(io.StringIO()):
        command.main(words, standalone_mode=False)
