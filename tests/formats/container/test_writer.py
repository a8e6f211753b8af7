"""The writer: complete or absent, strict about what it is given, previewed as it will be."""

from __future__ import annotations

import errno

import numpy as np
import pytest

from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import InputError, OutputError, OutputExistsError


def fill(writer, samples, header):
    for name, array in samples.arrays(header).items():
        writer.add_whole(name, array)


def test_preview_is_the_final_file(tmp_path, samples):
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


def test_preview_needs_no_quality_and_writing_may_go_on(tmp_path, samples):
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
        assert container.header["quality"] == quality
        assert "extra/more" in container.arrays


class Stop(BaseException):
    """As KeyboardInterrupt, without pytest's own ideas about that."""


@pytest.mark.parametrize("failure", [None, ValueError("x"), Stop()])
@pytest.mark.parametrize("older", [None, b"an older output"])
def test_leaving_without_commit_leaves_nothing(tmp_path, samples, failure, older):
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


def test_full_disk_is_an_output_error_and_leaves_nothing(tmp_path, samples, monkeypatch):
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


def test_existing_output_needs_force(sample, samples):
    header = samples.header()
    with pytest.raises(OutputExistsError, match="force"):
        samples.write(sample, header, samples.arrays(header))
    samples.write(sample, header, samples.arrays(header), force=True)


def test_missing_folder(tmp_path, samples):
    with pytest.raises(OutputError, match="folder"):
        samples.write(tmp_path / "none" / "a.fhz", samples.header(), {})


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
def test_what_does_not_fit_is_refused(tmp_path, samples, case):
    changes, message = BAD_ARRAYS[case]
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, samples.header())
        with pytest.raises(InputError, match=message) as caught:
            writer.add_array(**{"name": "extra", **GOOD, **changes})
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_half_an_array_cannot_be_committed(tmp_path, samples):
    header = samples.header()
    with ContainerWriter(tmp_path / "a.fhz") as writer:
        fill(writer, samples, header)
        with pytest.raises(InputError):
            writer.add_array("extra", **{**GOOD, "chunks": GOOD["chunks"][:1]})
        with pytest.raises(InputError, match="extra has 1 chunks; 2"):
            writer.commit(header)


def test_header_must_fit_the_arrays(tmp_path, samples):
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
