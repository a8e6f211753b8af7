"""URLs and paths, which must not be taken for each other."""

from __future__ import annotations

from pathlib import Path

import pytest

from fhash_formats.support.locations import file_name, is_url, local_path, without_secrets

URLS = [
    "https://host/run.fhz",
    "s3://bucket/run.fhz",
    "memory:///run.fhz",
    "simplecache::https://host/run.fhz",
    "zip://run.fhz::https://host/all.zip",
]
PATHS = ["run.fhz", "/data/run.fhz", "C:\\run.fhz", "C://run.fhz", "a::b.fhz", "12:00://x", ""]


@pytest.mark.parametrize("place", URLS)
def test_urls(place: str) -> None:
    assert is_url(place)
    assert local_path(place) is None


@pytest.mark.parametrize("place", PATHS)
def test_paths(place: str) -> None:
    assert not is_url(place)
    assert local_path(place) == Path(place)


def test_a_path_is_no_url() -> None:
    assert not is_url(Path("https://host/run.fhz"))


@pytest.mark.parametrize(
    ("url", "path"),
    [
        ("file:///data/run.fhz", "/data/run.fhz"),
        ("local:///data/a%20b.fhz", "/data/a%20b.fhz"),
        ("file://run.fhz", "run.fhz"),
        ("FILE:///C:/run.fhz", "C:/run.fhz"),
    ],
)
def test_local_files_by_url(url: str, path: str) -> None:
    assert is_url(url)
    assert local_path(url) == Path(path)


@pytest.mark.parametrize(
    ("place", "name"),
    [
        ("https://host/a/run.fhz?signature=a/b#c", "run.fhz"),
        ("zip://in/run.fhz::https://host/all.zip", "run.fhz"),
        ("https://host", "host"),
        ("/data/run.fhz", "run.fhz"),
        (Path("data/run.fhz"), "run.fhz"),
    ],
)
def test_last_names(place: str | Path, name: str) -> None:
    assert file_name(place) == name


@pytest.mark.parametrize(
    ("place", "shown"),
    [
        ("https://me:secret@host/run.fhz?signature=1#x", "https://host/run.fhz"),
        ("zip://run.fhz::https://me:secret@host/a.zip?k=1", "zip://run.fhz::https://host/a.zip"),
        ("memory:///run.fhz", "memory:///run.fhz"),
        ("/data/what?.fhz", "/data/what?.fhz"),
    ],
)
def test_secrets_are_left_out(place: str, shown: str) -> None:
    assert without_secrets(place) == shown
