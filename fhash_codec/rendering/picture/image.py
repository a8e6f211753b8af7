"""A finished picture: its pixels, the buffers beside them, what they cost, and the scene that they show.

A PNG holds the scene as JSON in an iTXt chunk `fhash.scene`, the name of the volume's file in `fhash.source` and its digest in
`fhash.digest`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from fhash_codec.rendering.colour.colours import parse_colour
from fhash_codec.rendering.scene.png_text import DIGEST_KEY, SCENE_KEY, SOURCE_KEY
from fhash_codec.rendering.scene.scene import Scene
from fhash_formats.errors import InputError
from fhash_formats.support.atomic import check_output, replacing_all

__all__ = ["Image"]

Single = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """What `render` gives.

    Attributes:
        rgba: float32 (H, W, 4), 0..1, colours multiplied by the opacity; the first row is the top.
        depth: float32 (H, W), from the eye along the ray in units of the coordinates, infinite where nothing is; or None.
        normal: float32 (H, W, 3), unit vectors in physical x, y, z, 0 where nothing is; or None.
        counters: what the picture took: rays, passes, samples and so on.
        scene: as `Scene.to_dict` gives it. source: the name of the volume's file, digest: `Container.digest` of it.
        seconds: of rendering.
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
        """Of the scene: '#rrggbb', a name, or 'transparent'."""
        return str(self.scene.get("background", Scene().background))

    def to_uint8(self, background: str | None = None) -> npt.NDArray[np.uint8]:
        """Bytes (H, W, 3) over a background, that of the scene if None; (H, W, 4), not multiplied, over 'transparent'.

        What is not finite counts as 0, so that it never reaches a pixel. Raises InputError for an unknown colour.
        """
        name = self.background if background is None else background
        rgba = np.clip(np.nan_to_num(self.rgba, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
        colour, opacity = rgba[..., :3], rgba[..., 3:]
        if name == "transparent":
            plain = np.minimum(colour / np.where(opacity > 0, opacity, np.float32(1)), 1.0)
            mixed = np.concatenate([plain, opacity], axis=-1)
        else:
            mixed = np.minimum(
                colour + (1 - opacity) * np.array(parse_colour(name), dtype=np.float32), 1.0
            )
        return np.asarray(np.rint(mixed * 255), dtype=np.uint8)

    def save(self, path: str | Path, *, force: bool = False) -> list[Path]:
        """Write the PNG, and buffers as NAME.depth.npy and NAME.normal.npy; the paths written, complete or none of them.

        Raises InputError for a name that does not end in .png, OutputExistsError unless `force`, OutputError.
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
                self._write_png(file)
        return outputs

    def outputs(self, path: Path) -> list[Path]:
        """Every path that `save` writes, the PNG last."""
        if path.suffix.lower() != ".png":
            raise InputError(f"{path}: pictures are written as .png; use such a name")
        named = (("depth", self.depth), ("normal", self.normal))
        return [
            *(
                path.with_name(f"{path.stem}.{name}.npy")
                for name, buffer in named
                if buffer is not None
            ),
            path,
        ]

    def _write_png(self, file: BinaryIO | io.BytesIO) -> None:
        from PIL import Image as Pictures
        from PIL.PngImagePlugin import PngInfo

        info = PngInfo()
        info.add_itxt(SCENE_KEY, json.dumps(dict(self.scene)))
        if self.source:
            info.add_itxt(SOURCE_KEY, Path(self.source).name)
        if self.digest:
            info.add_itxt(DIGEST_KEY, self.digest)
        Pictures.fromarray(self.to_uint8()).save(file, format="PNG", pnginfo=info)

    def _repr_png_(self) -> bytes:
        """How a notebook shows it."""
        file = io.BytesIO()
        self._write_png(file)
        return file.getvalue()

    def __repr__(self) -> str:
        height, width = self.rgba.shape[:2]
        return f"<fhash Image {width}x{height} of {Path(self.source).name or 'a volume'} in {self.seconds:.3g} s>"
