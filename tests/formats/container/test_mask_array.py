"""Masks in an array of their own are read with the table, and as an array."""

from __future__ import annotations

import numpy as np
import pytest
from table_files import table_parts, write_table

from fhash_formats.container import Container
from fhash_formats.errors import DamagedFileError, InputError

MASKS = "occupancy/mask"


@pytest.fixture
def path(tmp_path, samples):
    return write_table(tmp_path / "a.fhz", samples.compact_header(), table_parts(), apart=True)


def test_the_array_reads_as_the_mask_of_the_table(path) -> None:
    with Container.open(path) as container:
        masks = container.arrays[MASKS]
        region = (slice(1, 3), slice(0, 3), slice(2, 4), slice(1, 6))
        expected = container.arrays["tables/level_1"].read_mask(region)
        assert masks.read(region).dtype == np.uint8
        np.testing.assert_array_equal(masks.read(region), expected)
        with pytest.raises(InputError, match="level of detail 1"):
            masks.decode_chunk((0, 0, 0, 0), 1)


def test_coarse_values_need_no_mask(path) -> None:
    with Container.open(path) as container:
        masks = container.arrays[MASKS]
        masks.coded = None  # type: ignore[assignment]
        container.arrays["tables/level_1"].decode_chunk((0, 0, 0, 0), 1)


def test_a_damaged_mask_is_named_by_its_member(path, samples) -> None:
    parts = samples.unpack(path.read_bytes())
    place = [name for name, _ in parts].index(f"{MASKS}/c/0/0/0/0")
    data = bytearray(parts[place][1])
    data[1] ^= 1
    parts[place] = (parts[place][0], bytes(data))
    path.write_bytes(samples.pack(parts))
    with Container.open(path) as container:
        for name in ("tables/level_1", MASKS):
            with pytest.raises(DamagedFileError, match=rf"{MASKS}/c/0/0/0/0.*CRC"):
                container.arrays[name].read()
        with pytest.raises(DamagedFileError, match=MASKS):
            container.arrays[MASKS].verify(lambda: None)


def test_a_mask_for_a_tile_without_one_is_damage(path, samples, tmp_path) -> None:
    plain = table_parts(mask=False)
    mixed = type(plain)(
        shape=plain.shape,
        dtype=plain.dtype,
        tile=plain.tile,
        settings=table_parts().settings,
        streams=[table_parts().streams[0], plain.streams[1]],
    )
    write_table(path, samples.compact_header(), mixed, apart=True)
    with Container.open(path) as container:
        container.verify()
        streams = container.arrays[MASKS].coded((0, 0, 0, 0)), plain.streams[1]
        with pytest.raises(DamagedFileError, match="a mask for a coded tile that has none"):
            container.arrays["tables/level_1"]._metadata.coder._coder.join(*streams[::-1])
