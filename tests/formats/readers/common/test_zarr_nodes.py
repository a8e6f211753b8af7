"""Groups and arrays of a zarr hierarchy: in a folder, in a ZIP, and those that cannot be opened."""

from __future__ import annotations

from pathlib import Path

import pytest
import zarr
from stored_series import VALUES, create_zarr, zipped

from fhash_formats.errors import InputError
from fhash_formats.readers.common.zarr_nodes import (
    metadata_of,
    nodes_in_folder,
    nodes_in_zip,
    open_arrays,
)


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_nodes_of_a_folder_and_of_its_zip(tmp_path: Path, zarr_format: int) -> None:
    folder = tmp_path / "a.zarr"
    group = zarr.open_group(folder, mode="w", zarr_format=zarr_format)
    group.create_group("in").attrs["time"] = 2.5
    create_zarr(folder, VALUES, name="in/v", zarr_format=zarr_format)
    assert metadata_of(folder) is not None
    assert metadata_of(tmp_path) is None
    assert list(nodes_in_folder(folder)) == ["in", "in/v"]
    for inside in ("", "a.zarr/"):
        archive = zipped(folder, tmp_path / "a.zip", inside=inside)
        place, nodes = nodes_in_zip("a", archive)
        assert (place, nodes) == (inside.rstrip("/"), ["", "in", "in/v"])
    store = zarr.storage.LocalStore(folder, read_only=True)
    arrays, groups, failed = open_arrays(store, "", ["", "in", "in/v", "none"])
    assert list(arrays) == ["in/v"]
    assert groups["in"] == {"time": 2.5}
    assert list(failed) == ["none"]


def test_a_zip_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a.txt").write_text("words")
    archive = zipped(tmp_path / "folder", tmp_path / "a.zip")
    with pytest.raises(InputError, match="holds no zarr hierarchy"):
        nodes_in_zip("a", archive)
