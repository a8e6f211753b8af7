"""Any scene is written and read unchanged, and drawn in finite pixels or refused in one line."""

from __future__ import annotations

import dataclasses
import json
import math
import tempfile
import types
import typing
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from properties import looking, one_line

import fhash_codec
from fhash_codec import EncodeConfig, FhashWarning, Renderer, Volume
from fhash_codec.records import Record
from fhash_codec.rendering.image import Image
from fhash_codec.rendering.scenes import Scene, Shading
from fhash_formats.errors import FhashError, InputError, RegionError

pytestmark = pytest.mark.hard

COLOURS = st.sampled_from(["#000000", "#ff8000", "white", "red", "transparent", "no colour"])
TEXTS = {
    "colours": st.sampled_from(["viridis", "gray", "coolwarm", "no map"]),
    "opacity": st.sampled_from(
        [
            "auto",
            "feature",
            "linear",
            "linear_r",
            "geom",
            "sigmoid",
            "foreground",
            "opaque",
            "none such",
        ]
    ),
    "background": COLOURS,
    "colour": COLOURS,
}
QUICK_FIELDS: dict[str, st.SearchStrategy[Any]] = {
    "size": st.tuples(st.integers(1, 20), st.integers(1, 20)),
    "antialiasing": st.integers(1, 2),
    "samples_per_pass": st.none() | st.integers(1, 4000),
}
"""Strategies for fields whose full range would take minutes for one picture."""


def values_of(hint: Any, field: dataclasses.Field[Any], *, quick: bool) -> st.SearchStrategy[Any]:
    """Draw values of a field by its annotation and its limits."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    low, high = field.metadata.get("low"), field.metadata.get("high")
    choices = field.metadata.get("choices", ())
    if quick and field.name in QUICK_FIELDS:
        return QUICK_FIELDS[field.name]
    if origin in (types.UnionType, typing.Union):
        return st.one_of(*(values_of(argument, field, quick=quick) for argument in parts))
    if origin is tuple and parts[-1] is ...:
        return st.lists(values_of(parts[0], field, quick=quick), max_size=3).map(tuple)
    if origin is tuple:
        return st.tuples(*(values_of(argument, field, quick=quick) for argument in parts))
    if isinstance(hint, type) and issubclass(hint, Record):
        return records(hint, quick=quick)
    if hint is type(None):
        return st.none()
    if hint is bool:
        return st.booleans()
    if hint is int:
        return st.integers(int(low), int(high))
    if hint is float:
        return floats(field.name, low, high, quick=quick)
    return st.sampled_from(choices) if choices else TEXTS.get(field.name, COLOURS)


def floats(
    name: str, low: float | None, high: float | None, *, quick: bool
) -> st.SearchStrategy[float]:
    """Draw numbers within limits; the limits themselves and numbers near them come often."""
    if quick and name == "step" and low == 1e-6:  # a small step of a march takes many samples
        low = 0.02
    everything = st.floats(low, high, allow_nan=False, allow_infinity=False)
    if quick and name == "scale":  # three arbitrary scales are mostly too different to draw
        everything = st.one_of(
            everything, st.floats(1e-3, 1e3), st.sampled_from([1e-30, 1e-29, 1e29, 1e30])
        )
    near = [value for value in (low, high, 0.0, 0.5, 1.0, 2.0, -3.0, 1e30) if value is not None]
    return st.one_of(
        everything,
        st.sampled_from(
            [
                value
                for value in near
                if (low is None or value >= low) and (high is None or value <= high)
            ]
        ),
    )


def records(kind: type[Record], *, quick: bool) -> st.SearchStrategy[Any]:
    """Draw records with any of their fields; those that contradict themselves are left out."""
    hints = typing.get_type_hints(kind)
    fields = {
        field.name: values_of(hints[field.name], field, quick=quick)
        for field in dataclasses.fields(kind)
    }  # type: ignore[arg-type]
    required = {
        field.name for field in dataclasses.fields(kind) if field.default is dataclasses.MISSING
    }  # type: ignore[arg-type]
    chosen = st.fixed_dictionaries(
        {name: strategy for name, strategy in fields.items() if name in required},
        optional={name: strategy for name, strategy in fields.items() if name not in required},
    )

    def made(values: dict[str, Any]) -> Record | None:
        try:
            return kind(**values)
        except InputError:
            return None

    return chosen.map(made).filter(lambda record: record is not None)


def toml(values: dict[str, Any]) -> str:
    """Return the values as TOML with inline tables; it has no null, and says false instead."""

    def text(value: Any) -> str:
        if isinstance(value, dict):
            return (
                "{"
                + ", ".join(f"{json.dumps(key)} = {text(item)}" for key, item in value.items())
                + "}"
            )
        if isinstance(value, list):
            return "[" + ", ".join(map(text, value)) + "]"
        if value is None:
            return "false"
        return repr(value) if isinstance(value, float) else json.dumps(value)

    return "\n".join(f"{json.dumps(key)} = {text(value)}" for key, value in values.items())


@looking(150)
@given(scene=records(Scene, quick=False))
def test_a_scene_is_what_its_values_say(scene: Scene) -> None:
    values = scene.to_dict()
    assert Scene.from_dict(values) == scene
    assert Scene.from_dict(json.loads(json.dumps(values, allow_nan=False))) == scene
    assert Scene.from_dict(values).to_dict() == values


@looking(25)
@given(scene=records(Scene, quick=False))
def test_a_scene_comes_back_from_every_file(scene: Scene) -> None:
    with tempfile.TemporaryDirectory(prefix="fhash-") as folder:
        place = Path(folder)
        (place / "a.json").write_text(json.dumps(scene.to_dict()))
        (place / "a.toml").write_text(toml(scene.to_dict()))
        assert Scene.load(place / "a.json") == scene
        assert Scene.load(place / "a.toml") == scene
        values = scene.to_dict()
        picture = Image(rgba=np.zeros((2, 3, 4), np.float32), scene=values)
        if "background" in values:
            picture = dataclasses.replace(picture, scene={**values, "background": "white"})
        picture.save(place / "a.png")
        assert Scene.load(place / "a.png") == Scene.from_dict(dict(picture.scene))


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)
PLACES = [(), ("camera",), ("transfer_function",), ("effects",), ("effects", "shading"), ("march",)]


@looking(80)
@given(
    place=st.sampled_from(PLACES),
    name=st.sampled_from(
        [
            "size",
            "camera",
            "step",
            "view",
            "position",
            "range",
            "opacity",
            "isosurfaces",
            "light",
            "lod",
            "nonsense",
        ]
    ),
    value=ANYTHING,
)
@example(place=(), name="step", value=10**400)
@example(place=("transfer_function",), name="range", value=[[1, 2], 3])
@example(place=("effects",), name="isosurfaces", value=[True])
def test_any_values_make_a_scene_or_are_refused_in_one_line(
    place: tuple[str, ...], name: str, value: object
) -> None:
    values: dict[str, Any] = {name: value}
    for key in reversed(place):
        values = {key: values}
    try:
        scene = Scene.from_dict(values)
    except InputError as error:
        one_line(error)
    else:
        assert Scene.from_dict(scene.to_dict()) == scene


def field(shape: tuple[int, ...], *, holes: bool = False) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    values = (np.sin(5 * x + 3 * t) * np.cos(4 * y) + z).astype(np.float32)
    if holes:
        values[:, :2, 3:5] = np.nan
    return values


VOLUMES: dict[str, tuple[tuple[int, ...], EncodeConfig]] = {
    "compact": ((3, 6, 7, 8), EncodeConfig(effort=1)),
    "compact, a feature": (
        (3, 6, 7, 8),
        EncodeConfig(effort=1, features=("interval:0.2:2",), dilation=0),
    ),
    "paper": ((3, 6, 7, 8), EncodeConfig(preset="published", tables="float16", epochs=1, width=4)),
    "a plane": ((2, 1, 7, 8), EncodeConfig(effort=1)),
    "one vertex": ((1, 1, 1, 1), EncodeConfig(effort=1)),
}


@pytest.fixture(scope="module", params=VOLUMES)
def volume(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Volume]:
    shape, config = VOLUMES[request.param]
    path = tmp_path_factory.mktemp("scenes") / "a.fhz"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FhashWarning)
        fhash_codec.encode(field(shape, holes="compact" in request.param), path, config)
    with fhash_codec.open(path) as opened:
        yield opened


SMALL = {"size": [6, 5]}
ONCE_WRONG: dict[str, dict[str, Any]] = {
    "smallest scale": {"scale": [1e-30, 1e-30, 1e-30]},
    "largest scale": {"scale": [6e29, 6e29, 0.5]},
    "light over a huge length": {
        "scale": [9.9e29, 6.3e29, 9.2e15],
        "effects": {"shading": {}, "shadows": {}},
    },
    "occlusion over a huge length": {
        "scale": [1e10, 5.5e29, 8.6e29],
        "effects": {"ambient_occlusion": {}},
    },
    "a surface beyond float32": {"effects": {"isosurfaces": [{"value": 6e44}, {"value": 0.0}]}},
    "shadows over tiny lengths": {"scale": [1.0, 1e-30, 1e-30], "effects": {"shadows": {}}},
    "the largest parallel picture": {"camera": {"projection": "parallel", "parallel_scale": 1e100}},
    "a surface at the end of float32": {
        "effects": {"isosurfaces": [{"value": -3.402823364973241e38}]}
    },
    "light from a huge direction": {"effects": {"shadows": {"light": [0.0, 1e200, 1.7e308]}}},
    "a camera turned by next to nothing": {"camera": {"view": "xy", "azimuth": 2.2e-311}},
    "a focal point far away": {"camera": {"focal_point": [0.0, 0.0, 1e100]}},
    "light hardly aslant": {"effects": {"shadows": {"light": [0.0, 2.2471164185778944e307, 0.5]}}},
    "a tiny unit of distance": {
        "scale": [1.0, 1.0, 1.9e27],
        "transfer_function": {"unit_distance": 1e-100},
    },
    "all the light there may be": {
        "effects": {
            "shading": {"ambient": 10.0, "diffuse": 10.0, "specular": 10.0, "specular_power": 1.0}
        }
    },
    "rays without an end": {"scale": [8e29, 2.4e29, 1e-30], "camera": {"view": "yz"}},
    "a colour bar below a picture of one pixel": {
        "size": [1, 1],
        "effects": {"colour_bar": True},
    },
    "a huge direction upwards": {"camera": {"view_up": [1.7976931348623157e308, 1.0, 0.0]}},
}
"""Scenes with which the test below has failed once."""


@pytest.mark.parametrize("name", ONCE_WRONG)
def test_scenes_that_were_wrong_once_are_drawn(volume: Volume, name: str) -> None:
    check_picture(volume, Scene.from_dict({**SMALL, **ONCE_WRONG[name]}))


@looking(12, 1000)
@given(scene=records(Scene, quick=True))
def test_any_scene_is_drawn_in_finite_pixels_or_refused_in_one_line(
    volume: Volume, scene: Scene
) -> None:
    check_picture(volume, scene)


def check_picture(volume: Volume, scene: Scene) -> None:
    """Assert finite pixels, depths and normals, or an error of one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FhashWarning)
            image = Renderer(volume, threads=1).render(scene)
    except (InputError, RegionError) as error:
        one_line(error)
        return
    except FhashError as error:
        pytest.fail(f"{type(error).__name__}: {error}")
    width, height = scene.size
    if scene.evolution is not None:  # several pictures, side by side
        height, width = image.rgba.shape[:2]
    assert image.rgba.shape == (height, width, 4)
    assert np.isfinite(image.rgba).all()
    assert image.rgba.min() >= -1e-6
    assert image.rgba[..., 3].max() <= 1 + 1e-5
    light = scene.effects.shading or Shading()  # surfaces are always lit
    brightest = max(1.0, light.ambient + light.diffuse + light.specular)
    assert (
        image.rgba[..., :3].max(axis=-1) <= image.rgba[..., 3] * brightest * (1 + 1e-5) + 1e-5
    ).all()
    if image.depth is not None:
        assert not np.isnan(image.depth).any()
    if image.normal is not None:
        lengths = np.linalg.norm(image.normal, axis=-1)
        assert (np.isclose(lengths, 1, atol=1e-3) | (lengths == 0)).all()
    assert all(math.isfinite(count) for count in image.counters.values())
    assert Scene.from_dict(dict(image.scene)) is not None
    assert image.to_uint8().shape[:2] == (height, width)
