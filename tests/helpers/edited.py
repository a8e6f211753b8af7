"""Containers with one document changed, and every checksum right."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fhash_formats.container.zip_file import Member, ending, local_header


def edit(path: Path, name: str, change: Callable[[dict[str, Any]], Any]) -> None:
    """Let `change` alter the JSON object of a member, such as "zarr.json"; None drops it."""
    with zipfile.ZipFile(path) as file:
        parts = [(each, file.read(each)) for each in file.namelist()]
    members, chunks, position = [], [], 0
    for each, data in parts:
        content = data
        if each == name:
            values = json.loads(data)
            if change(values) is None:
                continue
            content = json.dumps(values).encode()
        member = Member(name=each, offset=position, size=len(content), crc=zlib.crc32(content))
        members.append(member)
        chunks += [local_header(member), content]
        position = member.end
    path.write_bytes(b"".join([*chunks, ending(members)]))
