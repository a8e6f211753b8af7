"""Animations on disk: numbered pictures, of which complete ones are kept, and films."""

from __future__ import annotations

import dataclasses
import re
import time
import warnings
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.animation.animation import Animation
from fhash_codec.rendering.animation.film import FILMS, check_film, film
from fhash_codec.rendering.animation.workers import rendered_by_workers
from fhash_codec.rendering.picture.image import Draw, Image
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scene.png_text import digest_in_png
from fhash_codec.rendering.scene.scene import Scene, scene_in_png
from fhash_codec.volume import Volume
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.support.atomic import check_output
from fhash_formats.support.leftovers import clear
from fhash_formats.support.locations import without_secrets

__all__ = ["Animated", "animate", "numbered"]

Pixels = npt.NDArray[np.uint8]

PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
"""Last bytes of every complete PNG."""


@dataclass(frozen=True, kw_only=True)
class Animated:
    """Result of `animate`.

    Attributes:
        paths: files that are now there.
        rendered: number of pictures that were rendered.
        kept: number of pictures that were there already.
        counters: sums of the counters of the rendered pictures.
        seconds: time of the whole job.
    """

    paths: tuple[Path, ...]
    rendered: int
    kept: int
    counters: dict[str, int]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**dataclasses.asdict(self), "paths": [str(path) for path in self.paths]}


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """One picture of an animation: its scene, its numbered file if any, whether that is kept."""

    scene: Scene
    path: Path | None
    kept: bool


def animate(
    volume: Volume,
    scene: Scene,
    animation: Animation,
    output: str | Path,
    *,
    pictures: str | Path | None = None,
    force: bool = False,
    progress: Progress = silent,
    draw: Draw | None = None,
    processes: int = 1,
) -> Animated:
    """Render every picture of an animation to numbered files or to a film.

    A numbered picture that is already there is kept if it is complete, of the same scene and of the
    same volume (by its digest). Any other file is replaced only with `force`.

    Args:
        volume: an open container.
        scene: what is shown where the animation changes nothing.
        animation: what changes.
        output: NAME.png for pictures NAME.0000.png and so on, NAME.mp4 or NAME.gif for a film.
        pictures: NAME.png; the numbered pictures of a film are written too, and kept.
        force: whether to replace files.
        progress: is told about each finished picture.
        draw: renders one picture; `Renderer(volume).render` if None.
        processes: how many render at a time, each with its share of the threads and frames of its
            own in memory. The files are the same as with one.

    Raises InputError for file names of other kinds, for what `Animation.scenes` refuses and for
    `draw` with several processes, FhashError where one of these ends by itself,
    OutputExistsError before anything is rendered, OutputError for what cannot be written,
    MissingDependencyError without the package for MP4.
    """
    output = Path(output)
    if processes < 1 or (draw is not None and processes > 1):
        raise InputError(
            f"processes is {processes}; at least 1 is needed, and 1 where 'draw' is given"
        )
    _check_names(output, pictures)
    is_film = output.suffix.lower() != ".png"
    begun = time.perf_counter()
    scenes = animation.scenes(scene, volume)
    base = pictures if is_film else output
    paths = [] if base is None else numbered(Path(base), len(scenes))
    clear(paths)  # the temporary files beside kept pictures too, which are not written anew
    frames = _frames(scenes, paths, volume)
    if is_film:
        check_output(output, force, sources=[volume.path])
        check_film(output.suffix.lower())
    for frame in frames:
        if frame.path is not None and not frame.kept:
            check_output(frame.path, force, sources=[volume.path])
    _warn_of_others(paths)
    counters: Counter[str] = Counter()
    with closing(_rendered(frames, volume, draw, processes)) as rendered:
        made = _made(frames, volume, rendered, force, counters, progress)
        if is_film:
            film(output, map(_pixels, made), scene.size, animation.rate, force=force)
        else:
            for _ in made:
                pass
    kept = sum(frame.kept for frame in frames)
    return Animated(
        paths=(*paths, output) if is_film else tuple(paths),
        rendered=len(frames) - kept,
        kept=kept,
        counters=dict(counters),
        seconds=time.perf_counter() - begun,
    )


def numbered(path: Path, count: int) -> list[Path]:
    """NAME.0000.png and so on for NAME.png, with as many digits as needed and at least 4."""
    digits = max(4, len(str(count - 1)))
    return [
        path.with_name(f"{path.stem}.{number:0{digits}}{path.suffix}") for number in range(count)
    ]


def _check_names(output: Path, pictures: str | Path | None) -> None:
    """Raise InputError for names of files that are neither pictures nor films."""
    suffix = output.suffix.lower()
    if suffix not in (".png", *FILMS):
        raise InputError(
            f"{output}: an animation is written as .png (numbered), {' or '.join(FILMS)}; "
            "use such a name"
        )
    if pictures is not None and (suffix == ".png" or Path(pictures).suffix.lower() != ".png"):
        raise InputError(
            f"{pictures}: pictures beside a film are written as .png; use such a name, "
            "and .mp4 or .gif for the film"
        )


def _frames(scenes: Sequence[Scene], paths: Sequence[Path], volume: Volume) -> list[_Frame]:
    """The frames of an animation; `paths` are empty if no numbered pictures are written."""
    if not paths:
        return [_Frame(scene=scene, path=None, kept=False) for scene in scenes]
    return [
        _Frame(scene=scene, path=path, kept=_is_good(path, scene, volume))
        for scene, path in zip(scenes, paths, strict=True)
    ]


def _is_good(path: Path, scene: Scene, volume: Volume) -> bool:
    """Whether a picture is there, complete, and of a scene and a volume."""
    try:
        with path.open("rb") as file:
            file.seek(-len(PNG_END), 2)
            if file.read() != PNG_END:
                return False
        if not all(
            path.with_name(f"{path.stem}.{name}.npy").is_file() for name in scene.effects.buffers
        ):
            return False
        return digest_in_png(path) == volume.container.digest and scene_in_png(path) == scene
    except (OSError, InputError):
        return False


def _rendered(
    frames: Sequence[_Frame], volume: Volume, draw: Draw | None, processes: int
) -> Generator[Image, None, None]:
    """Render the frames that are not kept, in order, here or in several processes."""
    scenes = [frame.scene for frame in frames if not frame.kept]
    processes = min(processes, len(scenes))
    if processes > 1:
        yield from rendered_by_workers(volume, scenes, processes)
        return
    draw = Renderer(volume).render if draw is None else draw
    # A frame is decoded ahead only for the very next picture.
    following = {number: after.scene for number, after in enumerate(frames[1:]) if not after.kept}
    for number, frame in enumerate(frames):
        if not frame.kept:
            yield draw(frame.scene, upcoming=following.get(number))


def _made(
    frames: Sequence[_Frame],
    volume: Volume,
    rendered: Iterator[Image],
    force: bool,
    counters: Counter[str],
    progress: Progress,
) -> Generator[Image | Path, None, None]:
    """Make the frames in order: the paths of kept pictures, and rendered images, which are saved.

    The counters of rendered images are added to `counters`.
    """
    for number, frame in enumerate(frames):
        if frame.kept:
            assert frame.path is not None
            yield frame.path
        else:
            image = next(rendered)
            counters.update(image.counters)
            image = dataclasses.replace(
                image,
                scene=frame.scene.to_dict(),
                source=without_secrets(volume.path),
                digest=volume.container.digest,
            )
            if frame.path is not None:
                image.save(frame.path, force=force)
            yield image
        progress("rendering", number + 1, len(frames), "")


def _warn_of_others(paths: Sequence[Path]) -> None:
    """Warn of numbered pictures of the same name beyond the last one.

    Another program that makes a film of the numbered pictures would take them too.
    """
    if not paths:
        return
    stem = paths[0].stem.rpartition(".")[0]
    form = re.compile(re.escape(stem) + r"\.\d{4,}" + re.escape(paths[0].suffix))
    others = sorted(
        {path.name for path in paths[0].parent.iterdir() if form.fullmatch(path.name)}
        - {path.name for path in paths}
    )
    if others:
        warnings.warn(
            f"{others[0]} and {len(others) - 1} more are of another animation of this name",
            FhashWarning,
            stacklevel=3,
        )


def _pixels(picture: Image | Path) -> Pixels:
    """The pixels (H, W, 3) of a picture in a film; what is transparent lies on white."""
    if isinstance(picture, Image):
        return picture.to_uint8("#ffffff" if picture.background == "transparent" else None)
    from PIL import Image as Pictures

    with Pictures.open(picture) as kept:
        if kept.mode != "RGBA":
            return np.asarray(kept.convert("RGB"))
        paper = Pictures.new("RGBA", kept.size, "white")
        return np.asarray(Pictures.alpha_composite(paper, kept).convert("RGB"))
