"""zarr opens containers with parts apart: it reads the head, and says why it reads no values."""

from __future__ import annotations

import numpy as np
import pytest
import zarr
from heads import random_head
from zarr.registry import get_codec_class

from fhash_formats.errors import InputError
from fhash_formats.transform.parts import head_parameters
from fhash_formats.transform.zarr_codec import TransformCodec
from fhash_formats.transform.zarr_parts import HeadCodec, MaskCodec


@pytest.mark.parametrize("codec", [HeadCodec, MaskCodec])
def test_the_codecs_are_found_by_name_and_have_no_settings(codec) -> None:
    assert get_codec_class(codec.name).__name__ == codec.__name__
    assert codec.from_dict({"name": codec.name}) == codec.from_dict(codec().to_dict())
    for wrong in ({"name": "other"}, {"name": codec.name, "configuration": {"a": 1}}):
        with pytest.raises(InputError, match="no settings"):
            codec.from_dict(wrong)


def test_zarr_reads_a_head(tmp_path) -> None:
    data = random_head().to_bytes()
    expected = head_parameters(data)
    array = zarr.create_array(
        tmp_path / "a.zarr",
        shape=expected.shape,
        chunks=expected.shape,
        dtype="float32",
        serializer=HeadCodec(),
        compressors=None,
        fill_value=0,
    )
    (tmp_path / "a.zarr" / "c").mkdir()
    (tmp_path / "a.zarr" / "c" / "0").write_bytes(data)
    np.testing.assert_array_equal(array[:], expected)
    with pytest.raises(InputError, match="only decodes"):
        array[:] = expected + 1


def test_a_table_shows_itself_but_gives_no_values_without_its_parts(tmp_path) -> None:
    configuration = {
        "transform": dict.fromkeys("tzyx", "none"),
        "step": 1.0,
        "center": 0.0,
        "range": [0.0, 9.0],
        "head": {"array": "mlp/parameters"},
    }
    codec = TransformCodec.from_dict({"name": "fhash.transform", "configuration": configuration})
    assert codec.to_dict() == {"name": "fhash.transform", "configuration": configuration}
    array = zarr.create_array(
        tmp_path / "a.zarr",
        shape=(2, 3, 4, 5),
        chunks=(2, 3, 4, 5),
        dtype="float32",
        serializer=codec,
        compressors=None,
        fill_value=0,
    )
    chunk = tmp_path / "a.zarr" / "c" / "0" / "0" / "0"
    chunk.mkdir(parents=True)
    (chunk / "0").write_bytes(b"abc")
    assert zarr.open_array(tmp_path / "a.zarr", mode="r").shape == (2, 3, 4, 5)
    with pytest.raises(InputError, match=r"mlp/parameters beside it; fhash_codec\.open"):
        array[:]
    with pytest.raises(InputError, match="mlp/parameters"):
        array[:] = 1
