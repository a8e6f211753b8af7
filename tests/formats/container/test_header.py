"""The header: every key has a type and a range, and fits the arrays; a message names the key."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from fhash_formats.container import Container, ContainerWriter, validate_header
from fhash_formats.container.expected_arrays import (
    check_key_frames,
    layer_shapes,
    occupancy_bytes,
)
from fhash_formats.errors import DamagedFileError, InputError

FIXED = {"format": "fhash", "format_version": [1, 0], "required_features": []}


def changed(header, path, value):
    """A copy with the value at "a.b" replaced, or removed where it is `...`."""
    result = copy.deepcopy(header)
    *parents, key = path.split(".")
    inner = result
    for parent in parents:
        inner = inner[parent]
    if value is ...:
        del inner[key]
    else:
        inner[key] = value
    return result


BAD = [
    ("format", "FHASH"),
    ("format_version", [1]),
    ("format_version", [1, 0.5]),
    ("format_version", "1.0"),
    ("required_features", {}),
    ("required_features", [1]),
    ("encoder", ...),
    ("encoder", []),
    ("encoder.version", 1),
    ("encoder.seed", 1.5),
    ("encoder.seed", True),
    ("variable.name", ...),
    ("variable.units", None),
    ("variable.dtype", "complex64"),
    ("variable.dtype", ["float32"]),
    ("variable.attributes", []),
    ("domain", [4, 3, 5, 6]),
    ("domain.shape", [4, 3, 5]),
    ("domain.shape", [0, 3, 5, 6]),
    ("domain.shape", [4, 3, 5, 2**41]),
    ("domain.shape", [4, 3, 5, True]),
    ("value_range", [1.0, 0.0]),
    ("value_range", [0.0]),
    ("value_range", [0.0, "1"]),
    ("value_range", [0, 10**400]),
    ("value_range", [-1e39, 0]),
    ("value_range", [0, 1e300]),
    ("background", -1e39),
    ("background", None),
    ("background", 10**400),
    ("background", True),
    ("feature_bounding_box", [[0, 3], [1, 5]]),
    ("feature_bounding_box", [[0, 3], [1, 5], [0, 7]]),
    ("feature_bounding_box", [[0, 3], [5, 5], [0, 6]]),
    ("feature_bounding_box", [[-1, 3], [1, 5], [0, 6]]),
    ("feature_bounding_box", [[0, 3], [1, 5], [0.0, 6]]),
    ("feature_bounding_box", [[0, 3], [1, 5], 6]),
    ("feature_bounding_box", None),
    ("features", "all"),
    ("features", [None]),
    ("dilation", -1),
    ("dilation", "1"),
    ("model", None),
    ("model.profile", 1),
    ("model.fold", 1),
    ("model.embedding_size", 0),
    ("model.embedding_size", 2000),
    ("model.hidden_layers", -1),
    ("model.hidden_layers", 10**9),
    ("model.width", 0),
    ("model.tables", "float64"),
    ("model.levels", []),
    ("model.levels", [[2, 3, 4, 6]] * 65),
    ("model.levels", [[2, 3, 4, 6], [2, 2, 2]]),
    ("model.levels", [[2, 3, 4, 6], [2, 2, 5, 2]]),
    ("model.levels", [[2, 3, 4, 6], [2, 0, 2, 2]]),
    ("model.levels", [[2, 3, 5, 6], [2, 2, 2, 3]]),
    ("model.levels", {"a": 1}),
    ("model.levels", [[5, 3, 4, 6], [2, 2, 2, 3]]),
    ("model.parameters", ...),
    ("model.parameters", 1.5),
    ("coreset_fraction", ...),
    ("coreset_fraction", 1.5),
    ("coreset_fraction", None),
    ("training", ...),
    ("training.seconds", ...),
    ("training.seconds", "1"),
    ("training.epochs", None),
    ("training.device", 0),
    ("training.restarts", -1),
    ("training.restarts", "1"),
    ("training.learning_rate", "0.1"),
    ("config", None),
    ("quality", ...),
    ("quality.psnr", "48"),
    ("history", {}),
    ("history", [1]),
    ("history", [{"seconds": "1"}]),
]


@pytest.mark.parametrize(("path", "value"), BAD)
def test_wrong_key_is_named(samples, path, value):
    header = {**FIXED, **samples.header()}
    validate_header(header)
    with pytest.raises(
        DamagedFileError, match=rf"header key {path.replace('.', '[.]')}\b"
    ) as caught:
        validate_header(changed(header, path, value))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("novelty", [1, 2]),
        ("model.novelty", {"a": None}),
        ("value_range", [1, 1]),
        ("background", -3),
        ("encoder.seed", 2**63 - 1),
        ("features", []),
        ("quality", {}),
        ("quality.psnr", None),
        ("training.seconds", 0.5),
        ("history", []),
        ("history", [{"epoch": 1}, {"seconds": None, "epoch": 2, "psnr": 1}]),
        ("variable.units", ""),
        ("format_version", [1, 3]),
    ],
)
def test_allowed(samples, path, value):
    validate_header(changed({**FIXED, **samples.header()}, path, value))


@pytest.mark.parametrize("dtype", ["float64", "int64", "uint32"])
def test_sources_that_decode_to_float64_may_have_its_range(samples, dtype):
    header = changed({**FIXED, **samples.header()}, "variable.dtype", dtype)
    validate_header({**header, "value_range": [-1e300, 1e300], "background": 1e299})


def test_a_table_that_overflows_the_type_of_decoded_values_is_refused(samples):
    header = {**FIXED, **samples.compact_header()}
    validate_header(changed(header, "model.tables", "int32"))
    with pytest.raises(DamagedFileError, match=r"header key model\.tables"):
        validate_header(changed(header, "model.tables", "float64"))


ARRAYS = {
    "coords/time": lambda a: a[:-1],
    "coords/z": lambda a: a.astype("float32"),
    "key_frames": lambda a: a[:1],
    "tables/level_1": lambda a: a[..., :1],
    "tables/level_2": lambda a: a.astype("float32"),
    "mlp/weight_1": lambda a: np.ascontiguousarray(a.T),
    "mlp/bias_1": lambda a: a[:, None],
    "mlp/weight_2": lambda a: a.astype("float64"),
    "occupancy/bits": lambda a: a[:, :-1],
}


@pytest.mark.parametrize("name", ARRAYS)
def test_array_that_does_not_fit_is_named(tmp_path, samples, name):
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
def test_other_models_fit(tmp_path, samples, fields):
    header = samples.header()
    header["model"].update(fields)
    arrays = samples.arrays(header)
    samples.write(tmp_path / "a.fhz", header, arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(arrays)


def test_one_step_of_one_vertex(tmp_path, samples):
    header = samples.header()
    header["domain"]["shape"] = [1, 1, 1, 1]
    header["feature_bounding_box"] = [[0, 1]] * 3
    header["model"]["levels"] = [[1, 1, 1, 1]]
    arrays = samples.arrays(header)
    assert arrays["occupancy/bits"].shape == (1, 1)
    samples.write(tmp_path / "a.fhz", header, arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(arrays)


@pytest.mark.parametrize(
    "attributes",
    [{}, {"offset": 0.0}, {"offset": "0", "scale": 1.0}, {"offset": 0.0, "scale": -1.0}],
)
def test_quantised_tables_need_offset_and_scale(tmp_path, samples, attributes):
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
def test_coded_tables_need_their_feature_and_their_components(tmp_path, samples, change, message):
    header = samples.header()
    arrays = samples.arrays(header)
    for key, value in change.items():
        header = changed(header, key, value)
    with pytest.raises(InputError, match=message):
        samples.write(tmp_path / "a.fhz", header, arrays)


@pytest.mark.parametrize("mixing", [None, 1.0, [1.0], [1.0, "2"], [1.0, 2.0, 3.0]])
def test_components_need_their_mixing(tmp_path, samples, mixing):
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


def test_arrays_of_other_names_are_ignored(tmp_path, samples):
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array)
        writer.add_whole("tables/novelty", np.zeros(3, dtype=np.uint8))
        writer.add_whole("coords/novelty", np.zeros(3), attributes={"name": 5})
        writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(container.arrays)


def test_name_of_a_coordinate_is_text(tmp_path, samples):
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array, attributes={"name": 5})
        with pytest.raises(InputError, match="array coords/time attribute name is 5"):
            writer.commit(header)


def test_missing_bits_fit_the_domain(tmp_path, samples):
    header = samples.header()
    arrays = samples.arrays(header)
    arrays["missing/bits"] = np.zeros((4, 12), dtype=np.uint8)
    samples.write(tmp_path / "a.fhz", header, arrays)
    arrays["missing/bits"] = np.zeros((4, 11), dtype=np.uint8)
    with pytest.raises(InputError, match="missing/bits"):
        samples.write(tmp_path / "b.fhz", header, arrays)


def test_key_frames_increase():
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
def test_occupancy_bytes(size, count):
    assert occupancy_bytes([(5, 5 + n) for n in size]) == count


def test_layer_shapes():
    model = {"levels": [[1] * 4] * 3, "embedding_size": 2, "hidden_layers": 2, "width": 8}
    assert layer_shapes(model) == [(8, 6), (8, 8), (1, 8)]
    assert layer_shapes({**model, "hidden_layers": 0}) == [(1, 6)]
