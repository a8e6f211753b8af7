"""The arrays that a header asks for: there, of the right shape and type, with their attributes."""

from __future__ import annotations

import numpy as np
import pytest
from hostile_files import DOCUMENT, edited, edited_header, refused
from sharded_files import NAME

from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container.expected_arrays import check_key_frames, layer_shapes, occupancy_bytes
from fhash_formats.errors import DamagedFileError, InputError

ARRAYS = {
    "coords/time": lambda a: a[:-1],
    "coords/z": lambda a: a.astype("float32"),
    "key_frames": lambda a: a[:1],
    "tables/level_1": lambda a: a[..., :1],
    "tables/level_2": lambda a: a.astype("float32"),
    "mlp/weight_1": lambda a: np.ascontiguousarray(a.T),
    "mlp/bias_1": lambda a: a[:, None],
    "mlp/weight_2": lambda a: a.astype("float64"),
    "occupancy/bits": lambda a: a[..., :-1],
}


@pytest.mark.parametrize("name", ARRAYS)
def test_array_that_does_not_fit_is_named(tmp_path, samples, name) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    arrays[name] = ARRAYS[name](arrays[name])
    with pytest.raises(InputError, match=f"array {name} is .* the header asks for"):
        samples.write(tmp_path / "a.fhz", header, arrays)
    del arrays[name]
    with pytest.raises(InputError, match=f"array {name} is missing"):
        samples.write(tmp_path / "a.fhz", header, arrays)


@pytest.mark.parametrize(
    "fields",
    [
        {"tables": "uint8"},
        {"tables": "float32"},
        {"hidden_layers": 0},
        {"hidden_layers": 3},
        {"embedding_size": 1},
    ],
)
def test_other_models_fit(tmp_path, samples, fields) -> None:
    header = samples.header()
    header["model"].update(fields)
    arrays = samples.arrays(header)
    samples.write(tmp_path / "a.fhz", header, arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(arrays)


def test_a_mask_may_stand_in_place_of_the_bits(tmp_path, samples) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    del arrays["occupancy/bits"]
    mask = np.ones(header["model"]["levels"][0], np.uint8)
    samples.write(tmp_path / "a.fhz", header, arrays | {"occupancy/mask": mask})
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(arrays) + 1
    for other in (mask[1:], mask.astype(np.int16)):
        with pytest.raises(InputError, match=r"array occupancy/mask is .* the header asks for"):
            samples.write(tmp_path / "b.fhz", header, arrays | {"occupancy/mask": other})
    header["features"] = [f"isosurface:{n}" for n in range(9)]
    with pytest.raises(InputError, match="of 9 features; more than 8 need occupancy/bits"):
        samples.write(tmp_path / "b.fhz", header, arrays | {"occupancy/mask": mask})


def test_the_bits_have_a_grid_of_each_feature(tmp_path, samples) -> None:
    header = samples.header()
    header["features"] = ["isosurface:0", "isosurface:1"]
    arrays = samples.arrays(header)
    samples.write(tmp_path / "a.fhz", header, arrays)
    arrays["occupancy/bits"] = arrays["occupancy/bits"][:1]
    with pytest.raises(InputError, match=r"the header asks for uint8 \(2, 2, 16\)"):
        samples.write(tmp_path / "b.fhz", header, arrays)


def test_one_step_of_one_vertex(tmp_path, samples) -> None:
    header = samples.header()
    header["domain"]["shape"] = [1, 1, 1, 1]
    header["feature_bounding_box"] = [[0, 1]] * 3
    header["model"]["levels"] = [[1, 1, 1, 1]]
    arrays = samples.arrays(header)
    assert arrays["occupancy/bits"].shape == (1, 1, 1)
    samples.write(tmp_path / "a.fhz", header, arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(arrays)


@pytest.mark.parametrize(
    "attributes",
    [{}, {"offset": 0.0}, {"offset": "0", "scale": 1.0}, {"offset": 0.0, "scale": -1.0}],
)
def test_quantised_tables_need_offset_and_scale(tmp_path, samples, attributes) -> None:
    header = samples.header()
    header["model"]["tables"] = "uint8"
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array, attributes=attributes)
        with pytest.raises(InputError, match=r"array tables/level_1 attribute (offset|scale)"):
            writer.commit(header)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model.tables": "transform"}, "required_features"),
        (
            {"model.tables": "transform", "required_features": ["transform"]},
            "array tables/level_1/component_1 is missing",
        ),
        ({"model.tables_loss_db": "0.1"}, "tables_loss_db"),
    ],
    ids=str,
)
def test_coded_tables_need_their_feature_and_their_components(
    tmp_path, samples, change, message
) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    for key, value in change.items():
        header = edited_header(header, key, value)
    with pytest.raises(InputError, match=message):
        samples.write(tmp_path / "a.fhz", header, arrays)


@pytest.mark.parametrize("mixing", [None, 1.0, [1.0], [1.0, "2"], [1.0, 2.0, 3.0]])
def test_components_need_their_mixing(tmp_path, samples, mixing) -> None:
    header = samples.header()
    arrays = {
        name: array
        for name, array in samples.arrays(header).items()
        if not name.startswith("tables/")
    }
    header["model"]["tables"], header["required_features"] = "transform", ["transform"]
    for number, level in enumerate(header["model"]["levels"], start=1):
        arrays |= {
            f"tables/level_{number}/component_{part}": np.ones(level, np.float32) for part in (1, 2)
        }
    for good in (True, False):
        with ContainerWriter(tmp_path / "a.fhz") as writer:
            for name, array in arrays.items():
                attributes = (
                    {"mixing": [0.5, -1e300]}
                    if good or not name.endswith("2/component_1")
                    else {}
                    if mixing is None
                    else {"mixing": mixing}
                )
                writer.add_whole(
                    name, array, attributes=attributes if name.startswith("tables/") else None
                )
            if good:
                writer.preview(header).close()
            else:
                with pytest.raises(
                    InputError, match="array tables/level_2/component_1 attribute mixing"
                ):
                    writer.commit(header)


def test_arrays_of_other_names_are_ignored(tmp_path, samples) -> None:
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array)
        writer.add_whole("tables/novelty", np.zeros(3, dtype=np.uint8))
        writer.add_whole("coords/novelty", np.zeros(3), attributes={"name": 5})
        writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(container.arrays)


def test_name_of_a_coordinate_is_text(sample, samples) -> None:
    data = edited(sample, samples, DOCUMENT, lambda v: v.update(attributes={"name": 5}))
    refused(sample, data, "array coords/time attribute name is 5")


def test_missing_bits_fit_the_domain(tmp_path, samples) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    arrays["missing/bits"] = np.zeros((4, 12), dtype=np.uint8)
    samples.write(tmp_path / "a.fhz", header, arrays)
    arrays["missing/bits"] = np.zeros((4, 11), dtype=np.uint8)
    with pytest.raises(InputError, match="missing/bits"):
        samples.write(tmp_path / "b.fhz", header, arrays)


def test_key_frames_increase() -> None:
    header = {"domain": {"shape": [5, 1, 1, 1]}}
    for good in ([0], [4], [0, 1, 4]):
        check_key_frames(header, np.array(good))
    for bad in ([5], [-1, 2], [0, 2, 2], [3, 1]):
        with pytest.raises(DamagedFileError, match=r"0\.\.4"):
            check_key_frames(header, np.array(bad))


@pytest.mark.parametrize(
    ("size", "count"),
    [
        ((1, 1, 1), 1),
        ((2, 2, 2), 1),
        ((3, 2, 2), 2),
        ((25, 125, 125), 65536),
        ((64, 64, 64), 32768),
    ],
)
def test_occupancy_bytes(size, count) -> None:
    assert occupancy_bytes([(5, 5 + n) for n in size]) == count


def test_layer_shapes() -> None:
    model = {"levels": [[1] * 4] * 3, "embedding_size": 2, "hidden_layers": 2, "width": 8}
    assert layer_shapes(model) == [(8, 6), (8, 8), (1, 8)]
    assert layer_shapes({**model, "hidden_layers": 0}) == [(1, 6)]


def test_shards_need_the_feature(tmp_path, samples) -> None:
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array)
        writer.add_sharded(
            NAME,
            shape=(2,),
            dtype="uint8",
            chunk_shape=(1,),
            shard_shape=(2,),
            chunks=[np.zeros(1, np.uint8)] * 2,
        )
        with pytest.raises(
            InputError, match="array extra/values has codecs of the feature transform"
        ):
            writer.commit(header)
        writer.commit({**header, "required_features": ["transform"]})


BOX = (3, 4, 6)


def write_compact(path, header, arrays):
    with ContainerWriter(path) as writer:
        for name, array in arrays.items():
            writer.add_whole(name, array)
        writer.commit(header)


def compact_arrays(key_frames=4, dtype="float32"):
    return {"tables/level_1": np.ones((key_frames, *BOX), dtype=dtype)}


OPTIONAL = {
    "nothing": {},
    "key frames": {"key_frames": np.arange(4)},
    "missing": {"missing/bits": np.zeros((4, 12), dtype=np.uint8)},
}


@pytest.mark.parametrize("case", OPTIONAL)
def test_arrays_that_it_may_have(tmp_path, samples, case) -> None:
    arrays = {**compact_arrays(), **OPTIONAL[case]}
    write_compact(tmp_path / "a.fhz", samples.compact_header(), arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert list(container.arrays) == list(arrays)
        assert container.header["required_features"] == ["transform"]
        assert container.verify() == len(arrays)
    if case != "nothing":
        name = next(iter(OPTIONAL[case]))
        with pytest.raises(InputError, match=f"array {name} is .* the header asks for"):
            write_compact(
                tmp_path / "b.fhz", samples.compact_header(), {**arrays, name: arrays[name][:-1]}
            )


def test_table_fits_the_header(tmp_path, samples) -> None:
    header = samples.compact_header()
    for wrong in ({}, compact_arrays(3), compact_arrays(dtype="float64")):
        with pytest.raises(InputError, match="tables/level_1"):
            write_compact(tmp_path / "a.fhz", header, wrong)


def test_key_frames_are_there_unless_every_step_is_one(tmp_path, samples) -> None:
    header = samples.compact_header()
    header["model"]["levels"] = [[2, *BOX]]
    with pytest.raises(InputError, match="array key_frames is missing"):
        write_compact(tmp_path / "a.fhz", header, compact_arrays(2))
    write_compact(tmp_path / "a.fhz", header, {**compact_arrays(2), "key_frames": np.array([0, 3])})
