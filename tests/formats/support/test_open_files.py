"""Many open files: the limit is raised as far as needed, and as it was afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_formats.support.open_files import OTHERS, many_files, open_files

resource = pytest.importorskip("resource")


@pytest.fixture
def few():
    """A limit of 200 files beside those that are open, the hard one left as it is."""
    limit, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (open_files() + 200, most))
    yield 200
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, most))


def limits() -> tuple[int, int]:
    return resource.getrlimit(resource.RLIMIT_NOFILE)


def opened(path: Path, count: int) -> int:
    files = []
    try:
        for _ in range(count):
            files.append(path.open("rb"))
        return len(files)
    finally:
        for file in files:
            file.close()


def test_more_files_than_the_limit_can_be_opened(few, tmp_path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"")
    before = limits()
    with pytest.raises(OSError, match="Too many open files"):
        opened(path, 300)
    with many_files(300):
        assert opened(path, 300) == 300
    assert limits() == before


def test_a_limit_that_does_is_left_alone(few) -> None:
    before = limits()
    with many_files(few - OTHERS - 8):  # listing them opens one more
        assert limits() == before
    with pytest.raises(KeyError), many_files(few):
        raise KeyError
    assert limits() == before


def test_the_hard_limit_is_kept(few) -> None:
    before = limits()
    _, most = before
    with many_files(1 << 40):
        assert limits()[0] <= most or most == resource.RLIM_INFINITY
    assert limits() == before


def test_open_files_are_counted(tmp_path) -> None:
    (tmp_path / "a").write_bytes(b"")
    before = open_files()
    with (tmp_path / "a").open("rb"), (tmp_path / "a").open("rb"):
        assert before == 0 or open_files() == before + 2
