"""A small valid container, and the means to make files from it that are wrong in one way.

Tests of this folder import the modules beside them; pytest's importlib mode puts no folder of
tests on the path.
"""

from __future__ import annotations

import math
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import ContainerWriter
from fhash_formats.container.zip_file import END, Member, comment, ending, local_header

sys.path.insert(0, str(Path(__file__).parent))

from tiled_files import random_values, write_tiled


def occupancy_bytes(box: Iterable[tuple[int, int]]) -> int:
    """Bytes of the occupancy of one key frame: a bit for each vertex of the box, whose axes are
    filled up to powers of two."""
    return -(-math.prod(1 << (high - low - 1).bit_length() for low, high in box) // 8)


Parts = list[tuple[str, bytes]]
"""Name and data of each member."""


def make_header() -> dict[str, Any]:
    """A header whose arrays are small and of several chunks."""
    return {
        "encoder": {"version": "0.1.0"},
        "variable": {
            "name": "density",
            "units": "kg m-3",
            "dtype": "float32",
            "attributes": {"long_name": "Dichte \u00fc"},
        },
        "domain": {"shape": [4, 3, 5, 6]},
        "value_range": [-1.5, 2.5],
        "background": 0.125,
        "feature_bounding_box": [[0, 3], [1, 5], [0, 6]],
        "features": ["all"],
        "dilation": 1,
        "coreset_fraction": 0.5,
        "coordinates": {},
        "model": {
            "profile": "paper",
            "fold": 2,
            "embedding_size": 2,
            "hidden_layers": 1,
            "width": 5,
            "parameters": 367,
            "tables": "float16",
            "levels": [[2, 3, 4, 6], [2, 2, 2, 3]],
        },
        "config": {"epochs": 1},
        "training": {"seconds": None, "epochs": 1, "device": "cpu"},
        "quality": {"psnr": 48.5},
        "history": {"seconds": [None], "epoch": [1], "psnr": [40.0]},
    }


def make_arrays(header: dict[str, Any]) -> dict[str, np.ndarray]:
    """Random values for every array that a header asks for."""
    rng = np.random.default_rng(0)
    model, shape = header["model"], header["domain"]["shape"]
    key_frames = model["levels"][0][0]
    arrays: dict[str, np.ndarray] = {
        "key_frames": np.linspace(0, shape[0] - 1, key_frames).astype(np.int64)
    }
    for number, level in enumerate(model["levels"], start=1):
        arrays[f"table_{number}"] = rng.standard_normal((*level, model["embedding_size"])).astype(
            model["tables"]
        )
    inputs = len(model["levels"]) * model["embedding_size"]
    widths = [inputs, *[model["width"]] * model["hidden_layers"], 1]
    for number, (inputs, outputs) in enumerate(pairwise(widths), start=1):
        arrays[f"mlp/weight_{number}"] = rng.standard_normal((outputs, inputs)).astype(np.float32)
        arrays[f"mlp/bias_{number}"] = rng.standard_normal(outputs).astype(np.float32)
    arrays["occupancy"] = rng.integers(
        0,
        256,
        (len(header["features"]), key_frames, occupancy_bytes(header["feature_bounding_box"])),
        dtype=np.uint8,
    )
    return arrays


def make_compact_header() -> dict[str, Any]:
    """A header of the profile compact, whose only array need be the table."""
    header = make_header()
    header["required_features"] = ["transform"]
    header["mlp"] = None
    header["model"] = {
        "profile": "compact",
        "levels": [[4, 3, 4, 6]],
        "embedding_size": 1,
        "tables": "float32",
        "parameters": 17,
    }
    header["coordinates"] = {
        "time": {"values": [0, 0.5, 2, 2.25], "attributes": {"units": "h"}},
        "z": {},
        "y": {"start": -1.5, "step": 0.25},
        "x": {"start": 0.1, "step": 0.3, "ulps": [1], "dtype": "float32", "name": "lon"},
    }
    return header


def write(
    path: Path,
    header: dict[str, Any],
    arrays: dict[str, np.ndarray],
    attributes: Mapping[str, dict[str, Any]] | None = None,
    **options: Any,
) -> int:
    """A container of whole arrays; the finest table in 2 x 2 x 2 chunks, some of them at an end."""
    with ContainerWriter(path, **options) as writer:
        for name, array in arrays.items():
            table = name == "table_1" and array.shape[1:] == (3, 4, 6, 2)
            quantised = name.startswith("table_") and array.dtype == np.uint8
            usual = {"offset": 0.5, "scale": 0.25} if quantised else None
            writer.add_whole(
                name,
                array,
                chunk_shape=(1, 2, 3, 6, 2) if table else None,
                attributes=(attributes or {}).get(name, usual),
            )
        return writer.commit(header)


def unpack(data: bytes) -> Parts:
    """The members of a sound container."""
    count, _, offset = _end(data)
    parts, at = [], offset
    for _ in range(count):
        size, name_size = (
            struct.unpack_from("<I", data, at + 20)[0],
            struct.unpack_from("<H", data, at + 28)[0],
        )
        begin = struct.unpack_from("<I", data, at + 42)[0] + 30 + name_size
        stored, method = data[begin : begin + size], struct.unpack_from("<H", data, at + 10)[0]
        parts.append(
            (
                data[at + 46 : at + 46 + name_size].decode(),
                zlib.decompress(stored, -15) if method == 8 else stored,
            )
        )
        at += 46 + name_size
    return parts


def pack(
    parts: Iterable[tuple[str, bytes]], stored: Mapping[str, tuple[bytes, int, int]] | None = None
) -> bytes:
    """A container's ZIP of any members, with sound checksums.

    stored: by name the bytes in the file, and the full size and CRC-32 that are declared.
    """
    members, chunks, position = [], [], 0
    for name, data in parts:
        held, full, crc = (stored or {}).get(name, (data, None, zlib.crc32(data)))
        member = Member(name=name, offset=position, size=len(held), crc=crc, full_size=full)
        members.append(member)
        chunks += [local_header(member), held]
        position = member.end
    return b"".join([*chunks, ending(members)])


def reseal(data: bytes) -> bytes:
    """The same file with the digest of its directory made right."""
    _, _, offset = _end(data)
    directory = data[offset : -len(comment(b""))]
    return data[:offset] + directory + comment(directory)


def _end(data: bytes) -> tuple[int, int, int]:
    """Entries, bytes and offset of the directory."""
    _, _, _, _, count, size, offset, _ = END.unpack_from(
        data, len(data) - len(comment(b"")) - END.size
    )
    return count, size, offset


def members(path: Path, folder: str) -> dict[tuple[int, ...], Member]:
    """The members of chunks or tiles by index. folder: "NAME/c" or "NAME/t" of an array."""
    found = {}
    with zipfile.ZipFile(path) as file:
        for each in file.infolist():
            if each.filename.startswith(f"{folder}/"):
                index = tuple(map(int, each.filename.removeprefix(f"{folder}/").split("/")))
                found[index] = Member(
                    name=each.filename,
                    offset=each.header_offset,
                    size=each.compress_size,
                    crc=each.CRC,
                )
    return found


class Samples:
    """Helpers that the tests of this folder share."""

    members = staticmethod(members)

    header = staticmethod(make_header)
    compact_header = staticmethod(make_compact_header)
    arrays = staticmethod(make_arrays)
    write = staticmethod(write)
    unpack = staticmethod(unpack)
    pack = staticmethod(pack)
    reseal = staticmethod(reseal)
    directory_at: Callable[[bytes], int] = staticmethod(lambda data: _end(data)[2])


@pytest.fixture
def samples() -> type[Samples]:
    return Samples


@pytest.fixture
def sample(tmp_path: Path) -> Path:
    """A valid container."""
    path = tmp_path / "sample.fhz"
    header = make_header()
    write(path, header, make_arrays(header))
    return path


@pytest.fixture
def tiled_file(tmp_path: Path, samples: type[Samples]) -> tuple[Path, np.ndarray]:
    """Two members of 2 x 2 tiles of 2 x 3, of which the last are cut; file and values."""
    values = random_values((7, 6))
    return write_tiled(tmp_path / "a.fhz", samples, values, (2, 3), (2, 2)), values
