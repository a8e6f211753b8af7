"""Pictures of a volume. The package is the function too: `fhash_codec.rendering(volume, scene)` is that of `render.py`."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fhash_codec.progress import Progress
    from fhash_codec.rendering.picture.image import Image
    from fhash_codec.rendering.scene.scene import Scene
    from fhash_codec.volume import Volume


class _Package(ModuleType):
    """A package that is called as a function, which its name is better known as."""

    def __call__(
        self, volume: Volume, scene: Scene | None = None, *, progress: Progress | None = None
    ) -> Image:
        """A picture of a volume, as `fhash_codec.rendering.renderer.render` makes it."""
        from fhash_codec.progress import silent
        from fhash_codec.rendering.renderer import render

        return render(volume, scene, progress=progress or silent)


# How a module gets methods of its own: Python's data model, "Customizing module attribute access".
sys.modules[__name__].__class__ = _Package
