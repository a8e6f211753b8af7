"""Animations on disk: numbered pictures, of which those that are there already are kept, and films."""

from __future__ import annotations

import dataclasses
import re
import time
import warnings
from collections import Counter
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.animation.animation import Animation
from fhash_codec.rendering.animation.film import FILMS, check_film, film
from fhash_codec.rendering.picture.image import Image
from fhash_codec.rendering.scene.png_text import digest_in_png
from fhash_codec.rendering.scene.scene import Scene, scene_in_png
from fhash_codec.volume import Volume
from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.support.atomic import check_output
from fhash_formats.support.leftovers import clear

__all__ = ["Animated", "animate", "numbered"]


class Draw(Protocol):
    """What renders a scene while it prepares another one, as `Renderer.render` does."""

    def __call__(self, scene: Scene, /, *, upcoming: Scene | None = None) -> Image:
        """The picture."""


Pixels = npt.NDArray[np.uint8]

END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
"""The last bytes of every complete PNG."""


@dataclass(frozen=True, kw_only=True)
class Animated:
    """What `animate` did: the files that are now there, how many pictures were rendered and kept, the sum of their counters, seconds."""

    paths: tuple[Path, ...]
    rendered: int
    kept: int
    counters: dict[str, int]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**dataclasses.asdict(self), "paths": [str(path) for path in self.paths]}


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
) -> Animated:
    """Render every picture of an animation: to NAME.0000.png and so on for an output NAME.png, to a film for NAME.mp4 and NAME.gif.

    pictures: NAME.png; the numbered pictures of a film are written too, and kept. A numbered picture that is there, complete, of the same
    scene and the same volume (by its digest) is not rendered again; any other is replaced only with `force`.
    draw: what renders, `Renderer(volume).render` if None.
    Raises InputError for names of other kinds and what `Animation.scenes` refuses, OutputExistsError before anything is rendered,
    OutputError, MissingDependencyError without the package for MP4.
    """
    output = Path(output)
    suffix = output.suffix.lower()
    if suffix not in (".png", *FILMS):
        raise InputError(
            f"{output}: an animation is written as .png (numbered), {' or '.join(FILMS)}; use such a name"
        )
    if pictures is not None and (suffix == ".png" or Path(pictures).suffix.lower() != ".png"):
        raise InputError(
            f"{pictures}: pictures beside a film are written as .png; use such a name, and .mp4 or .gif for the film"
        )
    begun = time.perf_counter()
    scenes = animation.scenes(scene, volume)
    base = output if suffix == ".png" else None if pictures is None else Path(pictures)
    paths = [] if base is None else numbered(base, len(scenes))
    clear(paths)  # also beside the pictures that are kept, which no one writes anew
    kept = (
        [_kept(path, each, volume) for path, each in zip(paths, scenes, strict=bool(paths))]
        if paths
        else []
    )
    if suffix != ".png":
        check_output(output, force, sources=[volume.path])
        check_film(suffix)
    for path, good in zip(paths, kept, strict=True):
        if not good:
            check_output(path, force, sources=[volume.path])
    _warn_of_others(paths)
    if draw is None:
        from fhash_codec.rendering.renderer import Renderer

        draw = Renderer(volume).render
    counters: Counter[str] = Counter()

    def frames() -> Generator[Pixels, None, None]:
        for number, each in enumerate(scenes):
            if kept and kept[number]:
                if suffix != ".png":
                    yield _pixels(paths[number])
            else:
                assert draw is not None
                following = number + 1 < len(scenes) and not (kept and kept[number + 1])
                image = draw(each, upcoming=scenes[number + 1] if following else None)
                counters.update(image.counters)
                image = dataclasses.replace(
                    image,
                    scene=each.to_dict(),
                    source=str(volume.path),
                    digest=volume.container.digest,
                )
                if paths:
                    image.save(paths[number], force=force)
                yield image.to_uint8("#ffffff" if image.background == "transparent" else None)
            progress("rendering", number + 1, len(scenes), "")

    if suffix == ".png":
        for _ in frames():
            pass
        written = paths
    else:
        with closing(frames()) as source:
            film(output, source, scene.size, animation.rate, force=force)
        written = [*paths, output]
    return Animated(
        paths=tuple(written),
        rendered=len(scenes) - sum(kept),
        kept=sum(kept),
        counters=dict(counters),
        seconds=time.perf_counter() - begun,
    )


def numbered(path: Path, count: int) -> list[Path]:
    """NAME.0000.png and so on for NAME.png, with as many digits as the last needs and no fewer than 4."""
    digits = max(4, len(str(count - 1)))
    return [
        path.with_name(f"{path.stem}.{number:0{digits}}{path.suffix}") for number in range(count)
    ]


def _kept(path: Path, scene: Scene, volume: Volume) -> bool:
    """Whether a picture is there, complete, and still that of a scene and a volume."""
    try:
        with path.open("rb") as file:
            file.seek(-len(END), 2)
            if file.read() != END:
                return False
        if not all(
            path.with_name(f"{path.stem}.{name}.npy").is_file() for name in scene.effects.buffers
        ):
            return False
        return digest_in_png(path) == volume.container.digest and scene_in_png(path) == scene
    except (OSError, InputError):
        return False


def _warn_of_others(paths: list[Path]) -> None:
    """Numbered pictures of the same name behind the last one would go into a film that another program makes of them."""
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


def _pixels(path: Path) -> Pixels:
    """Bytes (H, W, 3) of a picture that was kept; what is transparent lies on white, as in a film of pictures that are rendered."""
    from PIL import Image as Pictures

    with Pictures.open(path) as picture:
        if picture.mode != "RGBA":
            return np.asarray(picture.convert("RGB"))
        paper = Pictures.new("RGBA", picture.size, "white")
        return np.asarray(Pictures.alpha_composite(paper, picture).convert("RGB"))
