"""Plain files: standard codecs alone, every number there, the values of the file they are of."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import plain_reader
import pytest
import zarr
from edited import edit
from untrained_heads import some_head, with_head

import fhash_codec
from fhash_codec import EncodeConfig, InputError
from fhash_codec.plain import export_plain
from fhash_formats.container import Container, validate_header
from fhash_formats.errors import DamagedFileError, OutputExistsError
from fhash_formats.series import ArraySeries, Coordinate

HERE = Path(__file__).resolve().parent
GOLDENS = [
    HERE.parent / "golden" / f"{name}.fhz"
    for name in (
        "compact-bound",
        "compact-mask",
        "compact-predictor",
        "paper-feature",
        "paper-linear-uint8",
        "paper-transform",
    )
]
STANDARD = {"bytes", "zstd", "crc32c"}


def test_the_reader_is_independent_and_short() -> None:
    text = (HERE / "plain_reader.py").read_text(encoding="utf-8")
    assert "import fhash" not in text
    assert "from fhash" not in text
    assert sum(bool(line.strip()) for line in text.splitlines()) <= 90


def check(path: Path, plain: Path) -> None:
    """Compare a plain file with the one that it is of: by fhash, by zarr, and by the reader."""
    with (
        zarr.storage.ZipStore(plain, mode="r") as store,
        fhash_codec.open(path) as volume,
        fhash_codec.open(plain) as other,
    ):
        root = zarr.open_group(store, mode="r")
        by_path = {array.name: array for array in other.container.arrays.values()}
        for name, array in root.members(max_depth=None):
            if isinstance(array, zarr.Array):
                codecs = {codec["name"] for codec in array.metadata.to_dict()["codecs"]}
                assert codecs <= STANDARD
                np.testing.assert_array_equal(array[...], by_path[name].read())
        for table, again in zip(volume.tables, other.tables, strict=True):
            np.testing.assert_array_equal(again[...], table[...])
            stored = root[f"table_{table.level}"]
            if stored.dtype != np.uint8:
                np.testing.assert_array_equal(stored[...], table[...])
        for number, layer in enumerate(volume.mlp.layers, start=1):
            for kind, values in zip(("weight", "bias"), layer, strict=True):
                if volume.profile == "paper":
                    np.testing.assert_array_equal(root[f"mlp/{kind}_{number}"][...], values)
            for ours, theirs in zip(layer, other.mlp.layers[number - 1], strict=True):
                np.testing.assert_array_equal(ours, theirs)
        assert other.mlp.constants == volume.mlp.constants
        assert (other.dtype, other.fill, other.config) == (volume.dtype, volume.fill, volume.config)
        for axis in "tzyx":
            np.testing.assert_array_equal(other.coords[axis].values, volume.coords[axis].values)
        span = volume.value_range.high - volume.value_range.low
        for key, step in enumerate(volume.key_times.key_frames):
            grids = root["occupancy"][:, key]
            np.testing.assert_array_equal(np.bitwise_or.reduce(grids), volume.occupancy_bits(step))
            frame = volume.read(step)
            np.testing.assert_allclose(other.read(step), frame, rtol=0, atol=1e-6 * span)
            box = frame[volume.box.slices()]
            if 0 < key < table.shape[0] - 1:
                continue
            rebuilt = plain_reader.values(plain, key)
            there = np.isfinite(box)
            assert np.abs(rebuilt - box)[there].max(initial=0) <= 1e-6 * span
            assert not np.isfinite(rebuilt[~volume.occupancy(step)[volume.box.slices()]]).any() or (
                "missing" in volume.container.arrays
            )


@pytest.mark.parametrize("path", GOLDENS, ids=lambda path: path.stem)
def test_goldens_have_the_same_values_in_plain_numbers(path: Path, tmp_path: Path) -> None:
    figures = export_plain(path, tmp_path / "plain.fhz")
    check(path, tmp_path / "plain.fhz")
    assert figures["bytes"] == (tmp_path / "plain.fhz").stat().st_size
    assert figures["source_bytes"] == path.stat().st_size


def moving(dtype: str, steps: int = 3) -> np.ndarray:
    t, z, y, x = np.meshgrid(*(np.arange(n) for n in (steps, 7, 17, 22)), indexing="ij")
    smooth = np.tanh((x - 8 - t - y / 3) / 2) * 90 + 20 * np.sin(y / 4 + z / 3)
    noise = np.random.default_rng(1).normal(0, 1.5, smooth.shape)
    return (smooth + noise).astype(dtype)


CASES = {
    "head": ("float32", {"psnr": 45.0}),
    "bound": ("float32", {"max_error": 0.5}),
    "double": ("float64", {"max_error": 1e-9}),
    "int16": ("int16", {"psnr": 40.0, "features": ("interval:0:70",)}),
    "uint8": ("uint8", {"max_error": 0.0}),
}


@pytest.mark.parametrize("case", CASES)
def test_kinds_of_data_and_promises(case: str, tmp_path: Path) -> None:
    dtype, settings = CASES[case]
    path = tmp_path / "a.fhz"
    values = moving(dtype)
    if case == "head":
        head = some_head(scale=0.0123291015625, sigma=0.1234130859375)
        with_head(path, head)
    else:
        config = EncodeConfig(effort=3, tile="2x7x9x22", **settings)  # type: ignore[arg-type]
        fhash_codec.encode(values, path, config)
    export_plain(path, tmp_path / "plain.fhz")
    check(path, tmp_path / "plain.fhz")


def test_coded_weights_of_the_paper_come_back(tmp_path: Path) -> None:
    config = EncodeConfig(
        preset="published", epochs=1, width=32, tables="transform", features=("interval:0:70",)
    )
    fhash_codec.encode(moving("float32"), tmp_path / "a.fhz", config)
    with fhash_codec.open(tmp_path / "a.fhz") as volume:
        layers = volume.container.arrays["mlp/parameters"]
        assert layers.dtype == np.int16
    export_plain(tmp_path / "a.fhz", tmp_path / "plain.fhz")
    check(tmp_path / "a.fhz", tmp_path / "plain.fhz")


def test_integers_beyond_the_doubles_come_back(tmp_path: Path) -> None:
    big = np.array([2**62 + 1, 2**62 + 3, 2**53 + 1, 5], dtype=np.int64)
    values = big[np.random.default_rng(0).integers(0, 4, (2, 4, 5, 6))]
    fhash_codec.encode(values, tmp_path / "a.fhz", EncodeConfig(max_error=0.0, effort=2))
    export_plain(tmp_path / "a.fhz", tmp_path / "plain.fhz")
    with fhash_codec.open(tmp_path / "plain.fhz") as volume:
        np.testing.assert_array_equal(volume[...], values)


def test_levels_of_detail_are_the_tables(tmp_path: Path) -> None:
    fhash_codec.encode(moving("float32"), tmp_path / "a.fhz", EncodeConfig(effort=2))
    export_plain(tmp_path / "a.fhz", tmp_path / "plain.fhz")
    with (
        fhash_codec.open(tmp_path / "a.fhz") as volume,
        fhash_codec.open(tmp_path / "plain.fhz") as other,
    ):
        for lod in range(len(volume.tables)):
            np.testing.assert_array_equal(other.read_lod(1, lod), volume.read_lod(1, lod))
        with pytest.raises(InputError, match="a plain file has 0 to 4"):
            other.read_lod(1, 5)


def test_a_file_that_exists_stays_without_force(tmp_path: Path) -> None:
    path = GOLDENS[0]
    (tmp_path / "plain.fhz").write_bytes(b"mine")
    with pytest.raises(OutputExistsError):
        export_plain(path, tmp_path / "plain.fhz")
    assert (tmp_path / "plain.fhz").read_bytes() == b"mine"
    export_plain(path, tmp_path / "plain.fhz", force=True)
    copy = (tmp_path / "plain.fhz").read_bytes()
    with pytest.raises(InputError):
        export_plain(tmp_path / "plain.fhz", tmp_path / "plain.fhz", force=True)
    with pytest.raises(InputError, match="plain already"):
        export_plain(tmp_path / "plain.fhz", tmp_path / "again.fhz")
    with pytest.raises(InputError, match=r"ends in \.fhz"):
        export_plain(path, tmp_path / "plain.zarr")
    assert (tmp_path / "plain.fhz").read_bytes() == copy
    assert [file.name for file in tmp_path.iterdir()] == ["plain.fhz"]


def test_a_failure_on_the_way_leaves_nothing(tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int, note: str) -> None:
        assert 0 < done <= total
        if done > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_plain(GOLDENS[0], tmp_path / "plain.fhz", progress=stop)
    assert list(tmp_path.iterdir()) == []


def headed(tmp_path: Path) -> Path:
    """A plain file with a head."""
    path = with_head(tmp_path / "a.fhz", some_head())
    export_plain(path, tmp_path / "plain.fhz")
    return tmp_path / "plain.fhz"


def test_a_plain_table_has_names_and_coordinates_of_its_variable(tmp_path: Path) -> None:
    coords = {
        axis: Coordinate(name=name, values=np.arange(n) * 2.5, attributes={"units": "m"})
        for (axis, name), n in zip(
            {"t": "time", "z": "level", "y": "lat", "x": "lon"}.items(), (3, 4, 5, 6), strict=True
        )
    }
    values = np.random.default_rng(2).normal(size=(3, 4, 5, 6)).astype(np.float32)
    series = ArraySeries(values, name="speed", units="m s-1", coords=coords)
    fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(max_error=0.1, effort=1))
    export_plain(tmp_path / "a.fhz", tmp_path / "plain.fhz")
    store = zarr.storage.ZipStore(tmp_path / "plain.fhz", mode="r")
    group = zarr.open_group(store, mode="r")
    table = group["table_1"]
    assert table.metadata.dimension_names == ("time", "level", "lat", "lon", "embedding")
    assert table.attrs.asdict() == {"long_name": "speed", "units": "m s-1"}
    for name in table.metadata.dimension_names[:4]:
        axis = next(axis for axis, each in coords.items() if each.name == name)
        np.testing.assert_array_equal(group[name][...], coords[axis].values)
    store.close()


WRONG = {
    "tile": lambda model: model.update(tile=[2, 9, 0, 14]),
    "values": lambda model: model.update(values="float64"),
    "tables": lambda model: model.update(tables="int8"),
    "profile": lambda model: model.update(
        profile="paper", fold=2, embedding_size=1, hidden_layers=0, width=1, tables="float32"
    ),
}
WRONG_MLP = {
    "widths": {"widths": [4, 3, 2, 1]},
    "biases": {"widths": [5, 3]},
    "sigma": {"sigma": None},
    "range": {"range": [2, 1]},
    "scales": {"scales": [0.5]},
    "head: its scales": {"scales": [0.0] * 6},
    "letters": {"weights": "/" * 133},
    "weights are cut": {"weights": "A"},
}


def test_a_header_that_does_not_fit_is_damage(tmp_path: Path) -> None:
    path = headed(tmp_path)
    sound = path.read_bytes()
    with Container.open(path) as container:
        header = container.header
    validate_header(header)
    for key, change in WRONG.items():
        wrong = copy.deepcopy(header)
        change(wrong["model"])
        with pytest.raises(DamagedFileError, match=key):
            validate_header(wrong)

    def refused(message: str, member: str, change: Any) -> None:
        path.write_bytes(sound)
        edit(path, member, change)
        with pytest.raises(DamagedFileError, match=message):
            Container.open(path)

    for message, wrong in WRONG_MLP.items():

        def change(root: dict[str, Any], wrong: dict[str, Any] = wrong) -> Any:
            root["attributes"]["fhash"]["variables"][0]["mlp"] |= wrong
            return root

        refused(message, "zarr.json", change)


def test_coordinates_of_any_name_are_exported(tmp_path: Path) -> None:
    """Names that arrays cannot have, that others have, and the same one twice."""
    names = dict(zip("tzyx", ("auxiliary", "a b", "depth", "depth"), strict=True))
    coords = {
        axis: Coordinate(name=name, values=np.arange(n) * 2.5)
        for (axis, name), n in zip(names.items(), (3, 4, 5, 6), strict=True)
    }
    series = ArraySeries(moving("float32")[:, :4, :5, :6], name="a", coords=coords)
    fhash_codec.encode(series, tmp_path / "a.fhz", EncodeConfig(max_error=0.1, effort=1))
    export_plain(tmp_path / "a.fhz", tmp_path / "plain.fhz")
    with fhash_codec.open(tmp_path / "plain.fhz") as volume:
        assert {axis: volume.coords[axis].name for axis in "tzyx"} == names
        assert {"axis_t", "axis_z", "depth", "axis_x"} <= volume.container.arrays.keys()
