"""`merge`: parts become the file of the whole, byte for byte; wrong sets of parts are refused."""

from __future__ import annotations

import os
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import fhash_codec
from fhash_codec import DamagedFileError, EncodeConfig, InputError, Writer
from fhash_codec.appending.parts import Part, encode_part, merge
from fhash_codec.appending.series_plan import SeriesPlan, plan_parts
from fhash_codec.appending.writer import append
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container.growing import TableParts
from fhash_formats.errors import OutputExistsError
from fhash_formats.readers.registry import open_series
from fhash_formats.series import ArraySeries

SHAPE = (7, 4, 6, 8)
TILE = "2x4x6x4"


def values(seed: int = 0) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    noise = np.random.default_rng(seed).random(SHAPE)
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


@pytest.mark.parametrize("case", CASES)
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
        member = next(iter(container.arrays["tables/level_1"].chunks.values()))
    data[member.data_offset + 4] ^= 1
    parts[1].write_bytes(data)
    with pytest.raises(DamagedFileError, match="part2"):
        merge(parts, tmp_path / "run.fhz")
    assert sorted(os.listdir(tmp_path)) == ["part1.fhz", "part2.fhz", "part3.fhz"]


def rewritten(path: Path, change) -> None:
    """Write a part anew, with another header or other errors. change(header, errors) in place."""
    with Container.open(path) as container:
        table, header = container.arrays["tables/level_1"], deepcopy(container.header)
        errors = container.arrays["steps/errors"].read()
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
            writer.add_whole("steps/errors", errors)
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
        (lambda header, errors: header["model"].pop("gains"), "model.gains"),
        (lambda header, errors: errors.fill(np.nan), "steps/errors has numbers"),
        (lambda header, errors: errors.fill(-1), "steps/errors has numbers"),
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


@pytest.mark.parametrize("missing", [False, True])
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
        own = range(max(2 * number - 2 - beside, 0), min(2 * number + beside, 6))
        assert series.steps == set(own)
    merge(parts, tmp_path / "run.fhz")
    fhash_codec.encode(data, tmp_path / "whole.fhz", replace(config, timings=False))
    assert (tmp_path / "run.fhz").read_bytes() == (tmp_path / "whole.fhz").read_bytes()


def test_a_part_refuses_a_plan_of_others(tmp_path) -> None:
    plan, one = plan_parts(values_parts(), tmp_path / "run.plan", CONFIG), Part(number=2, of=3)
    for source, config, message in (
        (values_parts()[:, :3], None, "they differ in shape"),
        (values_parts() + 9, None, "step 2 has values from"),
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
