"""Lists of VTK files: .pvd and .series, their times, and lists that cannot be a series."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fhash_formats import open_series
from fhash_formats.errors import InputError, MissingInputError
from fhash_formats.series import Coordinate
from fhash_formats.writers import Region, save_region

VALUES = np.random.default_rng(0).normal(size=(3, 2, 3, 4)).astype("f4")
ROW = '<DataSet timestep="{}" part="{}" file="{}"/>'


def grids(folder: Path) -> None:
    """Three steps step_0.vti to step_2.vti, with the times 0, 1 and 2 in them."""
    for step, frame in enumerate(VALUES):
        coords = {
            axis: Coordinate(name=axis, values=np.arange(float(n)))
            for axis, n in zip("zyx", frame.shape, strict=True)
        }
        coords["t"] = Coordinate(name="time", values=np.array([float(step)]))
        region = Region(name="u", dtype=frame.dtype, shape=(1, *frame.shape), coords=coords)
        save_region(folder / f"step_{step}.vti", region, [frame])


def pvd(folder: Path, *rows: tuple[object, object, str]) -> Path:
    path = folder / "run.pvd"
    body = "".join(ROW.format(*row) for row in rows)
    path.write_text(f'<VTKFile type="Collection"><Collection>{body}</Collection></VTKFile>')
    return path


def test_steps_are_in_the_order_of_their_times(tmp_path: Path) -> None:
    grids(tmp_path)
    path = pvd(tmp_path, (10, 0, "step_2.vti"), (5.5, 0, "step_0.vti"), (7, 0, "step_1.vti"))
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [5.5, 7, 10]
        assert series.name == "u"
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)
        assert set(series.files) == {path, *tmp_path.glob("*.vti")}
        path.write_text(path.read_text() + " ")
        with pytest.raises(InputError, match=r"run\.pvd changed"):
            series.check()


def test_files_of_paraview_series(tmp_path: Path) -> None:
    grids(tmp_path)
    path = tmp_path / "run.vti.series"
    rows = [{"name": f"step_{step}.vti", "time": 0.5 * step} for step in range(3)]
    path.write_text(json.dumps({"file-series-version": "1.0", "files": rows}))
    with open_series(path) as series:
        assert series.coords["t"].values.tolist() == [0, 0.5, 1]
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)
    path.write_text("[1, 2]")
    with pytest.raises(InputError, match="is not a list of files"):
        open_series(path)
    path.write_text("{")
    with pytest.raises(InputError, match=r"run\.vti\.series"):
        open_series(path)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0, 0, "step_0.vti"), (0, 1, "step_1.vti")], "step_0.vti and step_1.vti for the time 0"),
        ([("soon", 0, "step_0.vti")], "the time 'soon' is no number"),
        ([("nan", 0, "step_0.vti")], "no finite number"),
        ([(0, 0, "mesh.vtu")], r"lists mesh\.vtu; \.vti, \.vtr, \.pvti and \.pvtr can be read"),
        ([(0, 0, "")], "names no file"),
        ([], "lists no file"),
    ],
)
def test_lists_that_are_no_series(
    tmp_path: Path, rows: list[tuple[object, object, str]], message: str
) -> None:
    grids(tmp_path)
    (tmp_path / "mesh.vtu").write_text('<VTKFile type="UnstructuredGrid"/>')
    with pytest.raises(InputError, match=message) as caught:
        open_series(pvd(tmp_path, *rows))
    assert "run.pvd" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"run\.pvd lists .*gone\.vti, which is not there"):
        open_series(pvd(tmp_path, (0, 0, "gone.vti")))


def test_no_pattern_joins_lists(tmp_path: Path) -> None:
    grids(tmp_path)
    pvd(tmp_path, (0, 0, "step_0.vti"))
    with pytest.raises(InputError, match="cannot be one of a pattern"):
        open_series(tmp_path / "*.pvd")
