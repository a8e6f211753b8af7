"""Files that are to be continued: which can, and what of them stays."""

from __future__ import annotations

import numpy as np
import pytest

import fhash_codec
from fhash_codec import DamagedFileError, EncodeConfig, InputError, MissingInputError
from fhash_codec.appending.resuming import bound_of_file, continued
from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container.coding import transform_codecs

BOUND = 0.02
CONFIG = EncodeConfig(max_error=BOUND, effort=1, tile="2x4x6x4")


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


def test_the_state_is_that_of_the_file(run) -> None:
    with continued(run) as growing:
        assert (growing.steps, growing.shape) == (4, (4, 6, 8))
        assert growing.coder.tile == (2, 4, 6, 4)
        assert growing.coder.coding.error == BOUND
        assert len(growing.figures.steps) == 4
    with continued(run, 2) as growing:
        assert growing.steps == len(growing.figures.steps) == 2


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
        with pytest.raises(InputError, match="has a value for each step"), continued(path):
            pass


@pytest.mark.parametrize("steps", [0, 1, 3, 5])
def test_only_whole_layers_are_kept(run, steps) -> None:
    with pytest.raises(InputError, match=r"within a layer|are to be kept"), continued(run, steps):
        pass


def test_files_that_cannot_grow(tmp_path, field) -> None:
    values = field((4, 4, 6, 8))
    gaps = values.copy()
    gaps[1, 2, 3, 4] = np.nan
    cases = {
        "does not promise a bound": (values, {"psnr": 40.0}),
        "keeps features or has missing values": (gaps, {"max_error": BOUND}),
    }
    for number, (message, (source, promise)) in enumerate(cases.items()):
        path = tmp_path / f"{number}.fhz"
        fhash_codec.encode(source, path, EncodeConfig(effort=1, tile="2x4x6x4", **promise))
        with pytest.raises(InputError, match=message), continued(path):
            pass
    with pytest.raises(MissingInputError), continued(tmp_path / "none.fhz"):
        pass
    (tmp_path / "bad.fhz").write_bytes(b"no container")
    with pytest.raises(DamagedFileError), continued(tmp_path / "bad.fhz"):
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
