"""Scenes: camera, image, time, transfer function and effects of a picture; their text in PNGs."""

from __future__ import annotations

import dataclasses
import io
import json
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from fhash_codec.records import Record, limits
from fhash_formats.errors import InputError, MissingInputError

SCENE_KEY = "fhash.scene"
"""Keyword of the iTXt chunk that holds the scene as JSON."""
SOURCE_KEY = "fhash.source"
"""Keyword of the chunk that holds the name of the volume's file."""
DIGEST_KEY = "fhash.digest"
"""Keyword of the chunk that holds the digest of the volume."""

SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG."""
MAX_TEXT = 2**20
"""Most bytes of a scene in a PNG, unpacked."""
MAX_KEYWORDS = 1024
"""Most bytes of keyword, flags and language that stand before the text of a chunk."""
MAX_CHUNKS = 100_000
"""Most chunks of a PNG before the scene; pillow writes one for each 64 KiB of pixels."""


def text_in_png(path: str | Path, keyword: str) -> bytes | None:
    """Read the text of a keyword in a PNG; None without it.

    Pixels are skipped, and no more of the file is held than a scene can be long. Raises InputError
    for a file that is no PNG, and for a damaged text.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            return _text(path, file, keyword)
    except FileNotFoundError as error:
        raise MissingInputError(f"{path}: no such picture") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _text(path: Path, file: BinaryIO, keyword: str) -> bytes | None:
    """Find the chunk of a keyword and return its text."""
    if file.read(len(SIGNATURE)) != SIGNATURE:
        raise InputError(f"{path}: not a PNG")
    for _ in range(MAX_CHUNKS):
        head = file.read(8)
        if len(head) < 8 or head[4:] == b"IEND":
            break
        length, kind = int.from_bytes(head[:4], "big"), head[4:]
        if kind != b"iTXt" or length > MAX_TEXT + MAX_KEYWORDS:
            file.seek(length + 4, io.SEEK_CUR)
            continue
        data, checksum = file.read(length), file.read(4)
        name, _, rest = data.partition(b"\0")
        if name != keyword.encode():
            continue
        if len(data) != length or zlib.crc32(kind + data).to_bytes(4, "big") != checksum:
            raise InputError(f"{path}: its scene is damaged; render it again")
        # Before the text stand a flag and a method of compression, a language and a translated
        # keyword, the last two ended by a zero each.
        packed, text = rest[:1] == b"\1", rest[2:].split(b"\0", 2)[-1]
        return _unpacked(path, text) if packed else text
    return None


def _unpacked(path: Path, data: bytes) -> bytes:
    """Decompress a text of at most MAX_TEXT bytes."""
    reader = zlib.decompressobj()
    try:
        text = reader.decompress(data, MAX_TEXT)
    except zlib.error as error:
        raise InputError(f"{path}: its scene is damaged; render it again") from error
    if not reader.eof:
        raise InputError(f"{path}: its scene is cut short or longer than {MAX_TEXT >> 20} MiB")
    return text


Vector = tuple[float, float, float]
Point = tuple[float, float]
Ends = tuple[float | None, float | None]

MAX_SIDE = 16384
"""Most pixels along a side of an image."""
VIEWS = ("auto", "iso", "xy", "xz", "yz", "yx", "zx", "zy")
"""Names of the directions to look from, as in PyVista: `xy` has x to the right and y upwards.
`auto` is `iso`, but from above for a volume with an axis of one vertex."""
MARCHES = ("auto", "cache", "arm", "stream")
"""Names of the ways to march: through a frame decoded at once, or as rays or samples need it."""
DEVICES = ("auto", "cpu", "cuda")
"""Names of the devices that rays are marched on."""
BUFFERS = ("depth", "normal")
"""Names of the buffers beside the colours."""
MAX_PLANES = 6
"""Most planes that clip a picture."""
GRADIENTS = ("cell", "central")
"""Names of the gradients for shading."""


@dataclass(frozen=True, kw_only=True)
class Camera(Record):
    """Place and lens of the camera, in the physical coordinates of the series (x, y, z).

    The place is a `position` with `focal_point` and `view_up` (as in PyVista), or a `view` by name.
    `azimuth` and `elevation` turn the camera from there.
    """

    view: str = limits("auto", "direction to look from", choices=VIEWS)
    azimuth: float = limits(
        0.0, "degrees to turn about the upward direction", low=-36000, high=36000
    )
    elevation: float = limits(0.0, "degrees to rise", low=-90, high=90)
    zoom: float = limits(1.0, "magnification", low=1e-3, high=1e6)
    position: Vector | None = limits(None, "where the camera stands", low=-1e100, high=1e100)
    focal_point: Vector | None = limits(
        None, "what it looks at; the middle of the volume if left out", low=-1e100, high=1e100
    )
    view_up: Vector | None = limits(None, "what is upwards in the picture")
    projection: str = limits(
        "perspective", "kind of projection", choices=("perspective", "parallel")
    )
    view_angle: float = limits(
        30.0, "vertical angle of the picture in degrees, of a perspective", low=0.1, high=170
    )
    parallel_scale: float | None = limits(
        None,
        "half the height of the picture in units of the coordinates, of a parallel projection",
        low=1e-100,
        high=1e100,
    )


@dataclass(frozen=True, kw_only=True)
class TransferFunctionSpec(Record):
    """Colour and opacity of values in data units."""

    colours: str | tuple[tuple[float, str], ...] = limits(
        "viridis", "name of a colour map, file of a ParaView preset, or points [value, '#rrggbb']"
    )
    range: Point | None = limits(
        None,
        "values that the colour map reaches from and to; "
        "those of the feature or the series if left out",
    )
    opacity: str | tuple[Point, ...] = limits(
        "auto", "name of an opacity preset, or points [value, opacity]"
    )
    density: float = limits(1.0, "factor of the extinction", low=0, high=1e6)
    unit_distance: float | None = limits(
        None,
        "length after which the opacity is as given, in units of the coordinates; "
        "a vertex spacing if left out",
        low=1e-100,
        high=1e100,
    )
    nothing: bool = limits(False, "show no volume at all, for surfaces alone")
    gradient_opacity: tuple[Point, ...] = limits(
        (),
        "points [gradient, factor 0..1] that the extinction is multiplied by, linear between them; "
        "a gradient is a share of the series' value range in the distance of two vertices",
        low=0,
        high=1e30,
    )


@dataclass(frozen=True, kw_only=True)
class Shading(Record):
    """Phong shading by the gradient, two-sided; the light is given in shares."""

    ambient: float = limits(0.2, "light from everywhere", low=0, high=10)
    diffuse: float = limits(0.8, "scattered light", low=0, high=10)
    specular: float = limits(0.2, "mirrored light", low=0, high=10)
    specular_power: float = limits(16.0, "sharpness of the highlights", low=1, high=1000)
    light: Vector | None = limits(
        None, "direction towards the light (x, y, z); the camera's if left out"
    )
    gradient: str = limits(
        "cell",
        "that within the cell, exact, or central differences over two vertices, smoother",
        choices=GRADIENTS,
    )


@dataclass(frozen=True, kw_only=True)
class Shadows(Record):
    """Shadows: light that the volume takes away on its way to a sample."""

    strength: float = limits(0.8, "share of the light that a shadow takes", low=0, high=1)
    light: Vector | None = limits(
        None,
        "direction towards the light (x, y, z); from above the camera's left shoulder if left out",
    )
    resolution: float = limits(2.0, "vertices between two samples of the shadow", low=0.5, high=64)


@dataclass(frozen=True, kw_only=True)
class AmbientOcclusion(Record):
    """Ambient occlusion: light from everywhere that the surroundings take away."""

    strength: float = limits(0.7, "share of the ambient light that it takes", low=0, high=1)
    radius: float = limits(8.0, "how far the surroundings reach, in vertices", low=1, high=256)


@dataclass(frozen=True, kw_only=True)
class Isosurface(Record):
    """A surface of equal value, shaded."""

    value: float = limits(dataclasses.MISSING, "value in data units", low=-1.7e308, high=1.7e308)
    colour: str | None = limits(
        None, "'#rrggbb' or a name; that of the transfer function if left out"
    )
    opacity: float = limits(1.0, "of the surface", low=0, high=1)


@dataclass(frozen=True, kw_only=True)
class LegendEntry(Record):
    """A colour and its meaning."""

    text: str = limits(dataclasses.MISSING, "meaning of the colour")
    colour: str = limits(dataclasses.MISSING, "'#rrggbb' or a name")


@dataclass(frozen=True, kw_only=True)
class AttenuatedMaximum(Record):
    """The largest value along each ray, lessened by what lies before it.

    With s = (value - low) / (high - low) of the colour map's range, clipped to 0..1, a ray shows
    the colour at the largest s exp(-attenuation * S), where S is the integral of s along the ray up
    to there, in vertex spacings. It is 'attenuated_mip' of napari and VisPy (vispy/visuals/
    volume.py), but for its sum, which depends on the length of a step there. Nothing is shown where
    no value lies above `low`.
    """

    attenuation: float = limits(
        0.05, "of the light by the largest value, in a vertex spacing", low=1e-6, high=1e3
    )


@dataclass(frozen=True, kw_only=True)
class ClipPlane(Record):
    """A plane that cuts the volume; the side that its normal points to is kept.

    It goes through `point`, or through the places whose product with the normal is `offset`.
    """

    normal: Vector = limits(
        dataclasses.MISSING, "direction (x, y, z) towards what is kept", low=-1e100, high=1e100
    )
    point: Vector | None = limits(None, "a point (x, y, z) of the plane", low=-1e100, high=1e100)
    offset: float | None = limits(
        None, "normal times place on the plane, instead of a point", low=-1e100, high=1e100
    )

    def __post_init__(self) -> None:
        """Check the fields, and that the plane is given once; raises InputError."""
        super().__post_init__()
        if (self.point is None) == (self.offset is None):
            raise InputError("clip plane: give either a point or an offset beside the normal")
        if not any(self.normal):
            raise InputError("clip plane: the normal has no length; give one such as [0, 0, 1]")


@dataclass(frozen=True, kw_only=True)
class Clip(Record):
    """The part of the volume that is shown, in the coordinates of the series, not stretched.

    Nothing outside is decoded or marched, and surfaces are cut. A sample at a cut is shaded by the
    gradient of the values there.
    """

    x: Ends | None = limits(
        None, "first and last x, null (TOML: false) where it is not cut", low=-1e100, high=1e100
    )
    y: Ends | None = limits(
        None, "first and last y, null (TOML: false) where it is not cut", low=-1e100, high=1e100
    )
    z: Ends | None = limits(
        None, "first and last z, null (TOML: false) where it is not cut", low=-1e100, high=1e100
    )
    planes: tuple[ClipPlane, ...] = ()

    def __post_init__(self) -> None:
        """Check the fields, and that ends ascend; raises InputError."""
        super().__post_init__()
        if not (self.x or self.y or self.z or self.planes):
            raise InputError("clip cuts nothing; give ends along 'x', 'y' or 'z', or 'planes'")
        if len(self.planes) > MAX_PLANES:
            raise InputError(f"clip has {len(self.planes)} planes; allowed: {MAX_PLANES}")
        for axis in "xyz":
            low, high = getattr(self, axis) or (None, None)
            if low is not None and high is not None and low >= high:
                raise InputError(
                    f"clip: {axis} is {low:g} to {high:g}; the first end must be below the second"
                )


@dataclass(frozen=True, kw_only=True)
class Effects(Record):
    """Effects of a picture: each is off unless it is named; `true` stands for its defaults."""

    shading: Shading | None = None
    shadows: Shadows | None = None
    ambient_occlusion: AmbientOcclusion | None = None
    isosurfaces: tuple[Isosurface, ...] = ()
    maximum_intensity: bool = limits(
        False, "show the largest value along each ray instead of the volume"
    )
    minimum_intensity: bool = limits(
        False, "show the smallest value along each ray instead of the volume"
    )
    average_intensity: bool = limits(
        False, "show the mean along each ray, where it meets values, instead of the volume"
    )
    attenuated_maximum_intensity: AttenuatedMaximum | None = None
    clip: Clip | None = None
    buffers: tuple[str, ...] = limits((), "pictures beside the colours", choices=BUFFERS)
    antialiasing: int = limits(1, "rays per side of a pixel", low=1, high=8)
    jitter: bool = limits(
        False, "begin each ray at a place of its own within the first step, against rings"
    )
    box: bool = limits(False, "the edges of the volume")
    axes: bool = limits(False, "names and ends of the axes")
    colour_bar: bool = limits(False, "the colours and their values")
    time_label: bool = limits(False, "step and time")
    legend: tuple[LegendEntry, ...] = ()

    @property
    def projections(self) -> tuple[str, ...]:
        """Names of the values that rays show instead of the volume; a picture can have but one."""
        kinds = {
            "maximum": self.maximum_intensity,
            "minimum": self.minimum_intensity,
            "average": self.average_intensity,
            "attenuated": self.attenuated_maximum_intensity is not None,
        }
        return tuple(name for name, on in kinds.items() if on)


USUAL_EFFECTS = Effects(
    shading=Shading(ambient=0.5, diffuse=0.6),
    box=True,
    axes=True,
    colour_bar=True,
    time_label=True,
)
"""Effects of a picture for which no scene is given. Haze has gradients in all directions, and takes
more light than a surface."""


@dataclass(frozen=True, kw_only=True)
class Marching(Record):
    """Sampling of the rays: accuracy against time."""

    mode: str = limits(
        "auto",
        "way to march: decoded frames from the cache, or adaptively (arm), where tiles are decoded "
        "and networks evaluated as rays come to them, or sample by sample (stream)",
        choices=MARCHES,
    )
    step: float = limits(0.5, "length of a step in vertex spacings", low=1e-6, high=64)
    threshold: float = limits(
        1 / 1024, "share of the light behind a sample below which a ray ends", low=0, high=1
    )
    lod: int | None = limits(
        None,
        "level of detail, 0 for the finest; by the size of a pixel if left out",
        low=0,
        high=10,
    )
    samples_per_pass: int | None = limits(
        None,
        "N_r of adaptive ray marching in passes, on a GPU and through networks on uneven axes: "
        "samples in a pass; the number of rays if left out",
        low=1,
        high=2**40,
    )
    device: str = limits(
        "auto",
        "where arm and stream march: as named, or networks on the first GPU if there is one and "
        "decoded frames on the CPU",
        choices=DEVICES,
    )
    skipping: bool = limits(True, "whether bricks without anything visible are passed over")


@dataclass(frozen=True, kw_only=True)
class Evolution(Record):
    """Several steps side by side in one picture, each as large as the scene says."""

    steps: tuple[float, ...] = limits(
        dataclasses.MISSING, "steps of the series, between two of them too", low=0, high=1e15
    )
    columns: int | None = limits(
        None, "pictures beside each other; by the shape of the whole if left out", low=1, high=1000
    )


@dataclass(frozen=True, kw_only=True)
class Scene(Record):
    """Everything that a picture is made from, apart from the volume."""

    camera: Camera = Camera()
    size: tuple[int, int] = limits((1024, 1024), "pixels across and down", low=1, high=MAX_SIDE)
    scale: Vector | None = limits(
        None,
        "factors by which the axes (x, y, z) are stretched; if left out, one in other units than "
        "the rest has its vertices as far apart, or a quarter of the longest. The camera lives in "
        "the stretched coordinates",
        low=1e-30,
        high=1e30,
    )
    background: str = limits("#ffffff", "'#rrggbb', a name, or 'transparent'")
    step: float | None = limits(
        None,
        "step of the series, between two of them too; of five steps that of most structure if "
        "neither it nor time is given",
        low=0,
        high=1e15,
    )
    time: float | None = limits(
        None, "physical time, instead of a step", low=-1.7e308, high=1.7e308
    )
    features: tuple[str, ...] = limits((), "features of the file to be shown; all if empty")
    transfer_function: TransferFunctionSpec = TransferFunctionSpec()
    effects: Effects = Effects()
    march: Marching = Marching()
    evolution: Evolution | None = None

    def __post_init__(self) -> None:
        """Check the fields, and that the time is given once; raises InputError."""
        super().__post_init__()
        if self.step is not None and self.time is not None:
            raise InputError("scene: step and time exclude each other")
        if self.evolution is not None and (self.step is not None or self.time is not None):
            raise InputError("scene: an evolution has steps of its own; leave step and time out")

    @classmethod
    def load(cls, path: str | Path) -> Scene:
        """Read a scene from a file; raises InputError, MissingInputError without the file.

        The suffix tells the kind: .toml for TOML, .png for a picture of `fhash render`, which holds
        its scene; any other file is JSON.
        """
        path = Path(path)
        if path.suffix.lower() == ".png":
            return scene_in_png(path)
        return cls.read(path, "a scene", "no such scene")


def scene_in_png(path: str | Path) -> Scene:
    """Read the scene that a picture shows.

    Raises InputError for a file that is no PNG of `fhash render`, damaged ones included.
    """
    text = text_in_png(path, SCENE_KEY)
    if text is None:
        raise InputError(f"{path}: holds no scene; only pictures of 'fhash render' do")
    try:
        return Scene.from_dict(json.loads(text))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: its scene is damaged: {' '.join(str(error).split())}") from error
