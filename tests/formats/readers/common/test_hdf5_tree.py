"""Datasets of an HDF5 file: links and cycles, filters, and files behind virtual datasets."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from stored_series import (
    VALUES,
    assert_frames,
    write_hdf5,
)

from fhash_formats import open_series
from fhash_formats.errors import InputError, MissingDependencyError


def test_links_and_cycles(tmp_path: Path) -> None:
    write_hdf5(tmp_path / "other.h5", far=VALUES[::-1])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["z_group/v"] = VALUES
        file["a_soft"] = h5py.SoftLink("/z_group/v")
        file["z_group/again"] = file["z_group/v"]
        file["z_group/round"] = file["/"]
        file["dangling"] = h5py.SoftLink("/nothing")
        file["gone"] = h5py.ExternalLink("missing.h5", "/v")
    assert_frames(tmp_path / "a.h5", VALUES)
    assert_frames(tmp_path / "a.h5", VALUES, var="a_soft")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["linked"] = h5py.ExternalLink("other.h5", "/far")
    assert_frames(tmp_path / "b.h5", VALUES[::-1])


def test_scales_and_bounds_are_no_candidates_but_can_be_named(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["v"] = VALUES
        file["corners"] = np.zeros((5, 6, 4))
        file["lat2d"] = np.zeros((5, 6))
        file["lat2d"].attrs["bounds"] = "corners"
        file["scale"] = np.zeros((2, 2, 2))
        file["scale"].make_scale("scale")
    with open_series(tmp_path / "a.h5") as series:
        assert series.name == "v"
    with open_series(tmp_path / "a.h5", var="corners", axes="z,y,x") as series:
        assert series.shape == (1, 5, 6, 4)


def test_a_missing_filter_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("v", data=VALUES, compression="gzip")
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda code: False)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "hdf5plugin", None)
        with pytest.raises(
            MissingDependencyError, match=r"filter deflate \(id 1\).*fhash\[formats\]"
        ):
            open_series(tmp_path / "a.h5")
    monkeypatch.setitem(sys.modules, "hdf5plugin", sys)
    with pytest.raises(
        InputError, match=r"deflate \(id 1\), which neither h5py nor hdf5plugin has"
    ):
        open_series(tmp_path / "a.h5")


def test_filters_of_hdf5plugin_are_loaded_when_needed(tmp_path: Path) -> None:
    imports = "import h5py, hdf5plugin, numpy, sys"
    write_it = (
        f"{imports}; h5py.File(sys.argv[1], 'w').create_dataset("
        "'v', data=numpy.ones((2, 2, 2)), **hdf5plugin.Zstd())"
    )
    read_it = (
        "import sys; from fhash_formats import open_series;"
        " assert open_series(sys.argv[1]).read(0).sum() == 8"
    )
    for script in (write_it, read_it):
        subprocess.run([sys.executable, "-c", script, str(tmp_path / "a.h5")], check=True)


def test_a_virtual_dataset_without_its_source_is_refused(tmp_path: Path) -> None:
    write_hdf5(tmp_path / "part.h5", v=VALUES)
    layout = h5py.VirtualLayout(shape=VALUES.shape, dtype="f4")
    layout[:] = h5py.VirtualSource("part.h5", "v", shape=VALUES.shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_virtual_dataset("v", layout)
    assert_frames(tmp_path / "a.h5", VALUES)
    (tmp_path / "part.h5").unlink()
    with pytest.raises(InputError, match=r"draws on part.h5, which is not there"):
        open_series(tmp_path / "a.h5")


def test_a_source_of_a_virtual_dataset_that_changes_is_refused(tmp_path: Path) -> None:
    write_hdf5(tmp_path / "part.h5", v=VALUES)
    layout = h5py.VirtualLayout(shape=VALUES.shape, dtype="f4")
    layout[:] = h5py.VirtualSource("part.h5", "v", shape=VALUES.shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_virtual_dataset("v", layout)
    with open_series(tmp_path / "a.h5") as series:
        series.read(0)
        series.check()
        os.utime(tmp_path / "part.h5", ns=(1, 1))
        for look in (series.check, lambda: series.read(1)):
            with pytest.raises(InputError, match=r"part\.h5 changed while it was being read"):
                look()
