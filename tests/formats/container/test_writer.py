"""The writer: complete or absent, strict about its arguments, previewed as it will be."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from itertools import product
from math import prod
from pathlib import Path

import numpy as np
import pytest
from growing_file import (
    FRAME,
    add_layer,
    check_layers,
    growing_array,
    growing_header,
    layer_values,
    streams_of,
)
from rarely import rarely
from table_files import table_parts
from tiled_files import CODECS, chunk_of, random_values, tiled, tiles_of, write_tiled

from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container import array as coding
from fhash_formats.container.growing import GrowingContainer, TableParts
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
    "bool": ({"dtype": "bool"}, "cannot be stored"),
    "complex": ({"dtype": "complex64"}, "cannot be stored"),
    "no axes": ({"shape": (), "chunk_shape": ()}, "cannot be stored"),
    "axes differ": ({"chunk_shape": (3, 1)}, "cannot be stored"),
    "empty axis": ({"shape": (0,)}, "cannot be stored"),
    "empty chunk": ({"chunk_shape": (0,)}, "cannot be stored"),
    "attributes": ({"attributes": {"x": np.nan}}, "JSON"),
    "name": ({"name": "\u00e4"}, "not allowed"),
    "long name": ({"name": "a" * 300}, "not allowed"),
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
        with pytest.raises(InputError, match="member extra/c/0 belongs to no array"):
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
    table = arrays.pop("table_1")
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        for name, array in arrays.items():
            writer.add_whole(name, array)
        chunks = (table[t : t + 1, z : z + 2] for t in range(2) for z in (0, 2))
        writer.add_array(
            "table_1",
            shape=table.shape,
            dtype=">f2",
            chunk_shape=(1, 2, 4, 6, 2),
            chunks=chunks,
        )
        writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        np.testing.assert_array_equal(container.arrays["table_1"].read(), table)
        assert container.arrays["table_1"].dtype == np.dtype("float16")


def test_no_more_than_one_member_is_held(tmp_path, samples) -> None:
    """While a member is given, those before it are in the file."""
    coder = tiled(np.zeros((1, 1 << 16), np.uint8), (1, 1 << 16)).coder
    values = np.random.default_rng(0).integers(0, 256, (16, 1 << 16), dtype=np.uint8)
    streams = [coder.encode(row[None]) for row in values]

    def chunks():
        for i, stream in enumerate(streams):
            if i == 15:
                assert tracemalloc.get_traced_memory()[0] - begun < 3 << 17
            yield bytes(bytearray(stream))

    tracemalloc.start()
    begun = tracemalloc.get_traced_memory()[0]
    write_tiled(tmp_path / "a.fhz", samples, values, (1, 1 << 16), (2, 1), chunks=chunks())
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
        writer.add_array(
            "table_1",
            shape=(steps, 64, 64, 128),
            dtype=tile.dtype,
            chunk_shape=tile.shape,
            together=(1, 2, 2, 2),
            chunks=[tile] * 8,
            codecs=CODECS,
        )
        size = writer.commit(header)
    with Container.open(tmp_path / "a.fhz") as container:
        table = container.arrays["table_1"].nbytes_stored
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
    "of a later member": (lambda given: [((2, 0), given[4])], r"chunk \(2, 0\) is none of member"),
    "twice": (lambda given: [((0, 0), given[0]), ((0, 0), given[0])], "given twice"),
    "in order after all": (lambda given: [((0, 1), given[1]), given[0], given[0]], "given twice"),
    "other type": (lambda given: [given[0].astype(np.float64)], r"float64 \(2, 3\)"),
    "other shape": (lambda given: [given[0][:1]], r"float32 \(1, 3\)"),
}


@pytest.mark.parametrize("case", BAD_CHUNKS)
def test_chunks_that_do_not_fit(tmp_path, samples, case) -> None:
    change, message = BAD_CHUNKS[case]
    values = random_values((7, 6))
    given = [chunk_of(values, at, (2, 3)) for at in tiles_of(tiled(values, (2, 3), (2, 2)))]
    with pytest.raises(InputError, match=message):
        write_tiled(tmp_path / "a.fhz", samples, values, (2, 3), (2, 2), chunks=change(given))
    assert list(tmp_path.iterdir()) == []


PROGRAM = Path(__file__).with_name("growing_file.py")


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


@pytest.mark.parametrize("frame", [FRAME, (3, 4, 4)], ids=["several tiles", "single tiles"])
def test_after_every_layer_the_file_is_complete(tmp_path, frame) -> None:
    path = tmp_path / "a.fhz"
    with GrowingContainer(path) as growing:
        for number in range(5):
            add_layer(growing, number, frame)
            assert check_layers(path, frame) == number + 1
    assert names(tmp_path) == ["a.fhz"]
    assert check_layers(path, frame) == 5


def test_the_last_layer_may_be_short(tmp_path) -> None:
    path = tmp_path / "a.fhz"
    with GrowingContainer(path) as growing:
        add_layer(growing, 0)
        add_layer(growing, 1, steps=3)
    with Container.open(path) as container:
        assert container.arrays["table_1"].shape == (3, *FRAME)
    assert check_layers(path) == 2


def test_a_grown_file_has_no_trace_of_its_growth(tmp_path) -> None:
    """The same layers at once and one by one give the same bytes."""
    for path, published in (("one", (0, 1, 2)), ("all", (2,))):
        with GrowingContainer(tmp_path / path) as growing:
            array = growing_array()
            for number in range(3):
                values = np.random.default_rng(number).standard_normal((2, 3, 4, 8))
                growing.add_layer(array, number, streams_of(values.astype(np.float32)))
                if number in published:
                    mark = growing.mark()
                    growing.describe(array, 2 * number + 2)
                    growing.publish(growing_header(2 * number + 2), mark)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "all").read_bytes()


def test_a_reader_goes_on_with_the_state_that_it_opened(tmp_path) -> None:
    path = tmp_path / "a.fhz"
    with GrowingContainer(path) as growing:
        add_layer(growing, 0)
        with Container.open(path) as early:
            for number in range(1, 4):
                add_layer(growing, number)
            assert early.arrays["table_1"].shape[0] == 2
            first = early.arrays["table_1"].read()
        with Container.open(path) as late:
            np.testing.assert_array_equal(late.arrays["table_1"].read()[:2], first)


def test_an_end_that_later_ones_took_the_place_of_is_that_of_its_time(tmp_path) -> None:
    """Positions lie in the end, which every layer moves and a reader keeps."""
    path = tmp_path / "a.fhz"
    with GrowingContainer(path) as growing:
        array = growing_array()
        for number in range(3):
            growing.add_layer(array, number, streams_of(layer_values(number)))
            mark = growing.mark()
            growing.describe(array, 2 * number + 2)
            header = growing_header(2 * number + 2)
            header["coordinates"]["time"] = {"values": [n**2 for n in range(2 * number + 2)]}
            growing.publish(header, mark)
            if number == 0:
                early = Container.open(path)
    np.testing.assert_array_equal(early.coordinate("time").values, np.arange(2.0) ** 2)
    assert early.arrays["table_1"].read().shape == (2, *FRAME)
    early.close()
    with Container.open(path) as late:
        np.testing.assert_array_equal(late.coordinate("time").values, np.arange(6.0) ** 2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
@pytest.mark.parametrize("every", [25, *rarely(5)])
def test_killed_at_some_lines_it_leaves_a_complete_file(tmp_path, every) -> None:
    result = subprocess.run(
        [sys.executable, str(PROGRAM), str(tmp_path), "3", str(every)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 400 / every


@pytest.mark.parametrize("call", ["fsync", "replace", "link"])
def test_a_failing_call_leaves_the_layers_before(tmp_path, monkeypatch, call) -> None:
    path = tmp_path / "a.fhz"

    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with GrowingContainer(path) as growing:
        add_layer(growing, 0)
        add_layer(growing, 1)
        monkeypatch.setattr(os, call, full)
        if call == "link":  # a file system without hard links costs a copy and no more
            add_layer(growing, 2)
            add_layer(growing, 3)
        else:
            with pytest.raises(OutputError, match=r"no space left.*the layers before are in"):
                add_layer(growing, 2)
    monkeypatch.undo()
    assert check_layers(path) == (4 if call == "link" else 2)
    assert names(tmp_path) == ["a.fhz"]


def test_an_existing_file_is_replaced_only_by_force_and_only_by_a_layer(tmp_path) -> None:
    path = tmp_path / "a.fhz"
    path.write_bytes(b"older")
    with pytest.raises(OutputExistsError), GrowingContainer(path):
        pass
    with GrowingContainer(path, force=True) as growing:
        array = growing_array()
        growing.add_layer(array, 0, streams_of(np.zeros((2, 3, 4, 8), np.float32)))
        assert path.read_bytes() == b"older"
    assert path.read_bytes() == b"older"
    assert names(tmp_path) == ["a.fhz"]
    with GrowingContainer(path, force=True) as growing:
        add_layer(growing, 0)
    assert check_layers(path) == 1


def test_a_file_that_another_process_took_is_left_alone(tmp_path) -> None:
    path, other = tmp_path / "a.fhz", tmp_path / "b.fhz"
    with GrowingContainer(other) as growing:
        add_layer(growing, 0)
    with GrowingContainer(path) as growing:
        add_layer(growing, 0)
        add_layer(growing, 1)
        os.replace(path, tmp_path / "moved.fhz")
        with pytest.raises(OutputError, match="another process"):
            add_layer(growing, 2)
    assert not path.exists()
    assert check_layers(tmp_path / "moved.fhz") == 2
    with GrowingContainer(path) as growing:
        add_layer(growing, 0)
        os.replace(other, path)
        with pytest.raises(OutputError, match="another process"):
            add_layer(growing, 1)
    assert check_layers(path) == 1
    assert names(tmp_path) == ["a.fhz", "moved.fhz"]


def test_a_continued_file_is_replaced_only_while_it_is_that_file(tmp_path) -> None:
    path, other = tmp_path / "a.fhz", tmp_path / "b.fhz"
    for one in (path, other):
        with GrowingContainer(one) as growing:
            add_layer(growing, 0)
    state = os.stat(path)
    with GrowingContainer(path, continues=state) as growing:
        os.replace(other, path)
        with pytest.raises(OutputError, match="another process"):
            add_layer(growing, 0)
    with GrowingContainer(path, continues=os.stat(path)) as growing:
        add_layer(growing, 0)
        add_layer(growing, 1)
    assert check_layers(path) == 2


def test_permissions_and_links_stay(tmp_path) -> None:
    path, link = tmp_path / "a.fhz", tmp_path / "link.fhz"
    link.symlink_to(path)
    with GrowingContainer(link) as growing:
        add_layer(growing, 0)
        path.chmod(0o600)
        add_layer(growing, 1)
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o600
    assert check_layers(link) == 2


def test_a_header_that_does_not_fit_changes_nothing(tmp_path) -> None:
    path = tmp_path / "a.fhz"
    with GrowingContainer(path) as growing:
        add_layer(growing, 0)
        growing.add_layer(growing_array(), 1, streams_of(np.zeros((2, 3, 4, 8), np.float32)))
        mark = growing.mark()
        growing.describe(growing_array(), 4)
        with pytest.raises(InputError, match="would not be readable"):
            growing.publish(growing_header(5), mark)
        assert check_layers(path) == 1
    assert check_layers(path) == 1


def test_an_interrupt_while_the_hidden_file_is_made_leaves_none(tmp_path, monkeypatch) -> None:
    """A signal may come after the file was made, and before anything knows of it."""

    with GrowingContainer(tmp_path / "a.fhz") as growing:
        add_layer(growing, 0)
    made = Path.open

    def opened(self, mode="r", **options):
        file = made(self, mode, **options)
        if mode == "xb":
            file.close()
            raise KeyboardInterrupt
        return file

    monkeypatch.setattr(Path, "open", opened)
    with pytest.raises(KeyboardInterrupt), GrowingContainer(tmp_path / "b.fhz") as growing:
        add_layer(growing, 0)
    assert os.listdir(tmp_path) == ["a.fhz"]


@pytest.mark.parametrize("most", [1, 200])
def test_a_table_beyond_a_member_is_cut_into_several(tmp_path, samples, monkeypatch, most) -> None:
    parts, header = table_parts(), samples.compact_header()

    def written(name: str, parts: TableParts) -> Path:
        with ContainerWriter(tmp_path / name) as writer:
            parts.write(writer)
            writer.commit({**header, "required_features": ["transform"]})
        return tmp_path / name

    whole = written("whole.fhz", parts)
    monkeypatch.setattr(coding, "MAX_MEMBER", most)
    known = replace(parts, sizes=np.array([len(stream) for stream in parts.streams]))
    paths = [written(f"{number}.fhz", each) for number, each in enumerate((parts, known))]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with Container.open(whole) as container, Container.open(paths[0]) as cut:
        table, other = container.arrays["table_1"], cut.arrays["table_1"]
        assert prod(other.together) < prod(table.together)
        np.testing.assert_array_equal(table.read(), other.read())
        for index in np.ndindex(table.grid):
            assert table.place(index)[1] == other.place(index)[1] == len(other.coded(index))
        assert cut.verify()
