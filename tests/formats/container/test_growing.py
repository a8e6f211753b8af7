"""Containers that grow: complete at every moment, and nothing written before is lost."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from dataclasses import replace
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
from table_files import table_parts

from fhash_formats.container import Container, ContainerWriter
from fhash_formats.container import array as sharding
from fhash_formats.container.growing import GrowingContainer, TableParts
from fhash_formats.errors import InputError, OutputError, OutputExistsError

PROGRAM = Path(__file__).with_name("growing_file.py")


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


@pytest.mark.parametrize("frame", [FRAME, (3, 4, 4)], ids=["shards", "single tiles"])
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
        assert container.arrays["tables/level_1"].shape == (3, *FRAME)
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
            assert early.arrays["tables/level_1"].shape[0] == 2
            first = early.arrays["tables/level_1"].read()
        with Container.open(path) as late:
            np.testing.assert_array_equal(late.arrays["tables/level_1"].read()[:2], first)


def test_an_end_that_later_ones_took_the_place_of_is_changed_rather_than_damaged(tmp_path) -> None:
    """Positions that do not fit the header lie in the end, which every layer moves."""
    path = tmp_path / "a.fhz"
    with GrowingContainer(path) as growing:
        array = growing_array()
        for number in range(3):
            growing.add_layer(array, number, streams_of(layer_values(number)))
            mark = growing.mark()
            growing.describe(array, 2 * number + 2)
            times = np.arange(2.0 * number + 2) ** 2
            growing.add_whole("coords/time", times, attributes={"name": "t"})
            header = growing_header(2 * number + 2)
            del header["coordinates"]["time"]
            growing.publish(header, mark)
            if number == 0:
                early = Container.open(path)
    with pytest.raises(InputError, match="the file changed since it was opened; open it again"):
        early.coordinate("time")
    assert early.arrays["tables/level_1"].read().shape == (2, *FRAME)
    early.close()
    with Container.open(path) as late:
        np.testing.assert_array_equal(late.coordinate("time").values, np.arange(6.0) ** 2)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_killed_at_one_line_of_five_it_leaves_a_complete_file(tmp_path) -> None:
    result = subprocess.run(
        [sys.executable, str(PROGRAM), str(tmp_path), "3", "5"],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 80


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
def test_a_table_beyond_a_member_is_cut_into_shards(tmp_path, samples, monkeypatch, most) -> None:
    parts, header = table_parts(), samples.compact_header()

    def written(name: str, parts: TableParts) -> Path:
        with ContainerWriter(tmp_path / name) as writer:
            parts.write(writer)
            writer.commit({**header, "required_features": ["transform"]})
        return tmp_path / name

    whole = written("whole.fhz", parts)
    monkeypatch.setattr(sharding, "MAX_MEMBER", most)
    known = replace(parts, sizes=np.array([len(stream) for stream in parts.streams]))
    paths = [written(f"{number}.fhz", each) for number, each in enumerate((parts, known))]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with Container.open(whole) as container, Container.open(paths[0]) as cut:
        table, other = container.arrays["tables/level_1"], cut.arrays["tables/level_1"]
        assert len(other.chunks) > len(table.chunks)
        np.testing.assert_array_equal(table.read(), other.read())
        for index in np.ndindex(table.grid):
            assert table.coded_bytes(index) == other.coded_bytes(index) == len(other.coded(index))
        assert cut.verify()
