"""The profile compact: which header and arrays it has, and how few bytes are not data."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from fhash_formats.container import Container, ContainerWriter, validate_header
from fhash_formats.errors import DamagedFileError, InputError

BOX = (3, 4, 6)


def changed(header, path, value):
    header = copy.deepcopy(header)
    *parents, key = path.split(".")
    inner = header
    for parent in parents:
        inner = inner[parent]
    if value is ...:
        del inner[key]
    else:
        inner[key] = value
    return {**header, "format": "fhash", "format_version": [1, 1]}


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("required_features", []),
        ("model.levels", [[4, 3, 4, 6], [2, 2, 2, 3]]),
        ("model.levels", [[5, 3, 4, 6]]),
        ("model.levels", [[4, 3, 4, 5]]),
        ("model.embedding_size", 2),
        ("model.tables", "complex64"),
        ("model.parameters", -1),
        ("model.head", ...),
        ("model.head", 1),
        ("coordinates", []),
        ("history", 1),
        ("history", {"psnr": [1]}),
        ("history", {"epoch": [1, 2], "psnr": [1]}),
        ("history", {"epoch": [1, None]}),
    ],
)
def test_wrong_key_is_named(samples, path, value):
    with pytest.raises(DamagedFileError, match=rf"header key {path.replace('.', '[.]')}\b"):
        validate_header(changed(samples.compact_header(), path, value))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("model.parameters", 0),
        ("model.head", {"width": 8}),
        ("model.tables", "uint16"),
        ("coordinates", ...),
        ("history", []),
        ("history", {"epoch": [1, 2], "psnr": [40.5, 41]}),
    ],
)
def test_allowed(samples, path, value):
    validate_header(changed(samples.compact_header(), path, value))


def write(path, header, arrays):
    with ContainerWriter(path) as writer:
        for name, array in arrays.items():
            writer.add_whole(name, array)
        writer.commit(header)


def arrays_of(key_frames=4, dtype="float32"):
    return {"tables/level_1": np.ones((key_frames, *BOX), dtype=dtype)}


OPTIONAL = {
    "nothing": {},
    "key frames": {"key_frames": np.arange(4)},
    "bits": {"occupancy/bits": np.full((4, 16), 255, dtype=np.uint8)},
    "mask": {"occupancy/mask": np.ones((4, *BOX), dtype=np.uint8)},
    "missing": {"missing/bits": np.zeros((4, 12), dtype=np.uint8)},
}


@pytest.mark.parametrize("case", OPTIONAL)
def test_arrays_that_it_may_have(tmp_path, samples, case):
    arrays = {**arrays_of(), **OPTIONAL[case]}
    write(tmp_path / "a.fhz", samples.compact_header(), arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert list(container.arrays) == list(arrays)
        assert container.header["required_features"] == ["transform"]
        assert container.verify() == len(arrays)
    if case != "nothing":
        name = next(iter(OPTIONAL[case]))
        with pytest.raises(InputError, match=f"array {name} is .* the header asks for"):
            write(tmp_path / "b.fhz", samples.compact_header(), {**arrays, name: arrays[name][:-1]})


def test_table_fits_the_header(tmp_path, samples):
    header = samples.compact_header()
    for wrong in ({}, arrays_of(3), arrays_of(dtype="float64")):
        with pytest.raises(InputError, match="tables/level_1"):
            write(tmp_path / "a.fhz", header, wrong)


def test_key_frames_are_there_unless_every_step_is_one(tmp_path, samples):
    header = samples.compact_header()
    header["model"]["levels"] = [[2, *BOX]]
    with pytest.raises(InputError, match="array key_frames is missing"):
        write(tmp_path / "a.fhz", header, arrays_of(2))
    write(tmp_path / "a.fhz", header, {**arrays_of(2), "key_frames": np.array([0, 3])})


def test_what_is_not_data_takes_few_bytes(tmp_path, samples):
    """A series of usual size: everything but the members of the table within 4 kB."""
    rng = np.random.default_rng(0)
    header = samples.compact_header()
    steps = 21
    header["domain"]["shape"] = [steps, 64, 64, 128]
    header["feature_bounding_box"] = [[0, 64], [0, 64], [0, 128]]
    header["model"]["levels"] = [[steps, 64, 64, 128]]
    header["coordinates"] = {
        "time": {
            "values": np.cumsum(rng.random(steps)).tolist(),
            "attributes": {"units": "hours since 2000-01-01"},
        },
        **{
            axis: {
                "start": 0.1,
                "step": 0.0771653543,
                "dtype": "float32",
                "attributes": {"units": "km"},
            }
            for axis in "zyx"
        },
    }
    figures = [float(f"{v:.4e}") for v in rng.random(steps)]
    header["quality"] = {
        **dict.fromkeys(
            (
                "psnr",
                "rmse",
                "max_abs_error",
                "ssim",
                "psnr_domain",
                "rmse_domain",
                "max_abs_error_domain",
            ),
            0.123456,
        ),
        "ssim_window": {
            "sigma": 1.5,
            "window": 11,
            "data_range": 4.0123456789,
            "steps": list(range(steps)),
        },
        "per_step": dict.fromkeys(("psnr", "rmse", "max_abs_error"), figures),
    }
    header["history"] = {"seconds": [1.234] * 24, "epoch": list(range(24)), "psnr": [45.12] * 24}
    header["config"] = {f"setting_{n}": 1.5 for n in range(16)}
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        tile = np.zeros((21, 32, 32, 64), dtype=np.float32)
        settings = {
            "shape": (steps, 64, 64, 128),
            "chunk_shape": tile.shape,
            "shard_shape": (steps, 64, 64, 128),
        }
        writer.add_sharded(
            "tables/level_1",
            dtype=tile.dtype,
            chunks=[tile] * 8,
            dimension_names=["t", "z", "y", "x"],
            **settings,
        )
        size = writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        table = container.arrays["tables/level_1"].nbytes_stored
        assert container.overhead() == size - table
    assert size - table <= 4096
