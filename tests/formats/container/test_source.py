"""Bytes at offsets: of a file, counted, and of a file whose end is not written yet."""

from __future__ import annotations

import os
from itertools import product

import pytest

from fhash_formats.container import Container
from fhash_formats.container.source import CountedSource, FileSource, PreviewSource
from fhash_formats.errors import DamagedFileError, InputError, MissingInputError


def test_no_file_folder_and_pipe(tmp_path) -> None:
    with pytest.raises(MissingInputError, match="no such file"):
        Container.open(tmp_path / "none.fhz")
    os.mkfifo(tmp_path / "pipe.fhz")
    for path in (tmp_path, tmp_path / "pipe.fhz"):
        with pytest.raises(InputError, match="regular file"):
            Container.open(path)


def test_file_cut_while_open(sample) -> None:
    with Container.open(sample) as container:
        sample.write_bytes(sample.read_bytes()[:100])
        with pytest.raises(DamagedFileError, match="cut short"):
            container.arrays["mlp/weight_1"].read()


def test_closed_container(sample) -> None:
    with Container.open(sample) as container:
        pass
    with pytest.raises(InputError, match="closed"):
        container.arrays["mlp/weight_1"].read()


def test_a_preview_is_the_file_followed_by_its_tail(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    preview = PreviewSource(FileSource(tmp_path / "a"), 5, b"XYZ")
    expected = b"abcdeXYZ"
    assert preview.size == len(expected)
    for start, stop in product(range(9), range(9)):
        if start <= stop:
            assert preview.read(start, stop - start) == expected[start:stop]
    for offset, size in ((0, 9), (8, 1), (-1, 1), (3, -1)):
        with pytest.raises(DamagedFileError, match="outside the file of 8 bytes"):
            preview.read(offset, size)
    preview.close()


def test_bytes_that_were_read_are_counted(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"abcdefgh")
    source = CountedSource(FileSource(tmp_path / "a"))
    assert source.read(2, 3) + source.read(0, 0) + source.read(7, 1) == b"cdeh"
    assert source.bytes_read == 4
    with pytest.raises(DamagedFileError, match="outside the file"):
        source.read(7, 2)
    assert source.bytes_read == 4
    source.close()
