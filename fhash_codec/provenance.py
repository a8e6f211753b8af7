"""The source of a container: what the header keeps of it, and the line of its history."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from datetime import UTC, datetime
from typing import Any

import numpy.typing as npt

from fhash_codec.config import EncodeConfig
from fhash_formats.container import SOURCE, Container, describe_metadata, read_metadata
from fhash_formats.container.header import CONFIG_DEFAULTS
from fhash_formats.series import AXES, Coordinate, Series
from fhash_formats.source_metadata import SourceMetadata, with_history

__all__ = [
    "PACKED",
    "date_of",
    "figure_attributes",
    "history_line",
    "metadata_of",
    "source_attributes",
    "source_parts",
]

PACKED = "pack"
"""Command in the header's `encoder` of a file whose tiles come from a Zarr store."""

FIGURES = {"fhash_max_error": "max_abs_error", "fhash_psnr": "psnr"}
"""Attributes of a variable that say how well the file holds it, and their names in its header."""

MAX_OPTION = 80
"""Letters of the value of an option in a line of the history; a longer one is cut."""


def source_parts(
    series: Series, coords: Mapping[str, Coordinate], attributes: Mapping[str, Any]
) -> tuple[dict[str, Any] | None, dict[str, npt.NDArray[Any]]]:
    """The header's `source` of a series, and the arrays that belong to it.

    coords, attributes: as the header has them. The entry is None where nothing is known.
    """
    metadata = series.metadata
    if metadata is None:
        return None, {}
    assert set(metadata.dimensions.values()) <= {*AXES, ""}
    return describe_metadata(metadata, coords, attributes)


def date_of(config: EncodeConfig) -> dict[str, str]:
    """The time of the encoding for the header's `source`, in UTC.

    It is left out with the other times: then the same input and settings give the same bytes.
    """
    now = datetime.now(UTC).replace(microsecond=0, tzinfo=None)
    return {"date": f"{now.isoformat()}Z"} if config.timings else {}


def figure_attributes(header: Mapping[str, Any]) -> dict[str, float]:
    """Attributes of a variable that say how well the file holds it, as far as it tells."""
    found = {key: header["quality"].get(name) for key, name in FIGURES.items()}
    return {key: value for key, value in found.items() if value is not None}


def source_attributes(metadata: SourceMetadata) -> dict[str, str]:
    """Attributes of a file that name its source and the digest of it, as far as they are known."""
    named = {"fhash_source": metadata.file, "fhash_source_digest": metadata.digest}
    return {key: text for key, text in named.items() if text}


def metadata_of(container: Container, coords: Mapping[str, Coordinate]) -> SourceMetadata | None:
    """The source as a container tells it, with a line of history for the encoding.

    coords: those of the container. None where it says nothing.
    """
    metadata = read_metadata(container.header, container.arrays, coords)
    if metadata is None:
        return None
    line = history_line(container.header)
    return replace(metadata, attributes=with_history(metadata.attributes, line))


def history_line(header: Mapping[str, Any]) -> str:
    """The encoding as a line of the global attribute `history`, as CF asks of a program.

    It has the date where the header has it, the version of the encoder, and the command that asks
    for the same settings.
    """
    source = header.get(SOURCE, {})
    date = f"{source['date']} " if isinstance(source.get("date"), str) else ""
    name = f" {source['file']}" if isinstance(source.get("file"), str) else ""
    begun = f"{date}fhash {header['encoder']['version']}: fhash"
    if header["encoder"].get("command") == PACKED:
        return f"{begun} pack{name}"
    words = "".join(f" {word}" for word in _options(header))
    return f"{begun} encode{name}{words}"


def _options(header: Mapping[str, Any]) -> list[str]:
    """The settings other than the defaults, as options of the command line."""
    config, profile = header.get("config", {}), header["model"]["profile"]
    defaults = EncodeConfig(profile=profile).to_dict() | {"profile": CONFIG_DEFAULTS["profile"]}
    named = {each.name: each.metadata.get("option") or each.name for each in fields(EncodeConfig)}
    words = []
    for name, option in named.items():
        value = config.get(name)
        if value is None or value == defaults.get(name):
            continue
        flag = option.replace("_", "-").lstrip("-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
            continue
        for each in value if isinstance(value, list | tuple) else [value]:
            words.append(f"--{flag} {str(each)[:MAX_OPTION]}")
    return words
