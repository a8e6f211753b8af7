"""The writer: complete or absent, strict about its arguments, previewed as it will be."""

from __future__ import annotations

import errno
import tracemalloc
from itertools import product

import numpy as np
import pytest
from sharded_files import chunk_of, random_values, write_sharded

from fhash_formats.container import Container, ContainerWriter, shard_order
from fhash_formats.container.writer import cut
from fhash_formats.errors import InputError, OutputError, OutputExistsError


def fill(writer, samples, header):
    for name, array in samples.arrays(header).items():
        writer.add_whole(name, array)


def test_preview_is_the_final_file(tmp_path, samples) -> None:
    header = samples.header()
    path = tmp_path / "a.fhz"
    with ContainerWriter(path) as writer:
        fill(writer, samples, header)
        with writer.preview(header) as preview:
            before = (
                preview.size,
                preview.overhead(),
                preview.header,
                {name: array.read() for name, array in preview.arrays.items()},
            )
            assert preview.verify() == len(preview.arrays)
            preview_bytes = preview._source.read(0, preview.size)
        assert not path.exists()
        assert writer.commit(header) == before[0]
    assert path.read_bytes() == preview_bytes
    with Container.open(path) as container:
        assert (container.size, container.overhead(), container.header) == before[:3]
        for name, array in container.arrays.items():
            np.testing.assert_array_equal(array.read(), before[3][name])


def test_preview_needs_no_quality_and_writing_may_go_on(tmp_path, samples) -> None:
    header = samples.header()
    quality = header.pop("quality")
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, header)
        with writer.preview(header) as preview:
            assert preview.header["quality"] == {}
        writer.add_whole("extra/more", np.arange(3))
        with pytest.raises(InputError, match="quality is missing"):
            writer.commit(header)
        writer.commit({**header, "quality": quality})
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.header["quality"]["psnr"] == quality["psnr"]
        assert "extra/more" in container.arrays


class Stop(BaseException):
    """A stand-in for KeyboardInterrupt, which pytest would take for its own."""


@pytest.mark.parametrize("failure", [None, ValueError("x"), Stop()])
@pytest.mark.parametrize("older", [None, b"an older output"])
def test_leaving_without_commit_leaves_nothing(tmp_path, samples, failure, older) -> None:
    path = tmp_path / "a.fhz"
    if older is not None:
        path.write_bytes(older)

    def leave():
        with ContainerWriter(path, force=True) as writer:
            fill(writer, samples, samples.header())
            if failure is not None:
                raise failure

    if failure is None:
        leave()
    else:
        with pytest.raises(type(failure)):
            leave()
    assert [file.name for file in tmp_path.iterdir()] == ([] if older is None else ["a.fhz"])
    assert older is None or path.read_bytes() == older


def test_full_disk_is_an_output_error_and_leaves_nothing(tmp_path, samples, monkeypatch) -> None:
    class Full:
        closed = False

        def __init__(self, file):
            self.file = file

        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

        def flush(self):
            self.file.flush()

    def attempt(at_commit):
        with ContainerWriter(tmp_path / "a.fhz") as writer:
            if at_commit:
                fill(writer, samples, samples.header())
            monkeypatch.setattr(writer, "_file", Full(writer._file))
            if at_commit:
                writer.commit(samples.header())
            else:
                fill(writer, samples, samples.header())

    for at_commit in (False, True):
        with pytest.raises(OutputError, match="no space left"):
            attempt(at_commit)
        assert list(tmp_path.iterdir()) == []


GOOD = {
    "shape": (4,),
    "dtype": "int16",
    "chunk_shape": (3,),
    "chunks": [np.zeros(3, "int16"), np.zeros(1, "int16")],
}


BAD_ARRAYS = {
    "too few chunks": ({"chunks": GOOD["chunks"][:1]}, r"chunk \(1,\) was not given"),
    "too many chunks": ({"chunks": [*GOOD["chunks"], np.zeros(1, "int16")]}, "more chunks"),
    "padded chunk": (
        {"chunks": [np.zeros(3, "int16"), np.zeros(3, "int16")]},
        r"int16 \(1,\) is needed",
    ),
    "other type": ({"chunks": [np.zeros(3, "int32"), np.zeros(1, "int32")]}, "int16 .* is needed"),
    "bool": ({"dtype": "bool"}, "data_type"),
    "complex": ({"dtype": "complex64"}, "data_type"),
    "no axes": ({"shape": (), "chunk_shape": ()}, "axes"),
    "axes differ": ({"chunk_shape": (3, 1)}, "axes"),
    "empty axis": ({"shape": (0,)}, "shape"),
    "empty chunk": ({"chunk_shape": (0,)}, "chunk_shape"),
    "large chunk": ({"shape": (2**30,), "chunk_shape": (2**30,)}, "limit"),
    "names": ({"dimension_names": ["a", "b"]}, "dimension names"),
    "attributes": ({"attributes": {"x": np.nan}}, "JSON"),
    "codec": ({"codecs": [{"name": "gzip"}, {"name": "crc32c"}]}, "codecs"),
    "no checksum": (
        {"codecs": [{"name": "bytes", "configuration": {"endian": "little"}}]},
        "crc32c",
    ),
    "name": ({"name": "../a"}, "not allowed"),
    "absolute": ({"name": "/a"}, "not allowed"),
    "document": ({"name": "a/zarr.json"}, "not allowed"),
    "again": ({"name": "key_frames"}, "there already"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_what_does_not_fit_is_refused(tmp_path, samples, case) -> None:
    changes, message = BAD_ARRAYS[case]
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, samples.header())
        with pytest.raises(InputError, match=message) as caught:
            writer.add_array(**{"name": "extra", **GOOD, **changes})
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_half_an_array_cannot_be_committed(tmp_path, samples) -> None:
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, header)
        with pytest.raises(InputError):
            writer.add_array("extra", **{**GOOD, "chunks": GOOD["chunks"][:1]})
        with pytest.raises(InputError, match="extra has 1 chunks; 2"):
            writer.commit(header)


def test_header_must_fit_the_arrays(tmp_path, samples) -> None:
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, header)
        for wrong in (
            {"model": {**header["model"], "width": 6}},
            {"background": float("nan")},
            {"dilation": -1},
            {"features": {1, 2}},
        ):
            with pytest.raises(InputError):
                writer.commit({**header, **wrong})
        writer.commit(header)
        with pytest.raises(OutputError, match="already"):
            writer.commit(header)
        with pytest.raises(OutputError, match="already"):
            writer.add_whole("late", np.arange(3))


def test_same_content_gives_same_bytes(tmp_path, samples) -> None:
    header = samples.header()
    for name in ("a.fhz", "b.fhz"):
        samples.write(tmp_path / name, header, samples.arrays(header))
        header = dict(reversed(header.items()))
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


def test_chunks_of_one_array_may_come_from_a_generator(tmp_path, samples) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    table = arrays.pop("tables/level_1")
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in arrays.items():
            writer.add_whole(name, array)
        chunks = (table[t : t + 1, z : z + 2] for t in range(2) for z in (0, 2))
        writer.add_array(
            "tables/level_1",
            shape=table.shape,
            dtype=">f2",
            chunk_shape=(1, 2, 4, 6, 2),
            chunks=chunks,
        )
        writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        np.testing.assert_array_equal(container.arrays["tables/level_1"].read(), table)
        assert container.arrays["tables/level_1"].dtype == np.dtype("float16")


def test_no_more_than_one_shard_is_held(tmp_path, samples) -> None:
    """While a shard is given, those before it are in the file."""
    values = np.random.default_rng(0).integers(0, 256, (16, 1 << 16), dtype=np.uint8)

    def chunks():
        for i in range(16):
            if i == 15:
                assert tracemalloc.get_traced_memory()[0] - begun < 3 << 17
            yield values[i : i + 1]

    tracemalloc.start()
    begun = tracemalloc.get_traced_memory()[0]
    write_sharded(tmp_path / "a.fhz", samples, values, (1, 1 << 16), (2, 1 << 16), chunks=chunks())
    tracemalloc.stop()


def test_what_is_not_data_takes_few_bytes(tmp_path, samples) -> None:
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


def test_arrays_after_a_mark_can_be_written_anew(tmp_path, samples) -> None:
    header = samples.header()
    for name, rewound in (("a.fhz", False), ("b.fhz", True)):
        with ContainerWriter(tmp_path / name) as writer:
            fill(writer, samples, header)
            mark = writer.mark()
            if rewound:
                writer.add_whole("extra/more", np.random.default_rng(0).random(5000))
                writer.preview(header).close()
                writer.rewind(mark)
            writer.add_whole("extra/more", np.arange(3))
            size = writer.size(header)
            assert writer.commit(header) == size == (tmp_path / name).stat().st_size
    assert (tmp_path / "a.fhz").read_bytes() == (tmp_path / "b.fhz").read_bytes()


def test_a_diverted_container_leaves_its_former_name_alone(tmp_path, samples) -> None:
    header, former, other = samples.header(), tmp_path / "a.fhz", tmp_path / "b.fhz"
    former.write_bytes(b"an older output")
    with ContainerWriter(former, force=True) as writer:
        fill(writer, samples, header)
        writer.divert(other)
        assert not other.exists()
        writer.commit(header)
    assert former.read_bytes() == b"an older output"
    with Container.open(other) as container:
        container.verify()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.fhz", "b.fhz"]


@pytest.mark.parametrize("commits", [True, False])
def test_a_diverted_container_replaces_nothing_and_leaves_nothing(
    tmp_path, samples, commits
) -> None:
    header, other = samples.header(), tmp_path / "b.fhz"
    other.write_bytes(b"another output")
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, header)
        if commits:
            with pytest.raises(OutputExistsError):
                writer.divert(other)
        else:
            writer.divert(tmp_path / "c.fhz")
    assert [path.name for path in tmp_path.iterdir()] == ["b.fhz"]
    assert other.read_bytes() == b"another output"


@pytest.mark.parametrize("chunk_shape", [(2, 3), (5, 7), (8, 8), (1, 1)])
def test_the_chunks_of_an_array_are_all_of_it_in_order(chunk_shape) -> None:
    values = random_values((5, 7))
    grid = [range(-(-n // chunk)) for n, chunk in zip(values.shape, chunk_shape, strict=True)]
    chunks = list(cut(values, chunk_shape))
    for index, chunk in zip(product(*grid), chunks, strict=True):
        np.testing.assert_array_equal(chunk, chunk_of(values, index, chunk_shape))


BAD_CHUNKS = {
    "too few": (lambda given: given[:-1], "was not given"),
    "too many": (lambda given: [*given, given[0]], "more chunks"),
    "of a later shard": (lambda given: [((2, 0), given[4])], r"chunk \(2, 0\) is none of shard"),
    "twice": (lambda given: [((0, 0), given[0]), ((0, 0), given[0])], "given twice"),
    "in order after all": (lambda given: [((0, 1), given[1]), given[0], given[0]], "given twice"),
    "other type": (lambda given: [given[0].astype(np.float64)], r"float64 \(2, 3\)"),
    "other shape": (lambda given: [given[0][:1]], r"float32 \(1, 3\)"),
}


@pytest.mark.parametrize("case", BAD_CHUNKS)
def test_chunks_that_do_not_fit(tmp_path, samples, case) -> None:
    change, message = BAD_CHUNKS[case]
    values = random_values((7, 6))
    given = [chunk_of(values, index, (2, 3)) for index in shard_order((7, 6), (2, 3), (4, 6))]
    with pytest.raises(InputError, match=message):
        write_sharded(tmp_path / "a.fhz", samples, values, (2, 3), (4, 6), chunks=change(given))
    assert list(tmp_path.iterdir()) == []
