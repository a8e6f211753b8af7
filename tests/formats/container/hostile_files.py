"""Containers that are wrong in one way, and the check that they are refused with little memory."""

from __future__ import annotations

import copy
import json
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fhash_formats.container import Container
from fhash_formats.errors import DamagedFileError, UnsupportedFileError

ROOT = "zarr.json"
DOCUMENT = "mlp/bias_1/zarr.json"
CHUNK = "mlp/bias_1/c/0"
"""The only chunk of this array, five numbers float32."""
METHOD = 10
"""Offsets of fields in a directory entry: this one and the next four."""
FLAGS = 8
SIZE = 20
FULL_SIZE = 24
OFFSET = 42


def read_everything(path: Path) -> tuple[Any, dict[str, bytes]]:
    """Open, verify and read: the header, and the bytes of each array's values."""
    with Container.open(path) as container:
        container.verify()
        return container.header, {
            name: array.read().tobytes() for name, array in container.arrays.items()
        }


def refused(
    path: Path, data: bytes, message: str, kind: type[DamagedFileError] = DamagedFileError
) -> None:
    """Assert that a file of these bytes is refused for the right reason, with little memory."""
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(kind, match=message) as caught:
        read_everything(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "\n" not in str(caught.value)
    assert peak < 20 * len(data) + (4 << 20)
    if kind is DamagedFileError:
        assert not isinstance(caught.value, UnsupportedFileError)


def edited(sample: Path, samples: Any, name: str, change: Callable[[Any], object]) -> bytes:
    """The file with the JSON document `name` changed in place by `change`."""
    parts = samples.unpack(sample.read_bytes())
    return samples.pack([(n, _changed(data, change) if n == name else data) for n, data in parts])


def replaced(sample: Path, samples: Any, name: str, content: bytes) -> bytes:
    """The file with other data in the member `name`."""
    parts = samples.unpack(sample.read_bytes())
    return samples.pack([(n, content if n == name else data) for n, data in parts])


def edited_header(header: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    """A copy with the value at "a.b" replaced, or removed where it is `...`."""
    result = copy.deepcopy(header)
    put_at(result, path, value)
    return result


def put_at(values: Any, path: str, value: object) -> None:
    """Replace the value at "a.0.b" in place, or remove it where it is `...`; "a.+" appends."""
    *parents, key = (int(word) if word.isdecimal() else word for word in path.split("."))
    for parent in parents:
        values = values[parent]
    if key == "+":
        values.append(value)
    elif value is ...:
        del values[key]
    else:
        values[key] = value


def frame(content: bytes, *, size: int | None = None) -> bytes:
    """A zstd frame (RFC 8878) of one raw block, which declares `size` bytes of content or none."""
    head = (
        struct.pack("<IB", 0xFD2FB528, 0x00) + b"\x58"
        if size is None
        else struct.pack("<IBQ", 0xFD2FB528, 0xE0, size)
    )
    return head + struct.pack("<I", len(content) << 3 | 1)[:3] + content


def _changed(data: bytes, change: Callable[[Any], object]) -> bytes:
    values = json.loads(data)
    change(values)
    return json.dumps(values).encode()
