"""Rendering of an animation: its pictures by several processes, as files or as one film."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import signal
import subprocess
import tempfile
import threading
import time
import warnings
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from fhash_codec.progress import Progress, silent
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.renderer import Renderer
from fhash_codec.rendering.scenes import DIGEST_KEY, Scene, scene_in_png, text_in_png
from fhash_codec.rendering.timeline import Animation
from fhash_codec.volume import Volume
from fhash_codec.volume import open as open_volume
from fhash_formats.container import Location
from fhash_formats.errors import (
    FhashError,
    FhashWarning,
    InputError,
    MissingDependencyError,
    OutputError,
)
from fhash_formats.support.files import check_output, clear_leftovers, replacing, without_secrets
from fhash_formats.support.threads import usable_threads

Pixels = npt.NDArray[np.uint8]

FILMS = (".mp4", ".gif")
"""Suffixes of films."""
QUALITY = 18
"""Constant rate factor of x264: nearly without visible loss."""


def check_film(suffix: str) -> str | None:
    """Find the program that writes MP4; None for a GIF.

    Raises MissingDependencyError where it is not installed.
    """
    if suffix != ".mp4":
        return None
    try:
        return str(importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe())
    except (ImportError, RuntimeError) as error:
        raise MissingDependencyError(
            "an MP4 needs imageio-ffmpeg: pip install 'fhash[video]'; a GIF needs nothing more"
        ) from error


def film(
    path: Path, frames: Iterator[Pixels], size: tuple[int, int], rate: float, *, force: bool = False
) -> None:
    """Write a film, complete or not at all.

    An MP4 is H.264 with 4:2:0 colours, as browsers play it; an odd side gets its last row or column
    twice. A GIF has 256 colours to a picture and repeats for ever; its pictures last whole
    hundredths of a second, at least two.

    Args:
        path: NAME.mp4 or NAME.gif.
        frames: pictures (H, W, 3), at least one.
        size: W, H of the frames.
        rate: pictures per second.
        force: whether to replace a file.

    Raises OutputError for what cannot be written, MissingDependencyError without the package for
    MP4.
    """
    ffmpeg = check_film(path.suffix.lower())
    with replacing(path, force=force) as temporary:
        if ffmpeg is None:
            _write_gif(temporary, frames, rate)
        else:
            _write_mp4(ffmpeg, path, temporary, frames, size, rate)


def _write_gif(path: Path, frames: Iterator[Pixels], rate: float) -> None:
    from PIL import Image as Pictures

    pictures = (
        Pictures.fromarray(frame).quantize(256, dither=Pictures.Dither.NONE) for frame in frames
    )
    first = next(pictures)
    hundredths = max(2, round(100 / rate))
    with path.open("xb") as file:
        first.save(
            file,
            format="GIF",
            save_all=True,
            append_images=pictures,
            duration=10 * hundredths,
            loop=0,
        )


def _write_mp4(
    ffmpeg: str,
    path: Path,
    temporary: Path,
    frames: Iterator[Pixels],
    size: tuple[int, int],
    rate: float,
) -> None:
    wide, high = (side + side % 2 for side in size)
    # The format is named, since the temporary file has another suffix. `faststart` puts the index
    # first, so that a film plays before all of it is loaded.
    words = (
        f"-y -loglevel error -f rawvideo -pix_fmt rgb24 -s {wide}x{high} -r {rate:.6g} -i - "
        f"-an -c:v libx264 -pix_fmt yuv420p -crf {QUALITY} -movflags +faststart -f mp4"
    )
    with tempfile.TemporaryFile() as log:
        with subprocess.Popen(
            [ffmpeg, *words.split(), str(temporary)], stdin=subprocess.PIPE, stdout=log, stderr=log
        ) as process:
            assert process.stdin is not None
            try:
                for frame in frames:
                    padding = ((0, high - frame.shape[0]), (0, wide - frame.shape[1]), (0, 0))
                    process.stdin.write(np.pad(frame, padding, mode="edge").tobytes())
                process.stdin.close()
            except BrokenPipeError:  # ffmpeg says why in its log
                pass
            except BaseException:
                process.kill()
                raise
        if process.returncode != 0:
            log.seek(0)
            reason = (
                " ".join(log.read(2000).decode(errors="replace").split())
                or f"it ended with {process.returncode}"
            )
            raise OutputError(f"{path}: ffmpeg failed: {reason[:200]}; take .gif, or numbered .png")


PATIENCE = 5.0
"""Seconds that a process may take to end after it is told to."""


@dataclass(frozen=True, kw_only=True)
class _Job:
    """The work of one process.

    Attributes:
        place: of the container, to be opened again.
        variable: which one of it, where it has several.
        digest: `Container.digest` of it, so that no other file is rendered.
        scenes: of its pictures, in order.
        threads: that it may use.
    """

    place: Location
    variable: str | None
    digest: str
    scenes: tuple[Scene, ...]
    threads: int


def rendered_by_workers(
    volume: Volume, scenes: Sequence[Scene], processes: int
) -> Generator[Image, None, None]:
    """Render scenes in several processes; yield the pictures in the order of the scenes.

    Close the generator to end the processes. Raises what rendering raises, and FhashError where a
    process ends by itself, as for want of memory.
    """
    # Without a fork: a copy of a process with threads may hang.
    context = get_context("spawn")
    threads = max(1, usable_threads() // processes)
    workers, ends = [], []
    try:
        for first in range(processes):
            here, there = context.Pipe(duplex=False)
            job = _job(volume, scenes[first::processes], threads)
            worker = context.Process(target=_work, args=(there, job), daemon=True)
            with _interrupts_ignored():
                worker.start()
            there.close()  # so that an end of the process is an end of the pipe
            workers.append(worker)
            ends.append(here)
        for number in range(len(scenes)):
            yield _received(ends[number % processes])
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join(PATIENCE)
            if worker.is_alive():
                worker.kill()
                worker.join()
        for end in ends:
            end.close()


def _job(volume: Volume, scenes: Sequence[Scene], threads: int) -> _Job:
    """The work of a process that draws scenes; raises InputError for a volume of an open file."""
    return _Job(
        place=dataclasses.replace(volume.container.reopening(), digest=None),
        variable=volume.variable,
        digest=volume.container.digest,
        scenes=tuple(scenes),
        threads=threads,
    )


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """A context that ignores Ctrl-C; processes that start in it ignore it for ever.

    Elsewhere than in the main thread, which alone may say so, nothing changes: `_work` says so too.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _received(end: Connection) -> Image:
    """The next picture of a process; warns of what it warned of and raises what it raised."""
    try:
        result, told = end.recv()
    except (EOFError, OSError) as error:
        raise FhashError(
            "a process that renders ended by itself, perhaps for want of memory; "
            "take fewer 'processes'"
        ) from error
    for text in told:
        warnings.warn(text, FhashWarning, stacklevel=3)
    if isinstance(result, BaseException):
        raise result
    assert isinstance(result, Image)
    return result


def _work(end: Connection, job: _Job) -> None:
    """Render the scenes of a job and send each picture, or what was raised, with the warnings."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["FHASH_THREADS"] = str(job.threads)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", FhashWarning)
            try:
                for image in _images(job):
                    end.send((image, _texts(told)))
            except (FhashError, OSError, MemoryError) as error:
                end.send((error, _texts(told)))
    except (BrokenPipeError, ConnectionResetError):
        return  # nobody waits for the pictures any more


def _images(job: _Job) -> Generator[Image, None, None]:
    """Render the scenes of a job; raises InputError where the container is another one now."""
    with open_volume(job.place, variable=job.variable) as volume:
        if volume.container.digest != job.digest:
            raise InputError(
                f"{volume.path}: the file changed while it was rendered; render it again"
            )
        renderer = Renderer(volume, pictures=len(job.scenes))
        for scene, upcoming in zip(job.scenes, (*job.scenes[1:], None), strict=True):
            image = renderer.render(scene, upcoming=upcoming)
            yield dataclasses.replace(image, counters=dict(image.counters), scene=dict(image.scene))


def _texts(told: list[warnings.WarningMessage]) -> list[str]:
    """The texts of warnings of fhash; the list is emptied."""
    texts = [str(each.message) for each in told if issubclass(each.category, FhashWarning)]
    told.clear()
    return texts


PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
"""Last bytes of every complete PNG."""


@dataclass(frozen=True, kw_only=True)
class Animated:
    """Result of `animate`."""

    paths: Annotated[tuple[Path, ...], "files that are now there"]
    rendered: Annotated[int, "number of pictures that were rendered"]
    kept: Annotated[int, "number of pictures that were there already"]
    counters: Annotated[dict[str, int], "sums of the counters of the rendered pictures"]
    seconds: Annotated[float, "time of the whole job"]

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {**dataclasses.asdict(self), "paths": [str(path) for path in self.paths]}


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """One picture of an animation: its scene, its numbered file if any, whether that is kept."""

    scene: Scene
    path: Path | None
    kept: bool


@dataclass(frozen=True, kw_only=True)
class Target:
    """Files that an animation is written to, and how they are made.

    Attributes:
        output: NAME.png for pictures NAME.0000.png and so on, NAME.mp4 or NAME.gif for a film.
        pictures: NAME.png; the numbered pictures of a film are written too, and kept.
        force: whether to replace files.
        processes: how many render at a time, each with its share of the threads and frames of its
            own in memory. The files are the same as with one.
    """

    output: str | Path
    pictures: str | Path | None = None
    force: bool = False
    processes: int = 1


def animate(
    volume: Volume,
    scene: Scene,
    animation: Animation,
    target: Target,
    *,
    progress: Progress = silent,
) -> Animated:
    """Render every picture of an animation to numbered files or to a film.

    A numbered picture that is already there is kept if it is complete, of the same scene and of the
    same volume (by its digest). Any other file is replaced only with `force`.

    Args:
        volume: an open container.
        scene: what is shown where the animation changes nothing.
        animation: what changes.
        target: the files to write.
        progress: is told about each finished picture.

    Raises InputError for file names of other kinds and for what `Animation.scenes` refuses,
    FhashError where a process ends by itself, OutputExistsError before anything is rendered,
    OutputError for what cannot be written, MissingDependencyError without the package for MP4.
    """
    output, force, processes = Path(target.output), target.force, target.processes
    if processes < 1:
        raise InputError(f"processes is {processes}; at least 1 is needed")
    _check_names(output, target.pictures)
    is_film = output.suffix.lower() != ".png"
    begun = time.perf_counter()
    scenes = animation.scenes(scene, volume)
    base = target.pictures if is_film else output
    paths = [] if base is None else numbered(Path(base), len(scenes))
    clear_leftovers(paths)  # also those beside kept pictures, which are not written anew
    frames = _frames(scenes, paths, volume)
    if is_film:
        check_output(output, force, sources=[volume.path])
        check_film(output.suffix.lower())
    for frame in frames:
        if frame.path is not None and not frame.kept:
            check_output(frame.path, force, sources=[volume.path])
    _warn_of_others(paths)
    counters: Counter[str] = Counter()
    with closing(_rendered(frames, volume, processes)) as rendered:
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
        is_of_volume = text_in_png(path, DIGEST_KEY) == volume.container.digest.encode()
        return is_of_volume and scene_in_png(path) == scene
    except (OSError, InputError):
        return False


def _rendered(
    frames: Sequence[_Frame], volume: Volume, processes: int
) -> Generator[Image, None, None]:
    """Render the frames that are not kept, in order, here or in several processes."""
    scenes = [frame.scene for frame in frames if not frame.kept]
    processes = min(processes, len(scenes))
    if processes > 1:
        yield from rendered_by_workers(volume, scenes, processes)
        return
    renderer = Renderer(volume, pictures=len(scenes))
    # A frame is decoded ahead only for the very next picture.
    following = {number: after.scene for number, after in enumerate(frames[1:]) if not after.kept}
    for number, frame in enumerate(frames):
        if not frame.kept:
            yield renderer.render(frame.scene, upcoming=following.get(number))


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
