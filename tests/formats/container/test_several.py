"""Several variables in a container: each reads as if it were alone, and coordinates are shared."""

from __future__ import annotations

import numpy as np
import pytest
from several_files import PLAIN_VARIABLE, add_coordinates, compact_header, write_several
from table_files import table_parts, write_table

from fhash_formats.container import Container, ContainerWriter
from fhash_formats.errors import InputError


def test_each_variable_is_what_a_file_of_its_own_would_be(tmp_path, samples) -> None:
    header = samples.header()
    arrays = samples.arrays(header)
    alone = write_table(tmp_path / "a.fhz", samples.compact_header(), table_parts())
    path = write_several(tmp_path / "b.fhz", samples)
    with Container.open(path) as file, Container.open(alone) as one:
        assert list(file.variables) == ["u", "group/v", "w", "paper"]
        assert (file.variable, one.variable, dict(one.variables)) == (None, None, {})
        for name in ("u", "group/v"):
            own, table = file.variables[name], one.arrays["tables/level_1"]
            assert own.variable == name
            assert own.header["variable"] == one.header["variable"]
            read = own.arrays["tables/level_1"]
            np.testing.assert_array_equal(read.read(), table.read())
            np.testing.assert_array_equal(read.read_mask(), table.read_mask())
            for lod in (0, 1):
                np.testing.assert_array_equal(
                    read.decode_chunk((0, 0, 0, 1), lod), table.decode_chunk((0, 0, 0, 1), lod)
                )
        assert not np.array_equal(
            file.variables["w"].arrays["tables/level_1"].read(), one.arrays["tables/level_1"].read()
        )
        paper = file.variables["paper"]
        assert {name: array.read().tobytes() for name, array in paper.arrays.items()} == {
            name: values.tobytes() for name, values in arrays.items()
        }
        assert file.verify() == len(file.arrays)
        assert paper.verify() == len(arrays)


def test_coordinates_are_there_once_and_others_have_their_own(tmp_path, samples) -> None:
    with Container.open(write_several(tmp_path / "a.fhz", samples, paper=False)) as file:
        shared = [name for name in file.arrays if "parts" not in name]
        assert shared == ["time", "z", "y", "lon_deg_", "u", "group_v", "lon_deg__of_w", "w"]
        u, v, w = file.variables.values()
        for axis in ("time", "z", "y"):
            assert u.arrays[f"coords/{axis}"] is w.arrays[f"coords/{axis}"]
        assert u.arrays["coords/x"] is v.arrays["coords/x"] is not w.arrays["coords/x"]
        assert u.coordinate("x").name == w.coordinate("x").name == "lon (deg)"
        assert u.coordinate("time").name == "time"
        assert (w.coordinate("x").values - u.coordinate("x").values).tolist() == [0.25] * 6
        assert u.coordinate("z").attributes == {"units": "m"}
        assert file.attributes == {"title": "four winds"}


def test_arrays_show_the_axes_that_are_whole(tmp_path, samples) -> None:
    with Container.open(write_several(tmp_path / "a.fhz", samples, paper=False)) as file:
        # The box of the samples has 4 of 5 vertices along y.
        names = file.arrays["u"].dimension_names, file.arrays["w"].dimension_names
        assert names == (
            ("time", "z", "y_box", "lon_deg_"),
            ("time", "z", "y_box_3", "lon_deg__of_w"),
        )
        assert file.arrays["u"].attributes == {"units": "m s-1"}
        assert file.arrays["lon_deg_"].dimension_names == ("lon_deg_",)


def test_sizes_of_variables_add_up_to_the_file(tmp_path, samples) -> None:
    parts, sizes = table_parts(), []
    with ContainerWriter(tmp_path / "a.fhz", variables=["u", "v"]) as writer:
        for _ in "uv":
            writer.begin(PLAIN_VARIABLE)
            add_coordinates(writer)
            mark = writer.mark()
            for _ in range(2):  # once more after a rewinding
                writer.rewind(mark)
                parts.write(writer)
                header = compact_header(samples)
                sizes.append(writer.size(header))
                with writer.preview(header) as preview:
                    assert preview.verify() == 5
            writer.finish(header)
        size = writer.commit()
    assert sizes[0] == sizes[1]
    assert sizes[1] + sizes[3] == size == (tmp_path / "a.fhz").stat().st_size
    with Container.open(tmp_path / "a.fhz") as file:
        own = [variable.size for variable in file.variables.values()]
        assert 0 < own[0] <= own[1] < sizes[3] < sizes[1]
        overheads = [variable.overhead() for variable in file.variables.values()]
        assert all(0 < each < size for each, size in zip(overheads, own, strict=True))


def test_variables_do_not_share_cached_chunks(tmp_path, samples) -> None:
    with Container.open(write_several(tmp_path / "a.fhz", samples, paper=False)) as file:
        region = tuple(slice(0, 2) for _ in range(4))
        values = {n: v.arrays["tables/level_1"].read(region) for n, v in file.variables.items()}
        again = {n: v.arrays["tables/level_1"].read(region) for n, v in file.variables.items()}
        for name in values:
            np.testing.assert_array_equal(values[name], again[name])
        assert not np.array_equal(values["u"], values["w"])
        assert len({v.digest for v in (file, *file.variables.values())}) == 4
        file.variables["u"].close()
        file.variables["w"].arrays["tables/level_1"].read()
        file.variables["u"].closing_file().close()
        with pytest.raises(InputError, match="closed"):
            file.variables["w"].arrays["coords/x"].read()


@pytest.mark.parametrize("names", [[""], ["u", "u"]])
def test_names_must_differ(tmp_path, names) -> None:
    with pytest.raises(InputError, match="different names"):
        ContainerWriter(tmp_path / "a.fhz", variables=names)


def test_a_variable_alone_is_not_committed(tmp_path) -> None:
    with ContainerWriter(tmp_path / "a.fhz", variables=["u"]) as writer:
        writer.begin(PLAIN_VARIABLE)
        with pytest.raises(InputError, match="finish each and commit them"):
            writer.commit({})
    assert not (tmp_path / "a.fhz").exists()


def test_a_coordinate_never_takes_the_place_of_a_variable(tmp_path, samples) -> None:
    parts = table_parts()
    names = ["u", "z", "y_box", "parts"]
    with ContainerWriter(tmp_path / "a.fhz", variables=names) as writer:
        for _ in names:
            writer.begin(PLAIN_VARIABLE)
            add_coordinates(writer)
            parts.write(writer)
            writer.finish(compact_header(samples))
        writer.commit()
    with Container.open(tmp_path / "a.fhz") as file:
        assert file.arrays["z"].shape == (4, 3, 4, 6)
        assert file.arrays["z_of_u"].dimension_names == ("z_of_u",)
        assert file.arrays["u"].dimension_names == ("time", "z_of_u", "y_box_2", "lon_deg_")
        assert file.arrays["parts_2"].shape == (4, 3, 4, 6)
        assert all(v.coordinate("z").name == "z" for v in file.variables.values())


def test_arrays_beside_the_data_are_there_once_where_they_are_equal(tmp_path, samples) -> None:
    path, places = tmp_path / "a.fhz", np.arange(30.0).reshape(5, 6)
    with ContainerWriter(path, variables=["u", "v", "w"]) as writer:
        for name in "uvw":
            writer.begin(PLAIN_VARIABLE)
            add_coordinates(writer)
            writer.add_whole("auxiliary/lat", places + (name == "w"))
            table_parts().write(writer)
            writer.finish(compact_header(samples))
        writer.commit()
    with Container.open(path) as file:
        lat = [name for name in file.arrays if "lat" in name]
        assert lat == ["parts/0.auxiliary.lat", "parts/2.auxiliary.lat"]
        u, v, w = (each.arrays["auxiliary/lat"] for each in file.variables.values())
        assert u is v
        assert (w.read() - u.read() == 1).all()
        assert file.variables["v"].size < file.variables["u"].size
        assert file.variables["v"].overhead() > 0
        assert sum(each.size for each in file.variables.values()) < file.size
