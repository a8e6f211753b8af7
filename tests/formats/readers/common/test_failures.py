"""Errors of readers on one line, and sources that change while they are read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.readers.common.failures import (
    LONGEST_MESSAGE,
    FolderStamp,
    Stamp,
    condense,
    refusing,
)


def test_a_message_is_one_line_of_bounded_length() -> None:
    assert condense(ValueError("two\n  lines")) == "two lines"
    assert condense(ValueError("")) == "ValueError"
    assert len(condense(ValueError("long " * 1000))) == LONGEST_MESSAGE


def test_errors_of_libraries_become_input_errors_and_ours_pass() -> None:
    refused = pytest.raises(InputError, match="a cannot be read: KeyError")
    with refused as caught, refusing("a cannot be read"):
        raise KeyError
    assert isinstance(caught.value.__cause__, KeyError)
    for error in (MissingInputError("gone"), MemoryError(), KeyboardInterrupt()):
        with pytest.raises(type(error)) as passed, refusing("a"):
            raise error
        assert passed.value is error


def test_a_stamp_tells_a_file_that_changed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    stamp = Stamp.of(path)
    stamp.check()
    os.utime(path, ns=(1, 1))
    with pytest.raises(InputError, match=r"changed.*same size, written again"):
        stamp.check()
    path.write_bytes(b"123")
    with pytest.raises(InputError, match="5 bytes before, 3 now"):
        stamp.check()
    path.unlink()
    with pytest.raises(InputError, match="cannot be read"):
        stamp.check()


def test_a_stamp_of_a_folder_tells_any_change_below_it(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    file = tmp_path / "inner" / "a"
    file.write_bytes(b"12345")
    stamp = FolderStamp.of(tmp_path)
    assert (stamp.files, stamp.size) == (1, 5)
    stamp.check()
    os.utime(file, ns=(1, 1))
    with pytest.raises(InputError, match="something in it was written again"):
        stamp.check()
    (tmp_path / "b").write_bytes(b"6")
    with pytest.raises(InputError, match="1 files and 5 bytes before, 2 and 6 now"):
        stamp.check()
