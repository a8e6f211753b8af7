"""A finished picture: pixels, buffers, what they cost, and the scene that they show.

A PNG holds the scene as JSON in an iTXt chunk `fhash.scene`, the name of the volume's file in
`fhash.source` and its digest in `fhash.digest`. A JPEG holds the pixels alone.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.colours import parse_colour
from fhash_codec.rendering.scenes import DIGEST_KEY, SCENE_KEY, SOURCE_KEY, Scene
from fhash_formats.errors import InputError
from fhash_formats.support.files import check_output, replacing_all

PICTURES = (".png", ".jpg", ".jpeg")
"""Suffixes of pictures, in lower case."""
JPEG_QUALITY = 92
"""Quality of a JPEG, 1..95, at which letters and edges stay clean."""

Single = npt.NDArray[np.float32]


class Draw(Protocol):
    """Renders a scene while the next one is prepared, as `Renderer.render` does."""

    def __call__(self, scene: Scene, /, *, upcoming: Scene | None = None) -> Image:
        """Render `scene`; `upcoming` is the scene of the next picture."""


def check_picture_name(path: Path, background: str) -> None:
    """Raise InputError for a name that no picture with this background can have."""
    suffix = path.suffix.lower()
    if suffix not in PICTURES:
        raise InputError(
            f"{path}: pictures are written as {', '.join(PICTURES[:-1])} or {PICTURES[-1]}; "
            "use such a name"
        )
    if suffix != ".png" and background == "transparent":
        raise InputError(
            f"{path}: a JPEG cannot be transparent; choose a background, or a name in .png"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """A rendered picture.

    Attributes:
        rgba: float32 (H, W, 4), 0..1, colours multiplied by the opacity; the first row is the top.
        depth: float32 (H, W), distance from the eye along the ray in units of the coordinates,
            infinite where nothing is; or None.
        normal: float32 (H, W, 3), unit vectors in physical x, y, z, 0 where nothing is; or None.
        counters: what the picture took: rays, passes, samples and so on.
        scene: as `Scene.to_dict` gives it.
        source: name of the volume's file.
        digest: `Container.digest` of the volume.
        seconds: time that rendering took.
    """

    rgba: Single
    depth: Single | None = None
    normal: Single | None = None
    counters: Mapping[str, int] = field(default_factory=dict)
    scene: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    digest: str = ""
    seconds: float = 0.0

    @property
    def background(self) -> str:
        """Background of the scene: '#rrggbb', a name, or 'transparent'."""
        return str(self.scene.get("background", Scene().background))

    def to_uint8(self, background: str | None = None) -> npt.NDArray[np.uint8]:
        """Convert to uint8 pixels over a background, that of the scene if None.

        The pixels are (H, W, 3); over 'transparent' (H, W, 4), with colours not multiplied by the
        opacity. Numbers that are not finite count as 0. Raises InputError for an unknown colour.
        """
        name = self.background if background is None else background
        rgba = np.clip(np.nan_to_num(self.rgba, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
        colour, opacity = rgba[..., :3], rgba[..., 3:]
        if name == "transparent":
            unmultiplied = np.minimum(colour / np.where(opacity > 0, opacity, np.float32(1)), 1.0)
            mixed = np.concatenate([unmultiplied, opacity], axis=-1)
        else:
            mixed = np.minimum(
                colour + (1 - opacity) * np.array(parse_colour(name), dtype=np.float32), 1.0
            )
        return np.asarray(np.rint(mixed * 255), dtype=np.uint8)

    def save(self, path: str | Path, *, force: bool = False) -> list[Path]:
        """Write NAME.png, and the buffers as NAME.depth.npy and NAME.normal.npy; return the paths.

        A name in .jpg or .jpeg gives a JPEG, which holds no scene. All files are written
        completely, or none is. Raises InputError for another suffix and for a transparent picture
        as JPEG, OutputExistsError unless `force`, OutputError for what cannot be written.
        """
        path = Path(path)
        outputs = self.outputs(path)
        for output in outputs:
            check_output(output, force)
        with replacing_all(outputs, force=force) as temporaries:
            buffers = [buffer for buffer in (self.depth, self.normal) if buffer is not None]
            for temporary, buffer in zip(temporaries[:-1], buffers, strict=True):
                with temporary.open("xb") as file:
                    np.save(file, np.ascontiguousarray(buffer, dtype="<f4"))
            with temporaries[-1].open("xb") as file:
                self._write(file, "PNG" if path.suffix.lower() == ".png" else "JPEG")
        return outputs

    def outputs(self, path: Path) -> list[Path]:
        """List every path that `save` writes, the picture last."""
        check_picture_name(path, self.background)
        named = (("depth", self.depth), ("normal", self.normal))
        return [
            *(
                path.with_name(f"{path.stem}.{name}.npy")
                for name, buffer in named
                if buffer is not None
            ),
            path,
        ]

    def _write(self, file: BinaryIO | io.BytesIO, form: str) -> None:
        from PIL import Image as Pictures
        from PIL.PngImagePlugin import PngInfo

        if form == "JPEG":
            # Colours at full resolution: thin lines would get coloured fringes.
            Pictures.fromarray(self.to_uint8()).save(
                file, format=form, quality=JPEG_QUALITY, subsampling=0
            )
            return
        info = PngInfo()
        info.add_itxt(SCENE_KEY, json.dumps(dict(self.scene)))
        if self.source:
            info.add_itxt(SOURCE_KEY, Path(self.source).name)
        if self.digest:
            info.add_itxt(DIGEST_KEY, self.digest)
        Pictures.fromarray(self.to_uint8()).save(file, format="PNG", pnginfo=info)

    def _repr_png_(self) -> bytes:
        """PNG bytes, for notebooks."""
        file = io.BytesIO()
        self._write(file, "PNG")
        return file.getvalue()

    def __repr__(self) -> str:
        height, width = self.rgba.shape[:2]
        source = Path(self.source).name or "a volume"
        return f"<fhash Image {width}x{height} of {source} in {self.seconds:.3g} s>"
