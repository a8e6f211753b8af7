"""Plans come back from their file, and are refused where they are damaged or of other data."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fhash_codec import DamagedFileError, EncodeConfig, InputError, UnsupportedFileError
from fhash_codec.appending import series_plan
from fhash_codec.appending.series_plan import (
    Filling,
    Recipe,
    SeriesPlan,
    bounded,
    code_layers,
    plan_parts,
)
from fhash_codec.boxes import Box
from fhash_codec.compact.tiles import Blocks, Coding, code
from fhash_codec.compact.transform import usual_transform
from fhash_codec.features.features import Extent
from fhash_codec.progress import silent
from fhash_formats.container import record as strict_json
from fhash_formats.container.record import Record
from fhash_formats.errors import FhashError, MissingInputError
from fhash_formats.series import ArraySeries, Coordinate
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile_format import TileSettings

SHAPE = (6, 4, 6, 8)
CONFIG = EncodeConfig(max_error=0.02, effort=2, tile="2x4x6x4", features=("interval:0.3:9",))


def series(**labels) -> ArraySeries:
    noise = np.random.default_rng(0).random(SHAPE)
    values = np.sin(np.linspace(0, 6, SHAPE[3])) + 0.05 * noise
    given = {"name": "u", "units": "m", "coords": times([0, 1, 2, 4, 5, 6]), **labels}
    return ArraySeries(given.pop("values", values.astype(np.float32)), **given)


def times(values: list[float]) -> dict[str, Coordinate]:
    return {"t": Coordinate(name="time", values=np.array(values, dtype=float))}


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "run.plan"
    plan_parts(series(), path, CONFIG)
    return path


def test_a_plan_comes_back_from_its_file(plan) -> None:
    made, read = SeriesPlan.make(series(), bounded(CONFIG)), SeriesPlan.read(plan)
    assert read.to_bytes() == plan.read_bytes() == made.to_bytes()
    assert (read.shape, read.layers, read.config.timings) == (SHAPE, 3, False)
    assert read.steps(range(1, 3)) == range(2, 6)
    read.require(series())


@pytest.mark.parametrize("promise", [{"psnr": 40}, {"ratio": 9}, {}, {"profile": "paper"}])
def test_only_a_bound_is_planned(tmp_path, promise) -> None:
    with pytest.raises(InputError, match="give max_error or max_error_rel"):
        plan_parts(series(), tmp_path / "a.plan", EncodeConfig(**promise))
    assert not list(tmp_path.iterdir())


def test_what_is_no_plan_is_refused(tmp_path) -> None:
    path = tmp_path / "a.plan"
    with pytest.raises(MissingInputError, match="does not exist; `fhash plan` makes a plan"):
        SeriesPlan.read(path)
    with pytest.raises(InputError, match="cannot be read"):
        SeriesPlan.read(tmp_path)
    path.write_text("{}")
    with pytest.raises(InputError, match=r"a\.plan is no plan"):
        SeriesPlan.read(path)
    for data in (b"", b"PK\x03\x04", b"\x80\x04]", b"[]", b" " * (series_plan.MAX_BYTES + 9)):
        path.write_bytes(data)
        with pytest.raises(DamagedFileError, match=r"a\.plan is damaged, or no plan"):
            SeriesPlan.read(path)


def test_every_cut_and_changed_byte_is_found(plan) -> None:
    data = plan.read_bytes()
    for place in range(0, len(data), 7):
        with pytest.raises(FhashError):
            SeriesPlan.from_bytes(data[:place])
        changed = bytearray(data)
        changed[place] ^= 1
        with pytest.raises(FhashError):
            SeriesPlan.from_bytes(bytes(changed))


def changed(path: Path, change) -> bytes:
    """A plan with other values, and the digest of these."""
    values = json.loads(path.read_bytes())
    del values["digest"]
    change(values)
    values["digest"] = hashlib.sha256(strict_json.dumps(values, "plan")).hexdigest()
    return strict_json.dumps(values, "plan")


def test_a_plan_of_another_version_is_refused(plan) -> None:
    data = changed(plan, lambda values: values.update(version="9.9"))
    with pytest.raises(UnsupportedFileError, match=r"made by fhash 9\.9, and this is"):
        SeriesPlan.from_bytes(data)


HOSTILE = {
    "no labels": lambda values: values.pop("labels"),
    "labels": lambda values: values.update(labels=[]),
    "shape": lambda values: values["labels"].update(shape=[1, 2, 3]),
    "huge shape": lambda values: values["labels"].update(shape=[1 << 50, 4, 6, 8]),
    "box": lambda values: values.update(box=[[0, 4], [0, 6], [0, 9]]),
    "empty box": lambda values: values.update(box=[[0, 4], [0, 6], [3, 3]]),
    "box of text": lambda values: values.update(box=[[0, 4], [0, 6], ["0", 3]]),
    "samples": lambda values: values.update(samples=0),
    "more samples": lambda values: values.update(samples=1 << 40),
    "range": lambda values: values.update(value_range=[1, 0]),
    "missing": lambda values: values.update(has_missing=0),
    "tile": lambda values: values["recipe"].update(tile=[7, 4, 6, 4]),
    "step": lambda values: values["recipe"]["settings"].update(step=-1),
    "basis": lambda values: values["recipe"]["settings"]["transform"].update(t={"klt": "AAAA"}),
    "coding": lambda values: values["recipe"].update(coding=None),
    "promise": lambda values: values["config"].update(max_error=None),
    "setting": lambda values: values["config"].update(effort=99),
    "unknown setting": lambda values: values["config"].update(os="system"),
    "no model": lambda values: values["header"].pop("model"),
    "gains": lambda values: values["header"]["model"].update(gains={}),
    "parameters": lambda values: values["header"]["model"].update(parameters="a"),
    "features": lambda values: values.update(features=[1]),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_plan_is_refused(plan, case) -> None:
    with pytest.raises(DamagedFileError, match="the plan is damaged: "):
        SeriesPlan.from_bytes(changed(plan, HOSTILE[case]))


TILE = (2, 4, 4, 4)
SETTINGS = TileSettings(transform=usual_transform(TILE), step=0.1, center=0.5, low=0.0, high=1.0)
RECIPE = Recipe(tile=TILE, settings=SETTINGS, coding=Coding(error=0.05, rounds=2, density=4))
FILLED = replace(RECIPE, filling=Filling(settings=replace(SETTINGS, step=0.2), density=2))


def read(values) -> Recipe:
    return Recipe.from_dict(Record(values, "recipe."))


@pytest.mark.parametrize("recipe", [RECIPE, FILLED])
@pytest.mark.parametrize("layers", [range(0, 1), range(1, 3)])
def test_some_layers_have_the_bytes_of_the_whole(recipe, layers) -> None:
    values = np.random.default_rng(0).random((5, 4, 6, 8), dtype=np.float32)
    packed = [np.packbits(frame < 0.8) for frame in values]
    extent = Extent(
        box=Box.of_shape(values.shape[1:]),
        key_frames=tuple(range(5)),
        packed=packed,
        domain=values.shape[1:],
        samples=int((values < 0.8).sum()),
        background=0.0,
    )
    blocks = Blocks(ArraySeries(values), extent, TILE)
    with thread_pool() as workers:
        whole = code_layers(blocks, recipe, range(3), workers, silent)
        some = code_layers(blocks.by_layers(), recipe, layers, workers, silent)
    per_layer = len(whole.streams) // 3
    assert some.streams == whole.streams[layers.start * per_layer : layers.stop * per_layer]
    assert some.outcome.size == sum(map(len, some.streams))
    assert whole.outcome.max_error <= 0.05
    if recipe is RECIPE:
        tile = blocks.read((0, 0, 0, 0))
        assert code(tile, SETTINGS, RECIPE.coding)[0].data == whole.streams[0]
