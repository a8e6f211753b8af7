"""TIFF stacks: pages, hyperstacks of ImageJ and OME, files of one page, colours, damaged files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fhash_formats.errors import InputError
from fhash_formats.readers.registry import open_series

tifffile = pytest.importorskip("tifffile")

RNG = np.random.default_rng(0)
VALUES = RNG.integers(0, 60_000, (4, 3, 5, 6)).astype("u2")


def write(path: Path, values: np.ndarray, **options: Any) -> Path:
    options = options if options.get("imagej") else {"photometric": "minisblack", **options}
    tifffile.imwrite(path, values, **options)
    return path


def frames(path: Path, **options: Any) -> np.ndarray:
    with open_series(path, **options) as series:
        return np.stack(list(series.frames()))


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
@pytest.mark.parametrize(
    "options", [{}, {"compression": "zlib"}, {"byteorder": ">"}, {"bigtiff": True}]
)
def test_pages_are_slices(tmp_path: Path, options: dict[str, Any], dtype: str) -> None:
    values = VALUES[0].astype(dtype)
    path = write(tmp_path / "a.tif", values, **options)
    with open_series(path) as series:
        assert (series.name, series.shape) == ("a", (1, *values.shape))
        np.testing.assert_array_equal(series.read(0), values)
    np.testing.assert_array_equal(frames(path, axes="t,y,x"), values[:, None])


def test_one_page_is_a_plane(tmp_path: Path) -> None:
    np.testing.assert_array_equal(frames(write(tmp_path / "a.tif", VALUES[0, 0])), VALUES[:1, :1])


def test_hyperstacks_of_imagej(tmp_path: Path) -> None:
    about = {"axes": "TZYX", "spacing": 3.0, "unit": "um", "finterval": 0.5}
    path = write(tmp_path / "a.tif", VALUES, imagej=True, resolution=(2, 4), metadata=about)
    with open_series(path) as series:
        for step in (3, 0, 1, 2):
            np.testing.assert_array_equal(series.read(step), VALUES[step])
        assert series.coords["t"].values.tolist() == [0, 0.5, 1, 1.5]
        assert series.coords["z"].values.tolist() == [0, 3, 6]
        assert series.coords["y"].values.tolist() == [0, 0.25, 0.5, 0.75, 1]
        assert series.coords["x"].values.tolist() == [0, 0.5, 1, 1.5, 2, 2.5]
        assert series.coords["x"].attributes == {"units": "um"}


def test_channels_are_variables(tmp_path: Path) -> None:
    channels = np.stack([VALUES, VALUES[::-1]], axis=2)
    path = write(tmp_path / "a.tif", channels, imagej=True, metadata={"axes": "TZCYX"})
    np.testing.assert_array_equal(frames(path, var="a.1"), VALUES[::-1])
    with pytest.raises(InputError, match=r"a\.0 .*a\.1 .*choose one with --var"):
        open_series(path)


def test_ome_axes_and_sizes(tmp_path: Path) -> None:
    about = {"axes": "TCZYX", "PhysicalSizeX": 0.25, "PhysicalSizeXUnit": "nm", "TimeIncrement": 2}
    channels = np.stack([VALUES, VALUES + 1], axis=1)
    path = write(tmp_path / "a.ome.tif", channels, metadata=about)
    with open_series(path, var="a.ome.1") as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES + 1)
        assert series.coords["x"].values.tolist() == [0, 0.25, 0.5, 0.75, 1, 1.25]
        assert series.coords["x"].attributes == {"units": "nm"}
        assert series.coords["t"].values.tolist() == [0, 2, 4, 6]


def test_files_of_one_page_are_asked_about(tmp_path: Path) -> None:
    for number, plane in enumerate(VALUES[0]):
        write(tmp_path / f"s_{number}.tif", plane)
    with pytest.raises(InputError, match=r"3 files of one page each; .*--axes z,y,x.*--axes t,y,x"):
        open_series(tmp_path / "s_*.tif")
    with open_series(tmp_path / "s_*.tif", axes="z,y,x") as series:
        assert series.name == "s"
        assert len(series.files) >= 3
        np.testing.assert_array_equal(series.read(0), VALUES[0])
    np.testing.assert_array_equal(frames(tmp_path / "s_*.tif", axes="t,y,x"), VALUES[0][:, None])
    write(tmp_path / "s_3.tif", VALUES[0, 0, :3])
    with pytest.raises(InputError, match=r"s_3\.tif: its page is not uint16 \(5, 6\)"):
        frames(tmp_path / "s_*.tif", axes="z,y,x")


def test_files_of_stacks_are_steps(tmp_path: Path) -> None:
    for step, frame in enumerate(VALUES):
        write(tmp_path / f"a_{step}.tif", frame)
    np.testing.assert_array_equal(frames(tmp_path / "a_*.tif"), VALUES)


def test_colours_and_several_series_are_refused(tmp_path: Path) -> None:
    colours = RNG.integers(0, 255, (4, 5, 6, 3)).astype("u1")
    write(tmp_path / "a.tif", colours, photometric="rgb")
    with pytest.raises(InputError, match="colour pictures of 3 samples"):
        open_series(tmp_path / "a.tif")
    with tifffile.TiffWriter(tmp_path / "b.tif") as file:
        file.write(VALUES[0], photometric="minisblack")
        file.write(VALUES[0, :, :3], photometric="minisblack")
    with pytest.raises(InputError, match="2 series of pages"):
        open_series(tmp_path / "b.tif")


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_cut_files_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write(tmp_path / "a.tif", VALUES[0], **options)
    whole = path.read_bytes()
    for length in (6, len(whole) // 2, len(whole) - 40):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError) as caught:
            frames(path)
        assert "\n" not in str(caught.value)


def test_tifffile_is_named_where_it_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.tif", VALUES[0])
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(
        ImportError, match=r"a\.tif: TIFF needs tifffile: pip install 'fhash\[formats\]'"
    ):
        open_series(path)
