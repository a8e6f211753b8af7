"""The arrays that a header asks for: there, of the right shape and type, with their attributes."""

from __future__ import annotations

import io
import os
import pickle
import random
import struct
import zlib
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numcodecs.zstd
import numpy as np
import pytest
from hostile_files import edited_header, read_everything, refused, replaced
from rarely import rarely
from several_files import compact_header, write_several
from table_files import table_parts, write_table
from tiled_files import CODECS, NAME, random_values, write_tiled

from fhash_formats.container import FORMAT_VERSION, Container, ContainerWriter, is_container
from fhash_formats.container.header import complete
from fhash_formats.container.reader import Location
from fhash_formats.errors import DamagedFileError, InputError, MissingInputError
from fhash_formats.native import crc32c

ARRAYS = {
    "key_frames": lambda a: a[:1],
    "table_1": lambda a: a[..., :1],
    "table_2": lambda a: a.astype("float32"),
    "mlp/weight_1": lambda a: np.ascontiguousarray(a.T),
    "mlp/bias_1": lambda a: a[:, None],
    "mlp/weight_2": lambda a: a.astype("float64"),
    "occupancy": lambda a: a[..., :-1],
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


def test_the_bits_have_a_grid_of_each_feature(tmp_path, samples) -> None:
    header = samples.header()
    header["features"] = ["isosurface:0", "isosurface:1"]
    arrays = samples.arrays(header)
    samples.write(tmp_path / "a.fhz", header, arrays)
    arrays["occupancy"] = arrays["occupancy"][:1]
    with pytest.raises(InputError, match=r"the header asks for uint8 \(2, 2, 16\)"):
        samples.write(tmp_path / "b.fhz", header, arrays)


@pytest.mark.parametrize(
    "attributes",
    [{}, {"offset": 0.0}, {"offset": "0", "scale": 1.0}, {"offset": 0.0, "scale": -1.0}],
)
def test_quantised_tables_need_offset_and_scale(tmp_path, samples, attributes) -> None:
    header = samples.header()
    header["model"]["tables"] = "uint8"
    arrays = samples.arrays(header)
    with pytest.raises(InputError, match=r"array table_1 attribute (offset|scale)"):
        samples.write(tmp_path / "a.fhz", header, arrays, dict.fromkeys(arrays, attributes))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model.tables": "transform"}, "required_features"),
        (
            {"model.tables": "transform", "required_features": ["transform"]},
            "array table_1/component_1 is missing",
        ),
        ({"model.tables_loss_db": "0.1"}, "tables_loss_db"),
        ({"required_features": ["residual"]}, "does not know: upgrade, or encode"),
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
    arrays = samples.arrays(header)
    header["model"]["tables"], header["required_features"] = "transform", ["transform"]
    components = {
        f"table_{number}/component_{part}": np.ones(level, np.float32)
        for number, level in enumerate(header["model"]["levels"], start=1)
        for part in (1, 2)
    }
    layers = [array.ravel() for name, array in arrays.items() if name.startswith("mlp/")]
    rest = {n: a for n, a in arrays.items() if not n.startswith(("table_", "mlp/"))}
    arrays = {**components, **rest, "mlp/parameters": np.concatenate(layers)}
    good = {name: {"mixing": [0.5, -1e300]} for name in components}
    samples.write(tmp_path / "a.fhz", header, arrays, good)
    bad = good | {"table_2/component_1": {} if mixing is None else {"mixing": mixing}}
    with pytest.raises(InputError, match="array table_2/component_1 attribute mixing"):
        samples.write(tmp_path / "b.fhz", header, arrays, bad)


def test_arrays_of_other_names_are_ignored(tmp_path, samples) -> None:
    header = samples.header()
    others = {"table_0": np.zeros(3, np.uint8), "t": np.zeros(3), "c": np.zeros(3)}
    arrays = samples.arrays(header) | others
    samples.write(tmp_path / "a.fhz", header, arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.verify() == len(container.arrays) == len(arrays)


def test_tiles_need_the_feature(tmp_path, samples) -> None:
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in samples.arrays(header).items():
            writer.add_whole(name, array)
        writer.add_whole(NAME, np.zeros(2, np.uint8), codecs=CODECS)
        with pytest.raises(
            InputError, match="array extra/values has codecs of the feature transform"
        ):
            writer.commit(header)
        writer.commit({**header, "required_features": ["transform"]})


BOX = (3, 4, 6)


def compact_arrays(key_frames=4, dtype="float32"):
    return {"table_1": np.ones((key_frames, *BOX), dtype=dtype)}


OPTIONAL = {
    "nothing": {},
    "key frames": {"key_frames": np.arange(4)},
    "missing": {"missing": np.zeros((4, 12), dtype=np.uint8)},
}


@pytest.mark.parametrize("case", OPTIONAL)
def test_arrays_that_it_may_have(tmp_path, samples, case) -> None:
    arrays = {**compact_arrays(), **OPTIONAL[case]}
    samples.write(tmp_path / "a.fhz", samples.compact_header(), arrays)
    with Container.open(tmp_path / "a.fhz") as container:
        assert list(container.arrays) == list(arrays)
        assert container.header["required_features"] == ["transform"]
        assert container.verify() == len(arrays)
    if case != "nothing":
        name = next(iter(OPTIONAL[case]))
        with pytest.raises(InputError, match=f"array {name} is .* the header asks for"):
            samples.write(
                tmp_path / "b.fhz", samples.compact_header(), {**arrays, name: arrays[name][:-1]}
            )


def test_table_fits_the_header(tmp_path, samples) -> None:
    header = samples.compact_header()
    for wrong in ({}, compact_arrays(3), compact_arrays(dtype="float64")):
        with pytest.raises(InputError, match="table_1"):
            samples.write(tmp_path / "a.fhz", header, wrong)


def test_key_frames_are_there_unless_every_step_is_one(tmp_path, samples) -> None:
    header = samples.compact_header()
    header["model"]["levels"] = [[2, *BOX]]
    with pytest.raises(InputError, match="array key_frames is missing"):
        samples.write(tmp_path / "a.fhz", header, compact_arrays(2))
    samples.write(tmp_path / "a.fhz", header, {**compact_arrays(2), "key_frames": np.array([0, 3])})


def test_header_comes_back(sample, samples) -> None:
    with Container.open(sample) as container:
        assert container.header == {
            **complete(samples.header()),
            "format": "fhash",
            "format_version": list(FORMAT_VERSION),
            "required_features": [],
        }
        assert container.size == sample.stat().st_size
        assert container.path == sample


def test_verify_reports_every_member(sample, samples) -> None:
    seen = []
    with Container.open(sample) as container:
        container.verify(lambda done, total: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1] == len(samples.unpack(sample.read_bytes()))
    assert [done for done, _ in seen] == list(range(seen[0][0], seen[-1][0] + 1))


def test_chunks_whose_values_are_known_are_checked_and_not_decoded(sample) -> None:
    with Container.open(sample) as container:
        name = "table_1"
        first = (0,) * len(container.arrays[name].grid)
        values = np.full_like(container.arrays[name].decode_chunk(first), 7)
    with Container.open(sample) as container:
        array = container.arrays[name]
        array.take_decoded({first: values})
        np.testing.assert_array_equal(array.decode_chunk(first), values)
        region = tuple(slice(0, min(1, n)) for n in array.shape)
        np.testing.assert_array_equal(array.read(region), values[region])
        offset, _ = array.place(first)
    data = bytearray(sample.read_bytes())
    data[offset] ^= 1
    sample.write_bytes(data)
    with Container.open(sample) as container, pytest.raises(DamagedFileError):
        container.arrays[name].take_decoded({first: values})


def test_is_container(sample, tmp_path) -> None:
    assert is_container(sample)
    assert is_container(str(sample))
    data = sample.read_bytes()
    for name, other in {
        "cut": data[:-1],
        "longer": data + b"\n",
        "empty": b"",
        "text": b"fhash 1",
    }.items():
        (tmp_path / name).write_bytes(other)
        assert not is_container(tmp_path / name)
    assert not is_container(tmp_path)
    assert not is_container(tmp_path / "missing")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x05\x06" + bytes(18),
        b"\x89HDF\r\n\x1a\n" + bytes(500),
        b"fhash 3 sha256=" + b"0" * 64,
    ],
)
def test_another_file_is_refused(tmp_path, content) -> None:
    refused(
        tmp_path / "other.fhz", content, "other.fhz: (not an fhash container|the ZIP end record)"
    )


@pytest.mark.parametrize("steps", [[0, 0], [3, 0], [-1, 3], [0, 4]])
def test_key_frames_increase_within_the_domain(sample, samples, steps) -> None:
    coded = numcodecs.zstd.compress(np.array(steps, dtype="<i8"), 1)
    coded += struct.pack("<I", crc32c(coded))
    refused(sample, replaced(sample, samples, "key_frames/c/0", coded), "key_frames")


def values(container: Container) -> np.ndarray:
    return container.arrays["mlp/weight_1"].read()


@pytest.fixture
def expected(sample) -> np.ndarray:
    with Container.open(sample) as container:
        return values(container)


def test_a_path_and_a_local_url(sample, expected) -> None:
    for place in (sample, str(sample), f"file://{sample}"):
        with Container.open(place) as container:
            np.testing.assert_array_equal(values(container), expected)
            assert container.path == sample
            assert container.reopening() == Location(place=sample, digest=container.digest)
    with pytest.raises(MissingInputError, match="no such file"):
        Container.open("file:///none/run.fhz")


def test_a_relative_path_is_opened_again_from_elsewhere(sample, monkeypatch) -> None:
    monkeypatch.chdir(sample.parent)
    with Container.open(sample.name) as container:
        assert container.path == Path(sample.name)
        location = pickle.loads(pickle.dumps(container.reopening()))
    monkeypatch.chdir("/")
    Container.open(location).close()


def test_options_of_a_url_are_kept_but_not_shown(sample, range_server) -> None:
    range_server.token = "Bearer secret"
    options = {"headers": {"Authorization": range_server.token}}
    with Container.open(
        range_server.put("run.fhz", sample.read_bytes()), storage_options=options
    ) as container:
        location = pickle.loads(pickle.dumps(container.reopening()))
    assert "secret" not in repr(location)
    Container.open(location).close()


def test_options_without_a_url_are_refused(sample) -> None:
    for place in (sample, io.BytesIO(sample.read_bytes())):
        with pytest.raises(InputError, match="storage_options are for URLs"):
            Container.open(place, storage_options={"anon": True})
    Container.open(sample, storage_options={}).close()


def test_a_url_that_became_a_path() -> None:
    with pytest.raises(InputError, match="given as text, not as a Path"):
        Container.open(Path("https://host/run.fhz"))


def test_memory(sample, expected) -> None:
    import fsspec

    with fsspec.open("memory://location/run.fhz", "wb") as file:
        file.write(sample.read_bytes())
    with Container.open("memory://location/run.fhz") as container:
        np.testing.assert_array_equal(values(container), expected)
        assert container.path == "memory://location/run.fhz"
        assert container.verify() == len(container.arrays)


@pytest.mark.parametrize("kind", ["file", "unbuffered", "bytes"])
def test_an_open_file_stays_open(sample, expected, kind) -> None:
    buffering = {"file": -1, "unbuffered": 0}
    in_memory = io.BytesIO(sample.read_bytes())
    with in_memory if kind == "bytes" else open(sample, "rb", buffering=buffering[kind]) as file:
        with Container.open(file) as container:
            assert container.path == ("<BytesIO>" if kind == "bytes" else str(sample))
            np.testing.assert_array_equal(values(container), expected)
            with pytest.raises(InputError, match="open it by its path or URL"):
                container.reopening()
        assert not file.closed
        with pytest.raises(InputError, match="closed"):
            values(container)


def test_an_open_file_that_is_cut(tmp_path, samples) -> None:
    path = write_tiled(tmp_path / "a.fhz", samples, random_values((99, 999)), (99, 333), (1, 3))
    file = io.BytesIO(path.read_bytes())
    container = Container.open(file)
    file.truncate(100)
    with pytest.raises(DamagedFileError, match="cut short"):
        container.arrays[NAME].read()


def test_files_that_cannot_be_read(sample) -> None:
    with (
        open(sample, encoding="latin-1") as file,
        pytest.raises(InputError, match="open it with 'rb'"),
    ):
        Container.open(file)
    with open(sample, "ab") as file, pytest.raises(InputError, match="cannot seek and read"):
        Container.open(file)
    ends = os.pipe()
    with open(ends[0], "rb") as pipe, pytest.raises(InputError, match="cannot seek and read"):
        Container.open(pipe)
    os.close(ends[1])
    with pytest.raises(InputError, match="int is no place of a container"):
        Container.open(5)


def test_a_file_of_fsspec_is_read_by_ranges(sample, expected, range_server) -> None:
    import fsspec

    data = sample.read_bytes()
    unopened = fsspec.open(range_server.put("run.fhz", data))
    with unopened as opened:
        for file in (unopened, opened):
            range_server.taken()
            with Container.open(file) as container:
                np.testing.assert_array_equal(values(container), expected)
                with pytest.raises(InputError, match="open it by its path or URL"):
                    container.reopening()
            assert range_server.taken()[1] <= len(data)
    with pytest.raises(InputError, match="compressed"):
        Container.open(fsspec.open(str(sample), compression="gzip"))


def test_another_file_in_the_place_is_noticed(sample, range_server) -> None:
    with Container.open(range_server.put("run.fhz", sample.read_bytes())) as container:
        location = container.reopening()
    Container.open(location).close()
    with pytest.raises(InputError, match="another file is there than was opened before"):
        Container.open(Location(place=location.place, digest="0" * 64))


def test_a_tail_that_is_cut_short_names_the_file(sample, monkeypatch) -> None:
    import fsspec

    from fhash_formats.container.remote import FsspecFile

    monkeypatch.setattr(FsspecFile.__init__, "__kwdefaults__", {"pause": lambda seconds: None})
    fsspec.filesystem("memory").pipe("/location/cut.fhz", sample.read_bytes())
    cat = fsspec.filesystem("memory").__class__.cat_file
    monkeypatch.setattr(
        fsspec.filesystem("memory").__class__,
        "cat_file",
        lambda self, path, start, end: cat(self, path, start, end - 1),
    )
    with pytest.raises(DamagedFileError, match=r"^memory://location/cut\.fhz: the file is"):
        Container.open("memory://location/cut.fhz")


@pytest.mark.parametrize("validators", [True, False])
def test_damage_is_told_as_a_change(tmp_path, samples, range_server, validators) -> None:
    path = write_tiled(tmp_path / "a.fhz", samples, random_values((99, 999)), (99, 333), (1, 3))
    range_server.conditions = range_server.range_conditions = False
    range_server.validators = validators
    data = path.read_bytes()
    with Container.open(range_server.put("run.fhz", data)) as container:
        range_server.put("run.fhz", bytes(len(data)))
        with pytest.raises(InputError, match="the file changed since it was opened") as told:
            container.arrays[NAME].read()
        assert not isinstance(told.value, DamagedFileError)


def test_damage_without_a_change_is_damage(sample, range_server) -> None:
    data = bytearray(sample.read_bytes())
    with Container.open(sample) as container:
        offset, _ = container.arrays["mlp/weight_1"].place((0, 0))
    data[offset] ^= 1
    with (
        Container.open(range_server.put("run.fhz", bytes(data))) as container,
        pytest.raises(DamagedFileError, match=r"run\.fhz: member mlp/weight_1"),
    ):
        values(container)


def refusal(path):
    """The one-line message with which a damaged file is refused."""
    with pytest.raises(DamagedFileError) as caught:
        read_everything(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def deflated_spans(path) -> list[tuple[int, int]]:
    """Offsets (first, end) of the data of deflated members."""
    with ZipFile(path) as members:
        spans = [
            (info.header_offset + 30 + len(info.filename), info.compress_size)
            for info in members.infolist()
            if info.compress_type == ZIP_DEFLATED
        ]
    return [(first, first + size) for first, size in spans]


def inflated(data: bytes) -> bytes | None:
    """The text of a deflated document; None unless the data are one stream that ends with them."""
    stream = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        text = stream.decompress(data)
    except zlib.error:
        return None
    return text if stream.eof and not stream.unused_data else None


@pytest.mark.parametrize("part", [0, *rarely(1, 2, 3)])
def test_every_flip_is_refused_unless_a_document_inflates_to_the_same_text(sample, part) -> None:
    sound = sample.read_bytes()
    contents, spans = read_everything(sample), deflated_spans(sample)
    choose = random.Random(0)
    # The last bytes of a stream are those with unused bits.
    last = [(end - 1, 1 << bit) for _, end in spans for bit in range(8)]
    flips = [(choose.randrange(len(sound)), choose.randrange(1, 256)) for _ in range(2000)]
    same = 0
    for at, bits in [*flips, *last][part::4]:
        damaged = bytearray(sound)
        damaged[at] ^= bits
        sample.write_bytes(damaged)
        span = next(((first, end) for first, end in spans if first <= at < end), None)
        if span is None or inflated(damaged[slice(*span)]) != inflated(sound[slice(*span)]):
            refusal(sample)
            continue
        same += 1
        assert read_everything(sample) == contents
    assert same > 0


def test_every_cut_is_refused(sample) -> None:
    sound = sample.read_bytes()
    choose = random.Random(1)
    for length in [0, 1, 22, len(sound) - 1, *(choose.randrange(len(sound)) for _ in range(300))]:
        sample.write_bytes(sound[:length])
        refusal(sample)


def test_every_removed_or_doubled_part_is_refused(sample) -> None:
    sound = sample.read_bytes()
    choose = random.Random(2)
    for _ in range(200):
        a, b = sorted(choose.sample(range(len(sound) + 1), 2))
        sample.write_bytes(sound[:a] + sound[b:])
        refusal(sample)
        sample.write_bytes(sound[:b] + sound[a:])
        refusal(sample)


def test_each_variable_is_what_a_file_of_its_own_would_be(tmp_path, samples) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    path = write_several(tmp_path / "b.fhz", samples)
    with Container.open(path) as file:
        assert list(file.variables) == ["u", "group/v", "w", "paper"]
        for name in ("u", "group/v"):
            parts = table_parts(seed=len(name))
            alone = write_table(tmp_path / "a.fhz", samples.compact_header(), parts)
            with Container.open(alone) as one:
                assert (file.variable, one.variable, dict(one.variables)) == (None, None, {})
                own, table = file.variables[name], one.arrays["table_1"]
                assert own.variable == name
                assert own.header["variable"] == one.header["variable"]
                read = own.arrays["table_1"]
                np.testing.assert_array_equal(read.read(), table.read())
                np.testing.assert_array_equal(read.read_mask(), table.read_mask())
                for lod in (0, 1):
                    np.testing.assert_array_equal(
                        read.decode_chunk((0, 0, 0, 1), lod), table.decode_chunk((0, 0, 0, 1), lod)
                    )
        u, w = (file.variables[name].arrays["table_1"].read() for name in "uw")
        assert not np.array_equal(u, w)
        paper = file.variables["paper"]
        assert {name: array.read().tobytes() for name, array in paper.arrays.items()} == {
            name: values.tobytes() for name, values in arrays.items()
        }
        assert file.verify() == len(file.arrays)
        assert paper.verify() == len(arrays)


def test_coordinates_are_there_once_and_others_have_their_own(tmp_path, samples) -> None:
    with Container.open(write_several(tmp_path / "a.fhz", samples, paper=False)) as file:
        assert list(file.arrays) == [
            *("v0/auxiliary/area", "v0/table_1", "v1/table_1"),
            *("v2/auxiliary/area", "v2/table_1"),
        ]
        headers = [each["coordinates"] for each in file.header["variables"]]
        assert headers[1] == {"time": 0, "z": 0, "y": 0, "x": 0}
        assert headers[2] == headers[1] | {"x": headers[0]["x"] | {"start": 0.25}}
        u, v, w = file.variables.values()
        assert u.header["coordinates"] == v.header["coordinates"]
        assert u.coordinate("x").name == w.coordinate("x").name == "lon (deg)"
        assert u.coordinate("time").name == "time"
        assert (w.coordinate("x").values - u.coordinate("x").values).tolist() == [0.25] * 6
        assert v.coordinate("z").attributes == {"units": "m"}
        assert file.attributes == {"title": "four winds"}


def test_sizes_of_variables_add_up_to_the_file(tmp_path, samples) -> None:
    sizes: list[int] = []
    with ContainerWriter(tmp_path / "a.fhz", variables=["u", "v"]) as writer:
        for seed, _ in enumerate("uv"):
            parts = table_parts(seed=seed)
            writer.begin()
            mark = writer.mark()
            for _ in range(2):  # once more after a rewinding
                writer.rewind(mark)
                parts.write(writer)
                header = compact_header(samples)
                sizes.append(writer.size(header))
                with writer.preview(header) as preview:
                    assert preview.verify() == 1
            writer.finish(header)
        size = writer.commit()
    assert sizes[0] == sizes[1]
    assert sizes[1] + sizes[3] == size == (tmp_path / "a.fhz").stat().st_size
    with Container.open(tmp_path / "a.fhz") as file:
        own = [variable.size for variable in file.variables.values()]
        assert 0 < min(own) <= max(own) < sizes[3] < sizes[1]
        overheads = [variable.overhead() for variable in file.variables.values()]
        assert all(0 < each < size for each, size in zip(overheads, own, strict=True))


def test_variables_do_not_share_cached_chunks(tmp_path, samples) -> None:
    with Container.open(write_several(tmp_path / "a.fhz", samples, paper=False)) as file:
        region = tuple(slice(0, 2) for _ in range(4))
        values = {n: v.arrays["table_1"].read(region) for n, v in file.variables.items()}
        again = {n: v.arrays["table_1"].read(region) for n, v in file.variables.items()}
        for name in values:
            np.testing.assert_array_equal(values[name], again[name])
        assert not np.array_equal(values["u"], values["w"])
        assert len({v.digest for v in (file, *file.variables.values())}) == 4
        file.variables["u"].close()
        file.variables["w"].arrays["table_1"].read()
        file.variables["u"].closing_file().close()
        with pytest.raises(InputError, match="closed"):
            file.variables["w"].arrays["auxiliary/area"].read()


@pytest.mark.parametrize("names", [[""], ["u", "u"]])
def test_names_must_differ(tmp_path, names) -> None:
    with pytest.raises(InputError, match="different names"):
        ContainerWriter(tmp_path / "a.fhz", variables=names)


def test_a_variable_alone_is_not_committed(tmp_path) -> None:
    with ContainerWriter(tmp_path / "a.fhz", variables=["u"]) as writer:
        writer.begin()
        with pytest.raises(InputError, match="finish each and commit them"):
            writer.commit({})
    assert not (tmp_path / "a.fhz").exists()


def test_arrays_beside_the_data_are_there_once_where_they_are_equal(tmp_path, samples) -> None:
    path, places = tmp_path / "a.fhz", np.arange(30.0).reshape(5, 6)
    with ContainerWriter(path, variables=["u", "v", "w"]) as writer:
        for name in "uvw":
            writer.begin()
            writer.add_whole("auxiliary/lat", places + (name == "w"))
            if name != "u":
                writer.add_whole(f"auxiliary/lat_{name}", places)
            table_parts().write(writer)
            writer.finish(compact_header(samples))
        writer.commit()
    with Container.open(path) as file:
        lat = [name for name in file.arrays if "lat" in name]
        assert lat == ["v0/auxiliary/lat", "v2/auxiliary/lat"]
        u, v, w = (each.arrays["auxiliary/lat"] for each in file.variables.values())
        assert u is v
        assert (w.read() - u.read() == 1).all()
        same = [file.variables[name].arrays[f"auxiliary/lat_{name}"] for name in "vw"]
        assert same == [u, u]
        assert file.header["variables"][2]["shares"] == {"auxiliary/lat_w": [0, "auxiliary/lat"]}
        assert file.variables["v"].size < file.variables["u"].size
        assert file.variables["v"].overhead() > 0
        assert sum(each.size for each in file.variables.values()) < file.size


@pytest.mark.parametrize(("kind", "chunk"), [("<f8", 1 << 20), ("<i4", 3 << 10), ("|u1", 700)])
def test_arrays_beside_the_data_are_coded_as_differences_where_that_is_smaller(
    tmp_path, samples, monkeypatch, kind, chunk
) -> None:
    monkeypatch.setattr("fhash_formats.container.writer.BESIDE_CHUNK_BYTES", chunk)
    smooth = (np.add.outer(np.arange(50) ** 2, np.arange(40)) / 8).astype(kind)
    rough = np.frombuffer(np.random.default_rng(5).bytes(2000 * smooth.itemsize), kind)
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        writer.begin()
        for name, values in samples.arrays(header).items():
            writer.add_whole(name, values)
        writer.add_whole("auxiliary/smooth", smooth)
        writer.add_whole("auxiliary/rough", rough)
        writer.commit({**header, "required_features": []})
    with Container.open(tmp_path / "a.fhz") as file:
        arrays = file.arrays
        assert arrays["auxiliary/smooth"].coding == "fhash.transform"
        assert arrays["auxiliary/smooth"].grid == (-(-smooth.nbytes // chunk), 1)
        assert arrays["auxiliary/rough"].coding == "bytes"
        assert arrays["auxiliary/smooth"].read().tobytes() == smooth.tobytes()
        assert arrays["auxiliary/rough"].read().tobytes() == rough.tobytes()
        assert file.verify() == len(arrays)


def test_the_bytes_of_a_file_are_split_without_a_rest(tmp_path, samples) -> None:
    path = write_several(tmp_path / "a.fhz", samples)
    with Container.open(path) as file:
        parts = file.split()
        assert list(parts) == ["field", "beside", "model", "index"]
        assert sum(parts.values()) == file.size == path.stat().st_size
        areas = [array for name, array in file.arrays.items() if name.endswith("/area")]
        assert parts["beside"] == sum(array.nbytes_stored for array in areas) > 0
        each = {name: variable.split() for name, variable in file.variables.items()}
        for name, variable in file.variables.items():
            assert sum(each[name].values()) == variable.size
        for part in ("field", "beside", "model"):
            assert sum(found[part] for found in each.values()) == parts[part]
        assert each["u"]["field"] == file.variables["u"].arrays["table_1"].nbytes_stored
        assert min(each["u"]["model"], each["w"]["model"]) > 0
        weights = sum(
            array.nbytes_stored
            for name, array in file.variables["paper"].arrays.items()
            if name.startswith("mlp/")
        )
        assert each["paper"]["model"] == weights
        assert file.variables["group/v"].split()["beside"] == 0, "the array is that of u"


@pytest.mark.parametrize("odd", [7, True, 1 << 63, {"values": [1]}])
def test_coordinates_of_axes_that_nobody_knows_are_ignored(tmp_path, samples, odd) -> None:
    header = samples.header()
    header["coordinates"]["w"] = odd
    samples.write(tmp_path / "a.fhz", header, samples.arrays(header))
    Container.open(tmp_path / "a.fhz").close()
