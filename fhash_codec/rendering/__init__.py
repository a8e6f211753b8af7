"""Pictures of a volume: a scene becomes a plan, the plan a task, and a marcher draws it.

From outside: `render`, `renderer.Renderer`, `scenes`, `timeline`, `film`, `tracking`, `image`.
Nothing that encodes or trains, no file of values, no click; torch in `torch_arrays` alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fhash_codec.progress import Progress, silent

if TYPE_CHECKING:
    from fhash_codec.rendering.image import Image
    from fhash_codec.rendering.scenes import Scene
    from fhash_codec.volume import Volume

__all__ = ["render"]


def render(volume: Volume, scene: Scene | None = None, *, progress: Progress = silent) -> Image:
    """Render one picture of a volume.

    Args:
        volume: an open container.
        scene: what to show. The default scene suits the feature of the file. A scene with
            `evolution` gives several steps side by side.
        progress: is told about each stage.

    Raises InputError for a scene that cannot be drawn, RegionError for a step or time outside
    the series.
    """
    # Imported here, so that `import fhash_codec.rendering` stays cheap.
    from fhash_codec.rendering.renderer import Renderer

    return Renderer(volume).render(scene, progress=progress)
