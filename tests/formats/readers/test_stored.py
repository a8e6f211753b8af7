"""Arrays without chunks: only the frame's bytes are read, and a file that changes is refused."""

from __future__ import annotations

import bz2
import gzip
import json
import os
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from stored_series import VALUES as PLAIN
from stored_series import save_netcdf, write_hdf5

from fhash_formats.errors import FhashWarning, InputError
from fhash_formats.readers import stored_bytes
from fhash_formats.readers.registry import open_series
from fhash_formats.readers.stored_bytes import (
    CompressedFile,
    FlatArray,
    NumbersInText,
    PlainFile,
    StoredBytes,
    axis_steps,
    lattice,
    numbers_of_words,
)
from fhash_formats.readers.variables import (
    Variable,
    component_by_number,
    components,
)
from fhash_formats.series import NotStored, Series, spans_text


@given(
    shape=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    place=st.integers(0, 3),
    part=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    block=st.sampled_from([1, 64, 10**6]),
    run=st.sampled_from([1, 10**6]),
)
@settings(max_examples=60)
def test_a_part_of_a_flat_array_is_that_part(
    tmp_path_factory: pytest.TempPathFactory,
    shape: list[int],
    place: int,
    part: tuple[int, int],
    block: int,
    run: int,
) -> None:
    place = place % len(shape)
    start, stop = sorted(min(edge, shape[place]) for edge in part)
    values = np.arange(np.prod(shape), dtype=">i4").reshape(shape)
    path = tmp_path_factory.mktemp("flat") / "a"
    path.write_bytes(b"head" + values.tobytes())
    ranges = tuple(
        slice(start, stop) if at == place else slice(0, length) for at, length in enumerate(shape)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stored_bytes, "BLOCK_BYTES", block)
        patch.setattr(stored_bytes, "SHORTEST_RUN", run)
        np.testing.assert_array_equal(
            FlatArray(path, tuple(shape), values.dtype, offset=4).read(ranges), values[ranges]
        )


@pytest.mark.parametrize("kind", ["npy", "raw"])
def test_a_variable_cannot_be_named(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", PLAIN)
    (tmp_path / "a_6x5x3x4_f4.raw").write_bytes(PLAIN.tobytes())
    with pytest.raises(InputError, match="--var v cannot be used"):
        open_series(tmp_path / ("a.npy" if kind == "npy" else "a_6x5x3x4_f4.raw"), var="v")


SAVE: dict[str, Callable[[Path], object]] = {
    "npy": lambda path: np.save(path, PLAIN),
    "raw": lambda path: path.write_bytes(PLAIN.tobytes()),
    "h5": lambda path: write_hdf5(path, v=PLAIN),
    "nc": lambda path: save_netcdf(path, xr.Dataset({"v": (tuple("tzyx"), PLAIN)})),
}


@pytest.mark.parametrize("kind", SAVE)
def test_a_file_that_changes_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a_6x5x3x4_f4.{kind}"
    for change in (
        lambda: os.truncate(path, 500),
        path.unlink,
        lambda: os.truncate(path, 5000),
        lambda: os.utime(path, ns=(1, 1)),
    ):
        SAVE[kind](path)
        with open_series(path) as series:
            np.testing.assert_array_equal(series.read(0), PLAIN[0])
            change()
            with pytest.raises(InputError, match=r"(changed|was removed) while it was being read"):
                series.read(1)


def test_a_file_cut_during_a_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(PLAIN.tobytes()[:-1])
    with pytest.raises(InputError, match="ends after 1439 bytes, 1440 are needed"):
        FlatArray(path, PLAIN.shape, PLAIN.dtype).read(
            (slice(3, 4), slice(0, 3), slice(0, 5), slice(0, 6))
        )


@pytest.mark.parametrize("order", ["t,z,y,x", "z,t,y,x"])
def test_one_frame_is_read_at_a_time(
    tmp_path: Path, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fhash_formats.readers.file_series.SLAB_BYTES", 1)
    values = np.zeros((40, 40, 64, 64), np.float32)
    np.save(tmp_path / "a.npy", values)
    count = 0
    original = FlatArray._read

    def counted(self: FlatArray, file: Any, into: np.ndarray, start: int) -> None:
        nonlocal count
        count += into.nbytes
        original(self, file, into, start)

    monkeypatch.setattr(FlatArray, "_read", counted)
    with open_series(tmp_path / "a.npy", axes=order) as series:
        series.read(0)
        count = 0
        tracemalloc.start()
        for step in (3, 30):
            series.read(step)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert count == 2 * values[0].nbytes
    assert peak < 3 * values[0].nbytes


FLOAT = np.dtype("f4")


def test_positions_are_origin_and_multiples_of_the_spacing() -> None:
    assert lattice("x", 0.1, 0.1, 4).whole().tolist() == [0.1 + i * 0.1 for i in range(4)]
    assert lattice("t", 1, -2, 3, first=0.5).whole().tolist() == [0, -2, -4]
    assert (lattice("t", 0, 1, 1).name, lattice("y", 5, 0, 1).whole().tolist()) == ("time", [5])


@pytest.mark.parametrize(
    ("origin", "spacing"), [(0, 0), (np.nan, 1), (0, np.inf), (-np.inf, 1), (0, np.nan)]
)
def test_positions_must_be_finite_and_apart(origin: float, spacing: float) -> None:
    with pytest.raises(InputError, match="both must be finite, and the spacing not 0"):
        lattice("x", origin, spacing, 2)


def test_directions_along_the_axes() -> None:
    assert axis_steps(np.diag([1.0, -2.0, 3.0])).tolist() == [1, -2, 3]
    nearly = np.eye(3)
    nearly[0, 1] = 0.9e-9
    assert axis_steps(nearly).tolist() == [1, 1, 1]
    for matrix in (np.eye(3)[[1, 0, 2]], np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="turned against the axes"):
            axis_steps(matrix)
    nearly[0, 1] = 1.1e-9
    with pytest.raises(InputError, match="turned against the axes"):
        axis_steps(nearly)


def test_components_are_variables_with_names() -> None:
    values = np.arange(72.0).reshape(2, 3, 4, 3)

    def whole(name: str, count: int) -> Variable:
        return Variable(
            name=name,
            shape=(2, 3, 4, count),
            dtype=values.dtype,
            dimensions=("z", "y", "x", None),
            read=lambda places: values[..., :count][places],
        )

    for count, said, names in (
        (1, [], ["v"]),
        (3, [], ["v.x", "v.y", "v.z"]),
        (2, [], ["v.0", "v.1"]),
        (2, ["u", "w"], ["v.u", "v.w"]),
        (2, ["u", None], ["v.0", "v.1"]),
        (2, ["u", "u"], ["v.0", "v.1"]),
    ):
        for interleaved in (True, False):
            found = components(whole("v", count), 3, said, interleaved=interleaved)
            assert [each.name for each in found] == names
            for number, each in enumerate(found):
                assert (each.shape, each.dimensions) == ((2, 3, 4), ("z", "y", "x"))
                np.testing.assert_array_equal(each.whole(), values[..., number])


def test_components_are_found_by_number() -> None:
    arrays = [
        Variable(name=name, shape=(2, 3, count), dtype=FLOAT)
        for name, count in (("u", 1), ("v", 3), ("CellData/w", 2))
    ]
    found = [each for array in arrays for each in components(array, 2)]
    assert [each.name for each in found[:4]] == ["u", "v.x", "v.y", "v.z"]
    assert component_by_number("v.1", found) == "v.y"
    assert component_by_number("v.y", found) == "v.y"
    assert component_by_number("w.1", found) == "w.1"
    assert component_by_number("v.3", found) == "v.3"
    assert component_by_number("u.0", found) == "u.0"
    assert component_by_number(None, found) is None


DATA = np.random.default_rng(0).integers(0, 9, 50_000).astype("u1").tobytes()
PACKED = {
    "zlib": ("deflate", zlib.compress(DATA)),
    "gzip": ("deflate", gzip.compress(DATA)),
    "members": ("deflate", gzip.compress(DATA[:30_000]) + gzip.compress(DATA[30_000:])),
    "rest": ("deflate", gzip.compress(DATA) + b"other bytes"),
    "bzip2": ("bzip2", bz2.compress(DATA)),
}


def part(stored: StoredBytes, place: int, count: int) -> bytes:
    into = bytearray(count)
    stored.readinto(place, memoryview(into))
    return bytes(into)


def compressed(folder: Path, data: bytes, kind: str, size: int = len(DATA)) -> CompressedFile:
    (folder / "a").write_bytes(b"head" + data)
    return CompressedFile(folder / "a", kind, start=4, size=size)


@pytest.mark.parametrize("chunk", [100, 2**18])
@pytest.mark.parametrize("name", PACKED)
def test_compressed_bytes(
    tmp_path: Path, name: str, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_bytes, "STORED_BYTES", chunk)
    kind, data = PACKED[name]
    file = compressed(tmp_path, data, kind)
    for place, count in ((0, 10), (10, 5000), (40_000, 10_000), (5, 3), (0, len(DATA))):
        assert part(file, place, count) == DATA[place : place + count]
    file.close()
    assert part(file, 7, 7) == DATA[7:14]
    file.close()


@pytest.mark.parametrize("name", ["zlib", "gzip", "members", "bzip2"])
def test_compressed_bytes_that_are_cut_or_changed(tmp_path: Path, name: str) -> None:
    kind, data = PACKED[name]
    for length in (0, 2, len(data) // 2, len(data) - 1):
        with pytest.raises(InputError):
            part(compressed(tmp_path, data[:length], kind), 0, len(DATA))
    changed = data[:-100] + bytes([data[-100] ^ 4]) + data[-99:]
    with pytest.raises(InputError):
        part(compressed(tmp_path, changed, kind), 0, len(DATA))


def test_more_and_fewer_bytes_than_promised(tmp_path: Path) -> None:
    kind, data = PACKED["gzip"]
    with pytest.raises(InputError, match="holds more than the 49999 bytes"):
        part(compressed(tmp_path, data, kind, len(DATA) - 1), 0, len(DATA) - 1)
    with pytest.raises(InputError, match="ends after 50000 decompressed bytes, 50001 are needed"):
        part(compressed(tmp_path, data, kind, len(DATA) + 1), 0, len(DATA) + 1)


def test_sizes_beyond_what_deflate_can_hold(tmp_path: Path) -> None:
    compressed(tmp_path, bytes(100), "deflate", 103_200)
    with pytest.raises(InputError, match="promises 103201 bytes"):
        compressed(tmp_path, bytes(100), "deflate", 103_201)


def test_plain_bytes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"head" + DATA)
    file = PlainFile(tmp_path / "a", start=4, size=len(DATA))
    assert part(file, 17, 100) == DATA[17:117]
    with pytest.raises(InputError, match="its header promises 50005"):
        PlainFile(tmp_path / "a", start=5, size=len(DATA))
    (tmp_path / "a").write_bytes(DATA[:50])
    with pytest.raises(InputError, match="ends after 50 bytes"):
        part(file, 0, 100)


def test_numbers_in_text(tmp_path: Path) -> None:
    values = np.array([1.5, -2, np.inf, 0.1], dtype="f4")
    (tmp_path / "a").write_text("head 1.5,-2\ninf 0.1\n")
    file = NumbersInText(tmp_path / "a", values.dtype, start=4, size=16)
    assert part(file, 4, 8) == values[1:3].tobytes()
    file.close()
    assert part(file, 0, 16) == values.tobytes()
    with pytest.raises(InputError, match="holds 4 numbers, 5 are needed"):
        part(NumbersInText(tmp_path / "a", values.dtype, start=4, size=20), 0, 4)
    with pytest.raises(InputError, match="too short for 100 numbers"):
        NumbersInText(tmp_path / "a", values.dtype, start=4, size=400)


@pytest.mark.parametrize(
    ("words", "dtype", "message"),
    [
        ([b"256"], "u1", "beyond the type uint8"),
        ([b"-1"], "u8", "beyond the type uint64"),
        ([b"1.5"], "i4", "invalid literal"),
        ([b"x"], "f4", "convert"),
        ([b"1" * 65], "f8", "text stands where numbers are needed"),
    ],
)
def test_words_that_are_no_numbers(words: list[bytes], dtype: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        numbers_of_words(words, np.dtype(dtype))
    assert numbers_of_words([b"18446744073709551615"], np.dtype("u8"))[0] == 2**64 - 1
    assert numbers_of_words([b"1" * 64], np.dtype("f8"))[0] == float("1" * 64)


VALUES = np.arange(6 * 4 * 3 * 5, dtype=np.float32).reshape(6, 4, 3, 5) + 7


def told(path: Path, **options: Any) -> NotStored | None:
    """Values that nobody wrote, as a series tells; it warns of them, and of nothing else."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with open_series(path, **options) as series:
            found: Series = series
    assert len(caught) == (found.not_stored is not None), [str(each.message) for each in caught]
    if found.not_stored is not None:
        text = str(caught[0].message)
        assert caught[0].category is FhashWarning
        assert "\n" not in text
        for word in (spans_text(found.not_stored.spans()), "%", "--missing"):
            assert word in text
    return found.not_stored


def parts(folder: Path, values: np.ndarray = VALUES) -> None:
    for step, frame in enumerate(values):
        with h5py.File(folder / f"part{step}.h5", "w") as file:
            file["u"] = frame


def virtual(
    path: Path, steps: list[int] | range = range(6), form: str = "part{}.h5", **fill: Any
) -> Path:
    layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
    for step in steps:
        layout[step] = h5py.VirtualSource(form.format(step), "u", VALUES.shape[1:])
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("u", layout, **fill)
    return path


def drop(path: Path) -> None:
    path.unlink()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:900])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def renamed(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.move("u", "v")


def shorter(path: Path) -> None:
    path.unlink()
    with h5py.File(path, "w") as file:
        file["u"] = VALUES[0][:2]


def a_group(path: Path) -> None:
    path.unlink()
    with h5py.File(path, "w") as file:
        file.create_group("u")


@pytest.mark.parametrize("harm", [drop, cut, emptied, renamed, shorter, a_group])
@pytest.mark.parametrize("depth", [1, 2, "link"])
def test_a_source_that_is_gone_is_refused_by_name(
    tmp_path: Path, harm: Callable[[Path], None], depth: int | str
) -> None:
    parts(tmp_path)
    path = virtual(tmp_path / "a.h5")
    if depth == 2:
        layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
        layout[...] = h5py.VirtualSource("a.h5", "u", VALUES.shape)
        path = tmp_path / "outer.h5"
        with h5py.File(path, "w") as file:
            file.create_virtual_dataset("u", layout)
    elif depth == "link":
        path = tmp_path / "outer.h5"
        with h5py.File(path, "w") as file:
            file["u"] = h5py.ExternalLink("a.h5", "u")
    assert told(path) is None
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)
        assert {file.name for file in series.files} >= {f"part{step}.h5" for step in range(6)}
    harm(tmp_path / "part3.h5")
    with pytest.raises(InputError, match=r"draws on .*part3\.h5") as caught:
        open_series(path)
    assert str(path) in str(caught.value)


def test_a_virtual_dataset_that_draws_on_itself_is_refused(tmp_path: Path) -> None:
    for one, other in (("a.h5", "b.h5"), ("b.h5", "a.h5")):
        layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
        layout[...] = h5py.VirtualSource(other, "u", VALUES.shape)
        with h5py.File(tmp_path / one, "w") as file:
            file.create_virtual_dataset("u", layout)
    with pytest.raises(InputError, match="draws on itself"):
        open_series(tmp_path / "a.h5")


def test_a_numbered_row_of_sources_that_breaks_off_is_refused(tmp_path: Path) -> None:
    parts(tmp_path)
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        space = h5py.h5s.create_simple(VALUES.shape, (h5py.h5s.UNLIMITED, *VALUES.shape[1:]))
        space.select_hyperslab(
            (0, 0, 0, 0), (h5py.h5s.UNLIMITED, 1, 1, 1), block=(1, *VALUES.shape[1:])
        )
        made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        source = h5py.h5s.create_simple(VALUES.shape[1:])
        made.set_virtual(space, b"part%b.h5", b"u", source)
        whole = h5py.h5s.create_simple(VALUES.shape, (h5py.h5s.UNLIMITED, *VALUES.shape[1:]))
        h5py.h5d.create(file.id, b"u", h5py.h5t.IEEE_F32LE, whole, made)
    with open_series(path) as series:
        np.testing.assert_array_equal(np.stack(list(series.frames())), VALUES)
    renamed(tmp_path / "part3.h5")
    with pytest.raises(InputError, match=r"ends before part3\.h5"):
        open_series(path)


def test_raw_files_that_are_gone_or_short_are_refused_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    halves = VALUES.tobytes()[: VALUES.nbytes // 2], VALUES.tobytes()[VALUES.nbytes // 2 :]
    for name, half in zip(("one.bin", "two.bin"), halves, strict=True):
        Path(name).write_bytes(half)
    path = Path("a.h5")
    listed = [("one.bin", 0, len(halves[0])), ("two.bin", 0, h5py.h5f.UNLIMITED)]
    with h5py.File(path, "w") as file:
        file.create_dataset("u", VALUES.shape, VALUES.dtype, external=listed)
    assert told(path) is None
    Path("two.bin").write_bytes(halves[1][:-4])
    with pytest.raises(InputError, match=r"two\.bin, which has 716 bytes from byte 0 on; 720 are"):
        open_series(path)
    Path("one.bin").unlink()
    with pytest.raises(InputError, match=r"raw file one\.bin, and one\.bin is not there"):
        open_series(path)


def test_links_that_lead_nowhere_are_told_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for step in range(4):
            file[f"Step#{step}/u"] = VALUES[step]
        file["Step#4"] = h5py.ExternalLink("gone.h5", "Step#4")
        file["v"] = h5py.SoftLink("/nowhere")
    with pytest.raises(InputError, match=r"Step#4 is a link to Step#4 of gone\.h5"):
        open_series(path)
    with pytest.raises(InputError, match=r"v .*a link to /nowhere, which is not there"):
        open_series(path, var="v")


def test_steps_that_nothing_maps_are_told(tmp_path: Path) -> None:
    parts(tmp_path)
    path = virtual(tmp_path / "a.h5", [0, 1, 2, 4])
    found = told(path)
    assert found is not None
    assert found.shares.tolist() == [0, 0, 0, 1, 0, 1]
    assert (found.fill, found.spans(), found.share) == (0, [[3, 4], [5, 6]], 1 / 3)
    assert told(path, missing=[0.0]) is None
    assert told(path, steps=slice(0, 3)) is None
    some = told(path, steps=slice(2, 5))
    assert some is not None
    assert some.spans() == [[1, 2]]
    assert told(virtual(tmp_path / "b.h5", [0], fillvalue=np.nan)) is None


def test_what_a_source_never_stored_is_told_of_the_virtual_dataset(tmp_path: Path) -> None:
    parts(tmp_path)
    with h5py.File(tmp_path / "part3.h5", "w") as file:
        made = file.create_dataset("u", VALUES.shape[1:], "f4", chunks=(1, 3, 5))
        made[0] = VALUES[3][0]
    with h5py.File(tmp_path / "part4.h5", "w") as file:
        file.create_dataset("u", VALUES.shape[1:], "f4")
    found = told(virtual(tmp_path / "a.h5"))
    assert found is not None
    assert found.shares.tolist() == [0, 0, 0, 0.75, 1, 0]


@pytest.mark.parametrize("suffix", ["h5", "nc"])
def test_chunks_of_hdf5_that_nobody_wrote_are_told(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    with h5py.File(path, "w") as file:
        made = file.create_dataset("u", VALUES.shape, "f4", chunks=(2, 2, 3, 5), fillvalue=3)
        made[:2], made[2:4, :2] = VALUES[:2], VALUES[2:4, :2]
    found = told(path)
    assert found is not None
    assert found.shares.tolist() == [0, 0, 0.5, 0.5, 1, 1]
    assert found.fill == 3
    with h5py.File(path, "a") as file:
        file["u"].attrs["_FillValue"] = np.float32(3)
    assert told(path) is None
    raw = told(path, raw_values=True)
    assert raw is not None


def test_packed_fill_is_told_as_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        made = file.create_dataset("u", VALUES.shape, "i2", chunks=(1, 4, 3, 5))
        made[:5] = 4
        made.attrs["scale_factor"], made.attrs["add_offset"] = 0.5, 270.0
    found = told(path)
    assert found is not None
    assert (found.fill, found.spans()) == (270, [[5, 6]])
    assert told(path, missing=[270.0]) is None


def test_steps_in_groups_and_selected_indices(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for step in range(4):
            made = file.create_dataset(f"Step#{step}/u", (4, 3, 5), "f4", chunks=(2, 3, 5))
            if step != 2:
                made[: 4 if step else 2] = VALUES[step][: 4 if step else 2]
        made = file.create_dataset("member", (2, *VALUES.shape), "f4", chunks=(1, 1, 4, 3, 5))
        made[0], made[1, :5] = VALUES, VALUES[:5]
    found = told(path, var="Step#*/u")
    assert found is not None
    assert found.shares.tolist() == [0.5, 0, 1, 0]
    axes = "t,z,y,x"
    assert told(path, var="member", axes=axes, select={"0": 0}) is None
    found = told(path, var="member", axes=axes, select={"0": 1})
    assert found is not None
    assert found.spans() == [[5, 6]]


def test_files_one_after_the_other(tmp_path: Path) -> None:
    for number in range(3):
        with h5py.File(tmp_path / f"a{number}.h5", "w") as file:
            made = file.create_dataset("u", (2, 4, 3, 5), "f4", chunks=(1, 4, 3, 5))
            made[: 1 if number == 1 else 2] = 2
    found = told(tmp_path / "a*.h5")
    assert found is not None
    assert found.shares.tolist() == [0, 0, 0, 1, 0, 0]


@pytest.mark.parametrize("consolidated", [False, True])
@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"zarr_format": 2}, "3.0.0.0"),
        ({"zarr_format": 2, "chunk_key_encoding": {"name": "v2", "separator": "/"}}, "3/0/0/0"),
        ({"zarr_format": 3}, "c/3/0/0/0"),
        ({"zarr_format": 3, "chunk_key_encoding": {"name": "v2", "separator": "."}}, "3.0.0.0"),
    ],
)
def test_chunks_that_a_zarr_store_lacks_are_told(
    tmp_path: Path, options: dict[str, Any], key: str, consolidated: bool
) -> None:
    path = tmp_path / "a.zarr"
    group = zarr.open_group(path, mode="w", zarr_format=options["zarr_format"])
    rest = {name: value for name, value in options.items() if name != "zarr_format"}
    made = group.create_array(
        "u", shape=VALUES.shape, dtype="f4", chunks=(1, 4, 3, 5), fill_value=1.5, **rest
    )
    made[...] = VALUES
    if consolidated:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(path)
    assert told(path) is None
    (path / "u" / key).unlink()
    found = told(path)
    assert found is not None
    assert (found.shares.tolist(), found.fill) == ([0, 0, 0, 1, 0, 0], 1.5)
    assert told(path, missing=[1.5]) is None


@pytest.mark.parametrize("where", ["start", "end"])
def test_chunks_that_a_shard_lacks_are_told(tmp_path: Path, where: str) -> None:
    path = tmp_path / "a.zarr"
    shards = {"shape": (3, 4, 3, 5), "index_location": where}
    made = zarr.create_array(
        path, shape=VALUES.shape, dtype="f4", chunks=(1, 2, 3, 5), shards=shards, fill_value=0
    )
    made[:4], made[4, :2] = VALUES[:4], VALUES[4, :2]
    found = told(path)
    assert found is not None
    assert found.shares.tolist() == [0, 0, 0, 0, 0.5, 1]


def test_a_fill_value_of_nan_or_of_xarray_is_missing_as_it_is(tmp_path: Path) -> None:
    made = zarr.create_array(
        tmp_path / "a.zarr", shape=VALUES.shape, dtype="f4", chunks=(1, 4, 3, 5), fill_value=np.nan
    )
    made[:5] = VALUES[:5]
    assert told(tmp_path / "a.zarr") is None
    group = zarr.open_group(tmp_path / "b.zarr", mode="w", zarr_format=2)
    made = group.create_array(
        "u", shape=VALUES.shape, dtype="f4", chunks=(1, 4, 3, 5), fill_value=-1
    )
    made[:5] = VALUES[:5]
    made.attrs["_ARRAY_DIMENSIONS"] = ["time", "z", "y", "x"]
    assert told(tmp_path / "b.zarr") is None


@pytest.mark.parametrize("missing", [1, 2])
def test_positions_that_nobody_wrote_are_told(tmp_path: Path, missing: int) -> None:
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=3)
    names = ["time", "z", "y", "x"]
    made = group.create_array(
        "u", shape=VALUES.shape, dtype="f4", chunks=VALUES.shape, dimension_names=names
    )
    made[...] = VALUES
    time = group.create_array("time", shape=6, dtype="f8", chunks=1, dimension_names=["time"])
    time[missing:] = np.arange(missing, 6)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["u"] = VALUES
        file.create_dataset("time", 6, "f8", chunks=(1,))[missing:] = np.arange(missing, 6)
        file["time"].make_scale("time")
        file["u"].dims[0].attach_scale(file["time"])
    for name in ("a.zarr", "a.h5"):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            open_series(tmp_path / name, var="u").close()
        told = {str(each.message) for each in caught}  # positions may be read again
        assert len(told) == missing - 1
        assert all("time: 33.3 % of its values are not stored: read as 0" in text for text in told)


def test_strips_that_a_tiff_lacks_are_told(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, VALUES[0], photometric="minisblack", rowsperstrip=1, metadata=None)
    assert told(path) is None
    with tifffile.TiffFile(path) as file:
        tag = file.pages[1].tags["StripByteCounts"]
        assert (tag.count, tag.dtype) == (3, tifffile.DATATYPE.SHORT)
    data = bytearray(path.read_bytes())
    data[tag.valueoffset : tag.valueoffset + 2] = bytes(2)  # the last three pages share the tag
    path.write_bytes(bytes(data))
    found = told(path)
    assert found is not None
    assert found.share == pytest.approx(3 / 12)


def test_text_of_steps() -> None:
    assert spans_text([[3, 4]]) == "step 3"
    assert spans_text([[0, 5], [7, 8]]) == "steps 0 to 4, 7"
    found = NotStored(shares=np.array([1.0, 0] * 500), fill=0)
    spans = found.spans()
    assert len(spans) == 64
    assert spans[-1] == [126, 999]
    assert json.dumps(spans)
