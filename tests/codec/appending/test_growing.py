"""Figures of a growing file: those of a comparison, before and after they were in a header."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import fhash_codec
from fhash_codec import (
    DamagedFileError,
    EncodeConfig,
)
from fhash_codec import (
    InputError as InputError_growing,
)
from fhash_codec import (
    InputError as InputError_resuming,
)
from fhash_codec.appending import growing
from fhash_codec.appending.growing import Figures, GrowingFile, LayerCoder, bound_of_file, continued
from fhash_codec.appending.writer import plan_layers
from fhash_codec.header import full_header
from fhash_codec.measure.value_range import ValueRange
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container.array import transform_codecs
from fhash_formats.errors import InputError
from fhash_formats.series import index_coordinate

WRITER = ContainerWriter("unused.fhz")
"""A writer that gets nothing: few steps have their figures in the header."""


def measured(count: int = 3) -> tuple[Figures, np.ndarray]:
    errors = np.random.default_rng(0).normal(0, 0.01, (count, 2, 3, 4))
    figures = Figures(Figures.scale_of(ValueRange(0.0, 5.0)))
    for error in errors:
        figures.steps.append(figures.measure(np.zeros(error.shape), error))
    return figures, errors


def test_what_a_header_tells_is_taken_up_again() -> None:
    figures, _ = measured()
    told = figures.header(WRITER, 5.0)
    header = {
        "domain": {"shape": [3, 2, 3, 4]},
        "value_range": [0.0, 5.0],
        "model": {},
        "history": {},
        "quality": told,
    }
    full = full_header(header, {})
    again = Figures.of_header(full, figures.scale).header(WRITER, 5.0)
    # Figures of steps are rounded to hundredths of a dB.
    assert again["rmse"] == pytest.approx(told["rmse"], rel=2e-3)
    assert again["rmse"] >= told["rmse"]
    assert again["max_abs_error"] == told["max_abs_error"]
    steps = full["quality"]["per_step"]
    for wrong in (steps[:2], [*steps[:2], {"rmse": None, "max_abs_error": 1.0}]):
        with pytest.raises(InputError, match="does not tell the errors of step 2"):
            Figures.of_header({**header, "quality": {"per_step": wrong}}, 1.0)


SHAPE = (3, 4, 5)


@pytest.fixture
def begun(tmp_path):
    """A file without steps, and its frames."""
    frames = np.random.default_rng(0).random((6, *SHAPE)).astype(np.float32)
    frames[3:] += 2
    config = EncodeConfig(max_error=0.05, effort=1, tile="2x3x4x5")
    plan = plan_layers(list(frames[:2]), config, 0.05, None)
    variable = {"name": "u", "units": "", "dtype": "float32", "attributes": {}}
    lengths = zip(("t", "z", "y", "x"), (1, *SHAPE), strict=True)
    coords = {axis: index_coordinate(axis, n) for axis, n in lengths}
    header = {**plan.header, "variable": variable}
    return GrowingFile(tmp_path / "a.fhz", plan.coder, header, coords, Figures(1.0)), frames


def add(file: GrowingFile, frames: np.ndarray, first: int, **options) -> None:
    with ThreadPoolExecutor(1) as workers:
        layer = file.coder.code(list(frames[first : first + 2]), file.figures, workers)
    file.add(layer, [float(first), first + 1.0], **options)


def test_there_is_a_limit_of_steps(begun, monkeypatch) -> None:
    file, frames = begun
    monkeypatch.setattr(growing, "MAX_STEPS", 3)
    with file:
        add(file, frames, 0)
        with pytest.raises(InputError_growing, match="at most 3: begin another"):
            add(file, frames, 2)
    with fhash_codec.open(file.path) as volume:
        assert volume.shape[0] == 2


BOUND = 0.01


@pytest.fixture(scope="module")
def frames_layers() -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (4, 5, 9, 12)), indexing="ij")
    return (np.sin(5 * x + t) * np.cos(4 * y) + z).astype(np.float32)


@pytest.fixture(scope="module")
def coder(frames_layers) -> LayerCoder:
    config = EncodeConfig(max_error=BOUND, effort=1, tile="4x5x6x6")
    return plan_layers(list(frames_layers), config, BOUND, None).coder


def coded(coder: LayerCoder, frames_layers: np.ndarray):
    figures = Figures(1.0)
    with ThreadPoolExecutor(2) as workers:
        return coder.code(list(frames_layers), figures, workers)


def test_a_tile_that_decodes_otherwise_is_told(frames_layers, coder, monkeypatch) -> None:
    monkeypatch.setattr("fhash_codec.appending.growing.decode_tile", lambda *_: frames_layers[0])
    with pytest.raises(RuntimeError, match="decodes to other values"):
        coded(coder, frames_layers)


BOUND_RESUMING = 0.02
CONFIG = EncodeConfig(max_error=BOUND_RESUMING, effort=1, tile="2x4x6x4")


@pytest.fixture
def run(tmp_path, field):
    path = tmp_path / "run.fhz"
    fhash_codec.encode(field((4, 4, 6, 8)), path, CONFIG)
    return path


def with_array(run, path, name, values, dimension_names):
    """A copy of a file with another array."""
    with Container.open(run) as container, ContainerWriter(path) as writer:
        table = container.arrays["tables/level_1"]
        writer.add_sharded(
            "tables/level_1",
            shape=table.shape,
            dtype=table.dtype,
            chunk_shape=table.chunk_shape,
            shard_shape=table.shard_shape,
            chunks=(bytes(table.coded(index)) for index in np.ndindex(*table.grid)),
            dimension_names=table.dimension_names,
            codecs=transform_codecs(table.settings),
        )
        writer.add_whole(name, values, dimension_names=dimension_names, attributes={"a": 1})
        header = dict(container.header)
        writer.commit({**header, "more": {"key": 1}})
    return path


def test_arrays_and_keys_that_do_not_depend_on_time_are_carried(run, tmp_path) -> None:
    path = with_array(run, tmp_path / "a.fhz", "auxiliary/area", np.arange(6.0), ["y"])
    with continued(path) as growing:
        growing.publish()
    with Container.open(path) as container:
        area = container.arrays["auxiliary/area"]
        np.testing.assert_array_equal(area.read(), np.arange(6.0))
        assert (area.attributes, area.dimension_names) == ({"a": 1}, ("y",))
        assert container.header["more"] == {"key": 1}
    for names in (["time"], None):
        other = tmp_path / f"{names}.fhz"
        path = with_array(run, other, "auxiliary/pressure", np.arange(4.0), names)
        with pytest.raises(InputError_resuming, match="has a value for each step"), continued(path):
            pass


def test_a_damaged_tile_is_found_before_anything_is_written(run) -> None:
    data = bytearray(run.read_bytes())
    data[data.index(b"/c/0/0/0/0") + 40] ^= 1
    run.write_bytes(data)
    with pytest.raises(DamagedFileError, match=r"run\.fhz"), continued(run):
        pass
    assert run.read_bytes() == data


def test_the_bound_of_a_file() -> None:
    header = {"value_range": [1.0, 3.0]}
    assert bound_of_file({**header, "config": {"max_error": 2}}) == 2
    assert bound_of_file({**header, "config": {"max_error_rel": 0.1}}) == pytest.approx(0.2)
    assert bound_of_file({**header, "config": {"psnr": 40, "max_error": None}}) is None
