"""`merge`: parts become the file of the whole, byte for byte; wrong sets of parts are refused."""

from __future__ import annotations

import hashlib
import json
import os
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from rarely import rarely

import fhash_codec
from fhash_codec import (
    ClusterError,
    DamagedFileError,
    EncodeConfig,
    InputError,
    UnsupportedFileError,
    Writer,
)
from fhash_codec.appending import cluster as rooms
from fhash_codec.appending import series_plan
from fhash_codec.appending.cluster import HeldSteps
from fhash_codec.appending.parts import Part, encode_part, merge
from fhash_codec.appending.series_plan import (
    Recipe,
    SeriesPlan,
    bounded,
    code_layers,
    plan_parts,
)
from fhash_codec.appending.writer import append
from fhash_codec.boxes import Box
from fhash_codec.compact import encode
from fhash_codec.compact import tiles as blocks
from fhash_codec.compact.tiles import Blocks, Coding, code
from fhash_codec.compact.transform import usual_transform
from fhash_codec.features.features import Extent
from fhash_codec.progress import silent
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container import record as strict_json
from fhash_formats.container.growing import TableParts
from fhash_formats.container.record import Record
from fhash_formats.errors import FhashError, MissingInputError, OutputExistsError
from fhash_formats.readers.registry import open_series
from fhash_formats.series import ArraySeries, Coordinate
from fhash_formats.support.threads import thread_pool
from fhash_formats.transform.tile_format import TileSettings

SHAPE = (7, 4, 6, 8)
TILE = "2x4x6x4"


def values(seed: int = 0, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(seed).random(shape)
    return (np.sin(6 * x + 2 * t) * np.cos(5 * y) + z + 0.05 * noise).astype(np.float32)


def with_gaps() -> np.ndarray:
    gaps = values()
    gaps[3:5, 1:3, 2:4] = np.nan
    return gaps


def settings(**options) -> EncodeConfig:
    return EncodeConfig(**{"max_error": 0.02, "effort": 1, "tile": TILE, **options}, timings=False)


def parts_of(source, folder: Path, config: EncodeConfig, count: int = 3) -> list[Path]:
    paths = [folder / f"part{number}.fhz" for number in range(1, count + 1)]
    for number, path in enumerate(paths, start=1):
        encode_part(source, path, config, Part(number=number, of=count))
    return paths


CASES = {
    "bound": (values, {}),
    "trials": (values, {"effort": 2, "max_error": 0.2}),
    "a relative bound": (values, {"max_error": None, "max_error_rel": 0.01}),
    "missing values": (with_gaps, {}),
    "a feature and missing values": (with_gaps, {"features": ("interval:0.5:9",)}),
    "integers": (lambda: (values() * 50).astype(np.int32), {"max_error": 0}),
    "no ssim": (values, {"without": ("ssim",)}),
}


@pytest.mark.parametrize(
    "case",
    [
        *("bound", "trials", "a feature and missing values"),
        *rarely("a relative bound", "missing values", "integers", "no ssim"),
    ],
)
def test_merged_parts_are_the_whole_byte_for_byte(tmp_path, case) -> None:
    make, options = CASES[case]
    source, config = make(), settings(**options)
    fhash_codec.encode(source, tmp_path / "whole.fhz", config)
    parts = parts_of(source, tmp_path, config)
    report = merge([parts[1], parts[2], parts[0]], tmp_path / "run.fhz")
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    assert (report["parts"], report["steps"], report["tiles"]) == (3, 7, 8)
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        assert volume.verify()


def test_gaps_overlaps_and_strangers_are_refused(tmp_path) -> None:
    parts = parts_of(values(), tmp_path, settings())
    (tmp_path / "other").mkdir()
    strangers = {
        "settings": parts_of(values(), tmp_path / "other", settings(max_error=0.03)),
        "value_range": [tmp_path / "other" / "data.fhz"],
        "parts": [tmp_path / "other" / "halves.fhz"],
    }
    encode_part(values(1), strangers["value_range"][0], settings(), Part(number=2, of=3))
    encode_part(values(), strangers["parts"][0], settings(), Part(number=2, of=2))
    fhash_codec.encode(values(), tmp_path / "whole.fhz", settings())
    for chosen, message in (
        ([], "no parts are given"),
        (parts[1:], "steps 0 to 1 are missing: parts 1/3"),
        (parts[:2], "steps 4 to 6 are missing: parts 3/3"),
        ([parts[0], parts[2]], "steps 2 to 3 are missing: parts 2/3"),
        ([*parts, parts[0]], "give each part once"),
        ([parts[0], strangers["settings"][1], parts[2]], "not of one encoding, they differ in"),
        ([parts[0], strangers["value_range"][0], parts[2]], "they differ in"),
        ([parts[0], strangers["parts"][0]], "they differ in parts"),
        ([parts[0], tmp_path / "whole.fhz"], "is no part of a series"),
    ):
        with pytest.raises(InputError, match=message):
            merge(chosen, tmp_path / "run.fhz")
        assert not (tmp_path / "run.fhz").exists()
    with pytest.raises(InputError, match="is the input itself"):
        merge(parts, parts[0], force=True)
    with pytest.raises(OutputExistsError):
        merge(parts, tmp_path / "whole.fhz")


def test_a_damaged_tile_is_found_and_nothing_is_written(tmp_path) -> None:
    parts = parts_of(values(), tmp_path, settings())
    data = bytearray(parts[1].read_bytes())
    with Container.open(parts[1]) as container:
        offset, _ = container.arrays["table_1"].place((0, 0, 0, 0))
    data[offset + 4] ^= 1
    parts[1].write_bytes(data)
    with pytest.raises(DamagedFileError, match="part2"):
        merge(parts, tmp_path / "run.fhz")
    assert sorted(os.listdir(tmp_path)) == ["part1.fhz", "part2.fhz", "part3.fhz"]


def rewritten(path: Path, change) -> None:
    """Write a part anew, with another header or other errors. change(header, errors) in place."""
    with Container.open(path) as container:
        table, header = container.arrays["table_1"], deepcopy(container.header)
        errors = container.arrays["step_errors"].read()
        change(header, errors)
        other = path.with_name("other.fhz")
        with ContainerWriter(other) as writer:
            TableParts(
                shape=table.shape,
                dtype=table.dtype,
                tile=table.chunk_shape,
                settings=table.settings,
                streams=[bytes(table.coded(index)) for index in np.ndindex(*table.grid)],
            ).write(writer)
            writer.add_whole("step_errors", errors)
            writer.commit(header)
    os.replace(other, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda header, errors: header["part"].pop("of"), "part.of"),
        (lambda header, errors: header["part"].update(number=9), "part.number"),
        (lambda header, errors: header["part"].update(first=-1), "part.first"),
        (lambda header, errors: header["part"].update(ssim_steps=[1, "a"]), "ssim_steps"),
        (lambda header, errors: header["part"].update(ssim_steps=3), "ssim_steps"),
        (lambda header, errors: header.update(part=[]), "part"),
        (lambda header, errors: errors.fill(np.nan), "step_errors has numbers"),
        (lambda header, errors: errors.fill(-1), "step_errors has numbers"),
        *(
            (lambda header, errors, at=at, new=new: errors.__setitem__((0, at), new), "no errors")
            for at, new in ((0, 1e300), (0, 0.5), (1, -1e-9), (2, 1e200), (4, -1.0), (8, 1e9))
        ),
    ],
)
def test_a_hostile_part_is_refused(tmp_path, change, message) -> None:
    parts = parts_of(values(), tmp_path, settings(), 1)
    rewritten(parts[0], change)
    with pytest.raises(DamagedFileError, match=message):
        merge(parts, tmp_path / "run.fhz")
    assert os.listdir(tmp_path) == ["part1.fhz"]


def test_a_part_of_masked_tiles_without_occupancy_is_refused(tmp_path) -> None:
    parts = parts_of(values(), tmp_path, settings(features=("interval:0:9",)), 1)
    with Container.open(parts[0]) as container:
        assert container.arrays["table_1"].masked
    rewritten(parts[0], lambda header, errors: None)
    with pytest.raises(DamagedFileError, match="array occupancy is missing"):
        merge(parts, tmp_path / "run.fhz")


@pytest.mark.parametrize("kind", ["rotated", "calendar"])
def test_what_belongs_to_the_variable_in_its_source_is_that_of_the_whole(tmp_path, kind) -> None:
    pytest.importorskip("h5netcdf")
    cf_files = pytest.importorskip("cf_files", exc_type=ImportError)
    made = cf_files.KINDS[kind]()
    made.dataset[made.variable].attrs["ancillary_variables"] = "long"
    long = made.dataset.assign(long=(("n",), np.arange(400.0)))  # too many for the header
    source = cf_files.Kind(long, made.variable, made.encoding).write(tmp_path / "source.nc")
    config = settings(tile="1x9x9x9", max_error_rel=0.01, max_error=None)
    with open_series(source, var=made.variable) as series:
        fhash_codec.encode(series, tmp_path / "whole.fhz", config)
        parts = parts_of(series, tmp_path, config, 2)
    merge(parts, tmp_path / "run.fhz")
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    with fhash_codec.open(tmp_path / "run.fhz") as volume:
        assert {"long"} <= {one.name for one in volume.metadata.variables}
    message = "time_bnds of its source has a value for each step" if kind == "calendar" else None
    if message is not None:
        with pytest.raises(InputError, match=message):
            Writer.resume(tmp_path / "run.fhz")
    else:
        with Writer.resume(tmp_path / "run.fhz") as writer:
            writer.append(np.full(writer.shape, 280, "f8").astype(made.dataset["tas"].dtype))
        with fhash_codec.open(tmp_path / "run.fhz") as volume:
            assert {"long"} <= {one.name for one in volume.metadata.variables}
            assert volume.metadata.digest is None


@pytest.mark.filterwarnings("ignore:.* are not stored:fhash_formats.errors.FhashWarning")
def test_parts_of_a_series_that_was_not_stored_whole(tmp_path: Path) -> None:
    source = tmp_path / "a.h5"
    with h5py.File(source, "w") as file:
        made = file.create_dataset("u", (6, 4, 5, 6), "f4", chunks=(1, 4, 5, 6))
        for step in (0, 1, 2, 4, 5):
            made[step] = np.arange(120).reshape(4, 5, 6) + step + 1
    config = EncodeConfig(max_error=0.1, effort=1, tile="1x4x5x6", timings=False)
    whole = tmp_path / "whole.fhz"
    fhash_codec.encode(source, whole, config)
    merge(parts_of(source, tmp_path, config), tmp_path / "merged.fhz")
    assert (tmp_path / "merged.fhz").read_bytes() == whole.read_bytes()
    with fhash_codec.open(tmp_path / "merged.fhz") as volume:
        told = volume.info["variable"]["not_stored"]
    assert told == {"share": round(1 / 6, 6), "steps": [[3, 4]], "fill": 0}
    grown = tmp_path / "grown.fhz"
    with open_series(source, steps=slice(0, 2)) as series:
        fhash_codec.encode(series, grown, config)
    with open_series(source, steps=slice(2, None)) as series:
        append(series, grown)
    with fhash_codec.open(grown) as volume:
        assert volume.info["variable"]["not_stored"] == told


@pytest.mark.parametrize("count", [1, 2, 7, 16, 100])
@pytest.mark.parametrize("of", [1, 2, 5, 16])
def test_parts_share_all_layers_evenly(count, of) -> None:
    if of > count:
        with pytest.raises(InputError, match=f"{of} parts of {count} layers"):
            Part(number=1, of=of).layers(count)
        return
    spans = [Part(number=number, of=of).layers(count) for number in range(1, of + 1)]
    assert [layer for span in spans for layer in span] == list(range(count))
    assert max(map(len, spans)) - min(map(len, spans)) <= 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/3/5", "-1/3", "a/b", "1/0", "1 / 3"])
def test_other_texts_name_no_part(text) -> None:
    with pytest.raises(InputError, match=r"allowed: |part"):
        Part.parse(text)
    assert Part.parse("3/16") == Part(number=3, of=16)


SHAPE_PARTS = (6, 4, 6, 8)
CONFIG = EncodeConfig(max_error=0.02, tile="1x4x6x8", effort=2)
FEATURES = {
    "all": ("all",),
    "interval": ("interval:0.2:9",),
    "in time": ("change:0.3", "onset:0.4"),
    "threshold": ("segmentation",),
}


def values_parts() -> np.ndarray:
    noise = np.random.default_rng(0).random(SHAPE_PARTS)
    return (np.sin(np.linspace(0, 6, SHAPE_PARTS[3])) + 0.5 * noise).astype(np.float32)


class Watched(ArraySeries):
    """A series that knows which steps were read."""

    def __init__(self, array: np.ndarray) -> None:
        super().__init__(array)
        self.steps: set[int] = set()

    def read(self, step: int) -> np.ndarray:
        self.steps.add(step)
        return super().read(step)

    def read_steps(self, steps: range) -> np.ndarray:
        self.steps |= set(steps)
        return super().read_steps(steps)


@pytest.mark.parametrize("missing", [True, *rarely(False)])
@pytest.mark.parametrize("case", FEATURES)
def test_a_part_with_a_plan_reads_its_own_steps_alone(tmp_path, case, missing) -> None:
    data, config = values_parts(), replace(CONFIG, features=FEATURES[case])
    if missing:
        data[4, 1] = np.nan
    plan_parts(data, tmp_path / "run.plan", config)
    plan = SeriesPlan.read(tmp_path / "run.plan")
    parts = [tmp_path / f"{number}.fhz" for number in (1, 2, 3)]
    for number, path in enumerate(parts, start=1):
        series, beside = Watched(data), case == "in time"
        encode_part(series, path, None, Part(number=number, of=3), plan=plan)
        own = {2 * number - 2, 2 * number - 1}
        around = {step + move for step in own for move in ((-1, 0, 1) if beside else (0,))}
        assert own <= series.steps <= around
    merge(parts, tmp_path / "run.fhz")
    fhash_codec.encode(data, tmp_path / "whole.fhz", replace(config, timings=False))
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()


def test_a_part_refuses_a_plan_of_others(tmp_path) -> None:
    plan, one = plan_parts(values_parts(), tmp_path / "run.plan", CONFIG), Part(number=2, of=3)
    for source, config, message in (
        (values_parts()[:, :3], None, "they differ in shape"),
        (values_parts() + 9, None, "in steps 2 to 3 are values from"),
        (
            np.where(values_parts() > 1, np.nan, values_parts()),
            None,
            "missing values, and the plan is of data",
        ),
        (values_parts(), replace(CONFIG, max_error=0.5), "max_error is 0.5, and 0.02 in the plan"),
    ):
        with pytest.raises(InputError, match=message):
            encode_part(source, tmp_path / "2.fhz", config, one, plan=plan)
    encode_part(values_parts(), tmp_path / "2.fhz", CONFIG, one, plan=plan)
    assert len(list(tmp_path.iterdir())) == 2


SHAPE_SERIES_PLAN = (6, 4, 6, 8)
CONFIG_SERIES_PLAN = EncodeConfig(
    max_error=0.02, effort=2, tile="2x4x6x4", features=("interval:0.3:9",)
)


def series(**labels) -> ArraySeries:
    noise = np.random.default_rng(0).random(SHAPE_SERIES_PLAN)
    values = np.sin(np.linspace(0, 6, SHAPE_SERIES_PLAN[3])) + 0.05 * noise
    given = {"name": "u", "units": "m", "coords": times([0, 1, 2, 4, 5, 6]), **labels}
    return ArraySeries(given.pop("values", values.astype(np.float32)), **given)


def times(values: list[float]) -> dict[str, Coordinate]:
    return {"t": Coordinate(name="time", values=np.array(values, dtype=float))}


@pytest.fixture(scope="module")
def plan(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "run.plan"
    plan_parts(series(), path, CONFIG_SERIES_PLAN)
    return path


def test_a_plan_comes_back_from_its_file(plan) -> None:
    made, read = SeriesPlan.make(series(), bounded(CONFIG_SERIES_PLAN)), SeriesPlan.read(plan)
    assert read.to_bytes() == plan.read_bytes() == made.to_bytes()
    assert (read.shape, read.layers, read.config.timings) == (SHAPE_SERIES_PLAN, 3, False)
    assert read.steps(range(1, 3)) == range(2, 6)
    read.require(series())


@pytest.mark.parametrize("promise", [{"psnr": 40}, {"ratio": 9}, {}, {"preset": "published"}])
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
    "settings": lambda values: values["recipe"].update(settings=-1),
    "cut settings": lambda values: values["recipe"].update(
        settings=values["recipe"]["settings"][:9]
    ),
    "coding": lambda values: values["recipe"].update(coding=None),
    "promise": lambda values: values["config"].update(max_error=None),
    "setting": lambda values: values["config"].update(effort=99),
    "unknown setting": lambda values: values["config"].update(os="system"),
    "no model": lambda values: values["header"].pop("model"),
    "parameters": lambda values: values["header"]["model"].update(parameters="a"),
    "features": lambda values: values.update(features=[1]),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_plan_is_refused(plan, case) -> None:
    with pytest.raises(DamagedFileError, match="the plan is damaged: "):
        SeriesPlan.from_bytes(changed(plan, HOSTILE[case]))


TILE_SERIES_PLAN = (2, 4, 4, 4)
SETTINGS = TileSettings(
    transform=usual_transform(TILE_SERIES_PLAN), step=0.1, center=0.5, low=0.0, high=1.0
)
RECIPE = Recipe(
    tile=TILE_SERIES_PLAN, settings=SETTINGS, coding=Coding(error=0.05, rounds=2, density=8)
)
FILLED = replace(RECIPE, filling=(replace(SETTINGS, step=0.2), 1))
TRAINED = replace(RECIPE, coding=replace(RECIPE.coding, aim=0.5, joint=1.2))


def read(values) -> Recipe:
    return Recipe.from_dict(Record(values, "recipe."))


@pytest.mark.parametrize("recipe", [RECIPE, FILLED, TRAINED])
@pytest.mark.parametrize("layers", [range(0, 1), range(1, 3)])
def test_some_layers_have_the_bytes_of_the_whole(recipe, layers) -> None:
    assert read(recipe.to_dict()).coding == recipe.coding
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
    blocks = Blocks(ArraySeries(values), extent, TILE_SERIES_PLAN)
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


SHAPE_CLUSTER = (9, 6, 8, 10)


def values_cluster() -> np.ndarray:
    return values(shape=SHAPE_CLUSTER)


def settings_cluster(**options) -> EncodeConfig:
    return settings(**{"tile": "2x6x8x5", **options})


class Threads:
    """A client of the threads of this process."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self.pool, self.futures = pool, []

    def submit(self, work, *arguments) -> Future:
        given = [each.result() if isinstance(each, Future) else each for each in arguments]
        self.futures.append(self.pool.submit(work, *given))
        return self.futures[-1]

    def compute(self, array) -> Future:
        return self.pool.submit(array.compute, scheduler="synchronous")

    def nthreads(self) -> dict[str, int]:
        return {"worker": 2}


@pytest.fixture
def threads():
    with ThreadPoolExecutor(2) as pool:
        yield Threads(pool)


@pytest.fixture(scope="module")
def client():
    """A client of two worker processes."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def saved(folder: Path, array: np.ndarray) -> Path:
    np.save(folder / "data.npy", array)
    return folder / "data.npy"


def labelled(array: np.ndarray, chunks: dict[str, int]):
    """A dask-backed array in another order of its axes, with coordinates."""
    xarray, _ = pytest.importorskip("xarray"), pytest.importorskip("dask")
    times = np.datetime64("2020-01-01", "ns") + np.arange(SHAPE_CLUSTER[0]) * np.timedelta64(6, "h")
    coords = {
        "time": times,
        "lat": ("lat", np.linspace(-40, 40, SHAPE_CLUSTER[2]), {"units": "degrees_north"}),
    }
    made = xarray.DataArray(
        array, dims=("time", "lev", "lat", "lon"), coords=coords, name="u", attrs={"units": "m s-1"}
    )
    made["lev"].attrs["axis"], made["lon"].attrs["axis"] = "Z", "X"
    return made.transpose("lat", "time", "lon", "lev").chunk(chunks)


def require_same(tmp_path: Path, source, client, config: EncodeConfig) -> dict:
    """Encode a source with and without a client; the files must be the same. The figures."""
    whole = fhash_codec.encode(source, tmp_path / "whole.fhz", config)
    figures = fhash_codec.encode(source, tmp_path / "run.fhz", config, client=client)
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()
    varying = ("path", "seconds", "stages")
    assert {key: value for key, value in figures.items() if key not in varying} == {
        key: value for key, value in whole.items() if key not in varying
    }
    assert not list(tmp_path.glob(".*"))
    return figures


CASES_CLUSTER = {
    "bound": {},
    "trials and a feature": {"effort": 2, "features": ("change:0.2",)},
    "a relative bound": {"max_error": None, "max_error_rel": 0.01},
}


@pytest.mark.parametrize("case", ["trials and a feature", *rarely("bound", "a relative bound")])
def test_workers_code_a_file_to_the_same_bytes(tmp_path, client, case) -> None:
    require_same(
        tmp_path, saved(tmp_path, values_cluster()), client, settings_cluster(**CASES_CLUSTER[case])
    )


@pytest.mark.parametrize("case", ["bound", *rarely("trials and a feature", "a relative bound")])
def test_workers_compute_the_frames_of_a_lazy_array(tmp_path, client, case) -> None:
    source = labelled(values_cluster(), {"time": 4, "lat": 3})
    require_same(tmp_path, source, client, settings_cluster(**CASES_CLUSTER[case]))


def test_a_persisted_array_stays_on_the_workers(tmp_path, client) -> None:
    source = labelled(values_cluster(), {"time": 2}).persist()
    require_same(tmp_path, source.to_dataset(), client, settings_cluster())


def test_a_failure_of_a_worker_is_one_line(tmp_path, client) -> None:
    path = saved(tmp_path, values_cluster())
    hidden = path.with_name("hidden.npy")

    def hide(stage: str, done: int, total: int, note: str) -> None:
        if stage == "planning" and done == total and path.exists():
            os.replace(path, hidden)

    with pytest.raises(ClusterError, match=r"part 1/5 failed on the cluster: .*data\.npy") as error:
        fhash_codec.encode(
            path, tmp_path / "a.fhz", settings_cluster(), client=client, progress=hide
        )
    assert "\n" not in str(error.value)
    assert os.listdir(tmp_path) == ["hidden.npy"]


@pytest.mark.parametrize("older", [False, True])
def test_an_interruption_cancels_the_rest_and_leaves_no_file(tmp_path, threads, older) -> None:
    path, output = saved(tmp_path, values_cluster()), tmp_path / "a.fhz"
    if older:
        output.write_bytes(b"older")

    def stop(stage: str, done: int, total: int, note: str) -> None:
        if stage == "coding" and note == "parts":
            raise KeyboardInterrupt

    config = settings_cluster(tile="1x6x8x5")  # 8 parts
    with pytest.raises(KeyboardInterrupt):
        fhash_codec.encode(path, output, config, client=threads, force=older, progress=stop)
    assert len(threads.futures) == rooms.AHEAD * 2  # and none was begun after that
    assert all(future.done() or future.running() for future in threads.futures)
    assert sorted(os.listdir(tmp_path)) == (["a.fhz"] if older else []) + ["data.npy"]
    assert not older or output.read_bytes() == b"older"


def test_what_other_machines_cannot_read_is_refused(tmp_path, threads) -> None:
    output = tmp_path / "a.fhz"
    for source, options, message in (
        (values_cluster(), {}, "leave client out"),
        (ArraySeries(values_cluster()), {}, "leave client out"),
        (saved(tmp_path, values_cluster()), {"mask": np.ones(SHAPE_CLUSTER)}, "feature mask:FILE"),
    ):
        with pytest.raises(InputError, match=message):
            fhash_codec.encode(source, output, settings_cluster(), client=threads, **options)
    for promise in ({"psnr": 40}, {"ratio": 10}, {}, {"preset": "published"}):
        with pytest.raises(InputError, match="give max_error or max_error_rel"):
            fhash_codec.encode(
                tmp_path / "data.npy", output, EncodeConfig(**promise), client=threads
            )
    output.write_bytes(b"older")
    with pytest.raises(OutputExistsError):
        fhash_codec.encode(tmp_path / "data.npy", output, settings_cluster(), client=threads)
    assert not threads.futures


def test_held_steps_have_the_labels_of_the_whole() -> None:
    whole = ArraySeries(values_cluster(), name="u", units="m")
    held = HeldSteps(whole, whole=True).with_steps(3, values_cluster()[3:5])
    assert (held.shape, held.name, held.units) == (SHAPE_CLUSTER, "u", "m")
    np.testing.assert_array_equal(held.read(4), values_cluster()[4])
    with pytest.raises(InputError, match="step 5 was not sent"):
        held.read(5)


@pytest.mark.parametrize("kind", ["gaps", *rarely("values", "integers", "constant")])
def test_a_long_series_is_scanned_on_the_cluster(tmp_path, threads, monkeypatch, kind) -> None:
    dask = pytest.importorskip("dask.array")
    for module in (rooms, series_plan, encode):
        monkeypatch.setattr(module, "fits_memory", lambda series: False)
    monkeypatch.setattr(blocks, "MAX_BYTES_IN_MEMORY", 1)
    array = values_cluster()
    if kind == "gaps":
        array[4, 2] = np.nan
    if kind == "integers":
        array = (100 * array).astype(np.int16)
    if kind == "constant":
        array[:] = 3
    monkeypatch.setattr(rooms, "PART_BYTES", 2 * array[0].nbytes)
    counts: list[tuple[int, int]] = []

    def watch(stage: str, done: int, total: int, note: str) -> None:
        if stage == "scanning":
            counts.append((done, total))

    require_same(
        tmp_path, dask.from_array(array, chunks=(4, 6, 8, 10)), threads, settings_cluster()
    )
    source = dask.from_array(array, chunks=(4, 6, 8, 10))
    fhash_codec.encode(
        source, tmp_path / "again.fhz", settings_cluster(), client=threads, progress=watch
    )
    on_cluster = [(2, 9), (4, 9), (6, 9), (8, 9), (9, 9)]
    alone = [(9, 9)]  # the client reads all steps as one block
    assert counts == (on_cluster[:3] + alone if kind == "gaps" else on_cluster)


def test_extremes_that_nobody_declared_are_refused_on_the_cluster_too(
    tmp_path, threads, monkeypatch
) -> None:
    dask = pytest.importorskip("dask.array")
    monkeypatch.setattr(rooms, "fits_memory", lambda series: False)
    monkeypatch.setattr(rooms, "PART_BYTES", 1)
    array = values_cluster()
    array[[1, 7], 0] = 1e20
    with pytest.raises(InputError, match="give --missing 1e\\+20"):
        fhash_codec.encode(
            dask.from_array(array, chunks=3), tmp_path / "a.fhz", settings_cluster(), client=threads
        )
    assert not list(tmp_path.iterdir())
