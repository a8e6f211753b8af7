"""Tables of needed vertices alone: what a header and its arrays must have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.container import Container, ContainerWriter, validate_header
from fhash_formats.container.header import COUNTS, SPARSE_FEATURE
from fhash_formats.errors import DamagedFileError, InputError

COUNTED = {"tables/level_1": [5, 7], "tables/level_2": [3, 0]}


@pytest.fixture
def header(samples) -> dict[str, Any]:
    """A header of sparse tables."""
    header: dict[str, Any] = samples.header()
    header["model"]["sparse"] = "fringe"
    header["required_features"] = [SPARSE_FEATURE]
    return header


def write(
    path: Path,
    header: dict[str, Any],
    arrays: dict[str, np.ndarray],
    counted: dict[str, Any] = COUNTED,
    **others: np.ndarray,
) -> None:
    """Write the arrays of a header, its tables with so many vertices at each time node."""
    with ContainerWriter(path) as writer:
        for name, array in {**arrays, **others}.items():
            if name not in COUNTED:
                writer.add_whole(name, array)
        for name, counts in counted.items():
            size = header["model"]["embedding_size"]
            rows = others.get(name, np.zeros((sum(COUNTED[name]), size), np.float16))
            writer.add_whole(name, rows, attributes={} if counts is None else {COUNTS: counts})
        writer.commit(header)


def test_a_file_of_sparse_tables_is_read(tmp_path, samples, header) -> None:
    write(tmp_path / "a.fhz", header, samples.arrays(header))
    with Container.open(tmp_path / "a.fhz") as container:
        assert container.arrays["tables/level_1"].shape == (12, 2)
        container.verify()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sparse": "all"}, "model.sparse is 'all'; needed: coreset or fringe"),
        ({"sparse": True}, "model.sparse is True; needed: coreset or fringe"),
        ({"tables": "transform"}, "sparse is 'fringe'; needed: tables of plain numbers"),
    ],
    ids=str,
)
def test_a_header_that_does_not_fit_is_refused(samples, header, changes, message) -> None:
    header["model"].update(changes)
    header["required_features"].append("transform")
    header |= {"format": "fhash", "format_version": [2, 0]}
    with pytest.raises(DamagedFileError, match=message):
        validate_header(header)


def test_the_feature_must_be_required(tmp_path, samples, header) -> None:
    """An older reader would otherwise take the tables for damaged ones."""
    header["required_features"] = []
    with pytest.raises(InputError, match="sparse is 'fringe'; needed: the feature sparse-tables"):
        write(tmp_path / "a.fhz", header, samples.arrays(header))


@pytest.mark.parametrize(
    "counts",
    [None, 12, [12], [5, 7, 0], [5.0, 7], [-1, 13], [5, True], [0, 73], ["5", "7"]],
    ids=str,
)
def test_counts_that_do_not_fit_the_level_are_refused(tmp_path, samples, header, counts) -> None:
    with pytest.raises(InputError, match="array tables/level_1 attribute counts is"):
        write(
            tmp_path / "a.fhz",
            header,
            samples.arrays(header),
            COUNTED | {"tables/level_1": counts},
        )


@pytest.mark.parametrize(
    "table",
    [np.zeros((11, 2), np.float16), np.zeros((12, 1), np.float16), np.zeros((12, 2), np.float32)],
    ids=lambda table: f"{table.dtype} {table.shape}",
)
def test_a_table_that_does_not_fit_its_counts_is_refused(tmp_path, samples, header, table) -> None:
    with pytest.raises(InputError, match=r"array tables/level_1 is .* asks for float16 \(12, 2\)"):
        write(tmp_path / "a.fhz", header, samples.arrays(header), **{"tables/level_1": table})


def test_dense_tables_in_a_sparse_file_are_refused(tmp_path, samples, header) -> None:
    with pytest.raises(InputError, match="array tables/level_1 attribute counts is missing"):
        samples.write(tmp_path / "a.fhz", header, samples.arrays(header))


def test_a_missing_table_is_named(tmp_path, samples, header) -> None:
    counted = {name: counts for name, counts in COUNTED.items() if name != "tables/level_2"}
    with pytest.raises(InputError, match="array tables/level_2 is missing"):
        write(tmp_path / "a.fhz", header, samples.arrays(header), counted)


def test_the_occupancy_must_be_bits(tmp_path, samples, header) -> None:
    arrays = samples.arrays(header)
    mask = np.ones(header["model"]["levels"][0], np.uint8)
    with pytest.raises(InputError, match="occupancy/mask is there in a file of sparse tables"):
        write(tmp_path / "a.fhz", header, arrays | {"occupancy/mask": mask})
    del arrays["occupancy/bits"]
    with pytest.raises(InputError, match="array occupancy/bits is missing"):
        write(tmp_path / "b.fhz", header, arrays)
